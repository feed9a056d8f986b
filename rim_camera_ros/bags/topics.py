"""Roles of topics, their names in a namespace, and how the names in a recording are found."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from rim_camera_ros.errors import InputError, nearest_name

DEFAULT_NAMESPACE = "/camera"

#: Placeholder of the surface's name in the topic of the role ``truth``.
SURFACE = "<surface>"

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
TEMPERATURE = "sensor_msgs/msg/Temperature"
RANGE = "sensor_msgs/msg/Range"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
CLOUD = "sensor_msgs/msg/PointCloud2"

#: Role: (name below the namespace, or an absolute name; message type). Drivers publish true poses below their
#: namespace, as those of two cameras differ; a recording is of one camera.
ROLES: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "distance": ("distance/image_raw", IMAGE),
        "amplitude": ("amplitude/image_raw", IMAGE),
        "camera_info": ("camera_info", CAMERA_INFO),
        "frame_info": ("frame_info", DIAGNOSTICS),
        "temperature": ("temperature", TEMPERATURE),
        "ambient": ("ambient_temperature", TEMPERATURE),
        "reference": ("reference", RANGE),
        "truth": (f"/ground_truth/{SURFACE}/pose", POSE),
        "truth_with_covariance": (f"/ground_truth/{SURFACE}/pose_with_covariance", POSE_WITH_COVARIANCE),
        "points": ("points", CLOUD),
        "sigma": ("sigma/image", IMAGE),
        "flags": ("flags/image", IMAGE),
        "corrected_distance": ("distance/image", IMAGE),
        "depth": ("depth/image_raw", IMAGE),
    }
)

#: Most modulation frequencies of a camera.
FREQUENCIES = 4

#: Images that only some devices measure, in the form of `ROLES`: those of each of several modulation
#: frequencies.
FURTHER_IMAGES: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        f"{kind}_{i}": (f"{kind}_{i}/image_raw", IMAGE)
        for i in range(FREQUENCIES)
        for kind in ("distance", "amplitude")
    }
)

#: Images of several values a pixel, in the form of `ROLES`: the data from which distance and amplitude were
#: evaluated. A frame may come without them.
SAMPLES: Mapping[str, tuple[str, str]] = MappingProxyType(
    {"histogram": ("histogram/image_raw", IMAGE), "gates": ("gates/image_raw", IMAGE)}
)

#: All roles.
KNOWN_ROLES: Mapping[str, tuple[str, str]] = MappingProxyType({**ROLES, **FURTHER_IMAGES, **SAMPLES})

#: Roles of poses, whose topics contain the placeholder of the surface's name.
POSE_ROLES = ("truth", "truth_with_covariance")

#: Roles that make up or accompany a raw frame, other than poses.
RAW_ROLES = (
    "distance",
    "amplitude",
    "camera_info",
    "frame_info",
    "temperature",
    "ambient",
    "reference",
)

#: Names below the namespace that ROS 1 SwissRanger drivers use, best first.
SWISSRANGER_DISTANCE = "distance/image_raw16"
SWISSRANGER_AMPLITUDE = ("intensity/image_raw16", "intensity/image_raw")

#: Ending of the names of topics with poses and their covariance.
_COVARIANCE = "/pose_with_covariance"
_NAME = re.compile(r"/[A-Za-z0-9_~{}]+(/[A-Za-z0-9_~{}]+)*")
_LISTED = 12


def _clean_name(name: str, place: str) -> str:
    text = name.strip()
    if text and not text.startswith("/"):
        text = "/" + text
    if not _NAME.fullmatch(text.replace(SURFACE, "s")):
        raise InputError(
            f"'{name}' is not a topic name",
            place=place,
            remedy="letters, digits and _ between slashes, for example /camera/distance/image_raw",
        )
    return text


def _clean_role(role: str, place: str) -> str:
    text = role.strip().replace(" ", "_")
    if text not in KNOWN_ROLES:
        raise InputError(f"no role '{role}'", place=place, remedy=nearest_name(text, KNOWN_ROLES))
    return text


@dataclass(frozen=True)
class Topics:
    """Topic names by role: a namespace, and names that differ from the default.

    ``overrides`` maps roles (see `ROLES`) to topic names; the name for ``truth`` contains the placeholder
    ``<surface>``. With a ``frequency``, distance and amplitude are the images of that one of several
    modulation frequencies (counted from 0), and the others are ignored.

    Raises InputError for an unknown role, a malformed name or one topic in two roles.
    """

    namespace: str = DEFAULT_NAMESPACE
    overrides: Mapping[str, str] = field(default_factory=dict)
    frequency: int | None = None

    def __post_init__(self) -> None:
        namespace = self.namespace.strip().rstrip("/")
        if namespace:
            namespace = _clean_name(namespace, "namespace")
        overrides: dict[str, str] = {}
        for given, name in self.overrides.items():
            place = f"--topic {given}={name}"
            role = _clean_role(given, place)
            overrides[role] = _clean_name(name, place)
            if (role in POSE_ROLES) != (SURFACE in overrides[role]):
                raise InputError(
                    f"{SURFACE} stands for the surface's name and belongs in the topic of the role truth",
                    place=place,
                    remedy=f"for example --topic truth=/ground_truth/{SURFACE}/pose",
                )
        if "truth" in overrides and "truth_with_covariance" not in overrides:
            overrides["truth_with_covariance"] = overrides["truth"].removesuffix("/pose") + _COVARIANCE
        object.__setattr__(self, "namespace", namespace)
        object.__setattr__(self, "overrides", overrides)
        users: dict[str, str] = {}
        for role in self.roles:
            other = users.setdefault(self[role], role)
            if other != role:
                raise InputError(f"{self[role]} is both {other} and {role}", place="--topic")

    def __hash__(self) -> int:
        return hash((self.namespace, tuple(sorted(self.overrides.items())), self.frequency))

    def __getitem__(self, role: str) -> str:
        """Return the topic name of a role; KeyError for an unknown one."""
        if self.frequency is not None and role in ("distance", "amplitude"):
            role = f"{role}_{self.frequency}"
        if role in self.overrides:
            return self.overrides[role]
        name = KNOWN_ROLES[role][0]
        return name if name.startswith("/") else f"{self.namespace}/{name}"

    @classmethod
    def parse(cls, options: Iterable[str], namespace: str = DEFAULT_NAMESPACE) -> Topics:
        """Make topics from ``role=name`` options as given on a command line.

        Raises InputError for an option without ``=``, a repeated or unknown role, a malformed name.
        """
        overrides: dict[str, str] = {}
        for option in options:
            place = f"--topic {option}"
            role, equals, name = option.partition("=")
            if not equals:
                raise InputError("no '=' in it", place=place, remedy="--topic role=name")
            role = _clean_role(role, place)
            if role in overrides:
                raise InputError(f"the role {role} is given twice", place=place)
            overrides[role] = name
        return cls(namespace, overrides)

    @property
    def roles(self) -> tuple[str, ...]:
        """All roles, without the images of other frequencies where one is chosen."""
        return tuple(role for role in KNOWN_ROLES if self.frequency is None or role not in FURTHER_IMAGES)

    @property
    def automatic(self) -> bool:
        """Whether the namespace may be detected, as no option states the topic of the distance."""
        return self.namespace == DEFAULT_NAMESPACE and "distance" not in self.overrides

    def truth(self, surface: str, *, role: str = "truth") -> str:
        """Return the topic of one surface's pose, or (``role``) of that with its covariance."""
        return self[role].replace(SURFACE, surface)

    def surface_of(self, topic: str, *, role: str = "truth") -> str | None:
        """Return the surface whose pose is published on a topic, None for topics of other roles.

        Without an override the topic may be below the namespace, as a driver publishes it, or not.
        """
        return next((surface for surface, _ in self._patterns_of(topic, role)), None)

    def pattern_of(self, topic: str, *, role: str = "truth") -> str | None:
        """Return the topic of `surface_of` with the placeholder, None for another topic."""
        return next((pattern for _, pattern in self._patterns_of(topic, role)), None)

    def _patterns_of(self, topic: str, role: str) -> Iterator[tuple[str, str]]:
        patterns = [self[role]] if role in self.overrides else [self.namespace + self[role], self[role]]
        for pattern in patterns:
            before, _, after = pattern.partition(SURFACE)
            if topic.startswith(before) and topic.endswith(after):
                surface = topic[len(before) : len(topic) - len(after)]
                if surface and "/" not in surface:
                    yield surface, pattern

    @property
    def raw_roles(self) -> tuple[str, ...]:
        """Roles that make up or accompany a raw frame, other than poses."""
        return tuple(role for role in self.roles if role in {*RAW_ROLES, *FURTHER_IMAGES, *SAMPLES})

    def paired_info(self, role: str) -> str:
        """Return the camera_info topic that image_transport pairs with the role's image."""
        return self[role].rpartition("/")[0] + "/camera_info"


def listed(names: Collection[str]) -> str:
    """Return topic names as a list for a sentence, a dozen at most."""
    names = sorted(names)
    if not names:
        return "none"
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more


def resolve(topics: Topics, types: Mapping[str, str]) -> tuple[Topics, list[str]]:
    """Fit topics to the contents of a recording (topic: message type).

    Returns the topics, and sentences that state assumptions. When nothing fits, the topics are returned
    unchanged; `require_images` then says what is missing.
    Raises InputError when more than one namespace holds distance images.
    """
    assumptions: list[str] = []
    if topics.automatic:
        topics = _with_namespace(topics, types, assumptions)
    overrides = dict(topics.overrides)
    base = topics.namespace
    if "distance" not in overrides and f"{base}/{SWISSRANGER_DISTANCE}" in types:
        overrides["distance"] = f"{base}/{SWISSRANGER_DISTANCE}"
        assumptions.append(f"{overrides['distance']} is the distance, as a ROS 1 SwissRanger driver names it")
    if "amplitude" not in overrides and topics["amplitude"] not in types:
        found = [name for one in SWISSRANGER_AMPLITUDE if (name := f"{base}/{one}") in types]
        if found:
            overrides["amplitude"] = found[0]
            eight = ", 256 counts each if it is mono8" if is_swissranger_intensity(found[0]) else ""
            assumptions.append(f"{found[0]} is the amplitude{eight}, as a ROS 1 SwissRanger driver names it")
    topics = replace(topics, overrides=overrides)
    if "camera_info" not in overrides and topics["camera_info"] not in types:
        paired = topics.paired_info("distance")
        if paired in types and paired not in overrides.values():
            topics = replace(topics, overrides={**overrides, "camera_info": paired})
    return topics, assumptions


def is_swissranger_intensity(topic: str) -> bool:
    """Whether a mono8 image of that name holds amplitudes of 256 counts each."""
    return topic.endswith("/" + SWISSRANGER_AMPLITUDE[1])


def _with_namespace(topics: Topics, types: Mapping[str, str], assumptions: list[str]) -> Topics:
    names = (ROLES["distance"][0], FURTHER_IMAGES["distance_0"][0], SWISSRANGER_DISTANCE)
    suffixes = tuple("/" + name for name in names)
    found = {
        name.removesuffix(suffix)
        for name, kind in types.items()
        for suffix in suffixes
        if kind == IMAGE and name.endswith(suffix)
    }
    if topics.namespace in found or not found:
        return topics
    if len(found) > 1:
        raise InputError(
            f"{len(found)} namespaces hold distance images: {listed([one or '/' for one in found])}",
            remedy=f"choose one: --topic distance={min(found)}{suffixes[0]} and so on",
        )
    namespace = found.pop()
    assumptions.append(f"the topics are those of the namespace {namespace or '/'}")
    return replace(topics, namespace=namespace)


def require_images(topics: Topics, types: Mapping[str, str]) -> None:
    """Check that a recording (topic: message type) has the topics that a raw frame needs.

    Raises InputError, which names the missing topic, the existing topics and the remedy, or a topic whose
    message type is not that of its role.
    """
    needed = image_roles(topics, types)
    for role in topics.raw_roles:
        name, expected = topics[role], KNOWN_ROLES[role][1]
        if name in types:
            if types[name] != expected:
                raise InputError(
                    f"its type is {types[name]}, the role {role} needs {expected}",
                    place=f"topic {name}",
                    remedy=f"--topic {role}=name",
                )
        elif role in needed or role in topics.overrides:
            raise _missing(role, topics, types)


def image_roles(topics: Topics, types: Mapping[str, str]) -> tuple[str, ...]:
    """Return the roles of the images that a raw frame of a recording (topic: message type) needs.

    With images of several frequencies these are the images of all frequencies up to the last that has one.
    """
    if topics.frequency is not None:
        return ("distance", "amplitude")
    numbers = [int(role.rpartition("_")[2]) for role in FURTHER_IMAGES if topics[role] in types]
    resolved = ("distance", "amplitude") if not numbers or topics["distance"] in types else ()
    count = 2 * (max(numbers) + 1) if numbers else 0
    return (*resolved, *list(FURTHER_IMAGES)[:count])


def _missing(role: str, topics: Topics, types: Mapping[str, str]) -> InputError:
    kind, _, number = role.partition("_")
    other = {"distance": "amplitude", "amplitude": "distance"}.get(kind, "") + (number and f"_{number}")
    without = f"{other} without {role}: " if other in KNOWN_ROLES and topics[other] in types else ""
    kind = KNOWN_ROLES[role][1]
    same = [name for name, one in types.items() if one == kind]
    short = kind.replace("/msg/", "/")
    there = f"topics of type {short}: {listed(same)}" if same else f"no {short}; topics: {listed(types)}"
    return InputError(
        f"{without}no topic {topics[role]}; {there}",
        remedy=f"name it with --topic {role}=name",
    )
