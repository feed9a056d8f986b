"""The background of a camera at rest: one distance per pixel, learnt and slowly forgotten."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Variance of a median relative to that of the mean, for many normally distributed samples.
_MEDIAN = math.pi / 2


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings:
    """How the background is learnt, and distinguished from moving surfaces.

    ``threshold`` [-]: a pixel moves where it is nearer than the background by more than this many standard
    deviations. If ``model_error`` is 0, noise alone causes this with the probability Q(threshold) of the
    normal distribution's tail. ``model_error`` [m]: 1-sigma of errors that are not part of sigma, added in
    quadrature (stray light and multipath by a person change the background's distance while the person is
    there). ``warm_start``: number of frames whose median is the first background. ``time_constant`` [s] of
    forgetting. ``absorb_after`` [s]: time after which a surface at rest becomes background. ``reveal_after``
    [s]: time after which a surface seen behind the background replaces it, as surfaces are not transparent.
    """

    threshold: float = 4.0
    model_error: float = 0.03
    warm_start: int = 20
    time_constant: float = 30.0
    absorb_after: float = 60.0
    reveal_after: float = 1.0


class Background:
    """Per-pixel background of radial distance; frames go in, moving pixels come out.

    A pixel's value is at first the mean of all samples, later an exponentially weighted mean: its gain is
    1 / n, but at least 1 - exp(-dt / time_constant). Its variance follows from the samples' own sigma.
    Samples beyond the threshold, on either side, are not used, which keeps the mean unbiased.
    """

    def __init__(self, settings: BackgroundSettings | None = None) -> None:
        self.settings = settings or BackgroundSettings()
        self._warm: list[tuple[NDArray[Any], NDArray[Any]]] = []
        self._state: _State | None = None
        self._last: float | None = None

    @property
    def missing_frames(self) -> int:
        """Number of frames that the warm start still needs; 0 once there is a background."""
        return 0 if self._state is not None else self.settings.warm_start - len(self._warm)

    @property
    def distance(self) -> Image | None:
        """The background's radial distance (H, W) in m, NaN where none is known; None before it began."""
        return None if self._state is None else self._state.mean.copy()

    @property
    def sigma(self) -> Image | None:
        """Standard deviation (H, W) of `distance` in m, from the noise of the samples."""
        return None if self._state is None else np.sqrt(self._state.variance)

    def take(self, distance: NDArray[Any], sigma: NDArray[Any], *, time: float) -> Mask | None:
        """Return the pixels (H, W) that move in front of the background, and learn from the others.

        ``distance``, ``sigma`` (H, W) in m, NaN where invalid; ``time`` in s. A pixel with a distance where
        the background has none counts as moving. None during the warm start. Raises `InputError` where the
        images differ in size from each other or from those before.
        """
        self._check(distance, sigma)
        if self._state is None:
            self._warm.append((np.array(distance, np.float32), np.array(sigma, np.float32)))
            if len(self._warm) >= self.settings.warm_start:
                self._state = _begun(self._warm)
                self._warm.clear()
            self._last = time
            return None
        step = 0.0 if self._last is None else max(time - self._last, 0.0)
        self._last = time
        with np.errstate(invalid="ignore"):
            return self._look(self._state, np.asarray(distance, float), np.asarray(sigma, float), time, step)

    def _look(self, state: _State, distance: Image, sigma: Image, time: float, step: float) -> Mask:
        settings = self.settings
        valid = np.isfinite(distance) & np.isfinite(sigma)
        known = np.isfinite(state.mean)
        innovation = distance - state.mean
        limit = settings.threshold * np.sqrt(sigma**2 + state.variance + settings.model_error**2)
        usual = valid & known & (np.abs(innovation) <= limit)
        farther = valid & known & (innovation > limit)
        moving: Mask = valid & ~usual & ~farther
        forgetting = -math.expm1(-step / settings.time_constant)
        gain = np.maximum(1.0 / (state.samples[usual] + 1), forgetting)
        state.mean[usual] += gain * innovation[usual]
        state.variance[usual] = (1 - gain) ** 2 * state.variance[usual] + gain**2 * sigma[usual] ** 2
        state.samples[usual] += 1
        self._replace(state, distance, sigma, time=time, usual=usual, moving=moving, farther=farther)
        return moving

    def _replace(
        self,
        state: _State,
        distance: Image,
        sigma: Image,
        *,
        time: float,
        usual: Mask,
        moving: Mask,
        farther: Mask,
    ) -> None:
        """Replace the background of pixels that have stayed at another distance for long enough."""
        settings = self.settings
        other = moving | farther
        spread = settings.threshold * np.sqrt(sigma**2 + settings.model_error**2)
        elsewhere = other & ~((np.abs(distance - state.other) <= spread) & (state.since <= time))
        state.other[elsewhere] = distance[elsewhere]
        state.since[elsewhere] = time
        state.other[usual] = np.nan
        patience = np.where(farther, settings.reveal_after, settings.absorb_after)
        stays = other & ~elsewhere & (time - state.since >= patience)
        state.mean[stays] = distance[stays]
        state.variance[stays] = sigma[stays] ** 2
        state.samples[stays] = 1
        state.other[stays] = np.nan

    def _check(self, distance: NDArray[Any], sigma: NDArray[Any]) -> None:
        known = self._state.mean.shape if self._state is not None else None
        if known is None and self._warm:
            known = self._warm[0][0].shape
        if distance.shape != sigma.shape or (known is not None and distance.shape != known):
            sizes = " and ".join(f"{one.shape[1]} x {one.shape[0]} px" for one in (distance, sigma))
            expected = "" if known is None else f", the background has {known[1]} x {known[0]} px"
            raise InputError(
                f"distance and sigma of {sizes}{expected}", remedy="learn the background of this camera anew"
            )


@dataclass
class _State:
    """All (H, W): mean [m], its variance [m^2], samples; another distance seen [m] and since when [s]."""

    mean: Image
    variance: Image
    samples: Image
    other: Image
    since: Image


def _begun(frames: list[tuple[NDArray[Any], NDArray[Any]]]) -> _State:
    """Return the first state by the median of each pixel, so that a passer-by has no influence."""
    distances, sigmas = (np.stack([frame[i] for frame in frames]).astype(float) for i in (0, 1))
    valid = np.isfinite(distances) & np.isfinite(sigmas)
    distances[~valid] = np.nan
    count = valid.sum(axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels that saw nothing in any frame
        mean = np.nanmedian(distances, axis=0)
        noise = np.nanmean(np.where(valid, sigmas, np.nan) ** 2, axis=0)
    # the median of one or two samples is their mean
    factor = np.where(count > 2, _MEDIAN, 1.0)
    variance = factor * noise / np.maximum(count, 1)
    return _State(
        mean, variance, count / factor, other=np.full(mean.shape, np.nan), since=np.zeros(mean.shape)
    )
