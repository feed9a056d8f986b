"""Raw frames -> corrected frames: the effects in reverse, folded into tables per setting."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.convolution import Spreading
from rim_camera_ros.effects.base import Context, DistanceTerm, outside_rows
from rim_camera_ros.effects.ambient_temperature import AmbientTemperature
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.effects.incidence_angle import IncidenceAngle, incidence_gon
from rim_camera_ros.effects.reference_path import ReferencePath, mean_reading
from rim_camera_ros.effects.scattering import Scattering
from rim_camera_ros.effects.warm_up_drift import WarmUpDrift
from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.frame import INVALID, NANOSECONDS, CorrectedFrame, Flag, RawFrame, Settings
from rim_camera_ros.pipeline.mixed import mixed_pixels
from rim_camera_ros.pipeline.normals import IncidenceEstimator
from rim_camera_ros.pipeline.tables import (
    AmplitudeModel,
    ByAmplitude,
    DistanceSolver,
    PlaneTable,
    distance_knots,
)

Image = NDArray[Any]

#: Settings kept folded at a time.
_KEPT = 8
#: Entries of the table of the incidence term over the cosine.
_COSINES = 4096


class Correction:
    """Corrects the frames of one camera.

    ``without``: names of effects that are left uncorrected. ``minimum_amplitude``: None takes the camera
    file's, or where that states none, the amplitude at which the noise of the amplitude term exceeds the
    range noise. ``exact``: float64 and iterated to 1e-9 m, for work at the desk; else float32 and tables,
    within 0.01 mm of it, for work in real time. Not for use from several threads at once.

    ``notes`` collects what the user should be told (a term that is off for lack of data).

    Raises `InputError` for an unknown name in ``without``.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        without: Iterable[str] = (),
        minimum_amplitude: float | None = None,
        exact: bool = False,
    ) -> None:
        self.camera = camera
        self.without = frozenset(without)
        for name in self.without:
            if name not in camera.effects:
                raise InputError(f"effect '{name}' is not in the camera file", remedy=nearest_name(name, camera.effects))
        self.exact = exact
        self.minimum_amplitude = (
            minimum_amplitude if minimum_amplitude is not None else camera.minimum_amplitude
        )
        self.notes: set[str] = set()
        self._memory: dict[str, Any] = {}
        self._start: int | None = None
        self._last: int | None = None
        self._folded: dict[float | None, _Folded] = {}
        dtype = np.float64 if exact else np.float32
        planes = np.ascontiguousarray(camera.rays.transpose(2, 0, 1), dtype)
        self._rays = planes
        self._estimator: IncidenceEstimator | None = None

    # --- public ---------------------------------------------------------------------------------

    def correct(self, frame: RawFrame) -> CorrectedFrame:
        """Return the corrected frame.

        Raises `InputError` where the frame's size is not the camera's, or where rows per integration time
        are needed and the setting is unknown.
        """
        self._check(frame)
        folded = self._fold(frame.settings)
        context = self._context(frame, folded)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            metres = self._metres(frame.distance)
            by_amplitude = folded.by_amplitude(frame.amplitude)
            context.saturated = _marked(by_amplitude.flags, Flag.SATURATED)
            y = metres - by_amplitude.term
            if folded.map is not None:
                y -= folded.map
            y -= self._drift(metres, context, folded)
            y = self._once(folded, y, by_amplitude, context)
            solution = self._solve(folded, y, by_amplitude, context)
            return self._finish(frame, folded, metres, solution, by_amplitude)

    def cloud(self, frame: CorrectedFrame) -> NDArray[np.float32]:
        """Return the organised cloud (H, W, 4) float32: x y z [m], intensity [counts]; NaN x y z where invalid."""
        points = np.empty((*frame.distance.shape, 4), np.float32)
        for axis in range(3):
            np.multiply(self._rays[axis], frame.distance, out=points[..., axis], casting="same_kind")
        points[..., 3] = frame.amplitude
        return points

    def depth(self, frame: CorrectedFrame) -> NDArray[np.float32]:
        """Return the depth along z in metres (H, W) float32, NaN where invalid."""
        result: NDArray[np.float32] = (self._rays[2] * frame.distance).astype(np.float32, copy=False)
        return result

    def minimum_for(self, settings: Settings) -> float:
        """Return the minimum amplitude in counts that holds at these settings."""
        return self._fold(settings).amplitude.minimum

    def carry_on(self, before: Correction) -> None:
        """Take over what another correction knows of the past (the lagging temperature)."""
        self._memory = dict(before._memory)
        self._start, self._last = before._start, before._last

    # --- preparation ----------------------------------------------------------------------------

    def _check(self, frame: RawFrame) -> None:
        if frame.distance.shape != self.camera.shape or frame.amplitude.shape != self.camera.shape:
            found, expected = frame.distance.shape, self.camera.shape
            raise InputError(
                f"images of {found[1]} x {found[0]} px, but the camera file is for {expected[1]} x {expected[0]}",
                remedy="give the camera file of this sensor",
            )
        if self._last is not None and frame.stamp < self._last:
            self._memory.clear()
            self._start = None
        if self._start is None:
            self._start = frame.stamp
        self._last = frame.stamp

    def _fold(self, settings: Settings) -> _Folded:
        known = settings.integration_time is not None or self.camera.sensor.integration_time is not None
        key = self.camera.integration_time(settings) if known else None
        folded = self._folded.get(key)
        if folded is None:
            folded = _Folded(self, settings)
            if len(self._folded) >= _KEPT:
                self._folded.pop(next(iter(self._folded)))
            self._folded[key] = folded
        return folded

    def _context(self, frame: RawFrame, folded: _Folded) -> Context:
        assert self._start is not None
        return Context(
            camera=self.camera,
            settings=frame.settings,
            stamp=frame.stamp,
            time=(frame.stamp - self._start) / NANOSECONDS,
            memory=self._memory,
            notes=self.notes,
        )

    # --- steps ----------------------------------------------------------------------------------

    def _metres(self, raw: Image) -> Image:
        """Counts or metres -> metres, NaN where there is no measurement."""
        dtype = np.float64 if self.exact else np.float32
        if raw.dtype.kind == "f":
            metres = raw.astype(dtype, copy=True)
        else:
            metres = np.multiply(raw, dtype(self.camera.sensor.lsb), dtype=dtype, casting="unsafe")
        metres[~(metres > 0)] = np.nan
        return metres

    def _drift(self, metres: Image, context: Context, folded: _Folded) -> Any:
        """Terms that are one number per frame; the reference path replaces the drift terms where it reads."""
        nothing = metres[:0]
        total = sum(float(one.term(nothing, nothing, context)) for one in folded.scalars)
        reading = context.settings.reference_distance
        if folded.reference is not None:
            region = folded.reference.region()
            if region is not None:
                reading = mean_reading(metres[region])
        if folded.reference is not None and reading is not None:
            total += folded.reference.drift(reading)
        else:
            total += sum(float(one.term(nothing, nothing, context)) for one in folded.drifts)
        return metres.dtype.type(total)

    def _once(self, folded: _Folded, y: Image, by_amplitude: ByAmplitude, context: Context) -> Image:
        """Terms of whole frames or of amplitude and place, evaluated once."""
        for one in folded.frame_terms:
            saturated = context.saturated
            if one.name == "saturation_bleed" and (saturated is None or not saturated.any()):
                continue
            y = y - np.asarray(one.term(y, by_amplitude.amplitude, context), y.dtype)
        return y

    def _solve(
        self, folded: _Folded, y: Image, by_amplitude: ByAmplitude, context: Context
    ) -> _Solution:
        """Solve for the light without stray light, emitter offset and all terms.

        Terms of distance and place are refined once (often, where ``exact``). Terms of the incidence need
        the result's own planes: the optics are undone, the angle is estimated, and both are done again.
        """
        amplitude = by_amplitude.amplitude
        delivered, placed = folded.refine(folded.distance.solve(y), y, amplitude, context)
        turns = folded.incidence_rounds
        solution = self._optics(folded, delivered, by_amplitude, None, quick=turns > 0 and not self.exact)
        for turn in range(turns):
            if self._estimator is None:
                self._estimator = IncidenceEstimator(self.camera.rays)
            cosine = self._estimator.cosine(solution.distance, solution.sigma)
            shifted = y - folded.incidence_term(cosine, by_amplitude, context)
            delivered, placed = folded.refine(
                folded.distance.solve(shifted - placed), shifted, amplitude, context
            )
            quick = turn + 1 < turns and not self.exact
            solution = self._optics(folded, delivered, by_amplitude, solution.image, quick=quick)
            solution.unplaned = np.isnan(cosine)
        return solution

    def _optics(
        self,
        folded: _Folded,
        delivered: Image,
        by_amplitude: ByAmplitude,
        guess: Image | None,
        *,
        quick: bool,
    ) -> _Solution:
        """Undo stray light in the complex domain, then the emitter's offset."""
        solution = _Solution(delivered, by_amplitude.amplitude, by_amplitude.sigma)
        if folded.spreading is not None:
            self._undo_spreading(folded.spreading, solution, guess, quick=quick)
        if self.camera.sensor.wraps:
            length = delivered.dtype.type(self.camera.sensor.ambiguity)
            periods = np.floor(solution.distance * (1 / length))
            periods *= length
            solution.distance = solution.distance - periods
        if folded.emitter is not None:
            solution.distance = folded.emitter.length(solution.distance, folded.emitter_ray)
        return solution

    def _undo_spreading(
        self, operator: Spreading, solution: _Solution, guess: Image | None, *, quick: bool
    ) -> None:
        delivered, amplitude = solution.distance, solution.amplitude
        dtype = delivered.dtype.type
        wave = dtype(2 * np.pi / self.camera.sensor.ambiguity)
        known = np.isfinite(delivered)
        phase = np.where(known, delivered, dtype(0))
        phase *= wave
        cosine, sine = np.cos(phase), np.sin(phase)
        light = amplitude * known
        image = np.empty((delivered.shape[0], 2, delivered.shape[1]), delivered.dtype)
        np.multiply(cosine, light, out=image[:, 0])
        np.multiply(sine, light, out=image[:, 1])
        solved = operator.first_order(image) if quick else operator.solve(image, guess=guess)
        # the angle between direct and delivered light, so that the distance keeps its period
        real = solved[:, 0] * cosine
        real += solved[:, 1] * sine
        imaginary = solved[:, 1] * cosine
        imaginary -= solved[:, 0] * sine
        turned = np.arctan2(imaginary, real)
        turned *= 1 / wave
        solution.distance = delivered + turned
        real *= real
        imaginary *= imaginary
        real += imaginary
        solution.amplitude = np.sqrt(real, out=real)
        # noise stays where it is, but is the greater against what is left of the light
        gain = amplitude / solution.amplitude
        gain *= dtype(1.0 / operator.direct)
        solution.sigma = solution.sigma * gain
        solution.image = solved

    def _finish(
        self,
        frame: RawFrame,
        folded: _Folded,
        metres: Image,
        solution: _Solution,
        by_amplitude: ByAmplitude,
    ) -> CorrectedFrame:
        flags = by_amplitude.flags.copy()
        distance, sigma = solution.distance, solution.sigma
        if folded.spreading is not None:
            # light that stray light had lent an amplitude above the minimum
            flags[solution.amplitude < folded.amplitude.minimum] |= Flag.LOW_AMPLITUDE.value
        if solution.unplaned is not None:
            sigma = np.where(solution.unplaned, np.hypot(sigma, folded.incidence_spread), sigma)
        # a value that only the amplitude's flags explain is not a missing measurement as well
        missing = np.isnan(distance) & ((flags & np.uint8(INVALID.value)) == 0)
        missing |= np.isnan(metres)
        flags[missing] |= Flag.NO_MEASUREMENT.value
        if folded.reference_region is not None:
            flags[folded.reference_region] |= Flag.NO_MEASUREMENT.value
        flags[mixed_pixels(distance, sigma)] |= Flag.MIXED_PIXEL.value
        if folded.outside:
            flags |= Flag.OUTSIDE_CALIBRATION.value
        self._mark_validity(flags, distance, frame.settings)
        invalid = _marked(flags, INVALID)
        corrected = distance.astype(np.float32)
        corrected[invalid] = np.nan
        sigma = np.array(sigma, np.float32)
        sigma[invalid] = np.nan
        return CorrectedFrame(
            stamp=frame.stamp,
            distance=corrected,
            amplitude=np.asarray(solution.amplitude, np.float32),
            sigma=sigma,
            flags=flags,
            settings=frame.settings,
        )

    def _mark_validity(self, flags: NDArray[np.uint8], distance: Image, settings: Settings) -> None:
        limits = self.camera.validity
        bit = np.uint8(Flag.OUTSIDE_CALIBRATION.value)
        if limits.distance is not None:
            flags[(distance < limits.distance[0]) | (distance > limits.distance[1])] |= bit
        if limits.region is not None:
            u0, v0, u1, v1 = (int(round(x)) for x in limits.region)
            inside = np.zeros(flags.shape, bool)
            inside[max(v0, 0) : v1 + 1, max(u0, 0) : u1 + 1] = True
            flags[~inside] |= bit
        for name, value in (
            ("integration_time", settings.integration_time),
            ("temperature", settings.ambient_temperature),
        ):
            bounds = getattr(limits, name)
            if bounds is not None and value is not None and not bounds[0] <= value <= bounds[1]:
                flags |= bit


@dataclass
class _Solution:
    """Light without stray light and emitter offset: distance [m], amplitude [counts], sigma [m]."""

    distance: Image
    amplitude: Image
    sigma: Image
    #: complex image (H, 2, W), where stray light was undone
    image: Image | None = None
    #: pixels where no plane was found for the incidence
    unplaned: NDArray[np.bool_] | None = None


class _Folded:
    """The effects of one camera at one integration time, sorted by what they depend on."""

    def __init__(self, correction: Correction, settings: Settings) -> None:
        camera, exact = correction.camera, correction.exact
        active = {name: one for name, one in camera.effects.items() if name not in correction.without}
        context = Context(camera=camera, settings=settings, notes=correction.notes)
        terms = [one for one in active.values() if isinstance(one, DistanceTerm)]
        self._exact = exact
        self._dtype = np.float64 if exact else np.float32
        by_amplitude: list[DistanceTerm] = []
        by_pixel: list[DistanceTerm] = []
        by_distance: list[DistanceTerm] = []
        self._placed_terms: list[DistanceTerm] = []
        self._incidence_terms: list[DistanceTerm] = []
        self.frame_terms: list[DistanceTerm] = []
        self.scalars: list[DistanceTerm] = []
        self.drifts: list[DistanceTerm] = []
        for one in terms:
            needs = one.depends_on() - {"settings"}
            if "incidence" in needs:
                self._incidence_terms.append(one)
            elif isinstance(one, WarmUpDrift | AmbientTemperature):
                self.drifts.append(one)
            elif not needs:
                self.scalars.append(one)
            elif needs == {"amplitude"}:
                by_amplitude.append(one)
            elif needs == {"pixel"}:
                by_pixel.append(one)
            elif needs == {"distance"} or one.name == "cyclic_error":
                by_distance.append(one)
            elif "frame" in needs or "distance" not in needs:
                self.frame_terms.append(one)
            else:
                self._placed_terms.append(one)
        self.amplitude = AmplitudeModel(camera, by_amplitude, context, correction.minimum_amplitude)
        self.distance = DistanceSolver(camera, by_distance, context, exact=exact)
        self.map = _sum_maps(by_pixel, camera, context, self._dtype)
        self._fold_placed(camera, context)
        self._fold_incidence(context)
        self._fold_optics(active, camera)
        reference = active.get("reference_path")
        self.reference = reference if isinstance(reference, ReferencePath) else None
        self.reference_region = self.reference.region() if self.reference is not None else None
        rows = [getattr(one, name, None) for one in terms for name in ("hyperbola", "polynomial", "offset")]
        t = settings.integration_time
        self.outside = any(outside_rows(one, t) for one in rows if one is not None and not isinstance(one, float))

    def _fold_placed(self, camera: Camera, context: Context) -> None:
        planes = [one for one in self._placed_terms if distance_knots(one) and "amplitude" not in one.depends_on()]
        if self._exact:
            planes = []
        self._placed_directly = [one for one in self._placed_terms if one not in planes]
        self._planes = PlaneTable(camera, planes, context) if planes else None

    def refine(self, distance: Image, y: Image, amplitude: Image, context: Context) -> tuple[Image, Image | float]:
        """Return the distance with the terms of distance and place in it, and those terms, in metres.

        ``distance`` solves y without them, or with nearly them: such terms change slowly with distance.
        """
        if not self._placed_terms:
            return distance, 0.0
        placed: Image | float = self.placed(distance, amplitude, context)
        for _ in range(8 if self._exact else 1):
            distance = self.distance.solve(y - placed)
            again = self.placed(distance, amplitude, context)
            # the terms' own change goes straight through: what it moves the others by is beyond the tolerance
            if not self._exact:
                return distance - (again - placed), again
            placed = again
        return distance, placed

    def placed(self, distance: Image, amplitude: Image, context: Context) -> Image:
        """Return the terms of distance and place in metres at a distance (H, W)."""
        if self._planes is not None:
            total: Any = self._planes.term(distance)
        else:
            total = distance.dtype.type(0)
        for one in self._placed_directly:
            total = total + one.term(distance, amplitude, context)
        result: Image = np.asarray(total, distance.dtype)
        return result

    def _fold_incidence(self, context: Context) -> None:
        self.incidence_rounds = (3 if self._exact else 1) if self._incidence_terms else 0
        only = [one for one in self._incidence_terms if isinstance(one, IncidenceAngle)]
        self._incidence_table: NDArray[np.float32] | None = None
        if only and len(only) == len(self._incidence_terms) and not self._exact:
            # over the square root of 1 - cos, in which the term is smooth
            root = np.linspace(0.0, 1.0, _COSINES)
            gon = incidence_gon(np.arccos(1.0 - root**2))
            self._incidence_table = np.asarray(only[0].at(gon, context), np.float32)
        #: RMS over the angles, in metres: what is not known where no plane is found
        self.incidence_spread = 0.0
        if self._incidence_terms:
            context.incidence = np.linspace(0, np.pi / 2, 91)[None]
            ones = np.ones_like(context.incidence)
            spread = sum(np.asarray(one.term(ones, ones, context)) for one in only)
            self.incidence_spread = float(np.sqrt(np.mean(np.square(spread))))

    def incidence_term(self, cosine: Image, by_amplitude: ByAmplitude, context: Context) -> Image:
        """Return the terms of the incidence in metres; 0 where no plane was found."""
        if self._incidence_table is not None:
            root = np.sqrt(np.maximum(np.float32(1.0) - cosine, np.float32(0.0)))
            position = root * np.float32(_COSINES - 1)
            index = position.astype(np.int32)
            lower = np.take(self._incidence_table, index, mode="clip")
            upper = np.take(self._incidence_table, index + 1, mode="clip")
            result = lower + (position - index) * (upper - lower)
        else:
            context.incidence = np.arccos(np.clip(cosine, 0.0, 1.0).astype(self._dtype))
            result = np.zeros(cosine.shape, self._dtype)
            for one in self._incidence_terms:
                result = result + one.term(result, by_amplitude.amplitude, context)
        return np.where(np.isnan(cosine), self._dtype(0), result).astype(self._dtype, copy=False)

    def _fold_optics(self, active: dict[str, Any], camera: Camera) -> None:
        scattering = active.get("scattering")
        self.spreading: Spreading | None = None
        if isinstance(scattering, Scattering):
            self.spreading = scattering.operator(camera.shape, self._dtype)
        emitter = active.get("emitter_offset")
        self.emitter = emitter if isinstance(emitter, EmitterOffset) else None
        if self.emitter is not None:
            self.emitter_ray = (camera.rays @ np.array(self.emitter.position)).astype(self._dtype)

    def by_amplitude(self, raw: Image) -> ByAmplitude:
        """Return what the published amplitude decides: by table for counts, else evaluated."""
        if raw.dtype == np.uint16 and not self._exact:
            table = self.amplitude.table
            return ByAmplitude(
                np.take(table.amplitude, raw, mode="wrap"),
                np.take(table.term, raw, mode="wrap"),
                np.take(table.sigma, raw, mode="wrap"),
                np.take(table.flags, raw, mode="wrap"),
            )
        exact = self.amplitude.evaluate(np.nan_to_num(raw.astype(np.float64), posinf=0.0, neginf=0.0))
        return ByAmplitude(
            exact.amplitude.astype(self._dtype, copy=False),
            exact.term.astype(self._dtype, copy=False),
            exact.sigma.astype(self._dtype, copy=False),
            exact.flags,
        )


def _sum_maps(terms: list[DistanceTerm], camera: Camera, context: Context, dtype: Any) -> Image | None:
    if not terms:
        return None
    zero = np.zeros(camera.shape)
    total = zero
    for one in terms:
        total = total + one.term(zero, zero, context)
    return total.astype(dtype)


def _marked(flags: NDArray[np.uint8], bits: Flag) -> NDArray[np.bool_]:
    result: NDArray[np.bool_] = (flags & np.uint8(bits.value)) != 0
    return result
