"""The internal reference path's scale and nominal reading from the drift that recordings show (eq. 4.5)."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.effect_status import EffectStatus
from rim_camera_ros.calibrate.solution import Solution
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects import InternalReference, ReferenceScale, estimate_reference_scale, mean_reading
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.data import Station
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.residuals import after_nuisances

Array = NDArray[Any]

NAME = InternalReference.name
PATHS = (f"effects.{NAME}.nominal", f"effects.{NAME}.scale")
#: Stations with a reading below which no scale is estimated.
_FEWEST = 6
#: Spread of the readings in units of their noise below which they do not move.
_LEAST_SPREAD = 2.0
#: Least 1-sigma [m] of a station's drift: stations differ by more than noise.
_LEAST_SIGMA = 2e-5


@dataclass(frozen=True)
class ReferenceDrift:
    """The drift of the scene's distances and the readings of the reference, by station (N,) [m].

    ``fold`` (N,) is that of the station's pose, ``sigma`` that of the drift, ``reading_sigma`` that of a
    reading.
    """

    drift: Array
    reading: Array
    sigma: Array
    reading_sigma: float
    fold: Array

    def scale(self, *, leave_out: int | None = None) -> ReferenceScale:
        """Return scale and nominal from all stations, or from those of all folds but one.

        Raises `InputError` where they do not determine the scale.
        """
        spread = float(np.std(self.reading))
        if spread < _LEAST_SPREAD * self.reading_sigma:
            raise InputError(
                f"the reference moves by {spread * 1e3:.2g} mm RMS, hardly more than its noise "
                f"({self.reading_sigma * 1e3:.2g} mm)",
                remedy="record a fixed scene from power-on, or through a change of temperature",
            )
        kept = np.ones(len(self.drift), bool) if leave_out is None else self.fold != leave_out
        return estimate_reference_scale(
            drift=self.drift[kept],
            reading=self.reading[kept],
            drift_sigma=self.sigma[kept],
            reading_sigma=self.reading_sigma,
        )


@dataclass(frozen=True)
class FittedReference:
    """The fitted path, also without each fold of poses, and its status.

    ``effect`` is None where the recordings do not determine it. ``covariance`` (2, 2) is that of `PATHS`.
    """

    status: EffectStatus
    effect: InternalReference | None = None
    folds: Mapping[int, InternalReference] = field(default_factory=dict)
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))


def with_reference(camera: Camera, path: FittedReference | None, *, leave_out: int | None = None) -> Camera:
    """Return the camera with the fitted path, by all stations or by those of all folds but one."""
    if path is None or path.effect is None:
        return camera
    effect = path.effect if leave_out is None else path.folds.get(leave_out, path.effect)
    return with_effects(camera, {**camera.effects, NAME: effect})


def fit_reference(solution: Solution, *, asked: bool) -> FittedReference | None:
    """Estimate the reference path after the joint fit, whose drift terms and residuals contain the drift.

    The readings are those of the camera's reference pixels, else of the reference topic. With ``asked`` the
    path was requested by name; otherwise it is fitted where the file has it or the topic was recorded. None
    without any reference. Readings are not corrected, so that the scale contains the slope of the reference's
    own cyclic error (eq. 4.5), as in the correction.
    """
    start = solution.fit.camera.effects.get(NAME)
    assert start is None or isinstance(start, InternalReference)
    region = None if start is None else start.region()
    readings = [_reading(station, region) for station in solution.fit.forward.dataset.stations]
    available = sum(reading is not None for reading in readings)
    if available == 0 and start is None and not asked:
        return None
    if available < _FEWEST:
        source = "topic /reference" if region is None else "reference pixels"
        text = f"{available} stations have a reading of the {source}, {_FEWEST} are needed"
        return FittedReference(_undetermined(text, known=start is not None))
    measured = _drifts(solution, readings)
    try:
        found = measured.scale()
    except InputError as error:
        return FittedReference(_undetermined(str(error), known=start is not None))
    words = "fitted" if start is not None else "fitted; not in the file before"
    start = InternalReference(nominal=found.nominal) if start is None else start
    folds = {}
    for k in {int(number) for number in measured.fold}:
        with contextlib.suppress(InputError):  # too few stations remain: that fold uses the path of all
            part = measured.scale(leave_out=k)
            folds[k] = replace(start, nominal=part.nominal, scale=part.scale)
    status = EffectStatus(
        NAME,
        "fitted",
        f"{words}: the scene drifts {found.scale:.3f} +- {found.scale_sigma:.2g} times as much as the "
        f"reference; {found.rms * 1e3:.2g} mm RMS of the stations' drift is left",
    )
    effect = replace(start, nominal=found.nominal, scale=found.scale)
    return FittedReference(status, effect, folds, np.diag([found.nominal_sigma**2, found.scale_sigma**2]))


def _undetermined(text: str, *, known: bool) -> EffectStatus:
    if known:
        return EffectStatus(NAME, "kept", f"as in the file: {text}")
    return EffectStatus(NAME, "undetermined", f"cannot be determined from these recordings: {text}")


def _reading(station: Station, region: tuple[slice, slice] | None) -> float | None:
    if region is None:
        return station.settings.reference_distance
    return mean_reading(station.distance[region])


def _drifts(solution: Solution, readings: Sequence[float | None]) -> ReferenceDrift:
    """Return drift and reading of the stations that have a reading and pixels that are used."""
    fitted = solution.fit
    forward = fitted.forward
    without = Forward(
        forward.dataset,
        fitted.scene,
        # the terms that a reading of the reference replaces
        with_effects(
            fitted.camera, {n: effect for n, effect in fitted.camera.effects.items() if not effect.drifts}
        ),
        views=forward.views,
    )
    without.amplitude_model, without.masks = forward.amplitude_model, forward.masks
    without.shifts, without.light_curves = forward.shifts, forward.light_curves
    rows = []
    pairs = zip(forward.predictions(), without.predictions(), readings, strict=True)
    for predicted, bare, reading in pairs:
        used = predicted.used & bare.used
        if reading is None or not used.any():
            continue
        rest, _ = after_nuisances(predicted, fitted.pattern, fitted.nuisances)
        weight = 1.0 / predicted.sigma[used] ** 2
        drift = np.average((rest + bare.residual - predicted.residual)[used], weights=weight)
        sigma = max(float(weight.sum()) ** -0.5, _LEAST_SIGMA)
        station = predicted.station
        fold = solution.folds.get((station.recording, station.pose), 0)
        rows.append((float(drift), reading, sigma, fold, station.recording))
    table: Array = np.array(rows, float).reshape(-1, 5)
    mean, read, recording = table[:, 0], table[:, 1], table[:, 4]
    spread = np.hypot(table[:, 2], _scatter(mean, recording))
    return ReferenceDrift(mean, read, spread, _scatter(read, recording), table[:, 3])


def _scatter(values: Array, recording: Array) -> float:
    """Return the 1-sigma of values [m] by their deviations from a line through neighbours (robustly)."""
    same = (recording[2:] == recording[:-2]) if len(values) > 2 else np.zeros(0, bool)
    second = np.diff(values, 2)[same]
    if not second.size:
        return _LEAST_SIGMA
    return max(1.4826 * float(np.median(np.abs(second))) / math.sqrt(6.0), _LEAST_SIGMA)
