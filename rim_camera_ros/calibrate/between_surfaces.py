"""Mixed pixels as they measure: which pixels measure a distance between two surfaces, and by how far.

A blur of what the centres of pixels see misses which pixels an edge crosses; the measurement itself shows
it (Kahlmann 2007, sec. 3.3.10, fig. 3.58).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from rim_camera_ros.calibrate.prediction import Prediction
from rim_camera_ros.calibrate.problem import Fit
from rim_camera_ros.calibrate.residuals import after_nuisances
from rim_camera_ros.effects.covariates import EDGE_STEP

Array = NDArray[Any]

#: Standard deviations from every surface beyond which a distance lies between them.
_SIGNIFICANT = 2.0
#: So far from every surface [m] a distance tells which of them fills more of the pixel; nearer to one, slopes
#: and errors of poses do as much.
_TELLING = 0.02
#: Share of the ambiguity range up to which the phases of two surfaces have an order.
_ORDERED = 0.45


#: Pixels count as certainly mixed so far from every surface, in standard deviations, in m and as a share of
#: the step, beside steps of more than so many m.
_CERTAIN, _FAR_OFF, _FAR_WITHIN, _STEP = 5.0, 0.03, 0.1, 0.2
#: Pixels within so many of a step, but not beside it, of which less than this part of the share beside it may
#: lie between surfaces: else it is stray light.
_RING, _FADING = 3, 0.3
#: Share of the pixels beside steps that are certainly mixed, from which nothing but mixed pixels explains
#: them, and the least number of them. In simulated recordings up to 0.2 % are without mixed pixels, 2.6 % with
#: stray light of 5 % over 3 px that is not yet fitted, and 2 to 12 % with footprints of 0.3 to 1 px.
MANY_SHARE, MANY = 0.03, 30


def many_between(fitted: Fit) -> bool:
    """Return whether more pixels measure between two surfaces than errors of poses or other effects do.

    Errors of poses let a pixel measure the other surface, noise moves it by little; a distance amid a step
    takes the light of both. Stray light does so farther from the step, too. Frames whose distances differ by
    more than their noise do not count, and a moving camera tells nothing.
    """
    if fitted.scene.camera_motion.moves:
        return False
    beside, mixed = np.zeros(2), np.zeros(2)
    for one in fitted.forward.predictions(slopes=False):
        own, _ = _seen(one)
        rest, _ = after_nuisances(one, fitted.pattern, fitted.nuisances)
        measured = own + rest
        station = one.station
        with np.errstate(invalid="ignore"):
            spread = np.sqrt(np.nan_to_num(station.distance_variance) / np.maximum(station.count, 1))
            sigma = np.maximum(one.sigma * _noise_by_light(one), spread)
            free = (station.count == station.frames) & (station.saturated == 0) & np.isfinite(measured)
            for ring, reach in enumerate((1, _RING)):
                near, far = (_extreme(own, reach, nearest=nearest) for nearest in (True, False))
                step = (far - near > _STEP) & free
                least = np.maximum(_FAR_WITHIN * np.where(step, far - near, 0.0), _FAR_OFF)
                off = _off(measured, own, near, far)
                mixed[ring] += int((step & (off > np.maximum(_CERTAIN * sigma, least))).sum())
                beside[ring] += int(step.sum())
                # the ring alone
                free &= ~step
    share = mixed / np.maximum(beside, 1)
    return bool(mixed[0] >= MANY and share[0] >= MANY_SHARE and share[1] < _FADING * share[0])


def measured_between(
    prediction: Prediction, moved: Array, pattern: Array, nuisances: Mapping[str, float]
) -> Array:
    """Return what mixed pixels do to the distances of a station [m], (H, W), signed.

    ``moved`` (H, W) [m] is what the effect of the camera does, which holds where no pixel measures
    between the nearest and the farthest surface beside it; ``pattern`` (H, W) [m] and ``nuisances`` are
    those of the fit. A pixel that measures one of its surfaces is not mixed, whichever of them its centre
    should see: the poses may be a tenth of a pixel off. Without the noise's own share, and where less light
    than predicted was measured, as a part of the noise that this light has.
    """
    own, light = _seen(prediction)
    near, light_of_near = _neighbours(own, light, nearest=True)
    far, light_of_far = _neighbours(own, light, nearest=False)
    rest, _ = after_nuisances(prediction, pattern, nuisances)
    measured = own + rest + moved
    noisier = _noise_by_light(prediction)
    with np.errstate(invalid="ignore"):
        sigma = prediction.sigma * noisier
        off = _off(measured, own, near, far)
        mixed = (far - near > EDGE_STEP) & (off > _SIGNIFICANT * sigma) & (prediction.station.count > 0)
        # phasors add: the light of each surface times the sine of the phase to the other, by shares
        wave = 2 * np.pi / prediction.context.ambiguity
        more_near = light_of_far * np.sin(wave * (far - measured)) > light_of_near * np.sin(
            wave * (measured - near)
        )
        expects_near = np.abs(own - near) < np.abs(own - far)
        surface = np.where(more_near == expects_near, own, np.where(more_near, near, far))
        telling = (off > _TELLING) & (far - near < _ORDERED * prediction.context.ambiguity)
        amount = np.where(telling, np.abs(measured - surface), off)
        amount = np.sqrt(np.maximum(amount**2 - sigma**2, 0.0)) / noisier
        return np.asarray(np.where(mixed, np.copysign(amount, measured - surface), moved))


def _seen(prediction: Prediction) -> tuple[Array, Array]:
    """Return the distance [m] of each pixel's surface, NaN where there is none, and its light, (H, W)."""
    geometry = prediction.view.geometry
    before = prediction.before.get("mixed_pixels", prediction.delivered)
    return np.where(geometry.hit, geometry.distance, np.nan), np.where(geometry.hit, before.amplitude, 0.0)


def _off(measured: Array, own: Array, near: Array, far: Array) -> Array:
    """Return how far a distance lies from all surfaces [m], negative where not between them."""
    return np.asarray(np.minimum(np.abs(measured - own), np.minimum(measured - near, far - measured)))


def _extreme(distance: Array, reach: int, *, nearest: bool) -> Array:
    """Return the nearest or the farthest distance within some pixels; infinite where there is no surface."""
    if nearest:
        return np.asarray(minimum_filter(np.nan_to_num(distance, nan=np.inf), 2 * reach + 1))
    return np.asarray(maximum_filter(np.nan_to_num(distance, nan=-np.inf), 2 * reach + 1))


def _neighbours(distance: Array, light: Array, *, nearest: bool) -> tuple[Array, Array]:
    """Return the nearest or the farthest distance [m] of each pixel and its eight neighbours, and its light.

    Infinite, with no light, where none of them sees a surface.
    """
    nothing = np.inf if nearest else -np.inf
    around = [
        np.lib.stride_tricks.sliding_window_view(np.pad(one, 1, constant_values=fill), (3, 3))
        for one, fill in ((np.nan_to_num(distance, nan=nothing), nothing), (light, 0.0))
    ]
    distances, lights = (one.reshape(*distance.shape, 9) for one in around)
    chosen = distances.argmin(axis=-1) if nearest else distances.argmax(axis=-1)
    at = chosen[..., None]
    return np.take_along_axis(distances, at, -1)[..., 0], np.take_along_axis(lights, at, -1)[..., 0]


def _noise_by_light(prediction: Prediction) -> Array:
    """Return how many times noisier than predicted the measured light is, (H, W), at least 1."""
    camera = prediction.context.camera
    predicted = prediction.model_amplitude
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = predicted * prediction.station.amplitude / prediction.model_reading
        sigmas = [
            camera.noise.sigma_distance(np.maximum(one, 1.0), background=camera.background)
            for one in (measured, predicted)
        ]
        ratio = sigmas[0] / sigmas[1]
    return np.asarray(np.fmax(np.nan_to_num(ratio, nan=1.0, posinf=1.0), 1.0))
