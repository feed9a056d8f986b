"""Recordings: rosbag2 and ROS 1 bags in, rosbag2 out. Needs rosbags and numpy, no ROS installation.

Readers and writers are imported on first use, so that a node that only names topics starts faster.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rim_camera_ros.bags.images import decode_image, encode_image
from rim_camera_ros.bags.topics import DEFAULT_NAMESPACE, KNOWN_ROLES, ROLES, Topics

if TYPE_CHECKING:
    from rim_camera_ros.bags.recording import Recording, RecordingSummary, TopicSummary
    from rim_camera_ros.bags.writer import RecordingWriter

__all__ = [
    "DEFAULT_NAMESPACE",
    "KNOWN_ROLES",
    "ROLES",
    "Recording",
    "RecordingSummary",
    "RecordingWriter",
    "TopicSummary",
    "Topics",
    "decode_image",
    "encode_image",
]

_LATER = {
    "Recording": "recording",
    "RecordingSummary": "recording",
    "TopicSummary": "recording",
    "RecordingWriter": "writer",
}


def __getattr__(name: str) -> Any:
    module = _LATER.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{module}"), name)
