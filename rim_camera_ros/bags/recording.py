"""Reading of recordings as frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rim_camera_ros.bags import messages
from rim_camera_ros.bags.mcap import guarded
from rim_camera_ros.bags.pairing import Backwards, Pairing
from rim_camera_ros.bags.storage import Storage, open_storage, unpack_message
from rim_camera_ros.bags.topics import (
    KNOWN_ROLES,
    POSE_ROLES,
    ROLES,
    Topics,
    image_roles,
    require_images,
    resolve,
)
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.frame import NANOSECONDS, CorrectedFrame, RawFrame

if TYPE_CHECKING:
    from typing import Self

#: Roles of the parts of a corrected frame, and the most stamps that wait for further parts.
CORRECTED_PARTS = ("corrected_distance", "sigma", "flags", "points")
_WAITING = 64

_WITHOUT = {
    "camera_info": "no camera_info: the optics are those of the camera file",
    "frame_info": "no frame_info: integration time and modulation frequency are those of the camera file, "
    "the uptime is unknown",
}


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """A topic of a recording: name, message type, number of messages, role (None: not used)."""

    name: str
    msgtype: str
    count: int
    role: str | None


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """The contents of a recording, without decoding its images.

    ``storage`` names the format, ``start`` is the time of recording of the first message in ns (None without
    messages), ``duration`` in s, ``frame_count`` the number of distance images. ``roles`` maps the roles that
    exist to their topics (`truth` to the pattern). ``damage`` says what is wrong with a recording that is
    only readable in part.
    """

    path: Path
    storage: str
    start: int | None
    duration: float
    message_count: int
    frame_count: int
    topics: tuple[TopicSummary, ...]
    roles: Mapping[str, str]
    truth_surfaces: tuple[str, ...]
    assumptions: tuple[str, ...]
    damage: str | None


class Recording:
    """A recording to read: a rosbag2 folder, an .mcap, a .db3 (zstd or not) or a ROS 1 .bag.

    A context manager. If the topics of the default namespace are absent and exactly one namespace has
    distance images, that one is used. ``assumptions`` states this and other assumptions; reading frames may
    add to it. ``skipped`` counts messages that did not become frames in the last pass, by reason.

    Entering raises InputError for a path that is not a recording or cannot be opened.
    """

    def __init__(self, path: str | PathLike[str], *, topics: Topics | None = None) -> None:
        self.path = Path(path)
        self.assumptions: list[str] = []
        self.skipped: Mapping[str, int] = {}
        self._asked = topics if topics is not None else Topics()
        self._storage: Storage | None = None

    def __enter__(self) -> Self:
        storage = open_storage(self.path)
        try:
            types = {name: info.msgtype for name, info in storage.topics.items()}
            self._topics, said = resolve(self._asked, types)
        except RimError as error:
            storage.close()
            raise error.located(self.path) from None
        self._storage = storage
        self._types = types
        self.assumptions[:] = said
        if self._topics[self._lead] in types:
            self.assumptions += [said for role, said in _WITHOUT.items() if self._topics[role] not in types]
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        storage, self._storage = self._storage, None
        if storage is not None:
            storage.close()

    @property
    def topics(self) -> Topics:
        """The topics, as found in the recording."""
        self._opened()
        return self._topics

    @property
    def truth_surfaces(self) -> tuple[str, ...]:
        """Names of the surfaces whose poses are recorded, sorted."""
        self._opened()
        return tuple(sorted({surface for surface, _ in self._pose_topics().values()}))

    @property
    def frame_count(self) -> int:
        """Number of distance images, without reading them."""
        info = self._opened().topics.get(self._topics[self._lead])
        return info.count if info else 0

    def summary(self) -> RecordingSummary:
        """Return the contents of the recording; no image is decoded, and no topic is required."""
        storage = self._opened()
        by_name = {self._topics[role]: role for role in self._topics.roles}
        topics = tuple(
            TopicSummary(name, info.msgtype, info.count, self._role(name, by_name))
            for name, info in sorted(storage.topics.items())
        )
        found = {topic.role for topic in topics}
        start, end = storage.start, storage.end
        return RecordingSummary(
            path=self.path,
            storage=storage.kind,
            start=start,
            duration=0.0 if start is None or end is None else (end - start) / NANOSECONDS,
            message_count=sum(topic.count for topic in topics),
            frame_count=self.frame_count,
            topics=topics,
            roles={role: self._topics[role] for role in self._topics.roles if role in found}
            | self._pose_patterns(),
            truth_surfaces=self.truth_surfaces,
            assumptions=tuple(self.assumptions),
            damage=storage.damage,
        )

    def frames(self, on_backwards: Backwards = "error") -> Iterator[RawFrame]:
        """Iterate over the frames as recorded, in bounded memory; each call begins anew.

        Distance, amplitude, camera_info and frame_info are paired by their stamps; poses, temperatures and
        the reference are the last ones at or before the frame's stamp. Arrays are read-only views of the
        recorded bytes where their layout allows it. With ``on_backwards='count'`` stamps that do not advance
        (a recording of a loop) are counted in ``skipped`` instead of raising an error.

        Raises InputError at once if a topic is missing. For damage in the recording, a wrong message, a
        change of the image size or a stamp that does not advance it is raised after the frames before it,
        and at the end if there was no frame.
        """
        storage = self._opened()
        try:
            require_images(self._topics, self._types)
        except InputError as error:
            if storage.damage and not self._types:
                raise InputError(storage.damage, file=self.path, remedy="record it again") from None
            raise error.located(self.path) from None
        return self._frames(storage, on_backwards)

    def corrected_frames(self) -> Iterator[CorrectedFrame]:
        """Iterate over corrected frames that have distance, sigma, flags and points.

        Raises InputError, which names the topic, for a missing topic, and for a wrong message.
        """
        storage = self._opened()
        missing = [self._topics[role] for role in CORRECTED_PARTS if self._topics[role] not in self._types]
        if missing:
            raise InputError(
                f"topic {missing[0]} is missing", file=self.path, remedy="record the corrected topics as well"
            )
        return self._corrected(storage)

    def _corrected(self, storage: Storage) -> Iterator[CorrectedFrame]:
        by_topic = {self._topics[role]: role for role in CORRECTED_PARTS}
        waiting: dict[int, dict[str, Any]] = {}
        with closing(guarded(storage.messages(by_topic), self._unreadable)) as stream:
            for message in stream:
                raw = unpack_message(message, self.path)
                decoded = messages.decode(raw, self._types[message.topic], ros1=storage.ros1)
                role, stamp = by_topic[message.topic], messages.stamp_of(decoded)
                parts = waiting.setdefault(stamp, {})
                if role == "points":
                    parts[role] = messages.points_array(decoded)[..., 3]
                else:
                    parts[role] = messages.image_array(decoded)
                if len(parts) == len(by_topic):
                    del waiting[stamp]
                    yield CorrectedFrame(
                        stamp=stamp,
                        distance=parts["corrected_distance"],
                        amplitude=parts["points"],
                        sigma=parts["sigma"],
                        flags=parts["flags"],
                    )
                elif len(waiting) > _WAITING:
                    del waiting[min(waiting)]

    def _frames(self, storage: Storage, on_backwards: Backwards) -> Iterator[RawFrame]:
        routes = {self._topics[role]: (role, "") for role in self._topics.raw_roles}
        routes |= {topic: (role, surface) for topic, (surface, role) in self._pose_topics().items()}
        routes = {topic: route for topic, route in routes.items() if topic in self._types}
        pairing = Pairing(routes, on_backwards, self._say)
        self.skipped = pairing.skipped
        count = 0
        fault: RimError | None = None
        try:
            with closing(guarded(storage.messages(routes), self._unreadable)) as stream:
                for message in stream:
                    raw = unpack_message(message, self.path)
                    place = f"topic {message.topic}, recorded at {messages.stamp_text(message.time)}"
                    decoded = messages.decode(raw, self._types[message.topic], ros1=storage.ros1, place=place)
                    for frame in pairing.add(message.topic, decoded):
                        count += 1
                        yield frame
        except RimError as error:
            fault = error
        for frame in pairing.flush():
            count += 1
            yield frame
        if fault is not None:
            raise type(fault)(
                f"{fault.problem}; frames read before it: {count}",
                file=fault.file or self.path,
                place=fault.place,
                remedy=fault.remedy,
            ) from fault
        if count == 0:
            reasons = ", ".join(f"{number} {reason}" for reason, number in pairing.skipped.items())
            raise InputError(
                f"no frame in it: {reasons or 'no message on ' + self._topics[self._lead]}",
                file=self.path,
                remedy="distance and amplitude of a frame must carry the same stamp"
                if reasons
                else "record it again",
            )

    def _role(self, name: str, by_name: Mapping[str, str]) -> str | None:
        if name in self._pose_topics():
            return self._pose_topics()[name][1]
        role = by_name.get(name)
        return role if role and KNOWN_ROLES[role][1] == self._types[name] else None

    def _pose_topics(self) -> dict[str, tuple[str, str]]:
        """Return surface and role of the topics with poses, by their names.

        Where a surface has poses both below the namespace of the camera and without it, the former are used.
        """
        found: dict[tuple[str, str], str] = {}
        for name, kind in self._types.items():
            for role in POSE_ROLES:
                if kind == ROLES[role][1] and (surface := self._topics.surface_of(name, role=role)):
                    known = found.setdefault((surface, role), name)
                    found[surface, role] = max(known, name, key=len)
        return {name: key for key, name in found.items()}

    def _pose_patterns(self) -> dict[str, str]:
        """Return the names of topics with poses by role, with the placeholder of the surface."""
        found = (
            (role, self._topics.pattern_of(name, role=role))
            for name, (_, role) in self._pose_topics().items()
        )
        return {role: pattern for role, pattern in found if pattern is not None}

    @property
    def _lead(self) -> str:
        """The role of the image that comes with every frame."""
        return image_roles(self._topics, self._types)[0]

    def _say(self, sentence: str) -> None:
        if sentence not in self.assumptions:
            self.assumptions.append(sentence)

    def _unreadable(self, error: Exception) -> RimError:
        reason = error.strerror if isinstance(error, OSError) else f"{type(error).__name__} {error}"
        return InputError(f"cannot be read on: {reason}", file=self.path, remedy="check the disk")

    def _opened(self) -> Storage:
        if self._storage is None:
            raise RuntimeError("the recording is not open: use it in a with statement")
        return self._storage
