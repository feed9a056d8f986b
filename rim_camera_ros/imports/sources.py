"""The topics of a profile in a recording, and the profile that fits a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from rim_camera_ros.bags.topics import CAMERA_INFO, IMAGE, listed
from rim_camera_ros.errors import InputError
from rim_camera_ros.imports.images import COMPRESSED_IMAGE, Transport
from rim_camera_ros.imports.profile import Profile, SettingSource, load_profile, shipped_profiles

#: Endings of image topics, the best first; rosbags names types of ROS 1 as those of ROS 2.
_TRANSPORTS: tuple[tuple[Transport, str, str], ...] = (
    ("raw", "", IMAGE),
    ("compressedDepth", "/compressedDepth", COMPRESSED_IMAGE),
    ("compressed", "/compressed", COMPRESSED_IMAGE),
)


@dataclass(frozen=True)
class ImageTopic:
    """A topic of images, and their transport."""

    topic: str
    transport: Transport


@dataclass(frozen=True)
class Sources:
    """The topics of a recording that are read by a profile; None for those that are missing."""

    profile: Profile
    namespace: str
    distance: ImageTopic
    amplitude: ImageTopic
    camera_info: str | None
    integration_time: str | None
    body_temperature: str | None

    @property
    def rectified(self) -> bool:
        """Whether the images are rectified."""
        stated = self.profile.camera_info.rectified
        return "_rect" in self.distance.topic if stated is None else stated


def image_topic(name: str, types: Mapping[str, str]) -> ImageTopic | None:
    """Return the topic of an image, raw if there is one, else compressed."""
    for transport, ending, msgtype in _TRANSPORTS:
        if types.get(name + ending) == msgtype:
            return ImageTopic(name + ending, transport)
    for transport, ending, msgtype in _TRANSPORTS[1:]:  # named with its ending
        if name.endswith(ending) and types.get(name) == msgtype:
            return ImageTopic(name, transport)
    return None


def _namespaces(profile: Profile, types: Mapping[str, str]) -> list[str]:
    """Return the namespaces with both images."""
    found = set()
    for name in profile.distance.topics:
        for _, ending, msgtype in _TRANSPORTS:
            suffix = f"/{name}{ending}"
            found |= {
                one.removesuffix(suffix)
                for one, kind in types.items()
                if kind == msgtype and one.endswith(suffix)
            }
    return sorted(one for one in found if _image(one, profile.amplitude.topics, types) is not None)


def _image(namespace: str, names: tuple[str, ...], types: Mapping[str, str]) -> ImageTopic | None:
    found = (image_topic(f"{namespace}/{name}", types) for name in names)
    return next((one for one in found if one is not None), None)


def _setting(namespace: str, source: SettingSource | None, types: Mapping[str, str]) -> str | None:
    if source is None:
        return None
    names = (f"{namespace}/{name}" for name in source.topics)
    return next((name for name in names if name in types), None)


def find_sources(
    profile: Profile, types: Mapping[str, str], *, namespace: str | None, named: Mapping[str, str]
) -> Sources:
    """Return the topics of a profile in a recording (topic: message type).

    ``namespace`` None: the namespace with both images. ``named`` maps distance, amplitude and camera_info to
    other topics. Raises `InputError`, which lists missing and existing topics.
    """
    if namespace is None:
        found = _namespaces(profile, types)
        if len(found) > 1:
            shown = [one or "/" for one in found]
            raise InputError(
                f"{len(found)} namespaces hold images of {profile.driver}: {listed(shown)}",
                remedy=f"choose one: --namespace {shown[0]}",
            )
        namespace = found[0] if found else profile.namespace
    images = {}
    for role, names in (("distance", profile.distance.topics), ("amplitude", profile.amplitude.topics)):
        if role in named:
            images[role] = image_topic(named[role], types)
            names = (named[role],)
        else:
            images[role] = _image(namespace, names, types)
        if images[role] is None:
            raise _missing(role, namespace, names, types)
    info = None
    if "camera_info" in named:
        info = named["camera_info"]
        if types.get(info) != CAMERA_INFO:
            raise InputError(
                f"no topic {info} of type sensor_msgs/CameraInfo",
                remedy=f"there are: {listed([name for name, kind in types.items() if kind == CAMERA_INFO])}",
            )
    else:
        listed_names = [f"{namespace}/{name}" for name in profile.camera_info.topics]
        paired = images["distance"].topic.rpartition("/")[0] + "/camera_info"  # type: ignore[union-attr]
        info = next((name for name in (*listed_names, paired) if types.get(name) == CAMERA_INFO), None)
    return Sources(
        profile=profile,
        namespace=namespace,
        distance=images["distance"],  # type: ignore[arg-type]
        amplitude=images["amplitude"],  # type: ignore[arg-type]
        camera_info=info,
        integration_time=_setting(namespace, profile.integration_time, types),
        body_temperature=_setting(namespace, profile.body_temperature, types),
    )


def _missing(role: str, namespace: str, names: tuple[str, ...], types: Mapping[str, str]) -> InputError:
    kinds = (IMAGE, COMPRESSED_IMAGE)
    there = [name for name, kind in types.items() if kind in kinds]
    wanted = " or ".join(name if name.startswith("/") else f"{namespace}/{name}" for name in names)
    return InputError(
        f"no {role} image {wanted}, raw or compressed; images: {listed(there)}",
        remedy=f"--topic {role}=NAME, --namespace NAME, or another --profile",
    )


def recognise(types: Mapping[str, str], *, namespace: str | None = None) -> Profile:
    """Return the shipped profile of whose topics a recording (topic: message type) has the most.

    Raises `InputError` where none or several fit.
    """
    scores: dict[str, int] = {}
    profiles = {name: load_profile(name) for name in shipped_profiles()}
    for name, profile in profiles.items():
        spaces = _namespaces(profile, types) if namespace is None else [namespace]
        counts = [
            sum(
                any(f"{space}/{one}{ending}" in types for _, ending, _ in _TRANSPORTS)
                for one in profile.names()
            )
            for space in spaces
            if _image(space, profile.distance.topics, types)
            and _image(space, profile.amplitude.topics, types)
        ]
        if counts:
            scores[name] = max(counts)
    if not scores:
        there = [one for one, kind in types.items() if kind in (IMAGE, COMPRESSED_IMAGE)]
        raise InputError(
            f"the topics are those of no driver that is known; images: {listed(there)}",
            remedy="name one with --profile (rim import --list), or copy the template",
        )
    most = max(scores.values())
    best = sorted(name for name, score in scores.items() if score == most)
    if len(best) > 1:
        raise InputError(
            f"the topics could be those of {' or '.join(best)}", remedy=f"say which: --profile {best[0]}"
        )
    return profiles[best[0]]


def with_options(
    profile: Profile, *, kind: str | None, unit: float | None, offset: float | None, counts: float | None
) -> Profile:
    """Return the profile with changes by options of the command line."""
    distance = profile.distance
    if kind is not None:
        distance = replace(distance, kind=kind)  # type: ignore[arg-type]
    if unit is not None:
        distance = replace(distance, unit=unit, unit_needed=None)
    if offset is not None:
        distance = replace(distance, offset=offset)
    amplitude = profile.amplitude if counts is None else replace(profile.amplitude, counts=counts)
    return replace(profile, distance=distance, amplitude=amplitude)
