"""Frames with poses from serialised messages, as they come; no ROS in here."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

from rim_camera_ros.bags import messages
from rim_camera_ros.bags.pairing import History
from rim_camera_ros.bags.stamp_pairing import IMAGES, READINGS, StampPairing
from rim_camera_ros.bags.topics import POSE_ROLES
from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose, RawFrame
from rim_camera_ros.photogrammetry.board_stations import BoardStations, board_of
from rim_camera_ros.scene import Scene


class Message(NamedTuple):
    """A message (CDR) of a role (see `rim_camera_ros.bags.ROLES`), with the surface's name for a pose."""

    role: str
    surface: str
    kind: str
    data: bytes


def live_frames(incoming: Iterable[Message]) -> Iterator[RawFrame]:
    """Yield the frames of messages, in their order; unreadable ones are skipped."""
    seen: set[str] = set()
    pairing = StampPairing(lambda role: role in seen)
    poses: dict[str, History] = {}
    for one in incoming:
        seen.add(one.role)
        if one.role not in (*IMAGES, *READINGS, "frame_info", *POSE_ROLES):
            continue
        try:
            message = messages.decode(one.data, one.kind)
            stamp = messages.stamp_of(message)
            if one.role in POSE_ROLES:
                read = messages.pose_from if one.role == "truth" else messages.pose_with_covariance_from
                poses.setdefault(one.surface, History()).add(stamp, read(message, one.surface))
                continue
            value = _value(one.role, message)
        except InputError:
            continue  # it stays in the recording, whose reader reports the error
        for frame in pairing.add(one.role, stamp, value, time.monotonic()):
            yield _placed(frame, poses)


def _value(role: str, message: Any) -> Any:
    if role in IMAGES:
        return messages.image_array(message, role=role, place=role)
    if role == "frame_info":
        return messages.settings_from(message, role)
    return messages.range_from(message) if role == "reference" else messages.temperature_from(message)


def _placed(frame: RawFrame, poses: dict[str, History]) -> RawFrame:
    truth: dict[str, Pose] = {}
    stamps: dict[str, int] = {}
    for surface, history in poses.items():
        found = history.latest(frame.stamp)
        if found is not None:
            stamps[surface], truth[surface] = found
            history.forget(frame.stamp)
    return replace(frame, truth=truth, pose_stamps=stamps)


def posed_frames(frames: Iterator[RawFrame], scene: Scene, camera: Camera) -> Iterator[RawFrame]:
    """Yield frames with the poses that the scene takes from a recording.

    These are the published poses, or if there is none at the first frame, those of the scene's board as found
    in the images. Frames that do not show the board, or come before the first pose, are skipped.
    """
    first = next(frames, None)
    if first is None:
        return
    every = itertools.chain([first], frames)
    if any(name not in first.truth for name in scene.needs_truth):
        try:
            board = board_of(scene)
        except InputError:
            board = None
        if board is not None:
            yield from BoardStations(board, camera).frames(every)
            return
    for frame in every:
        if all(name in frame.truth for name in scene.needs_truth):
            yield frame
