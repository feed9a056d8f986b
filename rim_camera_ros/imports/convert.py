"""Conversion of a driver's recording into one of this package."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from rim_camera_ros.bags import RecordingWriter, messages
from rim_camera_ros.bags.storage import unpack_message
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.imports.reading import DriverRecording

#: Topics that are copied unchanged: poses of surfaces by a reference instrument.
_TRUTH = "/ground_truth/"


@dataclass(frozen=True)
class Imported:
    """Numbers of frames and of messages with true poses that were written."""

    frames: int
    poses: int


def convert(
    recording: DriverRecording,
    out: Path,
    *,
    force: bool,
    counted: Callable[[Iterable[RawFrame]], Iterator[RawFrame]],
) -> Imported:
    """Write the frames of a prepared recording, and the true poses in it, as a recording of this package.

    ``counted`` wraps the frames, to show progress. Raises `RimError` where it cannot be written, `InputError`
    for a wrong message or a recording without a frame.
    """
    frames = 0
    with RecordingWriter(out, force=force, frame_id=recording.frame_id) as writer:
        poses = _copy_truth(recording, writer)
        for frame in counted(recording.frames()):
            writer.write_raw(frame)
            frames += 1
        if not frames:
            raise InputError("no frame in it", file=recording.path, remedy="record it again")
    return Imported(frames, poses)


def _copy_truth(recording: DriverRecording, writer: RecordingWriter) -> int:
    storage = recording.storage
    types = {name: kind for name, kind in recording.types.items() if name.startswith(_TRUTH)}
    if not types:
        return 0
    count = 0
    for message in storage.messages(types):
        kind = types[message.topic]
        raw = unpack_message(message, recording.path)
        try:
            data = bytes(messages.typestore().ros1_to_cdr(raw, kind)) if storage.ros1 else raw
        except Exception as error:  # the generated converters may raise anything for damaged bytes
            place = f"topic {message.topic}, recorded at {messages.stamp_text(message.time)}"
            raise InputError(
                f"a message of type {kind} is damaged: {type(error).__name__}",
                file=recording.path,
                place=place,
                remedy="record it again",
            ) from None
        writer.write_serialised("truth", message.topic, kind, message.time, bytes(data))
        count += 1
    return count
