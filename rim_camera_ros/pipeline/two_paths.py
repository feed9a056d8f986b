"""Light by two paths in one pixel, separated by several modulation frequencies.

The complex image at the frequency f_i is S_i / g_i = a exp(i k_i d) + b exp(i k_i (d + s)) with the wave
number k_i = 4 pi f_i / c: a direct path of the distance d and one that is longer by s, with amplitudes a >= b
>= 0 and the frequencies' relative gains g_i. At one frequency the two paths give one phasor with a wrong
phase; n frequencies give 2 n equations for the four unknowns. A. A. Dorrington et al., *Separating true range
measurements from multi-path and scattering interference in commercial range cameras*, Proc. SPIE 7864 (2011);
A. Bhandari et al., *Resolving multipath interference in time-of-flight imaging via modulation frequency
diversity and sparse regularization*, Optics Letters 39 (2014) 1705-1708.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import CorrectedFrame

Image = NDArray[Any]

#: Probability with which noise alone makes a pixel with one path look like one with two.
_FALSE_ALARM = 1e-4
#: Starting values [m]: the first path relative to the distance of a single path, the second to the first.
_SHIFTS = np.arange(-0.40, 0.121, 0.02)
_DETOURS = np.concatenate([np.arange(0.10, 1.5, 0.05), np.arange(1.5, 4.01, 0.1)])
_ROUNDS = 12
#: Pixels at a time, which bounds the memory.
_CHUNK = 256


class TwoPaths:
    """Fits two paths to the pixels of a camera that one path does not explain; ``span``: distances [m]."""

    def __init__(self, camera: Camera, span: tuple[float, float]) -> None:
        from scipy.stats import chi2  # imported here, as it would slow down the start of nodes

        self._waves = np.array([2 * np.pi / channel.sensor.ambiguity for channel in camera.channels])
        gains = np.array([channel.radiometry.gain for channel in camera.channels])
        self._gains = gains / gains.mean()
        self._span = span
        #: misfit of one path that noise exceeds with `_FALSE_ALARM`, and its gain by two more unknowns
        self._limit = float(chi2.isf(_FALSE_ALARM, 2 * len(gains) - 2))
        self._gain = float(chi2.isf(_FALSE_ALARM, 2))

    def correct(
        self, parts: list[CorrectedFrame], distance: Image, sigma: Image, usable: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Replace distances and sigmas (H, W) [m] where two paths explain the light and one does not.

        Returns where (H, W).

        ``parts``: distances modulo each ambiguity range, amplitudes and sigmas of the frequencies. The new
        sigma is that of d in the fit of all four unknowns.
        """
        at = np.flatnonzero(usable)
        amplitude = np.stack([corrected_frame.amplitude.ravel()[at] for corrected_frame in parts]).astype(
            float
        )
        phase = self._waves[:, None] * np.stack(
            [corrected_frame.distance.ravel()[at] for corrected_frame in parts]
        )
        noise = self._waves[:, None] * np.stack(
            [corrected_frame.sigma.ravel()[at] for corrected_frame in parts]
        )
        gains = self._gains[:, None]
        light = amplitude / gains * np.exp(1j * phase)
        weight = (gains / (amplitude * noise)) ** 2
        near = distance.ravel()[at].astype(float)
        turned = light * np.exp(-1j * self._waves[:, None] * near)
        mean = (weight * turned.real).sum(0) / weight.sum(0)
        alone = (weight * np.abs(turned - mean) ** 2).sum(0)
        chosen = np.flatnonzero(alone > self._limit)
        found = np.zeros(distance.shape, bool)
        for start in range(0, chosen.size, _CHUNK):
            part = chosen[start : start + _CHUNK]
            first, spread, misfit = self._fit(light[:, part], weight[:, part], near[part])
            better = alone[part] - misfit > self._gain
            better &= np.isfinite(spread) & (first > self._span[0]) & (first < self._span[1])
            where = at[part[better]]
            distance.ravel()[where] = first[better]
            sigma.ravel()[where] = spread[better]
            found.ravel()[where] = True
        return found

    def _fit(self, light: Image, weight: Image, near: Image) -> tuple[Image, Image, Image]:
        """Return d [m], its sigma [m] and the sum of squared residuals, of pixels (frequencies, N)."""
        state = self._start(light, weight, near)
        damping = np.full(near.size, 1e-3)
        residual, jacobian = self._model(state, light, weight)
        misfit = np.square(residual).sum(1)
        for _ in range(_ROUNDS):
            normal = np.einsum("nij,nik->njk", jacobian, jacobian)
            diagonal = np.einsum("njj->nj", normal)
            damped = normal + (damping[:, None] * diagonal + 1e-12)[:, :, None] * np.eye(4)
            step = np.linalg.solve(damped, np.einsum("nij,ni->nj", jacobian, residual)[..., None])[..., 0]
            tried = state + step
            tried[:, :2] = np.maximum(tried[:, :2], 0.0)
            tried[:, 1] = np.minimum(tried[:, 1], tried[:, 0])
            again, slopes = self._model(tried, light, weight)
            lower = np.square(again).sum(1)
            better = lower < misfit
            state[better], residual[better], jacobian[better] = tried[better], again[better], slopes[better]
            misfit = np.where(better, lower, misfit)
            damping = np.where(better, damping / 5, damping * 5)
        normal = np.einsum("nij,nik->njk", jacobian, jacobian)
        with np.errstate(invalid="ignore"):
            variance = np.linalg.pinv(normal, hermitian=True)[:, 2, 2]
            return state[:, 2], np.sqrt(variance), misfit

    def _start(self, light: Image, weight: Image, near: Image) -> Image:
        """Return (N, 4): a, b, d, s of the best of a grid of d and s, with a and b by least squares."""
        total = weight.sum(0)
        best = np.full(near.size, np.inf)
        state = np.zeros((near.size, 4))
        for shift in _SHIFTS:
            turned = light * np.exp(-1j * self._waves[:, None] * (near + shift))
            square = (weight * np.abs(turned) ** 2).sum(0)
            direct = (weight * turned.real).sum(0)
            for detour in _DETOURS:
                turn = np.exp(-1j * self._waves * detour)[:, None]
                shared = (weight * turn.real).sum(0)
                other = (weight * (turned * turn).real).sum(0)
                determinant = total**2 - shared**2
                a = (total * direct - shared * other) / determinant
                b = (total * other - shared * direct) / determinant
                misfit = square - a * direct - b * other
                better = (misfit < best) & (b > 0) & (b <= a)
                best = np.where(better, misfit, best)
                new = np.stack([a, b, near + shift, np.full(near.size, detour)], axis=1)
                state[better] = new[better]
        none = ~np.isfinite(best)
        state[none] = np.stack([np.abs(light).mean(0), 0 * near, near, 0 * near + 1.0], axis=1)[none]
        return state

    def _model(self, state: Image, light: Image, weight: Image) -> tuple[Image, Image]:
        """Return weighted residuals (N, 2 n) and derivatives (N, 2 n, 4) by a, b, d, s."""
        a, b, d, s = state.T
        k = self._waves[:, None]
        first, second = np.exp(1j * k * d), np.exp(1j * k * (d + s))
        root = np.sqrt(weight)
        residual = root * (light - a * first - b * second)
        by = root * np.stack(
            [first, second, 1j * k * (a * first + b * second), 1j * k * b * second]
        )  # (4, n, N)
        return (
            np.concatenate([residual.real, residual.imag]).T,
            np.concatenate([by.real, by.imag], axis=1).transpose(2, 1, 0),
        )
