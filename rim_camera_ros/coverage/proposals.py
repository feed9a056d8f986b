"""Proposals for the next station, in words: poses, distances, grey levels, integration times, waiting."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.fit.data import Station
from rim_camera_ros.frame import Pose, Settings
from rim_camera_ros.geometry import see
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Scene, Surface

#: Distances in multiples of that at which the surface fills the image.
_DISTANCES = (1.0, 1.6, 2.6, 4.2)
#: Least distance [m], and the largest as a share of the ambiguity range.
_NEAREST, _FARTHEST = 0.3, 0.9
#: Tilt [rad], and offset from the middle of the image as a share of half its width and height.
_TILT, _ASIDE = math.radians(40.0), 0.6
#: Reflectivities of grey targets.
_GREYS = (0.2, 0.5, 0.8)
#: Waiting times [s].
_WAITS = (600.0, 1800.0)
_PLACES = {
    "in the middle": (0.0, 0.0),
    "at the left": (-_ASIDE, 0.0),
    "at the right": (_ASIDE, 0.0),
    "at the top": (0.0, -_ASIDE),
    "at the bottom": (0.0, _ASIDE),
}


@dataclass(frozen=True)
class Proposal:
    """A station that could be recorded, in words; ``wait`` [s] passes before it.

    ``lasting``: it does not depend on the station before it. ``scene``: that of another target (None: that of
    the recording), with ``light_sigma``, the relative 1-sigma of the difference from its expected light.
    """

    words: str
    settings: Settings
    truth: dict[str, Pose]
    wait: float = 0.0
    lasting: bool = False
    scene: Scene | None = None
    light_sigma: float = 0.0


def proposals(scene: Scene, camera: Camera, last: Station) -> list[Proposal]:
    """Return proposals after the station ``last``: other poses, targets and settings, and waiting."""
    found = [*_poses(scene, camera, last), *_greys(scene, camera, last)]
    current = camera.integration_time(last.settings)
    for setting in sorted(_settings(camera) - {current}):
        other = replace(last.settings, integration_time=setting)
        found.append(Proposal(f"the present pose at integration time {setting:g}", other, dict(last.truth)))
    if last.settings.uptime is not None:
        for wait in _WAITS:
            later = replace(last.settings, uptime=last.settings.uptime + wait)
            words = f"the present pose after {wait / 60:.0f} min more of running"
            found.append(Proposal(words, later, dict(last.truth), wait))
        if last.settings.uptime > _WAITS[0]:
            words = "the present pose within 10 s of switching the camera on, cold"
            found.append(Proposal(words, replace(last.settings, uptime=5.0), dict(last.truth), _WAITS[1]))
    return found


def _poses(scene: Scene, camera: Camera, last: Station) -> Iterator[Proposal]:
    surface = _posed(scene)
    if surface is None or surface.name not in last.truth:
        return
    half = _half_field(camera)
    for number, distance in enumerate(_distances(surface, half, camera.sensor.ambiguity)):
        for place, (across, down) in _PLACES.items() if number % 2 else [("in the middle", (0.0, 0.0))]:
            tilts = {"": (0.0, 0.0)}
            if place == "in the middle":
                degrees = f"{math.degrees(_TILT):.0f} deg"
                tilts |= {
                    f", turned {degrees} sideways": (0.0, _TILT),
                    f", tilted {degrees} back": (_TILT, 0.0),
                }
            for tilt, angles in tilts.items():
                position = (distance * across * half[0], distance * down * half[1], distance)
                yield Proposal(
                    f"{surface.name} at {distance:.2g} m {place}{tilt}",
                    last.settings,
                    {**last.truth, surface.name: Pose(position, _turned(*angles))},
                    lasting=True,
                )


def _greys(scene: Scene, camera: Camera, last: Station) -> Iterator[Proposal]:
    """Yield targets of grey levels that a surface lacks, in its place and where it may be moved to."""
    surface = _posed(scene) or _seen_most(scene, camera, last)
    if surface is None:
        return
    places = {f"in the place of {surface.name}": dict(last.truth)}
    if surface.name in last.truth:
        for distance in _distances(surface, _half_field(camera), camera.sensor.ambiguity):
            facing = Pose((0.0, 0.0, distance), (0.0, 0.0, 0.0, 1.0))
            places[f"at {distance:.2g} m"] = {**last.truth, surface.name: facing}
    for level in _GREYS:
        if _has_level(surface, level):
            continue
        grey = replace(surface, reflectivity=level, texture=None)
        target = replace(
            scene, surfaces=tuple(grey if known is surface else known for known in scene.surfaces)
        )
        for place, truth in places.items():
            yield Proposal(
                f"a grey target of reflectivity {level:g} {place}",
                last.settings,
                truth,
                lasting=place.startswith("at"),
                scene=target,
                light_sigma=surface.reflectivity_sigma,
            )


def _posed(scene: Scene) -> Surface | None:
    """Return the first surface whose pose comes from the recording."""
    return next((surface for surface in scene.surfaces if surface.name in scene.needs_truth), None)


def _seen_most(scene: Scene, camera: Camera, last: Station) -> Surface | None:
    """Return the surface that most pixels see, None where none sees any."""
    geometry = see(scene, scene.poses_for(last.truth), camera.rays)
    pixels = np.bincount(geometry.surface[geometry.hit], minlength=len(scene.surfaces))
    return scene.surfaces[int(pixels.argmax())] if pixels.any() else None


def _has_level(surface: Surface, level: float) -> bool:
    """Return whether a surface already has a grey level, within the uncertainty of both."""
    if surface.texture is not None:
        own = surface.texture.values.values
    else:
        own = np.array([surface.nominal_reflectivity] if surface.is_described else [])
    return bool((np.abs(own - level) <= 2 * surface.reflectivity_sigma * level).any())


def _half_field(camera: Camera) -> tuple[float, float]:
    """Return the tangents of half the angles of view across and down, on the smaller side of each."""
    height, width = camera.shape
    optics = camera.optics
    across = min(optics.cx + 0.5, width - 0.5 - optics.cx) / optics.fx
    down = min(optics.cy + 0.5, height - 0.5 - optics.cy) / optics.fy
    return max(across, 0.05), max(down, 0.05)


def _distances(surface: Surface, half: tuple[float, float], ambiguity: float) -> list[float]:
    if surface.size is not None:
        fills = min(surface.size[0] / (2 * half[0]), surface.size[1] / (2 * half[1]))
    elif surface.radius is not None:
        fills = surface.radius / max(half)
    else:
        fills = _NEAREST
    low = min(max(fills, _NEAREST), _FARTHEST * ambiguity)
    return [low * factor for factor in _DISTANCES if low * factor <= _FARTHEST * ambiguity]


def _turned(about_x: float, about_y: float) -> tuple[float, float, float, float]:
    x = rotation_matrix((math.sin(about_x / 2), 0.0, 0.0, math.cos(about_x / 2)))
    y = rotation_matrix((0.0, math.sin(about_y / 2), 0.0, math.cos(about_y / 2)))
    return quaternion(np.asarray(y @ x))


def _settings(camera: Camera) -> set[float]:
    """Return the integration times for which effects of the camera file have rows."""
    tables = (getattr(effect, part.name) for effect in camera.effects.values() for part in fields(effect))
    return {key for table in tables if isinstance(table, Mapping) for key in table if isinstance(key, float)}
