"""Raw frames -> corrected frames: the effects in reverse, as tables for each setting."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.chain import Chain
from rim_camera_ros.effects import InternalReference
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.effects.signal import Context
from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.frame import (
    NANOSECONDS,
    CorrectedDistance,
    CorrectedFrame,
    Flag,
    RawFrame,
    Settings,
)
from rim_camera_ros.pipeline import kernels
from rim_camera_ros.pipeline.amplitude_tables import AmplitudeReading, ByAmplitude
from rim_camera_ros.pipeline.distance_tables import WHOLE
from rim_camera_ros.pipeline.folded import Folded
from rim_camera_ros.pipeline.judgement import Judgement, Work
from rim_camera_ros.pipeline.normals import IncidenceEstimator
from rim_camera_ros.pipeline.optics import Light, OpticsUndo
from rim_camera_ros.pipeline.reference import Linearity, ReferenceReader

Image = NDArray[Any]

#: Number of settings whose tables are kept.
_KEPT = 8
#: Number of pixels that are corrected together where no pixel needs others: intermediate values, 60 bytes a
#: pixel, then stay in the cache of a processor's core (1 MB or more).
_BAND = 1 << 15


class Correction:
    """Corrects the frames of one camera.

    ``without``: names of effects that are left uncorrected. ``minimum_amplitude``: None takes the camera
    file's, or where that states none, the amplitude at which the noise of the amplitude term exceeds the
    range noise. ``exact``: float64, iterated to 1e-9 m, for offline work; else float32 and tables, within
    0.01 mm of it, for real time. ``reference_linearity``: the cyclic error of the internal reference path
    itself (Kahlmann 2007, eq. 4.6), if its scale was not estimated from readings that contain this error.
    Not for use from several threads at once: buffers are reused from frame to frame. Results are new arrays.

    ``notes`` collects messages for the user (a term that is off for lack of data).

    Raises `InputError` for an unknown name in ``without``.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        without: Iterable[str] = (),
        minimum_amplitude: float | None = None,
        exact: bool = False,
        reference_linearity: Linearity | None = None,
    ) -> None:
        self.camera = camera
        self.without = frozenset(without)
        for name in self.without:
            if name not in camera.effects:
                raise InputError(
                    f"effect '{name}' is not in the camera file", remedy=nearest_name(name, camera.effects)
                )
        self.exact = exact
        self.minimum_amplitude = (
            minimum_amplitude if minimum_amplitude is not None else camera.minimum_amplitude
        )
        self.notes: set[str] = set()
        self._memory: dict[str, Any] = {}
        self._start: int | None = None
        self._last: int | None = None
        self._folded: dict[float | None, Folded] = {}
        self._dtype = np.float64 if exact else np.float32
        self._compiled = kernels.LIBRARY is not None and not exact
        self._active = {name: effect for name, effect in camera.effects.items() if name not in self.without}
        self._chain = Chain.of(self._active.values())
        undone = replace(camera, effects=self._active)
        self._optics = OpticsUndo(undone, self._dtype)
        reference = effect_of(undone, InternalReference)
        self._reference = (
            None if reference is None else ReferenceReader(camera, reference, linearity=reference_linearity)
        )
        self._judgement = Judgement(
            camera,
            reference_region=None if reference is None else reference.region(),
            spreads=self._optics.spreads,
            dtype=self._dtype,
            compiled=self._compiled,
        )
        self._rays = np.ascontiguousarray(camera.rays.transpose(2, 0, 1), np.float32)
        self._bands = _bands(camera.shape)
        self._points = np.empty_like(self._rays[:, self._bands[0]])

    # --- public ---------------------------------------------------------------------------------

    def correct(self, frame: RawFrame) -> CorrectedFrame:
        """Return the corrected frame.

        Raises `InputError` where the frame's size is not the camera's, or where rows per integration time
        are needed and the setting is unknown.
        """
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            work = self._undo(frame, whole=True)
            sigma, flags = self._judgement.judge(work, frame.settings)
        return CorrectedFrame(
            stamp=frame.stamp,
            distance=work.light.distance.astype(np.float32, copy=False),
            amplitude=work.light.amplitude.astype(np.float32, copy=False),
            sigma=sigma.astype(np.float32, copy=False),
            flags=flags,
            settings=frame.settings,
        )

    def correct_distance(self, frame: RawFrame) -> CorrectedDistance:
        """Return distance and amplitude as `correct` does, but faster, without sigma and flags."""
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            work = self._undo(frame, whole=False)
            distance = work.light.distance
            if self._optics.spreads:
                # elsewhere the amplitude's term is NaN there
                distance[work.light.amplitude < work.folded.amplitude.minimum] = np.nan
            if work.folded.reference_region is not None:
                distance[work.folded.reference_region] = np.nan
        return CorrectedDistance(
            stamp=frame.stamp,
            distance=distance.astype(np.float32, copy=False),
            amplitude=work.light.amplitude.astype(np.float32, copy=False),
            settings=frame.settings,
        )

    def cloud(
        self, frame: CorrectedDistance, *, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Return the organised cloud (H, W, 4) float32: x y z [m], NaN where invalid, intensity [counts].

        A new array, or ``out``.
        """
        result = np.empty((*self.camera.shape, 4), np.float32) if out is None else out
        amplitude = np.asarray(frame.amplitude, np.float32)
        for rows in self._bands:
            part = frame.distance[rows]
            points = self._points[:, : len(part)]
            np.multiply(self._rays[:, rows], part, out=points, casting="same_kind")
            cv2.merge([*points, amplitude[rows]], result[rows])
        return result

    def depth(self, frame: CorrectedDistance) -> NDArray[np.float32]:
        """Return the depth along z in metres (H, W) float32, NaN where invalid."""
        result: NDArray[np.float32] = self._rays[2] * frame.distance
        return result

    def minimum_for(self, settings: Settings) -> float:
        """Return the minimum amplitude in counts that holds at these settings."""
        return self._fold(settings).amplitude.minimum

    def carry_on(self, before: Any) -> None:
        """Take over the state of another correction: lagging temperature, filtered reference.

        A correction for another way of measuring has no such state.
        """
        if not isinstance(before, Correction):
            return
        self._memory = dict(before._memory)
        self._start, self._last = before._start, before._last

    # --- preparation ----------------------------------------------------------------------------

    def _begin(self, frame: RawFrame) -> Folded:
        """Check the frame and return the tables of its setting, with the frame's context."""
        if frame.distance.shape != self.camera.shape or frame.amplitude.shape != self.camera.shape:
            found, expected = frame.distance.shape, self.camera.shape
            raise InputError(
                f"images of {found[1]} x {found[0]} px, but the camera file is for "
                f"{expected[1]} x {expected[0]}",
                remedy="give the camera file of this sensor",
            )
        frame.require_one_distance()
        self.camera.check_modulation(frame.settings)
        if self._last is not None and frame.stamp < self._last:
            self._memory.clear()
            self._start = None
        if self._start is None:
            self._start = frame.stamp
        self._last = frame.stamp
        folded = self._fold(frame.settings)
        context = folded.context
        context.settings = frame.settings
        context.stamp = frame.stamp
        context.time = (frame.stamp - self._start) / NANOSECONDS
        context.memory = self._memory
        context.incidence = context.saturated = None
        return folded

    def _fold(self, settings: Settings) -> Folded:
        known = settings.integration_time is not None or self.camera.sensor.integration_time is not None
        key = self.camera.integration_time(settings) if known else None
        folded = self._folded.get(key)
        if folded is None:
            context = Context(camera=self.camera, settings=settings, notes=self.notes)
            folded = Folded(self.camera, self._chain, context, self.minimum_amplitude, exact=self.exact)
            if len(self._folded) >= _KEPT:
                self._folded.pop(next(iter(self._folded)))
            self._folded[key] = folded
        return folded

    @cached_property
    def _estimator(self) -> IncidenceEstimator:
        return IncidenceEstimator(self.camera.rays)

    # --- steps ----------------------------------------------------------------------------------

    def _undo(self, frame: RawFrame, *, whole: bool) -> Work:
        """Undo all effects; the distance is NaN where raw values give none.

        ``whole``: sigma and flags are needed, too.
        """
        folded = self._begin(frame)
        unit = 1.0 if frame.distance.dtype.kind == "f" else self.camera.sensor.lsb
        if self._reference is not None:
            folded.context.settings = self._reference.take(
                folded.reference_pixels(frame.distance, unit),
                frame.settings,
                stamp=frame.stamp,
                memory=self._memory,
            )
        offset = folded.offset()
        banded = folded.pixel_by_pixel and not self.exact
        if self._compiled and frame.distance.dtype == frame.amplitude.dtype == np.uint16:
            work = self._read_counts(frame, folded, unit, offset, solve=banded, whole=whole or not banded)
        else:
            work = self._read(frame, folded, unit, offset, solve=banded)
        y, reading = work.light.distance, work.reading
        if frame.sigma is not None:
            reading.sigma = frame.sigma.astype(self._dtype)
        if banded:
            work.light = self._optics.undo(y, reading.amplitude, folded.context)
            return work
        folded.context.saturated = reading.saturated
        folded.subtract_frame_terms(y, reading.amplitude)
        if folded.incidence_rounds:
            self._solve_with_incidence(work, y)
        else:
            delivered, _ = folded.refined(folded.distance.solve(y), y, reading.amplitude)
            work.light = self._optics.undo(delivered, reading.amplitude, folded.context)
        return work

    def _read_counts(
        self, frame: RawFrame, folded: Folded, unit: float, offset: float, *, solve: bool, whole: bool
    ) -> Work:
        """Do what `_read` does with counts, in one pass over the pixels; ``whole``: sigma and flags, too."""
        done = kernels.read(
            frame.distance,
            frame.amplitude,
            table=folded.amplitude.compiled,
            unit=unit,
            offset=offset,
            map_=folded.map,
            solver=folded.distance.compiled if solve else None,
            whole=whole,
        )
        some = done.found & Flag.SATURATED.value and not solve
        saturated = (done.flags & np.uint8(Flag.SATURATED.value)) != 0 if some else None
        says = ByAmplitude(done.amplitude, done.y, done.sigma, done.flags)
        reading = AmplitudeReading(done.amplitude, saturated, says, None)
        return Work(folded, reading, None, Light(done.y, done.amplitude))

    def _read(self, frame: RawFrame, folded: Folded, unit: float, offset: float, *, solve: bool) -> Work:
        """Return distances without the terms of raw values and place, and the values by amplitudes.

        ``unit`` [m] of the raw distances, ``offset`` [m]. ``solve``: terms of the distance are undone, too.
        """
        missing = _missing(frame.distance)
        reading = folded.amplitude.reading(frame.amplitude, self._dtype)
        y = np.empty(self.camera.shape, self._dtype)
        for rows in self._bands if solve else (WHOLE,):
            part = y[rows]
            np.copyto(part, frame.distance[rows], casting="same_kind")
            cv2.addWeighted(part, unit, reading.term(rows), -1.0, -offset, dst=part)
            if missing is not None:
                np.copyto(part, np.nan, where=missing[rows])
            if folded.map is not None:
                part -= folded.map[rows]
            if solve:
                folded.distance.solve(part, rows=rows, out=part)
        return Work(folded, reading, missing, Light(y, reading.amplitude))

    def _solve_with_incidence(self, work: Work, y: Image) -> None:
        """Solve with terms of the incidence, which need planes fitted to the result.

        The light is undone without these terms, the angle is estimated, and all is done again with them.
        """
        folded, reading = work.folded, work.reading
        amplitude = reading.amplitude
        delivered = folded.distance.solve(y)
        placed: Image | None = None
        if self.exact:
            delivered, placed = folded.refined(delivered, y, amplitude)
        elif folded.has_placed:
            placed = folded.placed(delivered, amplitude)
            delivered -= placed
        work.light = self._optics.undo(delivered, amplitude, folded.context, quick=not self.exact)
        for _ in range(folded.incidence_rounds):
            cosine = self._estimator.cosine(work.light.distance, work.noise)
            shifted = y - folded.incidence_term(cosine, amplitude, work.light.distance)
            delivered = folded.distance.solve(shifted if placed is None else shifted - placed)
            if self.exact:
                delivered, placed = folded.refined(delivered, shifted, amplitude)
            elif placed is not None:
                folded.follow(delivered, placed, folded.placed(delivered, amplitude))
            work.light = self._optics.undo(delivered, amplitude, folded.context, guess=work.light.image)
            work.cosine = cosine


def _missing(raw: Image) -> NDArray[np.bool_] | None:
    """Return where counts or metres hold no measurement, None if nowhere."""
    missing = ~(np.isfinite(raw) & np.greater(raw, 0)) if raw.dtype.kind == "f" else raw == 0
    return missing if missing.any() else None


def _bands(shape: tuple[int, int]) -> list[slice]:
    """Return the rows of the sensor in bands of about `_BAND` pixels."""
    height, width = shape
    rows = -(-height // max(1, round(height * width / _BAND)))
    return [slice(first, min(first + rows, height)) for first in range(0, height, rows)]
