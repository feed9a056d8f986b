"""Precision of one distance: theory (Kahlmann 2007, eqs. 2.8, 2.9) and the camera file's model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.parameters import quantity


class NoiseFactors(NamedTuple):
    """Factors [-] on the variances of `Noise` at distances and settings, of the pixels' shape or one for all.

    There are factors for the variance by the signal's photons, that which does not depend on the light, and
    that by unmodulated light.
    """

    photons: NDArray[Any] | float
    read_out: NDArray[Any] | float
    background: NDArray[Any] | float


@dataclass(frozen=True)
class Noise:
    """sigma_d^2 = floor^2 + shot^2 / A + (amplitude / A)^2, with A in counts."""

    floor: float = quantity("m", "distance noise of the brightest pixels", default=0.0045, minimum=0.0)
    shot: float = quantity("m*sqrt(counts)", "photon shot noise", default=0.0, minimum=0.0)
    amplitude: float = quantity("m*counts", "noise in proportion to 1 / A", default=28.0, minimum=0.0)
    circular_range: float | None = quantity(
        "m",
        "R of the amplitude's noise, sigma_A = 2 pi A sigma_d / R; null: the ambiguity range, with which "
        "noise is circular in the complex plane",
        default=None,
        above=0.0,
    )

    def sigma_distance(
        self,
        amplitude: NDArray[Any],
        *,
        background: float = 0.0,
        factors: NoiseFactors | None = None,
    ) -> NDArray[Any]:
        """Return the 1-sigma of one distance in metres for amplitudes in counts; inf where A <= 0.

        ``background`` (counts of unmodulated light) adds shot^2 * background / A^2 to the variance.
        ``factors``: those on the variances, where these do not only depend on the light.
        """
        dtype = amplitude.dtype if amplitude.dtype.kind == "f" else np.dtype(float)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            inverse = np.where(amplitude > 0, 1.0 / np.maximum(amplitude, 1e-30), np.inf).astype(dtype)
            photons, read_out, light = (1.0, 1.0, 1.0) if factors is None else factors
            extra = self.amplitude**2 * read_out + self.shot**2 * background * light
            variance = self.floor**2 + inverse * (self.shot**2 * photons + inverse * extra)
            result: NDArray[Any] = np.sqrt(np.where(amplitude > 0, variance, np.inf))
            return result.astype(dtype, copy=False)


def sigma_amplitude(
    sigma_distance: NDArray[Any], amplitude: NDArray[Any], *, ambiguity: float
) -> NDArray[Any]:
    """Return the 1-sigma of the amplitude in counts: noise is circular in the complex plane.

    NaN where there is no light: the noise of the distance is infinite, that of the amplitude unknown.
    """
    with np.errstate(invalid="ignore"):
        result: NDArray[Any] = 2 * np.pi / ambiguity * amplitude * sigma_distance
    return result


#: Variance by rounding to whole counts [counts^2].
ROUNDING = 1.0 / 12


def rounding_of_mean(variance: NDArray[Any], frames: NDArray[Any]) -> NDArray[Any]:
    """Return the variance [counts^2] that rounding to whole counts leaves in the mean of some frames.

    ``variance`` [counts^2] is that of the noise of one frame. Noise of half a count or more makes roundings
    independent (Widrow 1956); with less all frames are rounded alike, and their mean errs as one does.
    """
    return np.where(variance > 0.25, ROUNDING / frames, ROUNDING)


def shot_noise_precision(*, ambiguity: float, amplitude: float, offset: float) -> float:
    """Return the photon-shot-noise limit of one distance in metres (eq. 2.8).

    ``amplitude`` A and ``offset`` B of the received light in electrons per sample. Eq. 2.8 is exact
    for samples integrated over half a period (dt = T / 2, contrast 2 / pi); a Monte Carlo of eq. 2.5
    whose samples carry the amplitude A themselves is better by pi / 2.
    """
    return ambiguity / math.sqrt(8.0) * math.sqrt(offset) / (2.0 * amplitude)


def signal_to_noise_precision(
    *, modulation_wavelength: float, contrast: float, signal_to_noise: float, measurements: int = 1
) -> float:
    """Return the precision of a distance in metres from the signal-to-noise ratio (eq. 2.9).

    ``modulation_wavelength`` in metres, ``contrast`` k_tot 0..1, ``measurements`` N_phase per distance.
    """
    theory = modulation_wavelength / (math.sqrt(8.0) * math.pi)
    return theory / (math.sqrt(measurements) * contrast * signal_to_noise)
