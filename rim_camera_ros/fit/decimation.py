"""Large sensors on a coarser grid: every k-th pixel; parameters in units of pixels are scaled.

Pixels are picked, not averaged, so that no edge is mixed and the noise stays the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import added, with_effects
from rim_camera_ros.effects import CovariateTable, PixelMap, registry, vocabulary
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.effects.candidate import MANY_PIXELS
from rim_camera_ros.effects.covariates import POINTWISE, resampled_knots
from rim_camera_ros.fit.data import Dataset, Station

Array = NDArray[Any]

#: How many pixels a coarser grid has at most.
_COARSE_PIXELS = 30_000
#: ... and how many contain as much information as all where neighbours share their errors.
_CORRELATED_PIXELS = 5_000


def decimation_of(camera: Camera) -> int:
    """Return the step of the coarser grid in pixels, 1 where all pixels are used."""
    pixels = camera.sensor.width * camera.sensor.height
    if pixels <= MANY_PIXELS or any(effect.stated_by_pixels for effect in camera.effects.values()):
        return 1
    return int(np.ceil(np.sqrt(pixels / _COARSE_PIXELS)))


def correlated_decimation(camera: Camera, words: Sequence[str] | None = None) -> int:
    """Return the step of a coarser grid in pixels for fits with errors that neighbours share.

    1 for small sensors, and where all pixels are needed: by effects that are stated by pixels, or by those
    that --effects names (``words``).
    """
    if any(effect.stated_by_pixels for effect in camera.effects.values()):
        return 1
    if words is not None and _needs_all_pixels(camera, words):
        return 1
    return max(1, int(np.sqrt(camera.sensor.width * camera.sensor.height / _CORRELATED_PIXELS)))


def decimation_for(camera: Camera, words: Sequence[str]) -> int:
    """Return the step of the coarser grid [px] on which effects, as --effects names them, can be fitted.

    1 where all pixels are needed: small sensors, and effects that act on neighbours or are stated by
    pixels.
    """
    if _needs_all_pixels(camera, words):
        return 1
    return int(np.ceil(np.sqrt(camera.sensor.width * camera.sensor.height / MANY_PIXELS)))


def _needs_all_pixels(camera: Camera, words: Sequence[str]) -> bool:
    """Whether effects, as --effects names them, cannot be fitted on a coarser grid."""
    covariates = {name for word in words for name in word.split(":")[1:]}
    names = {word.partition(":")[0] for word in words}
    kept = effect_of(camera, CovariateTable)
    if kept is not None:
        covariates |= set(kept.covariates)
    known = vocabulary()
    present = [effect for effect in camera.effects.values() if not isinstance(effect, PixelMap)]
    return (
        any(effect.needs_all_pixels for effect in present)
        or any(known[name].needs_all_pixels for name in names if name in known)
        or bool(covariates - POINTWISE)
    )


def decimated_camera(camera: Camera, step: int) -> Camera:
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
    return with_effects(
        small, {name: effect.resampled(1.0 / step, step) for name, effect in camera.effects.items()}
    )


def decimated_dataset(dataset: Dataset, step: int) -> Dataset:
    """Return the stations on the coarser grid."""
    pick = slice(step // 2, None, step)
    stations = [
        replace(station.part(pick, pick), common=_coarser_common(station, step))
        for station in dataset.stations
    ]
    return replace(dataset, stations=stations, decimation=dataset.decimation * step)


def _coarser_common(station: Station, step: int) -> float | None:
    """Return the common variation relative to noise on the coarser grid, where noise averages out less."""
    return None if station.common is None else 1 + (station.common - 1) / step**2


def full_camera(small: Camera, camera: Camera, step: int) -> Camera:
    """Return the full camera with the effects, optics, noise and gain of the fitted ``small`` one."""
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
    for name, effect in small.effects.items():
        own = camera.effects.get(name)
        result = added(result, own if isinstance(own, PixelMap) else effect.resampled(float(step), None))
    return result


def full_image(image: Array, shape: tuple[int, int], step: int) -> Array:
    """Return an image of the coarser grid for all pixels, each with the value of the nearest one."""
    rows, columns = (
        np.clip(np.round((np.arange(n) - step // 2) / step).astype(int), 0, m - 1)
        for n, m in zip(shape, image.shape, strict=True)
    )
    return np.asarray(image[np.ix_(rows, columns)])


def full_number(path: str, value: float, step: int) -> float:
    """Convert a number of the coarser grid's camera, by its path in the camera file, to the full camera."""
    if path in ("optics.cx", "optics.cy"):
        return value * step + step // 2
    if path.startswith("effects."):
        _, name, inner = path.split(".", 2)
        effect = registry().get(name)
        return value if effect is None else effect.resampled_number(inner, value, step)
    return value * step if path in ("optics.fx", "optics.fy") else value


def full_covariate(name: str, values: Array, step: int) -> Array:
    """Convert values of a covariate from the coarser grid to the full one."""
    return np.asarray(resampled_knots(float(step), name, tuple(np.asarray(values, float).tolist())))
