"""Evaluation of the demonstration's recording: the correction compared with the known scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.frame import INVALID, CorrectedFrame, Flag, RawFrame
from rim_camera_ros.phasor import wrap_residual
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene

Image = NDArray[Any]


@dataclass(frozen=True)
class Error:
    """Bias, RMS and median of the absolute error in metres, and the number of values."""

    bias: float
    rms: float
    median: float
    count: int

    @classmethod
    def of(cls, error: Image) -> Error:
        error = error[np.isfinite(error)]
        if not error.size:
            return cls(np.nan, np.nan, np.nan, 0)
        return cls(
            float(error.mean()),
            float(np.sqrt(np.mean(error**2))),
            float(np.median(np.abs(error))),
            error.size,
        )


@dataclass(frozen=True)
class Comparison:
    """Errors before and after in metres, over the same pixels, and the maps of the last frame.

    ``noise`` is the RMS of the predicted sigma, ``systematic_*`` the RMS of each pixel's mean error over
    the frames of one integration time.
    """

    frames: int
    before: Error
    after: Error
    noise: float
    systematic_before: float
    systematic_after: float
    valid_share: float
    truth: Image
    raw_error: Image
    corrected_error: Image
    corrected: Image


def compare(pairs: Iterable[tuple[RawFrame, CorrectedFrame]], camera: Camera, scene: Scene) -> Comparison:
    """Compare raw and corrected frames with the true distances of the scene at their recorded poses.

    Pixels count if the correction gives them a distance and does not flag them as mixed. The raw
    distance is unwrapped to the period nearest the truth. Raises ValueError without frames.
    """
    simulation = Simulation(camera, scene)
    before, after, sigmas, shares = [], [], [], []
    maps: tuple[Image, Image, Image, Image] | None = None
    means: dict[float | None, _Mean] = {}
    for raw, corrected in pairs:
        truth = simulation.true_distance(recorded_exposure(raw, scene))
        usable = usable_pixels(corrected) & np.isfinite(truth)
        metres = np.where(raw.distance > 0, raw.distance * camera.sensor.lsb, np.nan)
        raw_error = wrap_residual(metres - truth, camera.sensor.ambiguity)
        error = corrected.distance - truth
        before.append(raw_error[usable])
        after.append(error[usable])
        sigmas.append(corrected.sigma[usable])
        shares.append(usable.mean())
        means.setdefault(raw.settings.integration_time, _Mean(truth.shape)).add(usable, raw_error, error)
        maps = (truth, raw_error, np.where(usable, error, np.nan), corrected.distance)
    if maps is None:
        raise ValueError("no frames to compare")
    systematic = np.concatenate([mean.means() for mean in means.values()], axis=1)
    noise = float(np.sqrt(np.mean(np.square(np.concatenate(sigmas)))))
    return Comparison(
        len(before),
        Error.of(np.concatenate(before)),
        Error.of(np.concatenate(after)),
        noise,
        _rms(systematic[0]),
        _rms(systematic[1]),
        float(np.mean(shares)),
        *maps,
    )


class _Mean:
    """Sums of errors per pixel."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._frames = 0
        self._count = np.zeros(shape)
        self._sums = np.zeros((2, *shape))

    def add(self, usable: NDArray[np.bool_], *errors: Image) -> None:
        self._frames += 1
        self._count += usable
        for total, error in zip(self._sums, errors, strict=True):
            total += np.where(usable, error, 0.0)

    def means(self) -> Image:
        """Return the mean errors (2, N) of the pixels that were usable in at least half of the frames."""
        often = self._count >= max(self._frames / 2, 1)
        means: Image = self._sums[:, often] / self._count[often]
        return means


def recorded_exposure(raw: RawFrame, scene: Scene) -> Exposure:
    """Return the exposure of a recorded frame, with the poses that were recorded with it."""
    return Exposure(stamp=raw.stamp, settings=raw.settings, poses={**scene.fixed_poses(), **raw.truth})


def usable_pixels(frame: CorrectedFrame) -> NDArray[np.bool_]:
    """Return the pixels that have a distance and are not flagged as mixed."""
    bits = np.uint8((INVALID | Flag.MIXED_PIXEL).value)
    usable: NDArray[np.bool_] = ((frame.flags & bits) == 0) & np.isfinite(frame.distance)
    return usable


@dataclass(frozen=True)
class Share:
    """Influence of one effect on distances, in metres: 68 % of the pixels have a smaller one.

    ``before``: on raw distances; ``after``: on corrected distances.
    """

    before: float
    after: float


def effect_shares(
    exposure: Exposure, *, simulated: Camera, correcting: Camera, scene: Scene
) -> Mapping[str, Share]:
    """Return each effect's share of the error of one frame without noise.

    Before: the change of the raw distance if the simulated camera does not have the effect. After: the change
    of the corrected distance if neither camera has the effect. Both are over the pixels with a distance in
    the correction of the full frame. The shares do not add up, as effects act on each other.
    """

    def measure(camera: Camera, corrector: Camera) -> tuple[Image, CorrectedFrame]:
        raw = Simulation(camera, scene, noise=False, quantised=False).frame(exposure)
        return raw.distance, Correction(corrector, exact=True).correct(raw)

    limits = replace(correcting, validity=type(correcting.validity)())
    raw, corrected = measure(simulated, limits)
    usable = usable_pixels(corrected)
    shares = {}
    for name in simulated.effects:
        without = with_effects(simulated, {k: v for k, v in simulated.effects.items() if k != name})
        corrector = with_effects(limits, {k: v for k, v in limits.effects.items() if k != name})
        raw_without, corrected_without = measure(without, corrector)
        both = usable & usable_pixels(corrected_without)
        change = wrap_residual(raw - raw_without, simulated.sensor.ambiguity)[both]
        left = (corrected.distance - corrected_without.distance)[both]
        shares[name] = Share(_spread(change), _spread(left))
    return shares


def _spread(values: Image) -> float:
    """Return the 68.3rd percentile of the magnitude, the RMS of a normal distribution without outliers."""
    values = np.abs(values[np.isfinite(values)])
    return float(np.percentile(values, 68.3)) if values.size else float("nan")


def _rms(values: Image) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
