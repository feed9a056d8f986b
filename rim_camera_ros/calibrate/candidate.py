"""What a candidate is: one variant of an effect as regressors, and what recordings must contain for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from rim_camera_ros.calibrate.blocks import Block
from rim_camera_ros.calibrate.stations import Dataset
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.scattering import Scattering

Coefficients = Mapping[str, float]


@dataclass(frozen=True)
class Candidate:
    """One variant of an effect that a camera file lacks.

    ``effect`` is its name in the vocabulary, ``variant`` tells variants apart; ``build`` makes the camera
    with it from the coefficients by label. ``positive`` coefficients by label: light that is added cannot be
    negative, which speaks for something else.
    """

    effect: str
    variant: str
    block: Block
    build: Callable[[Camera, Coefficients], Camera]
    positive: tuple[str, ...] = ()


@dataclass(frozen=True)
class Facts:
    """What the recordings contain, as far as the library depends on it."""

    integration_times: tuple[float, ...]
    amplitude: float
    uptime: tuple[float, float] | None
    ambient: tuple[float, float] | None
    saturated: bool
    moves: bool
    surfaces: int

    @classmethod
    def of(cls, dataset: Dataset, *, moves: bool, surfaces: int, camera: Camera) -> Facts:
        """Collect them from the stations."""
        times = {camera.integration_time(one.settings) for one in dataset.stations}
        uptimes = [one.settings.uptime for one in dataset.stations]
        ambients = [one.settings.ambient_temperature for one in dataset.stations]
        known_up = [u for u in uptimes if u is not None]
        known_ambient = [a for a in ambients if a is not None]
        bright = [
            float(np.median(one.amplitude[one.count > 0])) for one in dataset.stations if one.count.any()
        ]
        return cls(
            integration_times=tuple(sorted(times)),
            amplitude=float(np.median(bright)) if bright else 1.0,
            uptime=(min(known_up), max(known_up)) if len(known_up) == len(uptimes) and known_up else None,
            ambient=(min(known_ambient), max(known_ambient)) if known_ambient else None,
            saturated=any(bool(one.saturated.any()) for one in dataset.stations),
            moves=moves,
            surfaces=surfaces,
        )


def added(camera: Camera, effect: Effect) -> Camera:
    """Return the camera with one effect more, in the order along the light."""
    return with_effects(camera, {**camera.effects, effect.name: effect})


def without_idle_halos(camera: Camera) -> Camera:
    """Return the camera without halos of stray light that were fitted with no light; itself without such."""
    effect = camera.effects.get("scattering")
    if not isinstance(effect, Scattering) or (lean := effect.without_idle_halos()) == effect:
        return camera
    return added(camera, lean)
