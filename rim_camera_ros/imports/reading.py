"""Recordings of a driver as frames of this package: radial distances, amplitudes, settings, geometry."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags import messages
from rim_camera_ros.bags.mcap import Message
from rim_camera_ros.bags.storage import Storage, open_storage, unpack_message
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Intrinsics, RawFrame, Settings
from rim_camera_ros.imports.images import decode_pixels
from rim_camera_ros.imports.lens import Lens, PlumbBob, lens_from, lens_of_file, nearest_plumb_bob
from rim_camera_ros.imports.pixels import amplitude_counts, radial_distance
from rim_camera_ros.imports.profile import Profile, SettingSource
from rim_camera_ros.imports.settings import Definitions, number_at
from rim_camera_ros.imports.sources import Sources
from rim_camera_ros.imports.stamps import Series, half_period, header_stamp, pairs

if TYPE_CHECKING:
    from typing import Self

#: Most exposures that may wait for their other image.
_MOST_WAITING = 64
#: Residual of the converted lens model above which it is a warning [px].
_POOR_LENS = 0.3

_IMAGES = ("distance", "amplitude")


@dataclass(frozen=True)
class Given:
    """Statements of the user in addition to the profile: settings without a topic, and a calibration file."""

    integration_time: float | None = None
    modulation_frequency: float | None = None
    camera_info: Path | None = None


class DriverRecording:
    """A recording of another driver, read by a profile. A context manager; `frames` may be called once.

    ``notes`` state conversions and assumptions; ``skipped`` counts images that did not become frames.
    Entering raises InputError for a path that is not a recording. ``prepare`` finds the topics.
    """

    def __init__(self, path: Path, given: Given | None = None) -> None:
        self.path = path
        self.notes: list[str] = []
        self.skipped: Counter[str] = Counter()
        self.frame_id = messages.FRAME_ID
        self.lens: Lens | None = None
        self.plumb_bob: PlumbBob | None = None
        self._given = given if given is not None else Given()
        self._storage: Storage | None = None

    def __enter__(self) -> Self:
        self._storage = open_storage(self.path)
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
    def storage(self) -> Storage:
        """The open storage."""
        if self._storage is None:
            raise RuntimeError("the recording is not open: use it in a with statement")
        return self._storage

    @property
    def types(self) -> dict[str, str]:
        """Message types by topic."""
        return {name: info.msgtype for name, info in self.storage.topics.items()}

    def prepare(self, sources: Sources) -> int:
        """Read stamps, geometry and settings of the recording; return the number of frames to come.

        Raises InputError where a part that frames need is missing, or the images have no common exposures.
        """
        self._sources = sources
        profile = sources.profile
        self._check_unit(profile)
        self._definitions = Definitions(ros1=self.storage.ros1)
        self._routes: dict[str, str] = {}
        for role in _IMAGES:
            self._route(getattr(sources, role).topic, role)
        if sources.camera_info is not None:
            self._route(sources.camera_info, "camera_info")
        settings = {
            name: getattr(profile, name)
            for name in ("integration_time", "body_temperature")
            if getattr(sources, name) is not None
        }
        if self._given.integration_time is not None:
            settings.pop("integration_time", None)
        by_topic: dict[str, list[str]] = {}
        for name in settings:
            by_topic.setdefault(getattr(sources, name), []).append(name)
        self._scan(by_topic, settings)
        self._say_sources()
        return len(self._partner)

    def frames(self) -> Iterator[RawFrame]:
        """Yield the frames in the order of their stamps; raises InputError for a wrong message."""
        topics = {getattr(self._sources, role).topic: role for role in _IMAGES}
        distance_of = {amplitude: distance for distance, amplitude in self._partner.items()}
        waiting: OrderedDict[int, dict[str, NDArray[Any]]] = OrderedDict()
        for message in self.storage.messages(topics):
            role = topics[message.topic]
            stamp = self._stamp(message)
            key = stamp if role == "distance" else distance_of.get(stamp)
            if key is None or key not in self._partner:
                continue
            parts = waiting.setdefault(key, {})
            if role in parts or key in self._done:
                self.skipped[f"{role} twice with one stamp"] += 1
                continue
            parts[role] = self._pixels(message, role)
            if len(parts) == len(_IMAGES):
                del waiting[key]
                self._done.add(key)
                yield self._frame(key, parts["distance"], parts["amplitude"])
            elif len(waiting) > _MOST_WAITING:
                waiting.popitem(last=False)
                self.skipped["image whose partner is recorded far from it"] += 1
        self.skipped["image without its partner"] += len(waiting)
        self.skipped += Counter()

    def _route(self, topic: str, role: str) -> None:
        other = self._routes.setdefault(topic, role)
        if other != role:
            raise InputError(f"{topic} is both {other} and {role}", file=self.path, place="--topic")

    def _check_unit(self, profile: Profile) -> None:
        if profile.distance.unit_needed:
            raise InputError(
                f"the unit of the distance is not in the recording: {profile.distance.unit_needed}",
                file=self.path,
                place="--distance-unit",
                remedy="state it in metres per count",
            )

    def _raw(self, message: Message) -> bytes:
        return unpack_message(message, self.path)

    def _stamp(self, message: Message) -> int:
        """Return a message's stamp, that of its header, or the time of recording where it has none."""
        if self._recorded_times:
            return message.time
        stamp = header_stamp(self._raw(message), ros1=self.storage.ros1)
        return message.time if stamp is None else stamp

    def _scan(self, by_topic: dict[str, list[str]], sources: dict[str, SettingSource]) -> None:
        """Read all stamps, the geometry and the settings, and pair the images."""
        self._recorded_times = False
        stamps: dict[str, list[int]] = {role: [] for role in _IMAGES}
        times: dict[str, list[int]] = {role: [] for role in _IMAGES}
        self._settings: dict[str, Series] = {}
        infos: dict[tuple[Any, ...], Any] = {}
        first: dict[str, Message] = {}
        for topic in by_topic:
            for name in by_topic[topic]:
                self._definitions.add(self.types[topic], sources[name].definition, f"topic {topic}")
        for message in self.storage.messages({*self._routes, *by_topic}):
            role = self._routes.get(message.topic)
            if role in _IMAGES:
                first.setdefault(role, message)
                stamps[role].append(self._stamp(message))
                times[role].append(message.time)
            elif role == "camera_info":
                info = messages.decode(self._raw(message), self.types[message.topic], **self._how(message))
                infos.setdefault((*_field(info, "k"), *_field(info, "d")), info)
            for name in by_topic.get(message.topic, ()):
                self._keep_setting(name, sources[name], message)
        for role in _IMAGES:
            if not stamps[role]:
                topic = getattr(self._sources, role).topic
                raise InputError(f"no message on {topic}", file=self.path, remedy="record it again")
        if not any(stamps["distance"]):
            self._recorded_times, stamps = True, times
            self.notes.append("the images carry no stamps: the times of recording are taken")
        self._pair({role: np.array(values, np.int64) for role, values in stamps.items()})
        self._geometry(list(infos.values()), first["distance"])
        self._done: set[int] = set()

    def _how(self, message: Message) -> dict[str, Any]:
        place = f"topic {message.topic}, recorded at {messages.stamp_text(message.time)}"
        return {"ros1": self.storage.ros1, "place": place}

    def _keep_setting(self, name: str, source: SettingSource, message: Message) -> None:
        place = self._how(message)["place"]
        try:
            decoded = self._definitions.decode(self._raw(message), self.types[message.topic], place)
            value = number_at(decoded, source.path, place)
        except InputError as error:
            raise error.located(self.path) from None
        if value is None:
            return
        has_header = hasattr(decoded, "header")
        stamp = messages.stamp_of(decoded) if has_header and not self._recorded_times else message.time
        self._settings.setdefault(name, Series()).add(stamp or message.time, value * source.scale)

    def _pair(self, stamps: dict[str, NDArray[np.int64]]) -> None:
        distance, amplitude = stamps["distance"], stamps["amplitude"]
        self._tolerance = half_period(distance)
        self._partner = pairs(distance, amplitude, tolerance=self._tolerance)
        if not self._partner:
            gap = abs(int(distance[0]) - int(amplitude[0])) / 1e9
            raise InputError(
                "no distance image has an amplitude image within half a period"
                f" ({self._tolerance / 1e6:.3g} ms); the first two lie {gap:.3g} s apart",
                file=self.path,
                remedy="record both with one clock",
            )
        for role, number, used in (
            ("distance", len(distance), len(self._partner)),
            ("amplitude", len(amplitude), len(set(self._partner.values()))),
        ):
            if number > used:
                self.skipped[f"{role} images without a partner within half a period"] += number - used
        apart = [abs(name - other) for name, other in self._partner.items()]
        if any(apart):
            self.notes.append(
                f"distance and amplitude are up to {max(apart) / 1e6:.3g} ms apart"
                f" (half a period: {self._tolerance / 1e6:.3g} ms) and taken as one exposure"
            )

    def _geometry(self, infos: list[Any], first: Message) -> None:
        shape = self._pixels_of(first, "distance").shape[:2]
        rectified = self._sources.rectified
        try:
            if self._given.camera_info is not None:
                self.lens = lens_of_file(self._given.camera_info, rectified=rectified, shape=shape)
            elif infos:
                place = f"topic {self._sources.camera_info}"
                self.lens = lens_from(infos[0], rectified=rectified, shape=shape, place=place)
                if len(infos) > 1:
                    self.notes.append("camera_info changes in the recording: the first one is used")
            if self.lens is not None:
                self.plumb_bob = nearest_plumb_bob(self.lens)
        except InputError as error:
            raise error.located(self.path) from None
        kind = self._sources.profile.distance.kind
        self._stretch: NDArray[np.float32] | None = None
        if self.lens is None:
            if kind == "z":
                raise InputError(
                    "depth along z becomes distance by the camera's geometry, and there is no camera_info",
                    file=self.path,
                    remedy="--topic camera_info=NAME, or --camera-info FILE of a calibration",
                )
            self.notes.append("no camera_info: the recording will state no geometry")
            return
        if kind == "z":
            directions = self.lens.directions()
            self._stretch = np.sqrt(1.0 + (directions**2).sum(axis=-1)).astype(np.float32)
        self._say_lens(rectified)

    def _say_lens(self, rectified: bool) -> None:
        lens, found = self.lens, self.plumb_bob
        assert lens is not None
        assert found is not None
        if rectified:
            self.notes.append("the images are rectified: P of camera_info, no distortion")
        elif not lens.is_plumb_bob:
            poor = ": too coarse for a calibration; record rectified images" if found.rms > _POOR_LENS else ""
            self.notes.append(
                f"the lens model {lens.model} is converted to plumb_bob: residual {found.rms:.3g} px RMS,"
                f" {found.worst:.3g} px at most{poor}"
            )
        if found.lost > 0:
            self.notes.append(f"{found.lost:.2%} of the pixels have no direction by the lens model")

    def _say_sources(self) -> None:
        sources, profile = self._sources, self._sources.profile
        meaning = {"z": "depth along z", "radial": "radial distance", "points": "points"}
        self.notes.append(
            f"{sources.distance.topic} is the distance ({meaning[profile.distance.kind]}),"
            f" {sources.amplitude.topic} the amplitude, by the profile {profile.name or profile.driver}"
        )
        self.notes += profile.notes
        if self._given.integration_time is None and "integration_time" not in self._settings:
            self.notes.append(
                "no integration time: no topic states it; give --integration-time, in the device's own unit"
            )

    def _pixels_of(self, message: Message, role: str) -> NDArray[Any]:
        source = getattr(self._sources, role)
        how = self._how(message)
        try:
            decoded = messages.decode(self._raw(message), self.types[message.topic], **how)
            image = decode_pixels(decoded, source.transport, role=role, place=how["place"])
        except InputError as error:
            raise error.located(self.path) from None
        if role == "distance" and decoded.header.frame_id:
            self.frame_id = str(decoded.header.frame_id)
        return image

    def _pixels(self, message: Message, role: str) -> NDArray[Any]:
        image = self._pixels_of(message, role)
        try:
            profile = self._sources.profile
            if role == "amplitude":
                return amplitude_counts(image, profile.amplitude)
            return radial_distance(image, profile.distance, self._stretch)
        except InputError as error:
            place = self._how(message)["place"]
            raise InputError(error.problem, file=self.path, place=place, remedy=error.remedy) from None

    def _frame(self, stamp: int, distance: NDArray[Any], amplitude: NDArray[Any]) -> RawFrame:
        if distance.shape != amplitude.shape:
            raise InputError(
                f"the distance is {distance.shape[1]} x {distance.shape[0]},"
                f" the amplitude {amplitude.shape[1]} x {amplitude.shape[0]}",
                file=self.path,
                place=f"the exposure at {messages.stamp_text(stamp)}",
                remedy="--topic amplitude=name of the image that belongs to the distance",
            )
        profile = self._sources.profile
        extra = {"profile": profile.name or profile.driver}
        step = self.lsb
        if step is not None:
            extra["distance_lsb"] = repr(step)
        frequency = self._given.modulation_frequency
        settings = Settings(
            integration_time=self._setting("integration_time", stamp, self._given.integration_time),
            modulation_frequency=profile.modulation_frequency if frequency is None else frequency,
            body_temperature=self._setting("body_temperature", stamp, None),
            extra=extra,
        )
        intrinsics: Intrinsics | None = self.plumb_bob.intrinsics if self.plumb_bob is not None else None
        return RawFrame(
            stamp=stamp,
            distance=distance,
            amplitude=amplitude,
            settings=settings,
            intrinsics=intrinsics,
            device=profile.device,
        )

    @property
    def lsb(self) -> float | None:
        """Metres per count of the driver's images; None: as the camera file states."""
        return self._sources.profile.distance.unit

    def _setting(self, name: str, stamp: int, stated: float | None) -> float | None:
        if stated is not None:
            return stated
        series = self._settings.get(name)
        found = None if series is None else series.latest(stamp + self._tolerance)
        return None if name == "integration_time" and found is not None and found <= 0 else found


def _field(message: Any, name: str) -> Any:
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())
