"""Large sensors through a coarser grid: every k-th of their pixels, with what is stated in pixels scaled.

Pixels are picked, not averaged, so that no edge is mixed and the noise stays what it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.candidate import added
from rim_camera_ros.calibrate.stations import Dataset, Station
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.covariates import COVARIATES
from rim_camera_ros.effects.cyclic_error import CyclicError
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.scattering import Ghost, Kernel, Scattering
from rim_camera_ros.footprint import FINE
from rim_camera_ros.parameters import ArrayFile

Array = NDArray[Any]

#: Number of pixels from which a coarser grid is looked at, and how many it has at most.
MANY_PIXELS = 60_000
_COARSE_PIXELS = 30_000
#: Effects stated for pixels of the full grid.
BY_POSITION = ("integral_table", "empirical", "reference_path")
#: Effects that a calibration fits to all pixels: they act on neighbours, or are stated by pixels.
ALL_PIXELS = frozenset(
    {
        "camera_constant",
        "integral_table",
        "lens_distortion",
        "mixed_pixels",
        "multipath",
        "reference_path",
        "saturation_bleed",
        "scattering",
    }
)
#: Covariates of ``empirical`` that a pixel has whatever its neighbours and its place on the grid.
_POINTWISE = frozenset(COVARIATES) - {
    "row", "column", "row_amplitude", "column_amplitude", "contrast", "edge", "saturation"
}  # fmt: skip


def coarseness(camera: Camera) -> int:
    """Return the step of the coarser grid in pixels, 1 where all pixels are looked at."""
    pixels = camera.sensor.width * camera.sensor.height
    if pixels <= MANY_PIXELS or any(name in camera.effects for name in BY_POSITION):
        return 1
    return int(np.ceil(np.sqrt(pixels / _COARSE_PIXELS)))


def coarseness_of(camera: Camera, words: Sequence[str]) -> int:
    """Return the step of the coarser grid [px] on which effects, as --effects names them, can be fitted.

    1 where all pixels are needed: small sensors, and effects that act on neighbours or are stated by
    pixels.
    """
    covariates = {one for word in words for one in word.split(":")[1:]}
    names = {word.partition(":")[0] for word in words}
    kept = camera.effects.get("empirical")
    if isinstance(kept, Empirical):
        covariates |= set(kept.covariates)
    if names & (ALL_PIXELS | {"fixed_pattern_offset"}) or set(camera.effects) & ALL_PIXELS:
        return 1
    if covariates - _POINTWISE:
        return 1
    return int(np.ceil(np.sqrt(camera.sensor.width * camera.sensor.height / MANY_PIXELS)))


def coarser_camera(camera: Camera, step: int) -> Camera:
    """Return the camera that has every ``step``-th pixel, from pixel ``step // 2`` on."""
    first = step // 2
    width, height = (len(range(first, n, step)) for n in (camera.sensor.width, camera.sensor.height))
    optics, pitch = camera.optics, camera.sensor.pixel_pitch
    small = replace(
        camera,
        effects={},
        sensor=replace(
            camera.sensor,
            width=width,
            height=height,
            pixel_pitch=None if pitch is None else (pitch[0] * step, pitch[1] * step),
        ),
        optics=replace(
            optics,
            fx=optics.fx / step,
            fy=optics.fy / step,
            cx=(optics.cx - first) / step,
            cy=(optics.cy - first) / step,
        ),
        covariance=None,
    )
    return with_effects(small, {name: _scaled(one, 1.0 / step, step) for name, one in camera.effects.items()})


def coarser_dataset(dataset: Dataset, step: int) -> Dataset:
    """Return the stations on the coarser grid."""
    pick = (slice(step // 2, None, step), slice(step // 2, None, step))
    names = ("distance", "amplitude", "distance_variance", "amplitude_variance", "count", "saturated")
    stations = [
        replace(one, **_picked(one, pick, names), common=_coarser_common(one, step))
        for one in dataset.stations
    ]
    return replace(dataset, stations=stations, decimation=dataset.decimation * step)


def _coarser_common(station: Station, step: int) -> float | None:
    """Return the variation that fewer pixels have in common: noise averages out less."""
    return None if station.common is None else 1 + (station.common - 1) / step**2


def _picked(station: Station, pick: tuple[slice, slice], names: Sequence[str]) -> dict[str, Any]:
    return {name: np.ascontiguousarray(getattr(station, name)[pick]) for name in names}


def finer_camera(small: Camera, camera: Camera, step: int) -> Camera:
    """Return the full camera with the effects, optics, noise and gain that a coarser one came to have."""
    optics = small.optics
    first = step // 2
    result = replace(
        camera,
        effects={},
        radiometry=small.radiometry,
        noise=small.noise,
        optics=replace(
            optics,
            fx=optics.fx * step,
            fy=optics.fy * step,
            cx=optics.cx * step + first,
            cy=optics.cy * step + first,
        ),
    )
    for name, one in small.effects.items():
        own = camera.effects.get(name)
        result = added(
            result, own if isinstance(own, FixedPatternOffset) else _scaled(one, float(step), None)
        )
    return result


def finer_image(image: Array, shape: tuple[int, int], step: int) -> Array:
    """Return an image of the coarser grid on all pixels, each with the value of the nearest."""
    rows, columns = (
        np.clip(np.round((np.arange(n) - step // 2) / step).astype(int), 0, m - 1)
        for n, m in zip(shape, image.shape, strict=True)
    )
    return np.asarray(image[np.ix_(rows, columns)])


def finer_number(path: str, value: float, step: int) -> float:
    """Return a number of the coarser grid's camera, by its path in the camera file, as the full one's."""
    name = path.rpartition(".")[2]
    if path in ("optics.cx", "optics.cy"):
        return value * step + step // 2
    if path.startswith("effects.cyclic_error.gradient."):
        return value / step
    if path == "effects.mixed_pixels.footprint":
        return min(value * step, FINE.widest)
    by_pixels = path in ("optics.fx", "optics.fy", "effects.mixed_pixels.blur")
    if path.startswith("effects.scattering."):
        by_pixels = name != "weight"
    return value * step if by_pixels else value


def finer_covariate(name: str, values: Array, step: int) -> Array:
    """Return the values of a covariate of the coarser grid as they are on the full one."""
    return np.asarray(_knots(float(step), name, tuple(np.asarray(values, float).tolist())))


def _knots(factor: float, covariate: str, knots: tuple[float, ...]) -> tuple[float, ...]:
    """Return knots over a covariate with ``factor`` times as many pixels along each axis."""
    if covariate in ("row", "column"):
        # from pixel step // 2 on
        first = round(max(factor, 1 / factor)) // 2
        return tuple(one * factor + first if factor > 1 else (one - first) * factor for one in knots)
    if covariate in ("edge", "saturation"):
        return tuple(one * factor for one in knots)
    return knots


def _scaled(effect: Effect, factor: float, step: int | None) -> Effect:
    """Scale what an effect states in pixels; a map is thinned out where a ``step`` is given."""
    if isinstance(effect, Scattering):
        kernels = tuple(
            Kernel(one.weight, (one.sigma[0] * factor, one.sigma[1] * factor)) for one in effect.kernels
        )
        ghost = effect.ghost
        if ghost is not None:
            ghost = Ghost(ghost.weight, (ghost.shift[0] * factor, ghost.shift[1] * factor))
        return Scattering(kernels=kernels, ghost=ghost)
    if isinstance(effect, MixedPixels):
        side = effect.footprint
        # no wider than can be sampled: no pixel of the full grid is
        side = None if side is None else min(side * factor, FINE.widest)
        return replace(effect, blur=effect.blur * factor, footprint=side)
    if isinstance(effect, CyclicError):
        return replace(effect, gradient=(effect.gradient[0] / factor, effect.gradient[1] / factor))
    if isinstance(effect, Empirical):
        return replace(effect, knots=tuple(map(partial(_knots, factor), effect.covariates, effect.knots)))
    if isinstance(effect, FixedPatternOffset) and step is not None:
        picked = effect.map.values[step // 2 :: step, step // 2 :: step]
        return FixedPatternOffset(map=ArrayFile(effect.map.file, np.ascontiguousarray(picked)))
    return effect
