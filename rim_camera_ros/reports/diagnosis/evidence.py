"""The numbers behind the pictures of a diagnosis: residuals with and without the effects found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.result import Diagnosis
from rim_camera_ros.diagnose.smooth import values_of
from rim_camera_ros.effects import OF_SURFACES, OPTICS, vocabulary
from rim_camera_ros.effects.covariates import AXIS, COVARIATES
from rim_camera_ros.fit.data import Station
from rim_camera_ros.fit.decimation import full_covariate
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.select.effect_sizes import contribution

Array = NDArray[Any]

#: Angle between a pixel's ray and the optical axis [rad]: what the emitter's lobe depends on.
_SAMPLE = 2500
_SEED = 11


@dataclass
class Samples:
    """Values of pixels drawn from every station, (N,) each.

    ``after`` [m] are residuals of the better simulation; ``parts`` [m] the contribution of each effect, less
    its mean over all pixels; ``weight`` is 1 / variance [m^-2]. ``brightness`` are relative residuals of the
    amplitude, ``brightness_part`` its relative change by the better camera. ``station`` is the number of the
    station.
    """

    station: Array
    setting: Array
    weight: Array
    after: Array
    parts: dict[str, Array]
    brightness: Array
    brightness_part: Array
    covariates: dict[str, Array]


@dataclass
class PoseImage:
    """The station that shows an effect best: (H, W), NaN where nothing is compared.

    Residuals ``without`` the effects and ``after`` are in sigmas of the station's mean, the contribution of
    the effects ``part`` is in m.
    """

    pose: int
    time: float
    amplitude: Array
    without: Array
    after: Array
    part: Array


@dataclass
class SetupImage:
    """The station that agrees worst: amplitudes ``recorded`` and ``simulated`` [counts], and the
    ``difference`` of distances [m], recorded - simulated; (H, W), NaN where there is nothing.
    """

    pose: int
    time: float
    recorded: Array
    simulated: Array
    difference: Array


@dataclass
class Evidence:
    """Residuals of the simulation before (None: nothing changed) and of the better one.

    Maps (H, W): ``rms_*`` over the poses in sigmas of a pose's mean (1: noise), ``brightness_*`` mean
    relative residual of the amplitude. Per station: ``times`` [s], ``poses``, ``placements`` (numbers of
    recording and placement), ``chi_*`` per value, and ``strength``, the RMS [m] of the effects found.
    ``changed`` are the effects whose contributions are shown separately. ``worst`` is set where the set-up
    cannot be trusted.
    """

    times: Array
    poses: Array
    placements: list[tuple[int, int]]
    chi_before: Array | None
    chi_after: Array
    strength: Array | None
    rms_before: Array | None
    rms_after: Array
    brightness_before: Array | None
    brightness_after: Array
    samples: Samples
    changed: tuple[str, ...]
    image: PoseImage | None
    worst: SetupImage | None = None
    errors: dict[str, float] = field(default_factory=dict)


@dataclass
class _Compared:
    after: Array
    sigma: Array
    change: Array
    parts: dict[str, Array]
    brightness: Array
    brightness_part: Array


def evidence(result: Diagnosis) -> Evidence:
    """Compare the recording with the camera file as it was and with the improved one.

    Both have the errors of poses and powers of the improved fit, and each the fixed pattern that fits it
    best, so that only the physics differs.
    """
    fitted = better_fit(result)
    start = result.baseline.fit.start
    moved = result.verdict not in ("consistent", "inconsistent_setup") and bool(changed_effects(result))
    named = changed_effects(result) if moved else ()
    before = fitted.by_another(start)
    shape = fitted.camera.shape
    rng = np.random.default_rng(_SEED)
    stations: list[_Compared] = []
    drawn: list[Array] = []
    kept: list[Station] = []
    pictures: list[SetupImage] = []
    covariates: dict[str, list[Array]] = {name: [] for name in (*COVARIATES, AXIS)} if moved else {}
    predictions = fitted.forward.predictions()
    pairs = zip(before.predictions(), predictions, strict=True) if moved else ((p, p) for p in predictions)
    # a station keeps its images in single precision: all of them are in memory
    for old, new in pairs:
        comparison = _compared(old, new, fitted, named, start)
        pixels = np.flatnonzero(np.isfinite(comparison.after).ravel())
        drawn.append(rng.choice(pixels, min(_SAMPLE, pixels.size), replace=False))
        _collect(new, drawn[-1], covariates)
        stations.append(comparison)
        kept.append(new.station)
        if result.verdict == "inconsistent_setup":
            pictures.append(_as_set_up(new))
    samples = _samples(stations, kept, drawn, covariates)
    if result.step > 1:
        known = {name: full_covariate(name, x, result.step) for name, x in samples.covariates.items()}
        samples = replace(samples, covariates=known)
    _centre(stations, shape)
    after = np.stack([station.after / station.sigma for station in stations])
    without = np.stack([(station.after + station.change) / station.sigma for station in stations])
    return Evidence(
        times=np.array([station.time for station in kept]),
        poses=np.array([station.pose for station in kept]),
        placements=[(station.recording, station.placed) for station in kept],
        chi_before=_chi(without) if moved else None,
        chi_after=_chi(after),
        strength=_strength(stations) if moved else None,
        rms_before=_rms(without) if moved else None,
        rms_after=_rms(after),
        brightness_before=_mean([station.brightness + station.brightness_part for station in stations])
        if moved
        else None,
        brightness_after=_mean([station.brightness for station in stations]),
        samples=samples,
        changed=named,
        image=_image(stations, kept) if moved else None,
        worst=_worst(pictures, _chi(after)),
        errors=_errors(fitted),
    )


def better_fit(result: Diagnosis) -> Fit:
    """Return a fit by the improved camera: one of the search if possible, else with new nuisances."""
    final, baseline = result.final.fit, result.baseline.fit
    if result.verdict in ("consistent", "inconsistent_setup"):
        return final
    for fitted in (final, baseline):
        if fitted.camera.effects == result.model.effects and fitted.camera.optics == result.model.optics:
            return fitted
    frozen = Problem(
        final.forward.dataset,
        final.scene,
        effects=(),
        gain=False,
        robust=False,
        masks=final.forward.masks,
        shifts=final.forward.shifts,
        threads=final.forward.threads,
    )
    return fit(frozen, result.model, iterations=1, views=final.forward.views)


def changed_effects(result: Diagnosis) -> tuple[str, ...]:
    """Return the effects whose contribution is shown, by their names in the improved camera."""
    present = set(result.model.effects) | set(OPTICS) | OF_SURFACES
    missing = [effect.model or effect.effect for effect in result.missing]
    names = missing or [term.effect for term in result.adjusted]
    return tuple(name for name in names if name in present)


def _compared(
    old: Prediction, new: Prediction, fitted: Fit, names: Sequence[str], start: Camera
) -> _Compared:
    rest, brightness = after_nuisances(new, fitted.pattern, fitted.nuisances)
    reading = new.station.amplitude - new.amplitude_residual
    change = new.distance - old.distance
    parts = {}
    for name in names:
        if vocabulary()[name].shows_in == "amplitude":
            continue
        part = contribution(new, name, start)
        if name in start.effects:
            part = part - contribution(old, name, start)
        parts[name] = np.broadcast_to(part, rest.shape).astype(np.float32)
    used = new.used & np.isfinite(rest) & np.isfinite(change)
    for part in parts.values():
        used &= np.isfinite(part)
    bright = new.amplitude_used & (reading > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(bright, brightness / reading, np.nan)
        relative_part = np.where(bright, (new.station.amplitude - old.amplitude_residual) / reading, np.nan)
    return _Compared(
        np.where(used, rest, np.nan).astype(np.float32),
        new.sigma.astype(np.float32),
        np.where(used, change, np.nan).astype(np.float32),
        {name: np.where(used, part, np.nan) for name, part in parts.items()},
        relative.astype(np.float32),
        # the reading by the old camera is smaller by this share
        (1.0 - relative_part).astype(np.float32),
    )


def _collect(prediction: Prediction, pixels: Array, covariates: dict[str, list[Array]]) -> None:
    for name, parts in covariates.items():
        if name == AXIS:
            value: Any = np.arccos(np.clip(prediction.context.camera.rays[..., 2], -1, 1))
        else:
            value = values_of(name, prediction)
        if value is None:
            parts.append(np.full(pixels.size, np.nan))
        else:
            shape = prediction.used.shape
            parts.append(np.broadcast_to(np.asarray(value, float), shape).ravel()[pixels])


def _centre(stations: list[_Compared], shape: tuple[int, int]) -> None:
    """Remove the weighted mean over the stations of each pixel: it belongs to the fixed pattern."""

    def mean(of: Callable[[_Compared], Array]) -> Array:
        total, norm = np.zeros(shape), np.zeros(shape)
        for station in stations:
            values = of(station)
            valid = np.isfinite(values)
            weight = 1.0 / station.sigma[valid].astype(float) ** 2
            total[valid] += weight * values[valid]
            norm[valid] += weight
        return np.divide(total, norm, out=np.zeros(shape), where=norm > 0).astype(np.float32)

    names = stations[0].parts if stations else {}
    change = mean(lambda comparison: comparison.change)
    parts = {name: mean(lambda one, name=name: one.parts[name]) for name in names}  # type: ignore[misc]
    for station in stations:
        station.change -= change
        for name in names:
            station.parts[name] = station.parts[name] - parts[name]


def _chi(z: Array) -> Array:
    with np.errstate(invalid="ignore"):
        count = np.isfinite(z).sum(axis=(1, 2))
        return np.asarray(np.nansum(z**2, axis=(1, 2)) / np.where(count > 0, count, np.nan))


def _rms(z: Array) -> Array:
    count = np.isfinite(z).sum(axis=0)
    # the value of a pixel that few poses see is random
    enough = count >= max(2, len(z) // 8)
    return np.asarray(np.sqrt(np.nansum(z**2, axis=0) / np.where(enough, count, np.nan)))


def _mean(images: Sequence[Array]) -> Array:
    stack = np.stack(images)
    count = np.isfinite(stack).sum(axis=0)
    return np.asarray(np.nansum(stack, axis=0) / np.where(count >= max(2, len(stack) // 8), count, np.nan))


def _found(comparison: _Compared) -> Array:
    """Return the changes of distances [m] by the effects; all changes where these act by amplitudes alone."""
    return (
        np.asarray(np.sum(list(comparison.parts.values()), axis=0)) if comparison.parts else comparison.change
    )


def _strength(stations: Sequence[_Compared]) -> Array:
    result = []
    for station in stations:
        values = _found(station)
        known = values[np.isfinite(values)]
        result.append(float(np.sqrt(np.mean(known**2))) if known.size else np.nan)
    return np.array(result)


def _samples(
    stations: Sequence[_Compared],
    kept: Sequence[Station],
    drawn: Sequence[Array],
    covariates: Mapping[str, Sequence[Array]],
) -> Samples:
    def together(of: Callable[[_Compared], Array]) -> Array:
        parts = [of(station).ravel()[pixels] for station, pixels in zip(stations, drawn, strict=True)]
        return np.concatenate(parts).astype(float) if parts else np.zeros(0)

    sizes = [len(pixels) for pixels in drawn]
    settings = [station.settings.integration_time for station in kept]
    names = stations[0].parts if stations else {}
    weight = together(lambda comparison: comparison.sigma) ** -2

    def centred(values: Array) -> Array:
        return np.asarray(values - np.average(values, weights=weight)) if values.size else values

    return Samples(
        station=np.repeat(np.arange(len(sizes)), sizes),
        setting=np.repeat([np.nan if setting is None else setting for setting in settings], sizes),
        weight=weight,
        after=together(lambda comparison: comparison.after),
        parts={name: centred(together(lambda one, name=name: one.parts[name])) for name in names},  # type: ignore[misc]
        brightness=together(lambda comparison: comparison.brightness),
        brightness_part=together(lambda comparison: comparison.brightness_part),
        covariates={name: np.concatenate(parts) for name, parts in covariates.items()},
    )


def _image(stations: Sequence[_Compared], kept: Sequence[Station]) -> PoseImage | None:
    """Return the station at which the effects stand out most from pixel to pixel."""
    best: tuple[float, int] | None = None
    for number, comparison in enumerate(stations):
        z = _found(comparison) / comparison.sigma
        known = z[np.isfinite(z)]
        if known.size > 0.2 * z.size:
            energy = float(np.var(known) * known.size)
            if best is None or energy > best[0]:
                best = (energy, number)
    if best is None:
        return None
    comparison, station = stations[best[1]], kept[best[1]]
    part = _found(comparison)
    amplitude = np.where(station.count > 0, station.amplitude, np.nan)
    without, after = (comparison.after + part) / comparison.sigma, comparison.after / comparison.sigma
    return PoseImage(station.pose, station.time, amplitude, without, after, part)


def _as_set_up(prediction: Prediction) -> SetupImage:
    station = prediction.station
    measured = station.count > 0
    simulated = station.amplitude - prediction.amplitude_residual
    return SetupImage(
        station.pose,
        station.time,
        np.where(measured, station.amplitude, np.nan).astype(np.float32),
        np.where(simulated > 0, simulated, np.nan).astype(np.float32),
        np.where(measured, prediction.residual, np.nan).astype(np.float32),
    )


def _worst(pictures: Sequence[SetupImage], chi: Array) -> SetupImage | None:
    """Return the station with the greatest chi-square, or the first where no distances are compared."""
    if not pictures:
        return None
    return pictures[int(np.nanargmax(chi)) if np.isfinite(chi).any() else 0]


def _errors(fitted: Fit) -> dict[str, float]:
    from rim_camera_ros.diagnose.setup import standard_errors

    return dict(standard_errors(fitted))
