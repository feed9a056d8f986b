"""Profiles of drivers: which topics hold distance, amplitude and settings, and in which form.

A profile is a small YAML file (``rim_profile/1``). Those in ``profiles/`` are found by name, and each states
the repository and file of the driver from which it was written.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.parameters import decode, quantity
from rim_camera_ros.yaml_files import read_yaml

PROFILE_FORMAT = "rim_profile/1"

#: The profile to copy for a driver without one; it is not tried on recordings.
TEMPLATE = "template"

#: Meaning of a pixel of the distance image: depth along the optical axis, distance from the projection
#: centre, or the point itself (32FC3).
Kind = Literal["z", "radial", "points"]

_FOLDER = Path(__file__).parent / "profiles"


@dataclass(frozen=True)
class DistanceSource:
    """The distance image. Topics are names below the namespace, the best first."""

    topics: tuple[str, ...] = quantity("-", "image topics below the namespace, the best first")
    kind: Kind = quantity("-", "z, radial or points (32FC3)")
    unit: float | None = quantity(
        "m",
        "metres per count of a 16-bit image; null: the camera file's distance_lsb",
        default=None,
        above=0.0,
    )
    offset: float = quantity("m", "metres of count 0 of a 16-bit image", default=0.0)
    unit_needed: str | None = quantity(
        "-",
        "why the unit must be given on the command line, where the driver scales by a setting",
        default=None,
    )


@dataclass(frozen=True)
class AmplitudeSource:
    """The amplitude or infrared image."""

    topics: tuple[str, ...] = quantity("-", "image topics below the namespace, the best first")
    counts: float = quantity(
        "counts", "amplitude of one grey value of an 8-bit image", default=1.0, above=0.0, maximum=257.0
    )


@dataclass(frozen=True)
class CameraInfoSource:
    """The geometry of the distance image."""

    topics: tuple[str, ...] = quantity("-", "CameraInfo topics below the namespace, the best first")
    rectified: bool | None = quantity(
        "-",
        "whether the images are rectified, so that P holds; null: where the topic's name says _rect",
        default=None,
    )


@dataclass(frozen=True)
class SettingSource:
    """A number in a message of settings, with the definition of a message type that is not part of ROS."""

    topics: tuple[str, ...] = quantity("-", "topics below the namespace, the best first")
    path: str = quantity("-", "dotted path of the number in the message; a text in JSON is entered")
    scale: float = quantity("-", "factor to the unit of the setting", default=1.0)
    definition: str | None = quantity(
        "-", "message definition; null: one of ROS's own packages", default=None
    )


@dataclass(frozen=True)
class Profile:
    """Description of the topics of a driver."""

    driver: str = quantity("-", "name of the driver")
    source: tuple[str, ...] = quantity("-", "repositories, versions and files that this was read from")
    device: str = quantity("-", "name of the camera")
    distance: DistanceSource = quantity("-", "distance image")
    amplitude: AmplitudeSource = quantity("-", "amplitude image")
    camera_info: CameraInfoSource = quantity("-", "geometry")
    format: str = PROFILE_FORMAT
    namespace: str = quantity("-", "namespace by the driver's launch file", default="/camera")
    integration_time: SettingSource | None = quantity("-", "integration time", default=None)
    body_temperature: SettingSource | None = quantity("degC", "temperature of the camera", default=None)
    modulation_frequency: float | None = quantity(
        "Hz", "modulation frequency where it is public; of several the highest", default=None, above=0.0
    )
    also: tuple[str, ...] = quantity("-", "further topics by which the driver is known", default=())
    notes: tuple[str, ...] = quantity("-", "what a user must know of this driver's images", default=())
    name: str = field(default="", metadata={"unit": "-", "doc": "set by the file's name"})

    def names(self) -> tuple[str, ...]:
        """All topic names in the profile, without transports."""
        found = [*self.distance.topics, *self.amplitude.topics, *self.camera_info.topics]
        for setting_source in (self.integration_time, self.body_temperature):
            found += setting_source.topics if setting_source is not None else ()
        return tuple(dict.fromkeys([*found, *self.also]))


def shipped_profiles() -> tuple[str, ...]:
    """Return the names of the shipped profiles, without the template."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml") if path.stem != TEMPLATE))


def find_profile(name: str) -> Path:
    """Return the path of a profile, given as a path or a name. Raises `InputError` for an unknown one."""
    path = Path(name)
    if path.suffix in (".yaml", ".yml") or len(path.parts) > 1:
        if not path.is_file():
            raise InputError(
                "no such profile", file=name, remedy=f"give a file or one of: {', '.join(shipped_profiles())}"
            )
        return path
    known = (*shipped_profiles(), TEMPLATE)
    if name not in known:
        near = nearest_name(name, known)
        listed = f"shipped: {', '.join(shipped_profiles())}"
        raise InputError(
            "no profile of this name",
            file=name,
            remedy=f"{near} {listed}" if near.startswith("did") else listed,
        )
    return _FOLDER / f"{name}.yaml"


def load_profile(name: str) -> Profile:
    """Read a profile by its name or path. Raises `InputError` for any error in it."""
    path = find_profile(name)
    document = read_yaml(path)
    stated = document.data.get("format") if isinstance(document.data, dict) else None
    if stated != PROFILE_FORMAT:
        raise document.error(
            ("format",), f"not a profile: format is {stated!r}", f"expected format: {PROFILE_FORMAT}"
        )
    if "name" in document.data:
        raise document.error(("name",), "unknown key", "the file's name is the profile's")
    content = decode(Profile, {**document.data, "name": path.stem}, document)
    if content.distance.kind == "z" and content.distance.unit is None and not content.distance.unit_needed:
        raise document.error(
            ("distance",), "unit is missing", "depth along z needs metres per count, for example unit: 0.001"
        )
    return content
