"""Mixed pixels by their measurements: which pixels measure a distance between two surfaces, and how far off.

A simulation by the centres of pixels and a blur does not know exactly which pixels an edge crosses; the
measurements show it (Kahlmann 2007, sec. 3.3.10, fig. 3.58).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.covariates import EDGE_STEP
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.residuals import after_nuisances

Array = NDArray[Any]

#: Standard deviations from every surface beyond which a distance lies between them.
_SIGNIFICANT = 2.0
#: Distance from every surface [m] beyond which a measurement determines which surface fills more of the
#: pixel; below, slopes and errors of poses are as large.
_TELLING = 0.02
#: Greatest change of a pixel's distance as a multiple of that from the nearer surface: a measurement close to
#: one surface, metres from the other, is more likely an error of the pose.
_MOST = 5.0
#: Share of the ambiguity range up to which the phases of two surfaces have an order.
_ORDERED = 0.45


def measured_between(
    prediction: Prediction, moved: Array, pattern: Array, nuisances: Mapping[str, float]
) -> Array:
    """Return the changes of a station's distances [m] by mixed pixels, (H, W), signed.

    ``moved`` (H, W) [m] is the contribution of the camera's effect; it is kept for pixels that do not measure
    between the nearest and the farthest surface beside them. ``pattern`` (H, W) [m] and ``nuisances`` are
    those of the fit. A pixel that measures one of its surfaces is not mixed, whichever of them its centre
    should see: the poses may be a tenth of a pixel off. The variance of the noise is subtracted. Where less
    light than predicted was measured, the change is divided by the ratio of their noises.
    """
    geometry = prediction.view.geometry
    own = np.where(geometry.hit, geometry.distance, np.nan)
    name = next(name for name, effect in prediction.context.camera.effects.items() if effect.at_edges)
    light = np.where(geometry.hit, prediction.before[name].amplitude, 0.0)
    near, light_of_near = _neighbours(own, light, nearest=True)
    far, light_of_far = _neighbours(own, light, nearest=False)
    rest, _ = after_nuisances(prediction, pattern, nuisances)
    measured = own + rest + moved
    noisier = _noise_by_light(prediction)
    with np.errstate(invalid="ignore"):
        sigma = prediction.sigma * noisier
        off = np.minimum(np.abs(measured - own), np.minimum(measured - near, far - measured))
        mixed = (far - near > EDGE_STEP) & (off > _SIGNIFICANT * sigma) & (prediction.station.count > 0)
        # phasors add: the light of each surface times the sine of the phase to the other, by shares
        wave = 2 * np.pi / prediction.context.ambiguity
        more_near = light_of_far * np.sin(wave * (far - measured)) > light_of_near * np.sin(
            wave * (measured - near)
        )
        expects_near = np.abs(own - near) < np.abs(own - far)
        fuller = np.where(more_near == expects_near, own, np.where(more_near, near, far))
        nearer = np.where(measured - near < far - measured, near, far)
        closest = np.where(np.abs(measured - own) <= np.abs(measured - nearer), own, nearer)
        telling = (off > _TELLING) & (far - near < _ORDERED * prediction.context.ambiguity)
        change = measured - np.where(telling, fuller, closest)
        amount = np.minimum(np.abs(change), _MOST * off)
        amount = np.sqrt(np.maximum(amount**2 - sigma**2, 0.0)) / noisier
        return np.asarray(np.where(mixed, np.copysign(amount, change), moved))


def _neighbours(distance: Array, light: Array, *, nearest: bool) -> tuple[Array, Array]:
    """Return the nearest or the farthest distance [m] of each pixel and its eight neighbours, and its light.

    Infinite, with no light, where none of them sees a surface.
    """
    nothing = np.inf if nearest else -np.inf
    around = [
        np.lib.stride_tricks.sliding_window_view(np.pad(image, 1, constant_values=fill), (3, 3))
        for image, fill in ((np.nan_to_num(distance, nan=nothing), nothing), (light, 0.0))
    ]
    distances, lights = (windows.reshape(*distance.shape, 9) for windows in around)
    chosen = distances.argmin(axis=-1) if nearest else distances.argmax(axis=-1)
    at = chosen[..., None]
    return np.take_along_axis(distances, at, -1)[..., 0], np.take_along_axis(lights, at, -1)[..., 0]


def _noise_by_light(prediction: Prediction) -> Array:
    """Return the ratio of noise at the measured light to that at the predicted one, (H, W), 1 at least."""
    camera = prediction.context.camera
    predicted = prediction.model_amplitude
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = predicted * prediction.station.amplitude / prediction.model_reading
        sigmas = [camera.sigma_distance(np.maximum(light, 1.0)) for light in (measured, predicted)]
        ratio = sigmas[0] / sigmas[1]
    return np.asarray(np.fmax(np.nan_to_num(ratio, nan=1.0, posinf=1.0), 1.0))
