"""Frames -> messages of rclpy, and images back, on the fast path of their byte arrays."""

from __future__ import annotations

import dataclasses
import re
from array import array
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
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
    return Image(
        header=head,
        height=encoded.height,
        width=encoded.width,
        encoding=encoded.encoding,
        is_bigendian=0,
        step=encoded.step,
        data=_bytes(encoded.data),
    )


def cloud(points: NDArray[np.float32], head: Header) -> PointCloud2:
    """Return an organised cloud of (H, W, 4) float32: x y z [m], intensity [counts]; 16 bytes a point."""
    height, width, _ = points.shape
    plain = np.ascontiguousarray(points, "<f4")
    return PointCloud2(
        header=head,
        height=height,
        width=width,
        fields=_POINT_FIELDS,
        is_bigendian=False,
        point_step=16,
        row_step=16 * width,
        data=_bytes(plain),
        is_dense=False,
    )


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
    """Return the rclpy message of a message object of rosbags: what is published is what is recorded."""
    kind = ros_class(message.__msgtype__)
    return kind(**{one.name: _value(getattr(message, one.name)) for one in dataclasses.fields(message)})


@cache
def ros_class(name: str) -> Any:
    """Return the rclpy class of a message type such as ``sensor_msgs/msg/Image``."""
    package, _, rest = name.partition("/")
    return getattr(import_module(f"{package}.msg"), rest.rpartition("/")[2])


@cache
def _camera_info(intrinsics: Intrinsics) -> CameraInfo:
    message: CameraInfo = to_ros(recorded.camera_info_message(intrinsics, 0, ""))
    return message


def _value(value: Any) -> Any:
    if hasattr(value, "__msgtype__"):
        return to_ros(value)
    if isinstance(value, list):
        return [_value(one) for one in value]
    return value


def _bytes(values: NDArray[Any]) -> array[int]:
    # any other type is checked element by element by the message's setter
    data = array("B")
    data.frombytes(memoryview(values).cast("B"))
    return data


def topic_part(name: str) -> str:
    """Return a surface's name as part of a topic: letters, digits and _ only, no digit first."""
    text = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return f"_{text}" if not text or text[0].isdigit() else text
