"""Demodulation of modulated light: four samples, complex image, ambiguity, waveforms.

The complex image is S = A exp(i 2 pi d / L), with the amplitude A in counts, the distance d in metres
and the ambiguity range L in metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

SPEED_OF_LIGHT = 299_792_458.0


def ambiguity_range(modulation_frequency: float) -> float:
    """Return L = c / (2 f) in metres for a modulation frequency in Hz.

    Kahlmann 2007, eq. 2.4 prints c lambda / 2, which has the wrong dimension; L = lambda / 2.
    """
    return SPEED_OF_LIGHT / (2.0 * modulation_frequency)


def cosine_and_sine(angle: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return cosine and sine of angles in rad, in their precision, within 2.3e-16 for float64.

    In float64 they are computed from the tangent of half the angle, which numpy evaluates in vector
    registers; numpy's sine and cosine in this precision take ten times as long.
    """
    if angle.dtype == np.float32:
        return np.cos(angle), np.sin(angle)
    half = np.tan(angle * 0.5)
    square = half * half
    scale = 1.0 / (1.0 + square)
    return (1.0 - square) * scale, 2.0 * half * scale


def to_phasor(distance: NDArray[Any], amplitude: NDArray[Any], ambiguity: float) -> NDArray[Any]:
    """Return S = A exp(i 2 pi d / L); 0 where there is no distance (NaN) or no light.

    Computed in float64 and returned as complex128, or in float32 and complex64 for float32 input.
    """
    phase = distance * distance.dtype.type(2 * np.pi / ambiguity)
    dark = ~(np.isfinite(phase) & (amplitude > 0))
    if dark.any():
        phase[dark] = 0
        amplitude = np.where(dark, amplitude.dtype.type(0), amplitude)
    cosine, sine = cosine_and_sine(phase)
    phasor = np.empty(distance.shape, np.complex64 if distance.dtype == np.float32 else np.complex128)
    np.multiply(amplitude, cosine, out=phasor.real, casting="same_kind")
    np.multiply(amplitude, sine, out=phasor.imag, casting="same_kind")
    return phasor


def phase_distance(phasor: NDArray[Any], ambiguity: float) -> NDArray[Any]:
    """Return the distance in [0, L) in metres of a complex image; NaN where it is 0."""
    real, imaginary = phasor.real.copy(), phasor.imag.copy()
    distance = np.arctan2(imaginary, real)
    distance *= distance.dtype.type(ambiguity / (2 * np.pi))
    distance = wrap(distance, ambiguity)
    distance[(real == 0) & (imaginary == 0)] = np.nan
    return distance


def nearest_period(distance: NDArray[Any], near: NDArray[Any], ambiguity: float) -> NDArray[Any]:
    """Return ``distance`` shifted by whole ambiguity ranges to be nearest ``near`` (unshifted where NaN)."""
    periods = np.rint((near - distance) / ambiguity)
    known = np.isfinite(periods)
    if not known.all():
        periods[~known] = 0
    result: NDArray[Any] = distance + ambiguity * periods
    return result


def wrap(distance: NDArray[Any], ambiguity: float) -> NDArray[Any]:
    """Return the representative in [0, L)."""
    wrapped = np.floor(distance / ambiguity)
    wrapped *= -ambiguity
    wrapped += distance
    # rounding may give values just outside of the interval; NaN stays
    beyond = (wrapped >= ambiguity) | (wrapped < 0)
    if beyond.any():
        wrapped[beyond] = 0
    return wrapped.astype(distance.dtype, copy=False)


def wrap_residual(residual: NDArray[Any], ambiguity: float) -> NDArray[Any]:
    """Return a difference of distances modulo L in (-L / 2, L / 2]."""
    return residual - ambiguity * np.ceil(residual / ambiguity - 0.5)


# --- four samples -------------------------------------------------------------------------------


def demodulate(
    samples: NDArray[np.floating[Any]], *, integration_share: float = 0.0
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return phase [0, 2 pi), amplitude A and offset B from four samples (4, ...) (eqs. 2.5-2.7).

    ``integration_share`` is the integration interval over the modulation period, dt / T in [0, 1): the
    amplitude is divided by the contrast sin(delta) / delta, delta = pi dt / T, of sampling over an interval.
    The sign convention is that of eq. 2.5 (eq. 2.6 prints c3 - c1), with the four-quadrant arc tangent.
    Eq. 2.6 contains 1 / dt for samples that are integrals over dt; here samples are means over dt.

    Raises ValueError unless the first axis has length 4 and the share lies in [0, 1).
    """
    if samples.shape[0] != 4:
        raise ValueError(f"four samples are needed, found {samples.shape[0]}")
    if not 0 <= integration_share < 1:
        raise ValueError(f"integration_share must lie in [0, 1), found {integration_share}")
    real = samples[0] - samples[2]
    imaginary = samples[1] - samples[3]
    phase = np.arctan2(imaginary, real)
    number = phase.dtype.type
    np.add(phase, number(2 * np.pi), out=phase, where=phase < 0)
    phase *= phase < number(2 * np.pi)
    real *= real
    imaginary *= imaginary
    real += imaginary
    amplitude = np.sqrt(real, out=real)
    amplitude *= number(0.5 / float(np.sinc(integration_share)))
    offset = samples[0] + samples[1]
    offset += samples[2]
    offset += samples[3]
    offset *= number(0.25)
    return phase, amplitude, offset


@dataclass(frozen=True)
class Waveform:
    """Correlation of emitted light and demodulation over one period, by its harmonics.

    ``harmonics``: pairs (order, complex amplitude relative to the fundamental); sample k of a pixel at
    phase phi is Re sum_h a_h exp(i h (phi - k pi / 2)), the fundamental having a_1 = 1.
    """

    harmonics: tuple[tuple[int, complex], ...] = ()

    def __post_init__(self) -> None:
        for order, _ in self.harmonics:
            if order < 2:
                raise ValueError(f"a harmonic's order must be at least 2, found {order}")

    @classmethod
    def sinusoid(cls) -> Waveform:
        """Return the ideal waveform, without harmonics."""
        return cls()

    @classmethod
    def square(cls, duty_cycle: float = 0.5, *, integration_share: float = 0.0, orders: int = 15) -> Waveform:
        """Return a square wave of the given duty cycle (0..1), sampled over dt / T = integration_share.

        Fourier: a_h = sin(pi h duty) / h, times the sampling window's sinc(h dt / T), both relative to
        the fundamental; ``orders`` harmonics are kept.
        """
        if not 0 < duty_cycle < 1:
            raise ValueError(f"duty cycle must lie between 0 and 1, found {duty_cycle}")
        share = integration_share

        def strength(h: int) -> float:
            return math.sin(math.pi * h * duty_cycle) / h * float(np.sinc(h * share))

        return cls(tuple((h, strength(h) / strength(1)) for h in range(2, orders + 1)))

    def samples(self, phase: NDArray[Any], amplitude: NDArray[Any]) -> NDArray[np.float64]:
        """Return the four samples (4, ...) of pixels of given phase [rad] and amplitude, without offset."""
        steps = np.arange(4).reshape((4,) + (1,) * np.ndim(phase)) * (np.pi / 2)
        angle = phase - steps
        total = np.cos(angle)
        for order, strength in self.harmonics:
            total = total + np.real(strength * np.exp(1j * order * angle))
        result: NDArray[np.float64] = amplitude * total
        return result

    def phase_error(self, phase: NDArray[Any]) -> NDArray[np.float64]:
        """Return demodulated minus true phase in rad, in (-pi, pi]."""
        measured, _, _ = demodulate(self.samples(phase, np.ones_like(phase)))
        return wrap_residual(measured - phase, 2 * np.pi)


def parse_waveform(text: str) -> Waveform:
    """Return the waveform of ``sinusoid``, ``square``, ``square:DUTY`` or ``harmonics:3=0.1,5=-0.02``.

    Raises ValueError, which states the expected form.
    """
    kind, _, rest = text.partition(":")
    try:
        if kind == "sinusoid" and not rest:
            return Waveform.sinusoid()
        if kind == "square":
            return Waveform.square(float(rest) if rest else 0.5)
        if kind == "harmonics" and rest:
            pairs = [word.split("=") for word in rest.split(",")]
            return Waveform(tuple((int(order), complex(strength)) for order, strength in pairs))
    except ValueError as error:
        raise ValueError(f"waveform '{text}': {error}") from None
    raise ValueError(f"unknown waveform '{text}': sinusoid, square:DUTY or harmonics:3=0.1,5=-0.02")


# --- limits of the method -----------------------------------------------------------------------


def dynamic_range(
    *, nearest: float, farthest: float, least_reflectivity: float, greatest_reflectivity: float
) -> float:
    """Return the dynamic range in dB for distances in metres and reflectivities 0..1 (eq. 2.13)."""
    ratio = (farthest / nearest) ** 2 * greatest_reflectivity / least_reflectivity
    return 20.0 * math.log10(ratio)


def frequency_selectivity(*, frequency_difference: float, window: float) -> float:
    """Return sinc(2 pi df T_w / 2), the response to a spurious signal df Hz away (eq. 2.11).

    ``window`` T_w is the integration time in seconds; sinc(x) = sin(x) / x.
    """
    return float(np.sinc(frequency_difference * window))


def selectivity_envelope(*, frequency_difference: float, window: float) -> float:
    """Return the envelope of `frequency_selectivity`, min(1, 1 / (pi |df| T_w)).

    The sinc is exactly 0 for the thesis' example (20.0 and 20.1 MHz, 1 ms); its envelope is -49.9 dB.
    """
    x = math.pi * abs(frequency_difference) * window
    return 1.0 if x <= 1.0 else 1.0 / x
