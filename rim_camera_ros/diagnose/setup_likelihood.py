"""The likelihood of a recording by a set-up: predictions of some poses, and differences of two set-ups.

Two set-ups are compared by the same pixels, those that the files as given describe. A pixel that an edge may
reach can see what its neighbours see: the best of these counts, for both set-ups alike. Losses are twice the
negative log likelihood up to a constant that all set-ups share; their squares are bounded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.diagnose.hypotheses import Files
from rim_camera_ros.diagnose.setup_trials import CAMERA_AMPLITUDE, coarse_forward
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.views import Views
from rim_camera_ros.phasor import wrap_residual

Array = NDArray[Any]
#: A pose: recording and pose.
Key = tuple[int, int]

#: 1-sigma of the difference in distance between a camera and its file [m].
_CAMERA_DISTANCE = 0.03
#: Bound on the squares of standardised residuals.
_MOST = 9.0
#: Offsets in rows and columns of the neighbours of a pixel.
_NEIGHBOURS = [(v, u) for v in (-1, 0, 1) for u in (-1, 0, 1) if (v, u) != (0, 0)]
#: 1-sigma of reflectivities that the scene file calls known.
_EXACT = 1e-3
#: Rounds of weights by the loss of Huber.
_ROUNDS = 20


@dataclass(frozen=True)
class Look:
    """The comparison of a pose with the prediction by a set-up, each (H, W).

    ``distance`` is the loss of the distances, ``ratio`` the logarithm of measured over predicted amplitudes
    with its ``variance``, ``expected`` the loss by noise alone, ``tile`` the number of the tile. ``seen``
    marks the pixels where these hold, ``blind`` those that measured something where nothing is predicted.
    ``weight`` is the share of an independent observation that a pixel counts for.
    """

    distance: Array
    ratio: Array
    variance: Array
    expected: Array
    tile: Array
    seen: NDArray[np.bool_]
    blind: NDArray[np.bool_]
    weight: float


@dataclass(frozen=True)
class SetupPrediction:
    """The looks of poses by a set-up, without the ``offset`` [m] that all its distances share.

    The offset belongs to the camera, not to the set-up. ``sigma`` (T,) is the relative 1-sigma of each tile's
    reflectivity.
    """

    looks: Mapping[Key, Look]
    sigma: Array
    offset: float


@dataclass(frozen=True)
class Difference:
    """The gain of a set-up over another [nats]: in each pose (P,), and by the reflectivities of all poses.

    ``short`` is the misfit of the other one beyond noise and stated errors, ``left`` that of the set-up;
    ``count`` is the number of patches of neighbours that are compared.
    """

    poses: Array
    reflectivities: float
    short: float
    left: float
    count: float


def predicted(
    files: Files, before: SetupPrediction | None = None, *, views: Views | None = None
) -> SetupPrediction:
    """Return the predictions by files of the stations of their recording, one of each pose.

    Predictions ``before`` of other stations by the same files are included, and their offset is used.
    ``views`` as in `coarse_forward`.
    """
    scene = files[1]
    forward = coarse_forward(*files, views=views)
    predictions = list(forward.predictions(slopes=False))
    offset = _common_offset(predictions) if before is None else before.offset
    looks = {} if before is None else dict(before.looks)
    looks |= {
        (prediction.station.recording, prediction.station.pose): _look(forward, prediction, offset)
        for prediction in predictions
        if (prediction.station.count > 0).any()
    }
    sigma = [np.full(surface.tiles, max(surface.reflectivity_sigma, _EXACT)) for surface in scene.surfaces]
    return SetupPrediction(looks, np.concatenate(sigma), offset)


def _common_offset(predictions: Sequence[Prediction]) -> float:
    """Return the median residual [m] of distances over all pixels of a set-up; 0 without any."""
    apart = np.concatenate(
        [
            np.zeros(0),
            *(
                prediction.residual[prediction.view.clean & (prediction.station.count > 0)]
                for prediction in predictions
            ),
        ]
    )
    apart = apart[np.isfinite(apart)]
    return float(np.median(apart)) if apart.size else 0.0


def _look(forward: Forward, seen: Prediction, offset: float) -> Look:
    measured, view = seen.station.count > 0, seen.view
    hit, clean = view.geometry.hit, view.clean
    described = np.array([each.is_described for each in forward.scene.surfaces])[view.geometry.surface]
    scatter = seen.sigma**2 + _CAMERA_DISTANCE**2
    wraps, period = forward.camera.sensor.wraps, seen.context.ambiguity

    def loss_of(light: Array, away: Array, is_described: Array) -> tuple[Array, Array, Array]:
        """Distance loss, log ratio and its variance by predictions ``away`` [m] from the own ones."""
        rest = seen.residual - offset + away
        rest = wrap_residual(rest, period) if wraps else rest
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.log(seen.station.amplitude / light)
            variance = (seen.amplitude_noise / light) ** 2 + CAMERA_AMPLITUDE**2
            distance = np.minimum(np.nan_to_num(rest**2 / scatter, nan=_MOST), _MOST)
        distance = distance + _spread(scatter, _CAMERA_DISTANCE)
        # without an amplitude the loss is greatest; amplitudes of surfaces without a description do not count
        ratio = np.where(is_described, np.where(np.isfinite(ratio), ratio, np.inf), 0.0)
        return distance, ratio, variance

    images = [*loss_of(seen.model_amplitude, np.zeros(hit.shape), described), view.geometry.tile.copy()]
    least = _total(*images[:3])
    expected = seen.sigma**2 / scatter + (images[2] - CAMERA_AMPLITUDE**2) / images[2]
    expected = expected + _spread(scatter, _CAMERA_DISTANCE) + _spread(images[2], CAMERA_AMPLITUDE)
    for by in _NEIGHBOURS:
        light, there, is_described, tile = (
            _shifted(x, by) for x in (seen.model_amplitude, seen.distance, described, view.geometry.tile)
        )
        other = [*loss_of(light, seen.distance - there, is_described), tile]
        total = _total(*other[:3])
        better = ~clean & _shifted(hit, by) & (total < least)
        for image, value in zip([*images, least], [*other, total], strict=True):
            image[better] = value[better]
    # pixels at the border of what is described are half covered: neither seen nor blind
    near = cv2.dilate(hit.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    alike = float(np.median(forward.views.alike(view)[clean])) if clean.any() else np.inf
    distance, ratio, variance, tile = images
    return Look(
        distance=distance,
        ratio=ratio,
        variance=variance,
        expected=np.nan_to_num(expected, posinf=0.0),
        tile=tile,
        seen=measured & hit,
        blind=measured & ~near,
        weight=1.0 / alike,
    )


def _total(distance: Array, ratio: Array, variance: Array) -> Array:
    return np.asarray(distance + np.minimum(ratio**2 / variance, _MOST) + _spread(variance, CAMERA_AMPLITUDE))


def _spread(variance: Array, least: float) -> Array:
    """Return the loss by the size of a variance whose ``least`` sigma is given: wide densities are low."""
    return np.asarray(np.nan_to_num(np.log(variance / least**2), posinf=_MOST))


def _shifted(image: Array, by: tuple[int, int]) -> Array:
    """Return an image (H, W) shifted ``by`` so many rows and columns, with its border repeated."""
    height, width = image.shape
    padded = np.pad(image, 1, mode="edge")
    return padded[1 + by[0] : 1 + by[0] + height, 1 + by[1] : 1 + by[1] + width]


def difference(given: SetupPrediction, other: SetupPrediction) -> Difference:
    """Return the gain of a set-up over the files as ``given``.

    Where these describe not a single pixel of a pose, by the pixels that the other set-up describes.
    """
    regions, weights = {}, {}
    for key in sorted(given.looks.keys() & other.looks.keys()):
        own, its = given.looks[key], other.looks[key]
        regions[key] = own.seen & (its.seen | its.blind) if own.seen.any() else its.seen
        weights[key] = own.weight or its.weight
    before, cost_before, short = _losses(given, regions, weights)
    after, cost_after, left = _losses(other, regions, weights)
    return Difference(
        poses=0.5 * (before - after),
        reflectivities=0.5 * (cost_before - cost_after),
        short=0.5 * short,
        left=0.5 * left,
        count=sum(weights[key] * float(region.sum()) for key, region in regions.items()),
    )


def _losses(
    setup: SetupPrediction, regions: Mapping[Key, Array], weights: Mapping[Key, float]
) -> tuple[Array, float, float]:
    """Return the losses of each pose in its region (P,), of the reflectivities, and those beyond noise.

    Pixels without a prediction have the greatest loss.
    """
    parts = [
        (setup.looks[key], region & setup.looks[key].seen, weights[key]) for key, region in regions.items()
    ]
    nothing = [np.zeros(0)]
    ratio, variance, tile = (
        np.concatenate(nothing + [getattr(look, name)[pixels] for look, pixels, _ in parts])
        for name in ("ratio", "variance", "tile")
    )
    counts = [int(pixels.sum()) for _, pixels, _ in parts]
    weight = np.repeat([each for _, _, each in parts], counts)
    pose = np.repeat(np.arange(len(parts)), counts)
    light = _light(pose, tile.astype(int), ratio, variance, weight, sigma=setup.sigma, poses=len(parts))
    losses = []
    for k, ((look, pixels, each), region) in enumerate(zip(parts, regions.values(), strict=True)):
        rest = look.ratio[pixels] - light.power[k] - light.errors[look.tile[pixels]]
        bounded = np.minimum(rest**2 / look.variance[pixels], _MOST) + _spread(
            look.variance[pixels], CAMERA_AMPLITUDE
        )
        missed = int(region.sum() - pixels.sum())
        losses.append(each * (float(look.distance[pixels].sum() + bounded.sum()) + 2 * _MOST * missed))
    expected = sum(each * float(look.expected[pixels].sum()) for look, pixels, each in parts)
    beyond = float(np.sum(losses)) - expected + float(np.sum(light.errors**2 / setup.sigma**2))
    return np.array(losses), light.cost, beyond


@dataclass(frozen=True)
class _Light:
    """Log errors of the power of each pose (P,) and of the reflectivity of each tile (T,).

    ``cost`` is the total loss by the errors of the reflectivities.
    """

    power: Array
    errors: Array
    cost: float


def _light(
    pose: Array, tile: Array, ratio: Array, variance: Array, weight: Array, *, sigma: Array, poses: int
) -> _Light:
    """Estimate the powers of ``poses`` and the reflectivities of tiles jointly from pixels (N,).

    They are estimated jointly, as the power of a pose that sees mostly one tile would otherwise absorb that
    tile's error. Powers are free. The error of a tile is the same in all poses, with a normal prior of
    1-``sigma`` (T,), and is integrated out by Laplace's method (Kass & Raftery 1995, eq. 5). Medians of the
    pixels of a tile in a pose are adjusted with the loss of Huber (1964), so that a wrong pattern moves no
    power.
    """
    known = np.isfinite(ratio) & (weight > 0)
    tiles = sigma.size
    cells, cell = np.unique(pose[known] * tiles + tile[known], return_inverse=True)
    seen, column = np.unique(cells // tiles, return_inverse=True)
    median = np.array([np.median(ratio[known][cell == k]) for k in range(cells.size)])
    precision = np.bincount(cell, (weight / variance)[known], minlength=cells.size)
    scale = np.sqrt(np.bincount(cell, weight[known], minlength=cells.size) / precision)
    design = np.zeros((cells.size, seen.size + tiles))
    design[np.arange(cells.size), column] = 1.0
    design[np.arange(cells.size), seen.size + cells % tiles] = 1.0
    prior = np.diag(np.r_[np.zeros(seen.size), sigma**-2.0])
    found = np.zeros(seen.size + tiles)
    for _ in range(_ROUNDS):
        weights = precision / np.maximum(1.0, np.abs(median - design @ found) / scale)
        found = np.linalg.solve(design.T @ (weights[:, None] * design) + prior, design.T @ (weights * median))
    normal = design.T @ (precision[:, None] * design) + prior
    errors = found[seen.size :]
    # without the powers: the Schur complement
    log_determinant = np.linalg.slogdet(normal)[1] - np.sum(np.log(np.diag(normal)[: seen.size]))
    power = np.zeros(poses)
    power[seen] = found[: seen.size]
    cost = np.sum(errors**2 / sigma**2) + log_determinant + 2 * np.sum(np.log(sigma))
    return _Light(power, errors, float(cost))
