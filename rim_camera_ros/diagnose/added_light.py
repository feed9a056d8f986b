"""Light that does not come from the scene, as a description of unknown physics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import in_order
from rim_camera_ros.diagnose.smooth import UNKNOWN
from rim_camera_ros.effects import AdditionalLight
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.effects.candidate import Candidate, linear
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.select.compare import Result, in_addition, misfit
from rim_camera_ros.select.exploration import explore
from rim_camera_ros.select.thresholds import LEAST_EXPLAINED

#: Covariates over which the errors by such light vary.
COVARIATES_OF_LIGHT = ("column", "row", "amplitude", "distance")
#: Number of knots over the array, about.
_KNOTS = 64
#: Resultant length of the phases, weighted by the square of the light, above which it has come by one way.
_ONE_WAY = 0.9


@dataclass(frozen=True)
class LightFound:
    """Added light: its gain over the camera file and ``on_top`` of the effects found, and the camera with it.

    Gains and the ``threshold`` are in nats on held-out poses.
    """

    gain: float
    on_top: float
    threshold: float
    camera: Camera


def light_candidate(camera: Camera) -> Candidate | None:
    """Return the candidate: values at knots that are spaced evenly over the array.

    None where the camera file already has such light.
    """
    if effect_of(camera, AdditionalLight) is not None:
        return None
    width, height = camera.sensor.width, camera.sensor.height
    spacing = np.sqrt(width * height / _KNOTS)
    across, down = (max(2, round(size / spacing) + 1) for size in (width, height))
    nothing = ((0.0,) * across,) * down
    light = AdditionalLight(real=nothing, imaginary=nothing)
    return replace(linear(light, light.priors()), effect=UNKNOWN)


def added_light(result: Result, seed: int) -> LightFound | None:
    """Score light that does not come from the scene after a search.

    None where the camera file has some, or where it explains less than half of what the search left.
    """
    baseline, final = result.explorations[0], result.explorations[-1]
    candidate = light_candidate(final.fit.camera)
    if candidate is None:
        return None
    over = step = in_addition(final.fit, candidate, result.problem, result.folds)
    if float(step.gains[0]) < LEAST_EXPLAINED * misfit(final):
        return None
    if result.found:
        over = explore(
            replace(result.problem, geometry=(), reflectance=False, response=None),
            baseline.fit.camera,
            [],
            result.folds,
            further=[candidate],
            views=final.fit.forward.views,
            seed=seed,
            replicates=0,
            iterations=1,
        )
    return LightFound(
        gain=float(over.gains[0]),
        on_top=float(step.gains[0]),
        threshold=float(step.thresholds[0]),
        camera=in_order(candidate.build(step.fit.camera, step.scores.values(step.spans[0]))),
    )


def median_integration_time(fitted: Fit) -> float:
    """Return the median integration time of a fit's stations, which is that of one of them."""
    stations = fitted.forward.dataset.stations
    times = sorted(fitted.camera.integration_time(station.settings) for station in stations)
    return times[len(times) // 2]


def place_of_light(camera: Camera) -> str:
    """Return in words where the added light of a camera is strongest, in its own pixels."""
    light = effect_of(camera, AdditionalLight)
    assert light is not None
    strength = np.abs(light.image(camera.shape))
    row, column = np.unravel_index(int(strength.argmax()), strength.shape)
    return f"column {column}, row {row}"


def sentence_of_light(fitted: Fit, size: float) -> str:
    """Describe the added light of a fitted camera; ``size`` [m] is how far it moves distances."""
    light = effect_of(fitted.camera, AdditionalLight)
    assert light is not None
    camera, time = fitted.camera, median_integration_time(fitted)
    added = camera.radiometry.gain * time * light.image(camera.shape)
    strength = np.abs(added)
    sentence = (
        f"unknown physics: light of the emitter that does not come from the scene reaches the pixels: up to "
        f"{strength.max():.3g} counts at an integration time of {time:g}, most at {place_of_light(camera)}"
    )
    resultant = np.sum(added * strength) / np.sum(strength**2)
    if abs(resultant) > _ONE_WAY:
        away = float(np.angle(resultant) % (2 * np.pi)) / (2 * np.pi) * camera.sensor.ambiguity
        sentence += f", as from {away:.2f} m (modulo {camera.sensor.ambiguity:.2f} m)"
    return sentence + (
        f"; the 5 % of the distances that it moves most are moved by {size * 1e3:.3g} mm (RMS); a leak, a "
        "reflection within the housing or a bright object that the scene file lacks would do so"
    )
