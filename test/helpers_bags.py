"""Recordings made message by message, for the tests of rim_camera_ros.bags."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from rim_camera_ros.bags import messages
from rim_camera_ros.bags.topics import CAMERA_INFO, DIAGNOSTICS, IMAGE, POSE, RANGE, TEMPERATURE
from rim_camera_ros.frame import Intrinsics, Pose, RawFrame, Settings

SHARED = Path(__file__).parents[2] / "shared"
START = 1_700_000_000_123_456_789
STEP = 40_000_000
SIZE = (3, 5)

JAZZY = get_typestore(Stores.ROS2_JAZZY)
NOETIC = get_typestore(Stores.ROS1_NOETIC)

INTRINSICS = Intrinsics(
    width=SIZE[1], height=SIZE[0], fx=199.8875, fy=201.5, cx=2.25, cy=0.75, d=(-0.1, 0.05, 1e-3, -2e-3, 0.25)
)
POSE_A = Pose((0.1, -0.2, 1.3), (0.1, 0.2, 0.4, 0.8888194417315589))
POSE_B = Pose((-0.4, 0.5, 2.6))


@dataclass
class Line:
    """One message of a recording: topic, type, time of recording in ns, message."""

    topic: str
    msgtype: str
    time: int
    message: Any


def stamp_at(index: int) -> int:
    return START + index * STEP


def pixels(index: int, size: tuple[int, int] = SIZE, dtype: Any = np.uint16) -> Any:
    """Return pixels that differ in every row, column and frame."""
    height, width = size
    grid = np.arange(height)[:, None] * 1000 + np.arange(width)[None, :] * 7 + index * 3 + 258
    return grid.astype(dtype)


def image(
    topic: str, index: int, *, offset: int = 0, size: tuple[int, int] = SIZE, dtype: Any = np.uint16
) -> Line:
    stamp = stamp_at(index)
    return Line(topic, IMAGE, stamp, messages.image_message(pixels(index + offset, size, dtype), stamp))


def pair(index: int, namespace: str = "/camera", size: tuple[int, int] = SIZE) -> list[Line]:
    """Return distance and amplitude of one exposure."""
    return [
        image(f"{namespace}/distance/image_raw", index, size=size),
        image(f"{namespace}/amplitude/image_raw", index, offset=500, size=size),
    ]


def frame_info(index: int, settings: Settings, topic: str = "/camera/frame_info") -> Line:
    stamp = stamp_at(index)
    return Line(topic, DIAGNOSTICS, stamp, messages.frame_info_message(settings, stamp, "SR-3000 7"))


def camera_info(index: int, intrinsics: Intrinsics = INTRINSICS, topic: str = "/camera/camera_info") -> Line:
    stamp = stamp_at(index)
    return Line(topic, CAMERA_INFO, stamp, messages.camera_info_message(intrinsics, stamp))


def pose(stamp: int, value: Pose, surface: str = "board", time: int | None = None) -> Line:
    message = messages.pose_message(value, stamp)
    return Line(f"/ground_truth/{surface}/pose", POSE, stamp if time is None else time, message)


def temperature(stamp: int, value: float, topic: str = "/camera/temperature") -> Line:
    return Line(topic, TEMPERATURE, stamp, messages.temperature_message(value, stamp))


def reference(stamp: int, value: float) -> Line:
    return Line("/camera/reference", RANGE, stamp, messages.range_message(value, stamp))


def exposure(index: int, size: tuple[int, int] = SIZE) -> list[Line]:
    """Return all four messages of one exposure."""
    settings = Settings(integration_time=16.0, modulation_frequency=20e6, uptime=0.5 + index, extra={})
    intrinsics = replace(INTRINSICS, height=size[0], width=size[1])
    return [*pair(index, size=size), camera_info(index, intrinsics), frame_info(index, settings)]


def flat(groups: Iterable[Sequence[Line]]) -> list[Line]:
    return [line for group in groups for line in group]


def write_bag(
    path: Path,
    lines: Iterable[Line],
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """Write a rosbag2 folder with the library itself."""
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression != CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with writer:
        for line in lines:
            if line.topic not in connections:
                connections[line.topic] = writer.add_connection(line.topic, line.msgtype, typestore=JAZZY)
            writer.write(connections[line.topic], line.time, JAZZY.serialize_cdr(line.message, line.msgtype))
    return path


def to_ros1(message: Any, msgtype: str) -> bytes:
    """Return a message of ROS 2 in the serialisation of ROS 1."""
    return bytes(NOETIC.serialize_ros1(_as_ros1(message), msgtype))


def _as_ros1(value: Any) -> Any:
    """Rebuild a message with the classes of ROS 1: headers have seq, camera_info capital letters."""
    if isinstance(value, list):
        return [_as_ros1(one) for one in value]
    kind = getattr(value, "__msgtype__", None)
    if kind is None:
        return value
    fields = {
        name: _as_ros1(getattr(value, name))
        for name, _ in JAZZY.fielddefs[kind][1]
        if name != "variance" or kind != RANGE
    }
    if kind == "std_msgs/msg/Header":
        fields["seq"] = 0
    if kind == CAMERA_INFO:
        for name in "dkrp":
            fields[name.upper()] = fields.pop(name)
    make: Any = NOETIC.types[kind]
    return make(**fields)


def write_bag1(path: Path, lines: Iterable[Line], compression: str | None = None) -> Path:
    """Write a ROS 1 bag with the library itself."""
    writer = Bag1Writer(path)
    if compression:
        writer.set_compression(Bag1Writer.CompressionFormat[compression])
    connections: dict[str, Any] = {}
    with writer:
        for line in lines:
            if line.topic not in connections:
                connections[line.topic] = writer.add_connection(line.topic, line.msgtype, typestore=NOETIC)
            writer.write(connections[line.topic], line.time, to_ros1(line.message, line.msgtype))
    return path


def raw_frame(index: int, **changes: Any) -> RawFrame:
    """Return a frame with every field set and different from its neighbours."""
    frame = RawFrame(
        stamp=stamp_at(index),
        distance=pixels(index),
        amplitude=pixels(index + 500),
        settings=Settings(
            integration_time=16.0 + index,
            modulation_frequency=20e6,
            uptime=0.1 + index / 3,
            body_temperature=31.1 + index // 2,
            ambient_temperature=20.3,
            reference_distance=0.25,
            extra={"mode": "raw", "frame": str(index)},
        ),
        truth={"board": POSE_A if index < 2 else POSE_B, "wall": POSE_B},
        pose_stamps={"board": START - 1000 if index < 2 else stamp_at(2), "wall": START},
        intrinsics=INTRINSICS,
        device="SR-3000 7",
    )
    return replace(frame, **changes)


def same_frame(a: RawFrame, b: RawFrame) -> bool:
    """Whether two frames are equal in every bit."""
    others = ("stamp", "settings", "truth", "pose_stamps", "intrinsics", "device")
    return (
        all(getattr(a, name) == getattr(b, name) for name in others)
        and a.distance.dtype == b.distance.dtype
        and a.amplitude.dtype == b.amplitude.dtype
        and a.distance.tobytes() == b.distance.tobytes()
        and a.amplitude.tobytes() == b.amplitude.tobytes()
        and a.shape == b.shape
    )
