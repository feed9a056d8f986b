"""Frames -> messages of rclpy, and images back, on the fast path of their byte arrays."""

from __future__ import annotations

import re
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import Header

from rim_camera_ros.bags import messages as recorded
from rim_camera_ros.bags.images import encode_image
from rim_camera_ros.frame import Intrinsics, Pose, Settings

_POINT_FIELDS = [
    PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
    for i, name in enumerate(("x", "y", "z", "intensity"))
]

#: Readers of the fields of a message, the same as for recordings.
stamp_of = recorded.stamp_of
image_array = recorded.image_array
intrinsics_from = recorded.intrinsics_from
settings_from = recorded.settings_from
temperature_from = recorded.temperature_from
range_from = recorded.range_from


def header(stamp: int, frame_id: str) -> Header:
    """Return a header; ``stamp`` in ns. Raises `InputError` for a stamp that no message can hold."""
    seconds, nanoseconds = recorded.split_stamp(stamp)
    result = Header(frame_id=frame_id)
    result.stamp.sec, result.stamp.nanosec = seconds, nanoseconds
    return result


def image(pixels: NDArray[Any], head: Header) -> Image:
    """Return an image of uint8, uint16 or float32 pixels (H, W); `InputError` for others."""
    encoded = encode_image(pixels)
    message = Image(
        header=head,
        height=encoded.height,
        width=encoded.width,
        encoding=encoded.encoding,
        is_bigendian=0,
        step=encoded.step,
    )
    _fill(message, encoded.data)
    return message


class CloudMessage:
    """The message of an organised cloud whose bytes are written in place, frame by frame.

    ``points`` (H, W, 4) float32: x y z [m], intensity [counts], to be written before `of` is called. The same
    message is used each time: it must be published before the next points are written.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        zeros = np.zeros((*shape, len(_POINT_FIELDS)), "<f4")
        self._message = _cloud(zeros, _POINT_FIELDS)
        self.points = np.frombuffer(self._message.data, "<f4").reshape(zeros.shape)

    def of(self, head: Header) -> PointCloud2:
        """Return the message with a header."""
        self._message.header = head
        return self._message


def cloud(
    points: NDArray[np.float32],
    head: Header,
    *,
    sigma: NDArray[np.float32] | None = None,
    flags: NDArray[np.uint8] | None = None,
) -> PointCloud2:
    """Return an organised cloud of (H, W, 4) float32: x y z [m], intensity [counts]; 16 bytes a point.

    ``sigma`` (H, W) [m] adds a float32, ``flags`` (H, W) a uint8 in four bytes.
    """
    plain = np.ascontiguousarray(points, "<f4")
    fields = list(_POINT_FIELDS)
    for name, values in (("sigma", sigma), ("flags", flags)):
        if values is None:
            continue
        kind = PointField.UINT8 if name == "flags" else PointField.FLOAT32
        fields.append(PointField(name=name, offset=4 * plain.shape[2], datatype=kind, count=1))
        # the bytes of integers are stored as they are: nothing treats them as floats
        column = values.astype("<u4").view("<f4") if name == "flags" else values.astype("<f4", copy=False)
        plain = np.dstack([plain, column])
    message = _cloud(np.ascontiguousarray(plain), fields)
    message.header = head
    return message


def _cloud(points: NDArray[np.float32], fields: list[PointField]) -> PointCloud2:
    height, width, columns = points.shape
    message = PointCloud2(
        height=height,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=4 * columns,
        row_step=4 * columns * width,
        is_dense=False,
    )
    _fill(message, points)
    return message


def compressed_image(format_and_data: tuple[str, bytes], head: Header) -> CompressedImage:
    """Return a compressed image of what `compression` returns."""
    message = CompressedImage(header=head, format=format_and_data[0])
    message.data.frombytes(format_and_data[1])
    return message


def camera_info(intrinsics: Intrinsics, head: Header) -> CameraInfo:
    """Return a camera_info (plumb_bob, without rectification)."""
    message = _camera_info(intrinsics)
    message.header = head
    return message


def frame_info(settings: Settings, stamp: int, device: str, frame_id: str) -> Any:
    """Return the frame_info message of a frame; ``stamp`` in ns."""
    return to_ros(recorded.frame_info_message(settings, stamp, device, frame_id))


def temperature(value: float | None, stamp: int, frame_id: str) -> Any:
    """Return a temperature message; ``value`` in degC, ``stamp`` in ns."""
    return to_ros(recorded.temperature_message(value, stamp, frame_id))


def reference(value: float | None, stamp: int, frame_id: str) -> Any:
    """Return the message of the internal reference path; ``value`` in m, ``stamp`` in ns."""
    return to_ros(recorded.range_message(value, stamp, frame_id))


def pose(value: Pose, stamp: int, frame_id: str) -> Any:
    """Return a pose message; lengths in m, ``stamp`` in ns."""
    return to_ros(recorded.pose_message(value, stamp, frame_id))


def to_ros(message: Any) -> Any:
    """Return the rclpy message of a message object of rosbags: published messages are those of recordings."""
    kind = ros_class(message.__msgtype__)
    types = kind.get_fields_and_field_types()
    return kind(**{name: _value(getattr(message, name), of) for name, of in types.items()})


@cache
def ros_class(name: str) -> Any:
    """Return the rclpy class of a message type such as ``sensor_msgs/msg/Image``."""
    package, _, rest = name.partition("/")
    return getattr(import_module(f"{package}.msg"), rest.rpartition("/")[2])


@cache
def _camera_info(intrinsics: Intrinsics) -> CameraInfo:
    message: CameraInfo = to_ros(recorded.camera_info_message(intrinsics, 0, ""))
    return message


def _value(value: Any, kind: str) -> Any:
    if hasattr(value, "__msgtype__"):
        return to_ros(value)
    if kind == "octet":  # rclpy wants bytes, and sends 0xff for a number
        return bytes([value])
    if isinstance(value, list):
        return [_value(one, "") for one in value]
    return value.tolist() if kind.startswith("sequence") and isinstance(value, np.ndarray) else value


def _fill(message: Any, values: NDArray[Any]) -> None:
    # an assigned value would be copied once more, or checked byte by byte (ROS_PYTHON_CHECK_FIELDS)
    message.data.frombytes(memoryview(values).cast("B"))


def topic_part(name: str) -> str:
    """Return a surface's name as part of a topic: letters, digits and _ only, no digit first."""
    text = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return f"_{text}" if not text or text[0].isdigit() else text
