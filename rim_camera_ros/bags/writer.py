"""Writing of recordings: rosbag2 folders with mcap, completely or not at all."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Callable, Iterator
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from rim_camera_ros.bags import mcap, messages
from rim_camera_ros.bags.bag1 import BAG1_MAGIC
from rim_camera_ros.bags.compress import ZSTD_MAGIC
from rim_camera_ros.bags.images import ENCODINGS
from rim_camera_ros.bags.storage import METADATA, SQLITE_MAGIC
from rim_camera_ros.bags.topics import CAMERA_INFO, KNOWN_ROLES, POSE_ROLES, ROLES, SAMPLES, Topics
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.frame import CorrectedFrame, Intrinsics, Pose, RawFrame, Settings
from rim_camera_ros.temporary import Temporary, temporary_folder

if TYPE_CHECKING:
    from typing import Self

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DATA = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_PARTS = (*_DATA, ".db3-wal", ".db3-shm")
_MAGICS = (mcap.MAGIC, SQLITE_MAGIC, BAG1_MAGIC, ZSTD_MAGIC)
_FOREVER = QosTime(9223372036, 854775807)


def _qos(topic_role: str | None) -> list[Qos]:
    """Return the QoS for playback: reliable, for every subscriber; poses also for late subscribers."""
    latched = topic_role in POSE_ROLES
    return [
        Qos(
            QosHistory.KEEP_LAST,
            1 if latched else 10,
            QosReliability.RELIABLE,
            QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
            _FOREVER,
            _FOREVER,
            QosLiveliness.AUTOMATIC,
            _FOREVER,
            False,
        )
    ]


class RecordingWriter:
    """Writes a recording (rosbag2, mcap) that appears at ``path`` only once it is complete.

    A context manager. Files are first written to a hidden folder in the same folder as ``path``, which is
    removed if there is an exception. An existing output is an error unless ``force``; then it is replaced at
    the end, provided it is a recording and nothing else. Times of recording are the stamps of the frames.

    Entering raises InputError for a path that exists or cannot be written. Writing and leaving raise RimError
    when the disk is full or fails, and InputError for frames that do not fit a message. Leaving raises
    RimError when nothing was written. In all these cases no files remain.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        topics: Topics | None = None,
        force: bool = False,
        frame_id: str = messages.FRAME_ID,
    ) -> None:
        self.path = Path(path)
        self.topics = topics if topics is not None else Topics()
        self.force = force
        self.frame_id = frame_id
        self.message_count = 0
        self._writer: Writer | None = None
        self._work: Temporary | None = None
        self._connections: dict[str, Connection] = {}
        self._last_values: dict[str, float | None] = {}
        self._poses: dict[str, tuple[Pose, int]] = {}
        self._done: set[str] = set()
        self._stamp: int | None = None

    def __enter__(self) -> Self:
        self._check_target()
        with self._faults():
            self._work = temporary_folder(self._parent, self.path.name)
            self._writer = Writer(
                self._work.path / self.path.name, version=9, storage_plugin=StoragePlugin.MCAP
            )
            self._writer.open()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if exc_type is not None:
            self._discard()
            return
        if self._work is None:
            return
        with self._faults():
            if self.message_count == 0:
                raise RimError("no message came: nothing was written", file=self.path)
            assert self._writer is not None
            self._writer.close()
            self._writer = None
            self._put_in_place()

    def write_raw(self, frame: RawFrame) -> None:
        """Write a frame as the camera delivers it, with its settings, geometry, readings and poses.

        Temperatures, reference and poses are written when they have changed; poses with their own stamps. The
        reference is rounded to float32, all else is kept exactly.
        """
        self._begin(frame.stamp)
        self._write_truth(frame)
        self._write_settings(frame.settings, frame.stamp, frame.device)
        if frame.intrinsics is not None:
            self._write_intrinsics(frame.intrinsics, frame.stamp, ("distance",))
        for role, image in frame.by_role.items():
            self._write_image(role, image, frame.stamp)

    def write_corrected(
        self,
        frame: CorrectedFrame,
        points: NDArray[np.float32] | None = None,
        depth: NDArray[np.float32] | None = None,
        intrinsics: Intrinsics | None = None,
        raw: RawFrame | None = None,
    ) -> None:
        """Write a frame after the correction.

        ``points`` (H, W, 4): x y z in metres and intensity in counts; ``depth`` (H, W): metres along z;
        ``raw``: the frame that was corrected, whose true poses and device name are written as well.
        Settings, temperatures and camera_info that `write_raw` has written for the same stamp are not
        repeated: write the raw frame first.
        """
        self._begin(frame.stamp)
        if raw is not None:
            self._write_truth(raw)
        self._write_settings(frame.settings, frame.stamp, "" if raw is None else raw.device)
        if intrinsics is not None:
            roles = ("distance",) if depth is None else ("distance", "depth")
            self._write_intrinsics(intrinsics, frame.stamp, roles)
        self._write_image("corrected_distance", frame.distance, frame.stamp)
        self._write_image("sigma", frame.sigma, frame.stamp)
        self._write_image("flags", frame.flags, frame.stamp)
        if depth is not None:
            self._write_image("depth", depth, frame.stamp)
        if points is not None:
            cloud = messages.points_message(points, frame.stamp, self.frame_id)
            self._write_role("points", frame.stamp, cloud)

    def write_message(self, topic: str, msgtype: str, stamp: int, message: Any) -> None:
        """Write any message object of rosbags; ``stamp`` is its time of recording in ns.

        Raises RimError if the topic has been written with another type.
        """
        self._write(topic, msgtype, stamp, message, None)

    def write_serialised(self, role: str, topic: str, msgtype: str, stamp: int, data: bytes) -> None:
        """Write a message as it came from the middleware (CDR); ``stamp``: its time of recording in ns."""
        self._write_bytes(topic, msgtype, stamp, data, role)

    @property
    def _parent(self) -> Path:
        return self.path.absolute().parent

    def _begin(self, stamp: int) -> None:
        if stamp != self._stamp:
            self._stamp = stamp
            self._done.clear()

    def _once(self, what: str) -> bool:
        """Whether something has not been written yet for the present stamp."""
        fresh = what not in self._done
        self._done.add(what)
        return fresh

    def _write_truth(self, frame: RawFrame) -> None:
        for surface, pose in frame.truth.items():
            state = (pose, frame.pose_stamps.get(surface, frame.stamp))
            if self._poses.get(surface) != state:
                self._poses[surface] = state
                self._write_pose(surface, messages.pose_message(pose, state[1], self.frame_id), frame.stamp)
                if pose.covariance is not None:
                    message = messages.pose_with_covariance_message(pose, state[1], self.frame_id)
                    self._write_pose(surface, message, frame.stamp, role="truth_with_covariance")

    def _write_pose(self, surface: str, message: Any, stamp: int, *, role: str = "truth") -> None:
        self._write(self.topics.truth(surface, role=role), ROLES[role][1], stamp, message, role)

    def _write_settings(self, settings: Settings, stamp: int, device: str) -> None:
        if not self._once("settings"):
            return
        message = messages.frame_info_message(settings, stamp, device, self.frame_id)
        self._write_role("frame_info", stamp, message)
        for role, value, make in (
            ("temperature", settings.body_temperature, messages.temperature_message),
            ("ambient", settings.ambient_temperature, messages.temperature_message),
            ("reference", settings.reference_distance, messages.range_message),
        ):
            if self._last_values.get(role) != value:
                self._last_values[role] = value
                self._write_role(role, stamp, make(value, stamp, self.frame_id))

    def _write_intrinsics(self, intrinsics: Intrinsics, stamp: int, roles: tuple[str, ...]) -> None:
        topics = (self.topics["camera_info"], *(self.topics.paired_info(role) for role in roles))
        for topic in dict.fromkeys(topics):
            if self._once(topic):
                message = messages.camera_info_message(intrinsics, stamp, self.frame_id)
                self._write(topic, CAMERA_INFO, stamp, message, "camera_info")

    def _write_image(self, role: str, array: NDArray[Any], stamp: int) -> None:
        image = messages.image_message(array, stamp, self.frame_id)
        if role not in SAMPLES and image.encoding not in ENCODINGS[role]:
            raise InputError(f"an array of type {array.dtype} is no {role} image", file=self.path)
        self._write_role(role, stamp, image)

    def _write_role(self, role: str, stamp: int, message: Any) -> None:
        self._write(self.topics[role], KNOWN_ROLES[role][1], stamp, message, role)

    def _write(self, topic: str, msgtype: str, stamp: int, message: Any, role: str | None) -> None:
        self._write_bytes(topic, msgtype, stamp, lambda: messages.encode(message, msgtype), role)

    def _write_bytes(
        self,
        topic: str,
        msgtype: str,
        stamp: int,
        data: bytes | Callable[[], memoryview],
        role: str | None,
    ) -> None:
        if self._writer is None:
            raise RuntimeError("the recording is not open: use it in a with statement")
        messages.split_stamp(stamp)
        connection = self._connections.get(topic)
        if connection is not None and connection.msgtype != msgtype:
            raise RimError(f"{topic} is of type {connection.msgtype}, not {msgtype}", file=self.path)
        encoded = data if isinstance(data, bytes) else data()
        with self._faults():
            if connection is None:
                connection = self._connections[topic] = self._writer.add_connection(
                    topic, msgtype, typestore=messages.typestore(), offered_qos_profiles=_qos(role)
                )
            self._writer.write(connection, int(stamp), encoded)
        self.message_count += 1

    def _check_target(self) -> None:
        if not self.path.name:
            raise InputError("is not a name for an output", file=self.path)
        if not self._parent.is_dir():
            raise InputError(
                "its folder does not exist", file=self.path, remedy=f"make it: mkdir -p {self.path.parent}"
            )
        if self.path.exists() or self.path.is_symlink():
            if not self.force:
                raise InputError("exists already", file=self.path, remedy="--force replaces it")
            foreign = _foreign(self.path)
            if foreign:
                raise InputError(
                    f"is not replaced: {foreign}", file=self.path, remedy="choose another output or remove it"
                )

    def _put_in_place(self) -> None:
        """Move the finished folder to its place; an existing output is removed only after that."""
        assert self._work is not None
        self._check_target()
        self._work.put_in_place(self._work.path / self.path.name, self.path)
        self._work.close()
        self._work = None

    @contextlib.contextmanager
    def _faults(self) -> Iterator[None]:
        """Discard the output on any exception; errors of the disk become errors of the package."""
        try:
            yield
        except OSError as error:
            self._discard()
            full = error.errno in _FULL
            reason = "the disk is full" if full else error.strerror or str(error)
            raise RimError(
                f"cannot be written: {reason}; nothing was left behind",
                file=self.path,
                remedy="make room or choose another place"
                if full
                else "check the folder and its permissions",
            ) from error
        except BaseException:
            self._discard()
            raise

    def _discard(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            with contextlib.suppress(Exception):
                abort = getattr(writer, "abort", None)  # rosbags before 0.11 can only close
                abort() if abort else writer.close()
        if self._work is not None:
            self._work.close()
            self._work = None


def _foreign(path: Path) -> str:
    """Return why a path must not be replaced, '' if it is a recording and nothing else."""
    if path.is_symlink():
        return "it is a link"
    try:
        if path.is_file():
            return "" if _begins_as_recording(path) else "it is not a recording"
        entries = sorted(path.iterdir())
        for entry in entries:
            known = entry.name == METADATA or entry.name.endswith(_PARTS)
            if not known or entry.is_symlink() or not entry.is_file():
                return f"it holds {entry.name}, which is not part of a recording"
            if entry.name.endswith(_DATA) and not _begins_as_recording(entry):
                return f"its {entry.name} is not a recording's"
        if METADATA in [entry.name for entry in entries]:
            text = (path / METADATA).read_bytes()[:4096]
            return "" if b"rosbag2_bagfile_information" in text else f"its {METADATA} is not a recording's"
    except OSError as error:
        return f"it cannot be looked into: {error.strerror}"
    return "" if entries else "it is an empty folder, not a recording"


def _begins_as_recording(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(16).startswith(_MAGICS)
