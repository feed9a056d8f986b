"""Recordings as drivers publish them: topics, types, encodings of each profile's driver."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rim_camera_ros.bags import messages
from rim_camera_ros.bags.topics import CAMERA_INFO, IMAGE
from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import Intrinsics, RawFrame
from rim_camera_ros.imports.images import COMPRESSED_IMAGE
from test.helpers_bags import JAZZY, Line, to_ros1

START = 1_700_000_000_000_000_000
PERIOD = 33_333_333
SHAPE = (24, 32)

METADATA = "std_msgs/Header header\nstring json_data\n"
EXPOSURES = "std_msgs/Header header\nuint32[] usec\n"

#: An Azure Kinect's depth camera in NFOV, scaled to the images of the tests (published calibrations look so).
RATIONAL = (5.26, 3.61, -1.1e-4, 6.3e-5, 0.19, 5.59, 5.36, 1.02)
#: An O3R head of 105 degrees by 78 has coefficients of this size.
EQUIDISTANT = (0.09, -0.12, 0.08, -0.03)
PLUMB_BOB = (-0.12, 0.21, 1.1e-3, -7e-4, -0.05)

Make = Callable[[Any, str, int], Line]


def depth(index: int = 0) -> Any:
    """Return a tilted wall's depth along z in metres, float64, one pixel without a measurement."""
    rows, columns = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    z = 1.3 + 0.011 * columns - 0.007 * rows + 0.002 * index
    z[3, 5] = 0.0
    return z


def amplitude(index: int = 0) -> Any:
    rows, columns = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    return (400 + 13 * columns + 29 * rows + index).astype(np.uint16)


def image(array: Any, topic: str, stamp: int, encoding: str | None = None) -> Line:
    message = messages.image_message(array, stamp, "optical")
    if encoding is not None:
        message.encoding = encoding
    return Line(topic, IMAGE, stamp, message)


def points_image(array: Any, topic: str, stamp: int) -> Line:
    """Return a 32FC3 image."""
    flat = np.ascontiguousarray(array, "<f4")
    message = messages.image_message(flat[..., 0], stamp, "optical")
    message.encoding, message.step = "32FC3", 12 * array.shape[1]
    message.data = flat.reshape(-1).view(np.uint8)
    return Line(topic, IMAGE, stamp, message)


def packed(data: bytes, form: str, topic: str, stamp: int) -> Line:
    """Return a sensor_msgs/CompressedImage."""
    make: Any = JAZZY.types[COMPRESSED_IMAGE]
    message = make(
        header=messages.header(stamp, "optical"), format=form, data=np.frombuffer(data, np.uint8).copy()
    )
    return Line(topic, COMPRESSED_IMAGE, stamp, message)


def encoded(array: Any, ending: str) -> bytes:
    good, data = cv2.imencode(ending, array)
    assert good
    return bytes(data)


def compressed_depth(array: Any, topic: str, stamp: int, form: str = "16UC1; compressedDepth png") -> Line:
    header = struct.pack("<iff", 0, 0.0, 0.0)
    return packed(header + encoded(array, ".png"), form, f"{topic}/compressedDepth", stamp)


def info(
    topic: str,
    stamp: int,
    *,
    model: str = "plumb_bob",
    d: Iterable[float] = PLUMB_BOB,
    shape: tuple[int, int] = SHAPE,
    focal: tuple[float, float] = (30.5, 31.0),
    centre: tuple[float, float] = (15.2, 12.4),
) -> Line:
    """Return a CameraInfo; P differs from K, as after a rectification."""
    (fx, fy), (cx, cy) = focal, centre
    plain = Intrinsics(width=shape[1], height=shape[0], fx=fx, fy=fy, cx=cx, cy=cy)
    message = messages.camera_info_message(plain, stamp, "optical")
    message.distortion_model, message.d = model, np.array(list(d), np.float64)
    message.p = np.array([fx - 2, 0, cx + 0.5, 0, 0, fy - 1.5, cy - 0.25, 0, 0, 0, 1, 0], np.float64)
    return Line(topic, CAMERA_INFO, stamp, message)


@dataclass
class Own:
    """A message type of the driver's own: its definition, and its fields in addition to the header."""

    msgtype: str
    definition: str
    fields: dict[str, Any] = field(default_factory=dict)


def own_line(own: Own, topic: str, stamp: int, **fields: Any) -> tuple[str, Own, int, dict[str, Any]]:
    return (topic, own, stamp, fields)


def json_text(**values: int) -> str:
    return json.dumps(values, indent=2)


def femto_lines(
    frames: Iterable[RawFrame], camera: Camera, *, distortion: Any = None
) -> tuple[list[Line], list[tuple[str, Own, int, dict[str, Any]]]]:
    """Return what a Femto publishes of frames, and its own messages.

    Depth along z in whole millimetres, compressed, the infrared image 9 ms later, and the exposure.
    ``distortion`` takes the place of the coefficients in the camera_info.
    """
    kind = Own("orbbec_camera_msgs/msg/Metadata", METADATA)
    lines: list[Line] = []
    own = []
    for frame in frames:
        z = frame.distance * camera.sensor.lsb * camera.rays[..., 2]
        facts = messages.camera_info_message(camera.intrinsics, frame.stamp, "optical")
        if distortion is not None:
            facts.d = distortion
        lines += [
            compressed_depth(np.rint(z * 1e3).astype(np.uint16), "/camera/depth/image_raw", frame.stamp),
            image(frame.amplitude, "/camera/ir/image_raw", frame.stamp + 9_000_000, "mono16"),
            Line("/camera/depth/camera_info", CAMERA_INFO, frame.stamp, facts),
        ]
        exposure = json_text(exposure=int(frame.settings.integration_time or 0))
        own.append(own_line(kind, "/camera/depth/metadata", frame.stamp, json_data=exposure))
    return lines, own


def write_driver_bag(
    path: Path, lines: Iterable[Line], own: Iterable[tuple[str, Own, int, dict[str, Any]]] = (), *, ros1: bool
) -> Path:
    """Write what a driver publishes, with its own message types, by rosbags."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    plain = list(lines)
    rows: list[tuple[int, str, str, bytes]] = []
    for line in plain:
        raw = (
            to_ros1(line.message, line.msgtype)
            if ros1
            else bytes(JAZZY.serialize_cdr(line.message, line.msgtype))
        )
        rows.append((line.time, line.topic, line.msgtype, raw))
    for topic, kind, stamp, fields in own:
        if kind.msgtype not in store.fielddefs:
            store.register(get_types_from_msg(kind.definition, kind.msgtype))
        seconds, rest = divmod(stamp, 10**9)
        time = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        seq = {"seq": 0} if ros1 else {}
        header = store.types["std_msgs/msg/Header"](stamp=time, frame_id="optical", **seq)
        message = store.types[kind.msgtype](header=header, **fields)
        raw = bytes(
            store.serialize_ros1(message, kind.msgtype)
            if ros1
            else store.serialize_cdr(message, kind.msgtype)
        )
        rows.append((stamp, topic, kind.msgtype, raw))
    rows.sort(key=lambda row: row[0])
    writer: Any = Bag1Writer(path) if ros1 else Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    connections: dict[str, Any] = {}
    with writer:
        for time, topic, msgtype, raw in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            writer.write(connections[topic], time, raw)
    return path
