"""Whether repeated frames scatter according to the noise model, and independently from pixel to pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar, nnls
from scipy.special import fdtri

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import ForeignLight
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.fit.common_variation import Movement, together
from rim_camera_ros.fit.data import KEPT_FRAMES, Station
from rim_camera_ros.fit.design import BEYOND
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.noise import relative_variance
from rim_camera_ros.noise import Noise
from rim_camera_ros.select.thresholds import LEAST_SIGMA, NOISE_SIGMA

Array = NDArray[Any]

#: Share of a pixel's variance above which the common variation of all pixels is light of a second camera: the
#: read-out causes a little of it in every real camera.
LEAST_COMMON_SHARE = 0.003
#: Standard deviations, for independent frames with the light of a second camera, above which the common
#: variation is a drift (persistence), or tilts distances and not amplitudes.
_DRIFTS = 4.0
#: Probability of independent frames to be classified as ones whose first differs.
_BEGINS_BY_CHANCE = 0.001
_BINS = 10
#: Quantile of the noise that counts as that of the most precise values.
_PRECISE = 0.05
#: Factors on the light that a response of another form than the true one may leave.
_SCALES = (0.8, 1.25)


@dataclass(frozen=True)
class VarianceBin:
    """Pixels of similar amplitude [counts]: measured over modelled variance, with its standard error."""

    amplitude: float
    ratio: float
    sigma: float


@dataclass(frozen=True)
class Variance:
    """The evidence of repeated frames.

    ``ratio`` is measured over modelled variance of all pixels, with standard error ``sigma``; ``noise`` is
    the model fitted to them; ``common`` is the mean of `data.Station.common` over stations, with standard
    error ``common_sigma`` (1: pixels scatter independently). ``floor`` [m] is the RMS of the noise of station
    means, ``precise`` [m] that of one frame in the most precise twentieth of the values.
    ``background`` [counts] is unmodulated light that explains the excess as well as another noise (0: it does
    not). ``common_share`` is the share of a pixel's variance that all pixels have in common; ``movement`` is
    the common movement of the stations' frames (None: not known).
    """

    ratio: float
    sigma: float
    bins: tuple[VarianceBin, ...]
    noise: Noise
    common: float | None
    common_sigma: float
    floor: float
    repeated: bool
    background: float = 0.0
    common_share: float = 0.0
    movement: Movement | None = None
    precise: float = 0.0

    @property
    def noise_is_wrong(self) -> bool:
        """Whether the noise section is contradicted; False with light of a second camera, which hides it."""
        if not self.repeated or self.pixels_vary_together:
            return False
        ratios = [
            (self.ratio, self.sigma),
            *((variance_bin.ratio, variance_bin.sigma) for variance_bin in self.bins),
        ]
        return any(abs(ratio - 1) > max(BEYOND * NOISE_SIGMA, LEAST_SIGMA * sigma) for ratio, sigma in ratios)

    @property
    def pixels_vary_together(self) -> bool:
        """Whether all pixels share light that varies from frame to frame (a second camera)."""
        return self._common_variation and not self.moves and not self.begins

    @property
    def begins(self) -> bool:
        """Whether the first frames of poses differ from those after them, which are alike.

        A movement would go on: this is a remainder of the exposure before, or a pose that came to rest in the
        meantime.
        """
        return self._common_variation and self.movement is not None and _begins(self.movement)

    @property
    def moves(self) -> bool:
        """Whether the common variation of pixels is due to surfaces that move, or to a drift.

        A second camera adds light to all pixels, with a different phase in each frame, so that it tilts
        amplitudes as much as distances. A moving surface tilts distances, and goes on moving.
        """
        moves = self.movement is not None and drifts_or_tilts(self.movement)
        return self._common_variation and moves and not self.begins

    @property
    def _common_variation(self) -> bool:
        return self.common is not None and is_common(self.common, self.common_share, self.common_sigma)


def drifts_or_tilts(movement: Movement) -> bool:
    """Return whether the common variation of pixels is a movement rather than light of a second camera."""
    tilts = movement.by_tilt > movement.by_light and movement.tilts > _DRIFTS
    return tilts or movement.persistence > _DRIFTS * movement.persistence_sigma


def _begins(movement: Movement) -> bool:
    later = movement.freedom - movement.number
    # two numbers a frame
    if later <= 0 or movement.begins <= float(fdtri(2 * movement.number, 2 * later, 1 - _BEGINS_BY_CHANCE)):
        return False
    # a drift makes the first frame stand out as well, by an amount that its persistence determines
    return abs(movement.first - movement.first_where_it_begins) < abs(
        movement.first - movement.first_in_drift
    )


def is_common(common: float, share: float, sigma: float) -> bool:
    """Return whether pixels vary together; `Variance.common`, its ``sigma`` and `Variance.common_share`."""
    return share >= LEAST_COMMON_SHARE and common > 1 + max(6 * sigma, 1.0)


def movement_of(station: Station) -> float | None:
    """Return how far [m] distances tilt from frame to frame at the rim of the array, None if at rest."""
    pixels = int((station.count == station.frames).sum())
    if station.common is None or station.movement is None or not pixels:
        return None
    sigma = 1.0 / np.sqrt(max(min(station.frames, KEPT_FRAMES) - 1, 1))
    moves = is_common(station.common, (station.common - 1) / pixels, float(sigma))
    return station.movement.rim if moves and drifts_or_tilts(station.movement) else None


def examine_variance(forward: Forward, *, free_scale: bool = False) -> Variance:
    """Compare the variances of repeated frames with the noise model at the latent amplitudes.

    With ``free_scale`` the amplitudes are known only to a common factor near 1, and the best-fitting one is
    used: for a response that was found, whose small-signal gain depends on its form.
    """
    camera = forward.camera
    amplitude, measured, model, freedom, beyond = [], [], [], [], []
    common, shares, floors, single = [], [], [], []
    moves: list[Movement] = []
    second = effect_of(camera, ForeignLight)
    for prediction in forward.predictions(slopes=False):
        station = prediction.station
        pixels = prediction.amplitude_used & (station.count == station.frames)
        floors.append(prediction.sigma[prediction.used] ** 2)
        single.append(floors[-1] * station.count[prediction.used])
        if station.common is not None and pixels.any():
            common.append(station.common)
            shares.append((station.common - 1) / pixels.sum())
            moves += [] if station.movement is None else [station.movement]
        if station.frames < 2 or not pixels.any():
            continue
        amplitude.append(prediction.amplitude[pixels])
        measured.append(station.distance_variance[pixels])
        beyond.append(
            relative_variance(camera, amplitude[-1], prediction.delivered.distance[pixels], station.settings)
        )
        own = (prediction.sigma**2 - prediction.variance_of_other)[pixels] * station.frames
        model.append(
            own
            + (
                0.0
                if second is None
                else second.scatter(prediction.amplitude[pixels], prediction.context) ** 2
            )
        )
        freedom.append(np.full(int(pixels.sum()), station.frames - 1.0))
    floor = float(np.sqrt(np.mean(np.concatenate(floors)))) if sum(map(len, floors)) else 0.0
    used = np.concatenate(single) if single else np.zeros(0)
    precise = float(np.sqrt(np.quantile(used, _PRECISE))) if used.size else 0.0
    if not amplitude:
        return Variance(1.0, np.inf, (), camera.noise, None, np.inf, floor, False, precise=precise)
    parts = (amplitude, measured, model, freedom, beyond)
    a, s, m, f, d = (np.concatenate(part).astype(float) for part in parts)
    s, m = s / d, m / d
    if free_scale:
        factor = _scale_of_light(a, s, m, f, camera.noise)
        m = m * _scaled_variance(a, factor, camera.noise)
        a = a * factor
    ratio = s / m
    edges = np.unique(np.quantile(a, np.linspace(0, 1, _BINS + 1)))
    bins = []
    for low, high in pairwise(edges):
        own = (a >= low) & (a <= high)
        if f[own].sum() < 200:
            continue
        total = f[own].sum()
        bins.append(
            VarianceBin(
                float(np.median(a[own])),
                float((ratio[own] * f[own]).sum() / total),
                float(np.sqrt(2 / total)),
            )
        )
    number = max(len(common), 1)
    frames = min(float(np.mean(f)) + 1, KEPT_FRAMES)
    return Variance(
        ratio=float((ratio * f).sum() / f.sum()),
        sigma=float(np.sqrt(2 / f.sum())),
        bins=tuple(bins),
        noise=_fitted_noise(a, s, m, f, camera),
        common=float(np.mean(common)) if common else None,
        common_share=float(np.mean(shares)) if shares else 0.0,
        common_sigma=float(1.0 / np.sqrt(number * max(frames - 1, 1))),
        movement=together(moves) if moves else None,
        floor=floor,
        precise=precise,
        repeated=True,
        background=_background(a, s, m, f, camera),
    )


def moving(variance: Variance) -> str:
    """Return in words how surfaces move within poses."""
    assert variance.movement is not None
    movement = variance.movement
    slowly = movement.persistence > _DRIFTS * movement.persistence_sigma
    return (
        "surfaces move, or the camera does, within poses that are stated as one: from frame to frame "
        f"distances tilt by up to {movement.rim * 1e3:.2g} mm at the rim of the array"
        f"{', slowly,' if slowly else ''} where the light of a second camera would change amplitudes "
        "as much, with another phase in every frame; record each pose at rest, or the pose of every frame"
    )


def _scaled_variance(amplitude: Array, factor: float, noise: Noise) -> Array:
    """Return the ratio of the variance at amplitudes times a factor to that at the amplitudes."""
    ratio = noise.sigma_distance(amplitude * factor) / noise.sigma_distance(amplitude)
    return np.asarray(ratio**2)


def _scale_of_light(a: Array, s: Array, m: Array, f: Array, noise: Noise) -> float:
    """Return the factor on all amplitudes with which the noise model fits the variances best."""

    def misfit(factor: float) -> float:
        model = m * _scaled_variance(a, factor, noise)
        return float((f * (np.log(model) + s / model)).sum())

    return float(minimize_scalar(misfit, bounds=_SCALES, method="bounded").x)


def _background(a: Array, s: Array, m: Array, f: Array, camera: Camera) -> float:
    """Return the level whose photon noise explains the excess variance better than any scale of the noise.

    It adds shot^2 * level / A^2 to the variance, so that its form over the amplitude distinguishes it. 0
    where it does not explain the excess better.
    """
    shot = camera.noise.shot
    if shot == 0:
        return 0.0
    excess = s / m - 1
    shape = shot**2 / a**2 / m

    def misfit(x: Array) -> tuple[float, float]:
        value = float((f * x * excess).sum() / (f * x * x).sum())
        return value, float((f * (excess - value * x) ** 2).sum()) / 2

    level, own = misfit(shape)
    _, scaled = misfit(np.ones_like(excess))
    return level if level > 0 and own < scaled - 5 else 0.0


def _fitted_noise(amplitude: Array, measured: Array, model: Array, freedom: Array, camera: Camera) -> Noise:
    """Fit floor^2 + shot^2 (A + background) / A^2 + amplitude^2 / A^2, weighted by the model's variances.

    The variance by rounding to counts is subtracted, as where a calibration fits noise.
    """
    noise = camera.noise
    with_shot = noise.shot > 0
    by_photons = (amplitude + camera.background) / amplitude**2
    columns = [np.ones_like(amplitude), 1 / amplitude**2] + ([by_photons] if with_shot else [])
    weight = np.sqrt(freedom) / model
    design = np.stack([c * weight for c in columns], axis=1)
    scale = np.linalg.norm(design, axis=0)
    target = (measured - camera.sensor.lsb**2 / 12) * weight
    # the same least squares in as few equations as unknowns
    triangle = np.linalg.qr(np.column_stack([design / scale, target]), mode="r")
    solution = nnls(triangle[:, :-1], triangle[:, -1])[0] / scale
    return replace(
        noise,
        floor=float(np.sqrt(solution[0])),
        shot=float(np.sqrt(solution[2])) if with_shot else noise.shot,
        amplitude=float(np.sqrt(solution[1])),
    )
