"""Conversions between frame data and ROS messages.

The ``*_message`` functions make message objects of the rosbags library. The others read any object with the
fields of the message, also messages of rclpy and of ROS 1 bags; their ``place`` names topic and stamp in
errors.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rim_camera_ros.bags.images import decode_image, encode_image
from rim_camera_ros.bags.topics import (
    CAMERA_INFO,
    CLOUD,
    DIAGNOSTICS,
    IMAGE,
    POSE,
    POSE_WITH_COVARIANCE,
    RANGE,
    TEMPERATURE,
)
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import NANOSECONDS, Intrinsics, Pose, Settings

FRAME_ID = "camera_optical_frame"

_UNIT_TOLERANCE = 1e-6
_FLOAT32 = 7
_POINT_FIELDS = ("x", "y", "z", "intensity")


@cache
def typestore(name: str = "ROS2_JAZZY") -> Typestore:
    """Return the message definitions of a ROS distribution; those inside recordings are not used."""
    return get_typestore(Stores[name])


def _make(msgtype: str, **fields: Any) -> Any:
    make: Any = typestore().types[msgtype]
    return make(**fields)


def split_stamp(stamp: int) -> tuple[int, int]:
    """Return (s, ns) of a stamp in ns; InputError outside the range of ROS stamps."""
    seconds, nanoseconds = divmod(int(stamp), NANOSECONDS)
    if not 0 <= seconds < 2**31:
        raise InputError(f"the stamp {stamp} ns is outside what a ROS message holds")
    return seconds, nanoseconds


def stamp_text(stamp: int) -> str:
    """Return a stamp in ns as text in seconds."""
    seconds, nanoseconds = divmod(stamp, NANOSECONDS)
    return f"{seconds}.{nanoseconds:09d} s"


def stamp_of(message: Any) -> int:
    """Return the stamp of a message's header in ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def header(stamp: int, frame_id: str) -> Any:
    """Return a std_msgs/Header; ``stamp`` in ns."""
    seconds, nanoseconds = split_stamp(stamp)
    time = _make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return _make("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def image_message(array: NDArray[Any], stamp: int, frame_id: str = FRAME_ID) -> Any:
    """Return a sensor_msgs/Image of a uint8, uint16 or float32 array; ``stamp`` in ns.

    Raises InputError for another type of array.
    """
    image = encode_image(array)
    return _make(
        IMAGE,
        header=header(stamp, frame_id),
        height=image.height,
        width=image.width,
        encoding=image.encoding,
        is_bigendian=int(image.is_bigendian),
        step=image.step,
        data=image.data,
    )


def image_array(
    message: Any, *, role: str | None = None, place: str | None = None, mono8_amplitude: bool = False
) -> NDArray[Any]:
    """Return the pixels of a sensor_msgs/Image; raises InputError as `decode_image` does."""
    return decode_image(
        message.encoding,
        message.height,
        message.width,
        message.step,
        message.is_bigendian,
        message.data,
        role=role,
        place=place,
        mono8_amplitude=mono8_amplitude,
    )


def camera_info_message(intrinsics: Intrinsics, stamp: int, frame_id: str = FRAME_ID) -> Any:
    """Return a sensor_msgs/CameraInfo (plumb_bob, no rectification); ``stamp`` in ns."""
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    region = _make(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return _make(
        CAMERA_INFO,
        header=header(stamp, frame_id),
        height=intrinsics.height,
        width=intrinsics.width,
        distortion_model="plumb_bob",
        d=np.array(intrinsics.d, np.float64),
        k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], np.float64),
        r=np.array([1, 0, 0, 0, 1, 0, 0, 0, 1], np.float64),
        p=np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], np.float64),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def intrinsics_from(message: Any, place: str | None = None) -> tuple[Intrinsics | None, str]:
    """Return the intrinsics of a sensor_msgs/CameraInfo, or None and why they are not used.

    Raises InputError for numbers that are not finite.
    """
    k = [float(x) for x in (message.k if hasattr(message, "k") else message.K)]
    d = tuple(float(x) for x in (message.d if hasattr(message, "d") else message.D))
    if len(k) != 9 or not all(map(math.isfinite, (*k, *d))):
        raise InputError("the camera matrix or D is not finite", place=place, remedy="calibrate the camera")
    if k[0] == 0.0:
        return None, "camera_info is of an uncalibrated camera (K is 0) and not used"
    if message.distortion_model not in ("plumb_bob", ""):
        return None, f"camera_info has the distortion model {message.distortion_model} and is not used"
    width, height = int(message.width), int(message.height)
    return Intrinsics(width=width, height=height, fx=k[0], fy=k[4], cx=k[2], cy=k[5], d=d), ""


def _number(value: float) -> str:
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else repr(float(value))


def frame_info_message(settings: Settings, stamp: int, device: str = "", frame_id: str = FRAME_ID) -> Any:
    """Return the frame_info message (diagnostic_msgs/DiagnosticArray, one status); ``stamp`` in ns."""
    pairs: dict[str, str] = {}
    if settings.integration_time is not None:
        pairs["integration_time"] = _number(settings.integration_time)
    if settings.modulation_frequency is not None:
        pairs["modulation_frequency"] = _number(settings.modulation_frequency)
    if settings.uptime is not None:
        pairs["uptime"] = _number(settings.uptime)
    for key, value in settings.extra.items():
        pairs.setdefault(str(key), str(value))
    values = [_make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in pairs.items()]
    status = _make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=0,
        name="frame_info",
        message="",
        hardware_id=device,
        values=values,
    )
    return _make(DIAGNOSTICS, header=header(stamp, frame_id), status=[status])


def settings_from(message: Any, place: str | None = None) -> tuple[Settings, str]:
    """Return settings and device name of a frame_info message.

    If a key occurs twice the first counts. Raises InputError for a value that is not a finite number, an
    integration time or modulation frequency that is not positive, and a negative uptime.
    """
    pairs: dict[str, str] = {}
    device = ""
    for status in message.status:
        device = device or str(status.hardware_id)
        for pair in status.values:
            pairs.setdefault(str(pair.key), str(pair.value))

    def number(key: str) -> float | None:
        text = pairs.pop(key, None)
        return None if text is None else _setting(key, text, place)

    settings = Settings(
        integration_time=number("integration_time"),
        modulation_frequency=number("modulation_frequency"),
        uptime=number("uptime"),
        extra=pairs,
    )
    return settings, device


def _setting(key: str, text: str, place: str | None) -> float:
    where = f"{place}, {key}" if place else key
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"'{text}' is not a number", place=where)
    if value < 0 or (value == 0 and key != "uptime"):
        word = "0 or more" if key == "uptime" else "positive"
        raise InputError(f"{text} is not {word}", place=where, remedy="correct it where it was recorded")
    return value


def temperature_message(value: float | None, stamp: int, frame_id: str = FRAME_ID) -> Any:
    """Return a sensor_msgs/Temperature; ``value`` in degC, None becomes NaN; ``stamp`` in ns."""
    number = math.nan if value is None else float(value)
    return _make(TEMPERATURE, header=header(stamp, frame_id), temperature=number, variance=0.0)


def temperature_from(message: Any) -> float | None:
    """Return a sensor_msgs/Temperature in degC, None if it is not finite."""
    value = float(message.temperature)
    return value if math.isfinite(value) else None


def range_message(value: float | None, stamp: int, frame_id: str = FRAME_ID) -> Any:
    """Return a sensor_msgs/Range of the reference path; ``value`` in m, None becomes NaN; ``stamp`` in ns.

    The message has float32, to which the value is rounded.
    """
    return _make(
        RANGE,
        header=header(stamp, frame_id),
        radiation_type=1,
        field_of_view=0.0,
        min_range=0.0,
        max_range=math.inf,
        range=math.nan if value is None else float(value),
        variance=0.0,
    )


def range_from(message: Any) -> float | None:
    """Return a sensor_msgs/Range in m, None if it is not finite."""
    value = float(message.range)
    return value if math.isfinite(value) else None


def pose_message(pose: Pose, stamp: int, frame_id: str = FRAME_ID) -> Any:
    """Return a geometry_msgs/PoseStamped; ``stamp`` in ns."""
    return _make(POSE, header=header(stamp, frame_id), pose=_pose_fields(pose))


def pose_with_covariance_message(pose: Pose, stamp: int, frame_id: str = FRAME_ID) -> Any:
    """Return a geometry_msgs/PoseWithCovarianceStamped of a pose that has a covariance; ``stamp`` in ns."""
    assert pose.covariance is not None
    both = _make(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=_pose_fields(pose),
        covariance=np.array(pose.covariance, np.float64),
    )
    return _make(POSE_WITH_COVARIANCE, header=header(stamp, frame_id), pose=both)


def _pose_fields(pose: Pose) -> Any:
    x, y, z = pose.position
    position = _make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z))
    x, y, z, w = pose.orientation
    turn = _make("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w))
    return _make("geometry_msgs/msg/Pose", position=position, orientation=turn)


def pose_with_covariance_from(message: Any, place: str | None = None) -> Pose:
    """Return a geometry_msgs/PoseWithCovarianceStamped.

    Raises InputError as `pose_from` does, and for an invalid covariance.
    """
    pose = pose_from(message.pose, place)
    matrix = np.array(message.pose.covariance, np.float64).reshape(6, 6)
    remedy = "36 numbers row by row: x y z in m, rotations about x y z in rad"
    if not np.isfinite(matrix).all():
        raise InputError("the covariance of the pose is not finite", place=place, remedy=remedy)
    matrix = (matrix + matrix.T) / 2
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    unit = np.where(scale > 0, scale, 1.0)
    if np.diag(matrix).min() < 0 or np.linalg.eigvalsh(matrix / np.outer(unit, unit))[0] < -1e-6:
        raise InputError("the covariance of the pose has a negative variance", place=place, remedy=remedy)
    return replace(pose, covariance=tuple(matrix.ravel().tolist()))


def pose_from(message: Any, place: str | None = None) -> Pose:
    """Return a geometry_msgs/PoseStamped; a quaternion that is not of length 1 is normalised.

    Raises InputError for numbers that are not finite and a quaternion of length 0.
    """
    p, q = message.pose.position, message.pose.orientation
    position = (float(p.x), float(p.y), float(p.z))
    turn = (float(q.x), float(q.y), float(q.z), float(q.w))
    if not all(map(math.isfinite, (*position, *turn))):
        raise InputError("the pose is not finite", place=place)
    length = math.hypot(*turn)
    if length < _UNIT_TOLERANCE or not math.isfinite(length):
        raise InputError("the quaternion of the pose has no direction", place=place)
    if abs(length - 1.0) > _UNIT_TOLERANCE:
        turn = (turn[0] / length, turn[1] / length, turn[2] / length, turn[3] / length)
    return Pose(position, turn)


def points_message(points: NDArray[np.float32], stamp: int, frame_id: str = FRAME_ID) -> Any:
    """Return an organised sensor_msgs/PointCloud2 of 16 bytes a point; ``stamp`` in ns.

    ``points`` (H, W, 4): x y z in metres (NaN where invalid) and intensity in counts.
    Raises InputError for another shape.
    """
    if points.ndim != 3 or points.shape[2] != len(_POINT_FIELDS) or points.size == 0:
        raise InputError(f"points of shape {points.shape}", remedy="(height, width, 4): x y z intensity")
    height, width, _ = points.shape
    plain = np.ascontiguousarray(points, dtype="<f4")
    fields = [
        _make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=_FLOAT32, count=1)
        for i, name in enumerate(_POINT_FIELDS)
    ]
    return _make(
        CLOUD,
        header=header(stamp, frame_id),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=16,
        row_step=16 * width,
        data=plain.reshape(-1).view(np.uint8),
        is_dense=False,
    )


def points_array(message: Any, place: str | None = None) -> NDArray[np.float32]:
    """Return x y z intensity of a cloud as made by `points_message` as (H, W, 4) float32.

    Further fields are not read. Raises InputError for a cloud that begins with other fields, or has another
    layout.
    """
    fields = [(str(f.name), int(f.offset), int(f.datatype)) for f in message.fields]
    expected = [(name, 4 * i, _FLOAT32) for i, name in enumerate(_POINT_FIELDS)]
    if fields[: len(expected)] != expected:
        raise InputError(
            f"the cloud's fields are {_names(fields)}", place=place, remedy="x y z intensity float32"
        )
    height, width = int(message.height), int(message.width)
    flat = np.frombuffer(message.data, np.uint8)
    step = int(message.point_step)
    packed = step == 16 if len(fields) == len(expected) else step > 16 and step % 4 == 0
    if not packed or message.row_step != step * width or flat.size != step * width * height:
        raise InputError("the cloud is not packed in 16 bytes a point", place=place)
    points = flat.view(">f4" if message.is_bigendian else "<f4").reshape(height, width, step // 4)
    return np.ascontiguousarray(points[..., :4], np.float32)


def _names(fields: Iterable[tuple[str, int, int]]) -> str:
    return " ".join(name for name, _, _ in fields) or "missing"


def decode(raw: bytes, msgtype: str, *, ros1: bool = False, place: str | None = None) -> Any:
    """Return the message object of serialised bytes (CDR, or ROS 1's).

    A sensor_msgs/Range of ROS 2 before Iron, which has one field less, is read, too.
    Raises InputError for bytes that are not such a message.
    """
    stores = (
        ("ROS1_NOETIC",) if ros1 else ("ROS2_JAZZY", "ROS2_HUMBLE") if msgtype == RANGE else ("ROS2_JAZZY",)
    )
    problem = ""
    for name in stores:
        store = typestore(name)
        try:
            return store.deserialize_ros1(raw, msgtype) if ros1 else store.deserialize_cdr(raw, msgtype)
        except Exception as error:  # the generated decoders may raise anything for damaged bytes
            problem = problem or f"{type(error).__name__} {error}"
    raise InputError(
        f"a message of type {msgtype} cannot be decoded: {problem}",
        place=place,
        remedy="the recording is damaged; record it again",
    )


def encode(message: Any, msgtype: str) -> memoryview:
    """Return the CDR bytes of a message object of rosbags."""
    return typestore().serialize_cdr(message, msgtype)
