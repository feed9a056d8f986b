"""The effects of one camera at one setting, sorted by what they depend on and folded into tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.chain import Chain
from rim_camera_ros.effects import InternalReference
from rim_camera_ros.effects.base import DistanceTerm
from rim_camera_ros.effects.incidence import IncidenceTerm, incidence_gon
from rim_camera_ros.effects.rows import outside_rows
from rim_camera_ros.effects.signal import Context
from rim_camera_ros.pipeline import kernels
from rim_camera_ros.pipeline.amplitude_tables import AmplitudeModel
from rim_camera_ros.pipeline.distance_tables import DistanceSolver, PlaneTable

Image = NDArray[Any]

#: Entries of the table of the incidence terms over the root of 1 - cosine: 0.2 mrad or less apart.
_ANGLES = 1 << 13
#: Below this angle in rad a plane is seen nearly perpendicularly.
_PERPENDICULAR = 0.05
#: Where exact: evaluations of terms of distance and place, and rounds of terms of the incidence.
_EXACT_PLACED = 8
_EXACT_ROUNDS = 3


class Folded:
    """Tables that correct frames of one setting; ``context``: that of the effects, renewed for each frame."""

    def __init__(
        self,
        camera: Camera,
        chain: Chain,
        context: Context,
        minimum: float | None,
        *,
        exact: bool,
    ) -> None:
        self.context = context
        self._exact = exact
        self._dtype = np.float64 if exact else np.float32
        self._sort(chain.terms)
        self.amplitude = AmplitudeModel(
            camera,
            self._by_amplitude,
            chain.response,
            context,
            minimum,
        )
        self.distance = DistanceSolver(camera, self._by_distance, context, exact=exact)
        self.map = _sum_maps(self._by_pixel, camera, context, self._dtype)
        planes = (
            []
            if exact
            else [distance_term for distance_term in self._placed if _folds_into_planes(distance_term)]
        )
        self._placed_directly = [
            distance_term for distance_term in self._placed if distance_term not in planes
        ]
        self._planes = PlaneTable(camera, planes, context) if planes else None
        self._fold_incidence()
        self._reference = next(
            (
                reference_path
                for reference_path in chain.light
                if isinstance(reference_path, InternalReference)
            ),
            None,
        )
        #: pixels that see no scene
        self.reference_region = self._reference.region() if self._reference is not None else None
        self._constant = sum(self._number(constant) for constant in self._constants)
        t = context.camera.stated_integration_time(context.settings)
        #: whether the setting lies outside the calibrated rows
        self.outside = any(outside_rows(effect.rows(), t) for effect in (*chain.light, *chain.terms))

    def _sort(self, terms: Sequence[DistanceTerm]) -> None:
        self._by_amplitude: list[DistanceTerm] = []
        self._by_pixel: list[DistanceTerm] = []
        self._by_distance: list[DistanceTerm] = []
        self._placed: list[DistanceTerm] = []
        self._by_incidence: list[DistanceTerm] = []
        self._by_frame: list[DistanceTerm] = []
        self._constants: list[DistanceTerm] = []
        self._scalars: list[DistanceTerm] = []
        self._drifts: list[DistanceTerm] = []
        for term in terms:
            needs = term.depends_on() - {"settings"}
            if "incidence" in needs:
                self._by_incidence.append(term)
            elif term.drifts:
                self._drifts.append(term)
            elif term.constant_in_setting:
                self._constants.append(term)
            elif not needs:
                self._scalars.append(term)
            elif needs == {"amplitude"}:
                self._by_amplitude.append(term)
            elif needs == {"pixel"}:
                self._by_pixel.append(term)
            elif needs == {"distance"} or term.has_phase:
                self._by_distance.append(term)
            elif "frame" in needs or "distance" not in needs:
                self._by_frame.append(term)
            else:
                self._placed.append(term)

    # --- terms that are evaluated once ----------------------------------------------------------

    def _number(self, term: DistanceTerm) -> float:
        nothing = np.empty((0,))
        return float(np.asarray(term.term(nothing, nothing, self.context)))

    def offset(self) -> float:
        """Return the sum of the terms that are one number per frame, in metres.

        Where there is a reading of the reference path it replaces the drift terms.
        """
        total = self._constant + sum(self._number(scalar) for scalar in self._scalars)
        reading = self.context.settings.reference_distance
        if self._reference is not None and reading is not None:
            return total + self._reference.drift(reading)
        return total + sum(self._number(drift) for drift in self._drifts)

    def reference_pixels(self, raw: Image, unit: float) -> Image | None:
        """Return the distances [m], or NaN, of the pixels that see the reference; None without such."""
        if self.reference_region is None:
            return None
        pixels = raw[self.reference_region]
        return np.where(pixels > 0, pixels * unit, np.nan)

    def subtract_frame_terms(self, y: Image, amplitude: Image) -> None:
        """Subtract terms of whole frames, or of amplitude and place, from y in metres."""
        saturated = self.context.saturated
        for distance_term in self._by_frame:
            lines = None if saturated is None else distance_term.line_terms(saturated)
            if lines is not None:
                y -= lines[0].astype(y.dtype)[:, None]
                y -= lines[1].astype(y.dtype)
            else:
                y -= np.asarray(distance_term.term(y, amplitude, self.context), y.dtype)

    # --- terms of distance, or of distance and place --------------------------------------------

    def refined(self, distance: Image, y: Image, amplitude: Image) -> tuple[Image, Image | None]:
        """Return the distance that includes the terms of distance and place, and these terms, in metres.

        ``distance`` (H, W) solves y without these terms or with approximate ones, as they change slowly with
        distance.
        """
        if not self._placed:
            return distance, None
        placed = self.placed(distance, amplitude)
        for _ in range(_EXACT_PLACED if self._exact else 1):
            distance = self.distance.solve(y - placed)
            again = self.placed(distance, amplitude)
            if not self._exact:
                self.follow(distance, placed, again)
            placed = again
        return distance, placed

    def follow(self, distance: Image, before: Image, after: Image) -> None:
        """Apply a change of the terms of distance and place directly to the distance.

        Its influence on the other terms is below the tolerance. ``before`` is overwritten.
        """
        before -= after
        distance += before

    def placed(self, distance: Image, amplitude: Image) -> Image:
        """Return the terms of distance and place in metres at a distance (H, W); a new array."""
        total: Image = np.zeros_like(distance) if self._planes is None else self._planes.term(distance)
        for distance_term in self._placed_directly:
            total += np.asarray(distance_term.term(distance, amplitude, self.context), distance.dtype)
        return total

    @property
    def pixel_by_pixel(self) -> bool:
        """Whether terms only need the counts and the place of their pixel."""
        return not (self._by_frame or self._placed or self._by_incidence)

    @property
    def has_placed(self) -> bool:
        """Whether there are terms of distance and place."""
        return bool(self._placed)

    # --- terms of the incidence -----------------------------------------------------------------

    def _fold_incidence(self) -> None:
        #: number of evaluations of the terms of the incidence
        self.incidence_rounds = 0
        #: RMS over the angles, in metres: 1-sigma of the term where no plane is found
        self.incidence_spread = 0.0
        self._by_angle: NDArray[np.complex64] | None = None
        if not self._by_incidence:
            return
        self.incidence_rounds = _EXACT_ROUNDS if self._exact else 1
        angles = [
            incidence_term
            for incidence_term in self._by_incidence
            if isinstance(incidence_term, IncidenceTerm)
        ]
        gon = incidence_gon(np.linspace(0, np.pi / 2, 91))
        spread = sum(np.asarray(angle.at(gon, self.context)) for angle in angles)
        self.incidence_spread = float(np.sqrt(np.mean(np.square(spread))))
        if len(angles) == len(self._by_incidence) and not self._exact:
            self._by_angle = self._tabulate_incidence(angles)
            self._pair = [np.empty(self.context.camera.shape, np.float32) for _ in range(2)]

    def _tabulate_incidence(self, terms: list[IncidenceTerm]) -> NDArray[np.complex64]:
        """Return t and b over sqrt(1 - cosine), for the angle estimated from distances that contain the term.

        A plane r = d / cos(angle) appears as r + t(angle). To first order in t / d the tangent of its
        apparent angle is tan(angle) + (t' - t tan(angle)) / d. At the apparent angle the term is therefore t
        + b / d, with b = -t' cos^2(angle) (t' - t tan(angle)). Where the plane is seen perpendicularly, t has
        an edge, which the window of the estimate smoothes, and b goes to 0.
        """
        angle = np.arccos(1.0 - np.linspace(0.0, 1.0, _ANGLES) ** 2)

        def at(angle: Image) -> Image:
            gon = incidence_gon(angle)
            return np.asarray(sum(np.asarray(term.at(gon, self.context)) for term in terms))

        step = 1e-4
        slope = (at(angle + step) - at(np.maximum(angle - step, 0))) / (np.minimum(angle, step) + step)
        value, cosine = at(angle), np.cos(angle)
        change = -slope * cosine * (slope * cosine - value * np.sin(angle))
        # the first entry is for pixels without a plane
        table = np.zeros((_ANGLES + 1, 2), np.float32)
        table[1:, 0] = value
        table[1:, 1] = change * np.minimum(angle / _PERPENDICULAR, 1.0)
        return table.view(np.complex64).ravel()

    def incidence_term(self, cosine: Image, amplitude: Image, distance: Image) -> Image:
        """Return the terms of the incidence in metres (H, W); 0 where no plane was found. A new array.

        ``distance`` [m]: that from which the angle was estimated.
        """
        if self._by_angle is not None and kernels.LIBRARY is not None:
            return kernels.incidence_term(cosine, distance, table=self._by_angle)
        if self._by_angle is not None:
            # NaN becomes a negative entry, which counts as the first
            entry = np.sqrt(np.float32(1.0) - cosine)
            entry *= np.float32(_ANGLES - 1)
            entry += np.float32(1.5)
            found = np.take(self._by_angle, entry.astype(np.int32), mode="clip")
            term, change = cv2.split(found.view(np.float32).reshape(*cosine.shape, 2), self._pair)
            change /= distance
            result: Image = term + change
            return result
        self.context.incidence = np.arccos(np.clip(cosine, 0.0, 1.0).astype(self._dtype))
        result = np.zeros(cosine.shape, self._dtype)
        for distance_term in self._by_incidence:
            result += np.asarray(distance_term.term(distance, amplitude, self.context), self._dtype)
        result[np.isnan(cosine)] = 0
        return result


def _folds_into_planes(term: DistanceTerm) -> bool:
    return bool(term.distance_knots()) and "amplitude" not in term.depends_on()


def _sum_maps(terms: list[DistanceTerm], camera: Camera, context: Context, dtype: Any) -> Image | None:
    if not terms:
        return None
    zero = np.zeros(camera.shape)
    total = zero
    for term in terms:
        total = total + term.term(zero, zero, context)
    return total.astype(dtype)
