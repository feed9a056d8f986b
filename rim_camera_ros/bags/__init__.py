"""Recordings: rosbag2 and ROS 1 bags in, rosbag2 out. Needs rosbags and numpy, no ROS installation."""

from __future__ import annotations

from rim_camera_ros.bags.images import decode_image, encode_image
from rim_camera_ros.bags.recording import Recording, RecordingSummary, TopicSummary
from rim_camera_ros.bags.topics import DEFAULT_NAMESPACE, ROLES, Topics
from rim_camera_ros.bags.writer import RecordingWriter

__all__ = [
    "DEFAULT_NAMESPACE",
    "ROLES",
    "Recording",
    "RecordingSummary",
    "RecordingWriter",
    "TopicSummary",
    "Topics",
    "decode_image",
    "encode_image",
]
