"""Where the misfit is: pixels, times and covariates of the missing physics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.between_surfaces import measured_between
from rim_camera_ros.diagnose.smooth import values_of
from rim_camera_ros.effects import CovariateTable, ForeignLight, vocabulary
from rim_camera_ros.effects.base import DistanceTerm
from rim_camera_ros.effects.covariates import COVARIATES
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.select.compare import LEAST_SIZE
from rim_camera_ros.select.effect_sizes import SAME_SIZE, contribution, moved_by_light

Array = NDArray[Any]

_LEAST_SHARE = 0.03
_MOST_COVARIATES = 4
_MOST_STRETCHES = 8
#: 1-sigma [px] of the averaging of residuals, of which the one that predicts the other poses best is used.
_WIDTHS = (0.0, 0.7, 1.0, 1.5, 2.2, 3.2, 4.7, 7.0, 10.0)
#: Relative error to which light that differs between pixels is estimated, least 1-sigma [px] of averaging.
_RATIO = 0.1
_NARROWEST = 1.5


@dataclass(frozen=True)
class Where:
    """The location of a misfit.

    ``pixels`` (H, W) is the mean square over poses in units of the single-frame sigma; ``covariates`` are
    names with the share of the variance that each explains; ``times`` [s] are counted from the first frame;
    ``curves`` by covariate are centres, means [m] and standard errors.
    """

    pixels: Array
    covariates: tuple[tuple[str, float], ...]
    times: tuple[tuple[float, float], ...]
    curves: dict[str, tuple[Array, Array, Array]]


def of_terms(
    fitted: Fit,
    names: Sequence[str],
    origin: Camera,
    *,
    rest: Callable[[Prediction], Array] | None = None,
) -> Where:
    """Locate the contribution of effects of the fitted camera; ``origin`` has the optics before.

    Effects on the amplitude count by the changes of distances that depend on it, where these are `LEAST_SIZE`
    or more (RMS), else by the amplitude itself; effects at edges count by distances that pixels measure
    between surfaces. ``rest`` returns changes (H, W) of the distance [m] in addition to the forms of effects.
    """
    of_light = [name for name in names if vocabulary()[name].shows_in == "amplitude"]
    by_distance = {name for name in of_light if _moves_distances(fitted, name)}

    def value(predicted: Prediction) -> Array:
        shape = predicted.used.shape
        distance, light = np.zeros(shape), np.zeros(shape)
        for name in names:
            physics = vocabulary()[name]
            if name in by_distance:
                distance = distance + moved_by_light(predicted, name)
                continue
            moved = contribution(predicted, name, origin)
            if physics.at_edges:
                moved = measured_between(predicted, moved, fitted.pattern, fitted.nuisances)
            if name in of_light:
                # noise is circular in the complex plane: a relative amplitude corresponds to a phase, in
                # metres
                light = light + moved / SAME_SIZE * predicted.context.ambiguity / (2 * np.pi)
            else:
                distance = distance + moved
        if rest is not None:
            distance = distance + rest(predicted)
        if not light.any():
            return np.asarray(distance)
        return np.copysign(np.hypot(distance, light), distance if distance.any() else light)

    return _locate(fitted, value, centred=list(names) == [CovariateTable.name])


def _moves_distances(fitted: Fit, name: str) -> bool:
    """Return whether distances depend on the light that an effect changes, by terms of the amplitude."""
    terms = [effect for effect in fitted.camera.effects.values() if isinstance(effect, DistanceTerm)]
    if vocabulary()[name].is_response or not any("amplitude" in term.depends_on() for term in terms):
        return False
    predictions = fitted.forward.predictions()
    moved = [moved_by_light(prediction, name)[prediction.used] for prediction in predictions]
    values = np.concatenate(moved)
    return bool(values.size) and float(np.sqrt(np.mean(values**2))) >= LEAST_SIZE


def of_values(fitted: Fit, value: Callable[[Prediction], Array]) -> Where:
    """Locate a function of each station's prediction: changes (H, W) of the distance [m]."""
    return _locate(fitted, value)


def of_noise(fitted: Fit, before: Camera, after: Camera) -> Where:
    """Locate another noise: the root of the change of one frame's variance between two cameras."""

    def value(predicted: Prediction) -> Array:
        sigmas = [
            c.sigma_distance(
                predicted.amplitude, distance=predicted.distance, settings=predicted.station.settings
            )
            for c in (before, after)
        ]
        return np.asarray(np.sqrt(np.abs(sigmas[1] ** 2 - sigmas[0] ** 2)))

    return _locate(fitted, value)


def of_scatter(fitted: Fit, effect: ForeignLight) -> Where:
    """Locate a second camera: the scatter by its effect, in each pixel times the observed ratio to it.

    Its light need not be the same in all pixels. The ratio is that of the excess variance of repeated frames
    to the variance by the effect, averaged over as many neighbours as it takes to estimate it.
    """
    found = _locate(fitted, lambda prediction: effect.scatter(prediction.amplitude, prediction.context))
    excess, model, freedom = (np.zeros(fitted.camera.shape) for _ in range(3))
    for prediction in fitted.forward.predictions(slopes=False):
        relative = prediction.station.distance_variance / _sigma(prediction) ** 2 - 1
        frames = prediction.station.count - 1.0
        valid = prediction.view.geometry.hit & (frames > 0) & np.isfinite(relative)
        excess[valid] += (frames * relative)[valid]
        model[valid] += (frames * found.pixels)[valid]
        freedom[valid] += frames[valid]
    seen = freedom > 0
    if not seen.any() or not model.any():
        return found
    # variances of normal numbers: 2 / freedom, averaged over 4 pi width^2 pixels
    share = model[seen].sum() / freedom[seen].sum()
    error = np.sqrt(2 / freedom[seen].mean()) * (1 + share) / share
    width = float(np.clip(error / _RATIO / np.sqrt(4 * np.pi), _NARROWEST, max(seen.shape)))
    around = cv2.GaussianBlur(np.stack([excess, model], axis=-1), (0, 0), width)
    ratio = np.divide(around[..., 0], around[..., 1], out=np.zeros(seen.shape), where=around[..., 1] > 0)
    return replace(found, pixels=(found.pixels * np.maximum(ratio, 0.0)).astype(np.float32))


def of_change(fitted: Fit, camera: Camera) -> Where:
    """Locate how a fit changes the distances that a camera file predicts."""
    stations = fitted.by_another(camera).predictions(slopes=False)

    def value(predicted: Prediction) -> Array:
        return np.asarray(predicted.distance - next(stations).distance)

    return _locate(fitted, value)


def of_residuals(fitted: Fit) -> Where:
    """Locate the residuals of a fit after nuisances, in the pixels in use.

    The noise is subtracted from the mean squares of pixels and times; the covariates' shares are of the
    variance with noise. Pixels are averaged over the width by which poses predict each other best.
    """

    def value(predicted: Prediction) -> Array:
        rest, _ = after_nuisances(predicted, fitted.pattern, fitted.nuisances)
        return np.where(predicted.used, rest, np.nan)

    return _locate(fitted, value, noise=lambda predicted: predicted.sigma**2)


def of_repeated_frames(fitted: Fit) -> Where:
    """Locate what differs between the frames of a pose: the variance of repeated frames beyond their noise.

    Over which covariates it varies is not examined.
    """

    def value(predicted: Prediction) -> Array:
        return np.sqrt(predicted.station.distance_variance)

    found = _locate(fitted, value, noise=lambda predicted: _sigma(predicted) ** 2)
    return replace(found, covariates=(), curves={})


def nowhere(fitted: Fit) -> Where:
    """Return the location of nothing."""
    return Where(np.zeros(fitted.camera.shape, np.float32), (), (), {})


def _sigma(predicted: Prediction) -> Array:
    camera = predicted.context.camera
    noise = camera.sigma_distance(
        predicted.amplitude, distance=predicted.distance, settings=predicted.station.settings
    )
    return np.asarray(np.hypot(noise, camera.sensor.lsb / np.sqrt(12)))


def _locate(
    fitted: Fit, value: Any, *, centred: bool = False, noise: Callable[[Prediction], Array] | None = None
) -> Where:
    """Return the location of values; ``noise`` returns by what noise raises their squares (H, W) [m^2]."""
    shape = fitted.camera.shape
    # sums of two halves of the poses: the width of the averaging is chosen by cross-validation
    total, count = np.zeros((2, *shape)), np.zeros((2, *shape))
    rng = np.random.default_rng(7)
    energy: list[tuple[float, float, float]] = []
    samples: list[Array] = []
    weights: list[Array] = []
    covariates: dict[str, list[Array]] = {name: [] for name in COVARIATES}
    missing: set[str] = set()
    middle = 0.0
    if centred:
        # the constant of a table belongs to the fixed pattern: the median is subtracted
        parts = [
            np.broadcast_to(value(prediction), shape)[prediction.used]
            for prediction in fitted.forward.predictions()
        ]
        middle = float(np.median(np.concatenate(parts)))
    # a long pose, or one at several settings, is several stations: it counts once
    stations = Counter((station.recording, station.placed) for station in fitted.forward.dataset.stations)
    number = {placed: k for k, placed in enumerate(stations)}
    for prediction in fitted.forward.predictions():
        image = np.broadcast_to(value(prediction), shape) - middle
        if not prediction.used.any():
            continue
        sigma = _sigma(prediction)
        # effects are located also in pixels beside edges, which the fit excludes
        valid = (
            prediction.view.geometry.hit & (prediction.station.count > 0) & np.isfinite(image) & (sigma > 0)
        )
        # a pixel that saturates in some frames only is neither saturated nor unsaturated
        valid &= np.isfinite(sigma) & (prediction.station.saturated == 0)
        if not valid.any():
            continue
        by_noise = np.zeros(1) if noise is None else noise(prediction)[valid] / sigma[valid] ** 2
        placed = (prediction.station.recording, prediction.station.placed)
        part, half_of = 1.0 / stations[placed], number[placed] % 2
        total[half_of][valid] += part * ((image[valid] / sigma[valid]) ** 2 - by_noise)
        count[half_of][valid] += part
        half = prediction.station.duration / 2
        mean_square = float(np.mean((image[valid] / sigma[valid]) ** 2) - by_noise.mean())
        energy.append((prediction.station.time - half, prediction.station.time + half, mean_square))
        pixels = np.flatnonzero(valid.ravel())
        chosen = rng.choice(pixels, min(500, pixels.size), replace=False)
        samples.append(image.ravel()[chosen])
        weights.append(1.0 / sigma.ravel()[chosen] ** 2)
        for name in COVARIATES:
            found = values_of(name, prediction)
            if found is None:
                missing.add(name)
                continue
            covariates[name].append(np.broadcast_to(found, shape).ravel()[chosen].astype(float))
    pixels_map = mean_of_halves(total, count, smooth=noise is not None)
    if not samples:
        return nowhere(fitted)
    known = {
        name: np.concatenate(parts)
        for name, parts in covariates.items()
        if name not in missing and parts and np.ptp(np.concatenate(parts)) > 0
    }
    shares, curves = _shares(np.concatenate(samples), np.concatenate(weights), known)
    return Where(pixels_map, tuple(shares), tuple(_times(energy)), curves)


def mean_of_halves(total: Array, count: Array, *, smooth: bool) -> Array:
    """Return means (H, W), at least 0, from sums and numbers (2, H, W) of two halves of the poses.

    With ``smooth`` they are of each pixel and its neighbours, weighted by the normal distribution whose width
    predicts each half best from the other (cross-validation; Stone 1974).
    """

    def mean(sums: Array, numbers: Array, width: float) -> Array:
        if width > 0:
            sums, numbers = (
                cv2.GaussianBlur(np.ascontiguousarray(x), (0, 0), width) for x in (sums, numbers)
            )
        return np.divide(sums, numbers, out=np.zeros(sums.shape), where=numbers > 1e-9)

    def error(width: float) -> float:
        pairs = ((0, 1), (1, 0))
        return sum(
            float(np.sum(count[b] * (mean(total[a], count[a], width) - mean(total[b], count[b], 0.0)) ** 2))
            for a, b in pairs
        )

    width = min(_WIDTHS, key=error) if smooth else 0.0
    known = count.sum(axis=0) > 0
    return np.where(known, np.maximum(mean(total.sum(axis=0), count.sum(axis=0), width), 0.0), 0.0).astype(
        np.float32
    )


def _shares(
    values: Array, weights: Array, covariates: dict[str, Array]
) -> tuple[list[tuple[str, float]], dict[str, tuple[Array, Array, Array]]]:
    """Explain values by one covariate after the other; the shares of the variance add up to 1 at most."""
    mean = np.average(values, weights=weights)
    rest = values - mean
    variance = float(np.average(rest**2, weights=weights))
    shares: list[tuple[str, float]] = []
    curves: dict[str, tuple[Array, Array, Array]] = {}
    left = dict(covariates)
    while left and variance > 0 and len(shares) < _MOST_COVARIATES:
        tries = {}
        for name, x in left.items():
            bins = _bins(x)
            sums = np.bincount(bins, weights)
            means = np.bincount(bins, weights * rest) / np.maximum(sums, 1e-300)
            explained = float(np.sum(sums * means**2) / weights.sum()) / variance
            tries[name] = (explained, bins, means, sums)
        name = max(tries, key=lambda tried: tries[tried][0])
        explained, bins, means, sums = tries[name]
        if explained < _LEAST_SHARE:
            break
        centres = np.bincount(bins, weights * left[name]) / np.maximum(sums, 1e-300)
        if not shares:
            spread = np.bincount(bins, weights * (rest - means[bins]) ** 2) / np.maximum(sums, 1e-300)
            # covariates with few values leave classes empty
            own = sums > 0
            error = np.sqrt(spread[own] / np.bincount(bins)[own])
            curves[name] = (centres[own], means[own] + mean, error)
        rest = rest - means[bins]
        shares.append((name, explained))
        left.pop(name)
    return shares, curves


def _bins(x: Array, count: int = 16) -> Array:
    edges = np.unique(np.quantile(x, np.linspace(0, 1, count + 1)[1:-1]))
    return np.searchsorted(edges, x, side="right")


def _times(energy: list[tuple[float, float, float]]) -> list[tuple[float, float]]:
    """Return stretches of time that hold 90 % of the energy, from (start, end, energy) of each station.

    They are made of the fewest stations; neighbouring stations are joined, and of many stretches those with
    the shortest gaps.
    """
    energy = sorted(energy)
    values = np.maximum([e for _, _, e in energy], 0.0)
    if values.sum() <= 0:
        return []
    order = np.argsort(-values)
    needed = int(np.searchsorted(np.cumsum(values[order]), 0.9 * values.sum())) + 1
    chosen = sorted(order[:needed].tolist())
    stretches: list[tuple[float, float]] = []
    for before, i in zip([-2, *chosen], chosen, strict=False):
        start, end, _ = energy[i]
        stretches.append((stretches.pop()[0] if i == before + 1 and stretches else start, end))
    while len(stretches) > _MOST_STRETCHES:
        gaps = [later[0] - earlier[1] for earlier, later in pairwise(stretches)]
        k = int(np.argmin(gaps))
        stretches[k : k + 2] = [(stretches[k][0], stretches[k + 1][1])]
    return stretches
