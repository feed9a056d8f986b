"""The prediction of a station by one camera: readings, residuals and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.base import ComplexEffect, DistanceTerm, Effect, ResponseEffect
from rim_camera_ros.effects.candidate import Block, Groups
from rim_camera_ros.effects.light_curves import RESPONSE, LightCurves
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.fit.channels import Places
from rim_camera_ros.fit.data import Station
from rim_camera_ros.fit.light import DARK, SpreadLight
from rim_camera_ros.fit.pose_columns import PoseColumn
from rim_camera_ros.fit.undescribed import Undescribed
from rim_camera_ros.fit.views import View
from rim_camera_ros.phasor import to_phasor

Array = NDArray[Any]

#: Derivatives (H, W) of measured distance and published amplitude (None: none) by one regressor.
Column = tuple[Array, Array | None]

#: Key of the derivatives by the emitter's power, which are kept with those by the poses.
_POWER = "power"


@dataclass
class Prediction:
    """One station: prediction, residuals, weights and derivatives, (H, W) each.

    ``residual`` [m] and ``amplitude_residual`` [counts] are measured - predicted; ``used`` and
    ``amplitude_used`` mark the pixels to fit. ``sigma`` is the standard deviation of the station's mean
    distance by the noise model, including ``variance_of_other`` [m^2] of a recording that it is compared
    with; ``amplitude_noise`` that of its mean amplitude. ``amplitude_sigma`` includes the errors of predicted
    amplitudes, which neighbours share: so a pixel counts as ``amplitude_share`` of an observation, and the
    expected value of its chi-square, by its own noise, is ``amplitude_freedom``. ``amplitude`` is the latent
    amplitude [counts] that distance terms depend on; ``amplitude_follows`` is its relative derivative by the
    predicted light, ``amplitude_measured`` that by the measured light. ``model_slope`` [counts] is the
    derivative of the predicted published amplitude by the logarithm of the predicted light (not of the latent
    amplitude, which contains the noise of the measurement). ``of_window`` is the prediction of
    the window of the array in which rays meet the scene, where that is computed alone.
    """

    station: Station
    view: View
    context: Context
    order: dict[str, int]
    before: dict[str, Signal]
    delivered: Signal
    distance: Array
    amplitude: Array
    residual: Array
    amplitude_residual: Array
    sigma: Array
    amplitude_sigma: Array
    amplitude_noise: Array
    amplitude_share: Array
    amplitude_freedom: Array
    used: NDArray[np.bool_]
    amplitude_used: NDArray[np.bool_]
    slope_distance: Array | float
    slope_amplitude: Array | float
    slope_published: Array
    pose_columns: list[PoseColumn]
    model_amplitude: Array
    model_reading: Array
    model_slope: Array
    gain: float
    spread_light: SpreadLight
    pixel_gain: Array | float = 1.0
    amplitude_follows: Array | float = 1.0
    amplitude_measured: Array | float = 0.0
    spread: list[Effect] = field(default_factory=list)
    light_curves: LightCurves | None = None
    variance_of_other: Array | float = 0.0
    linear: Sequence[Any] = ()
    undescribed: Undescribed | None = None
    of_window: Prediction | None = None
    _images: dict[str, tuple[Array, Array]] = field(default_factory=dict)
    _changes: dict[str, tuple[Array, Array]] = field(default_factory=dict)
    _by_light: tuple[Array, Array] | None = None

    @property
    def inner(self) -> Prediction:
        """The prediction whose images are no larger than they need be."""
        return self if self.of_window is None else self.of_window

    def for_columns(self, block: Block) -> Prediction:
        """Return the prediction from which the columns of regressors are computed."""
        return self.inner if block.pointwise else self

    def places(self, pixels: Array) -> Places:
        """Return where pixels (N,) of the whole array, flat, are in its images and in those of `inner`."""
        window, (_, width) = self.inner.context.window, self.used.shape
        if window is None:
            return Places(pixels, self.used.size)
        row, column = np.divmod(pixels, width)
        rows, columns = window
        within = (row - rows.start) * (columns.stop - columns.start) + column - columns.start
        return Places(pixels, self.used.size, within)

    def light_change(self, after: str | None, change: Array) -> tuple[Array, Array]:
        """Propagate a relative change of the complex image through the optics that follow an effect.

        ``change`` (H, W) complex: dS / S just after effect ``after`` (None: at the scene). Returns the
        derivatives of measured distance and published amplitude.
        """
        start = -1 if after is None else self.order[after]
        if self.undescribed is not None and start < self.undescribed.place:
            change = self.undescribed.left_of(change)
        return self._spread_change(start, change)

    def _spread_change(self, start: int, relative: Array) -> tuple[Array, Array]:
        """Propagate a relative change of the light through what spreads it after a place in the order."""
        for effect in self.spread:
            if self.order[effect.name] > start:
                assert isinstance(effect, ComplexEffect)
                before, inverse = self._through(effect)
                # a derivative needs no more digits
                relative = relative.astype(np.complex64)
                if not np.isfinite(relative.sum()):
                    relative[~np.isfinite(relative)] = 0
                relative = effect.apply(relative * before, self.context) * inverse
        return self._delivered_change(relative)

    def groups_change(self, number: Array, count: int) -> Groups:
        """Return the derivatives by the relative light of groups of pixels at the scene.

        ``number`` (H, W) is the group of each pixel, of ``count`` groups (-1: none). Light that optics spread
        is approximated: that of a group arrives where that of all groups does, in proportion to its light.
        Fits with these derivatives take as many steps as with the exact ones, which would be dense.
        """
        groups = number.astype(np.intp)
        if not self.spread:
            return Groups(groups, self.gain_column(), np.zeros(count))
        direct: Array = np.ones(number.shape, np.complex64)
        for effect in self.spread:
            assert isinstance(effect, ComplexEffect)
            before, inverse = self._through(effect)
            direct = effect.direct * direct * before * inverse
        light = self.spread_light.before_spreading(self.spread)
        total = np.bincount(
            groups.ravel() + 1, weights=self.context.inside(light).ravel(), minlength=count + 1
        )
        share = total[1:] / max(float(light.sum()), DARK)
        return Groups(groups, self._delivered_change(direct), share, self._delivered_change(1.0 - direct))

    def _delivered_change(self, relative: Array) -> tuple[Array, Array]:
        by_distance = relative.imag * (self.context.ambiguity / (2 * np.pi))
        return self.reading_change(by_distance, relative.real)

    def _through(self, effect: ComplexEffect) -> tuple[Array, Array]:
        """Return the image before a spreading effect, and the inverse of that after it (0 where dark)."""
        found = self._images.get(effect.name)
        if found is None:
            before, inverse = (self.context.inside(image) for image in self.spread_light.through(effect))
            found = self._images[effect.name] = (before, inverse)
        return found

    def reading_change(self, by_distance: Array | float, relative: Array | float) -> tuple[Array, Array]:
        """Return the changes of the readings for changes of delivered distance [m] and log amplitude."""
        if self._by_light is None:
            by_latent = self.delivered.amplitude * self.slope_amplitude
            self._by_light = (self.amplitude_follows * by_latent, self.model_slope)
        measured, published = (relative * slope for slope in self._by_light)
        if isinstance(by_distance, np.ndarray) or by_distance:
            measured = by_distance * self.slope_distance + measured
        return np.asarray(measured), np.asarray(published)

    def columns(self, effect: Effect) -> dict[str, tuple[Array, Array]]:
        """Return the derivatives of measured distance and published amplitude by an effect's parameters.

        The effect need not be one of the camera's: a candidate has its place in the order of effects.
        """
        name = effect.name
        if isinstance(effect, ResponseEffect):
            return self._of_response(effect)
        signal = self.before_effect(name)
        columns = effect.columns(signal, self.context)
        if effect.remembers_geometry and name in self.context.memory:
            self.view.memory[name] = self.context.memory[name]
        if isinstance(effect, DistanceTerm):
            zero = np.zeros(self.distance.shape)
            return {path: (zero + d, zero + a) for path, (d, a) in columns.items()}
        after = effect.simulate(signal, self.context).amplitude
        result = {}
        for path, (d, a) in columns.items():
            with np.errstate(divide="ignore", invalid="ignore"):
                relative = np.where(after > 0, a / after, 0.0)
            change = relative + 1j * (2 * np.pi / self.context.ambiguity) * np.nan_to_num(d)
            result[path] = self.light_change(name, change)
        undone = isinstance(effect, ComplexEffect) and effect.spreads and name in self.before
        if self.undescribed is not None and undone:
            assert isinstance(effect, ComplexEffect)
            for path, change in self.undescribed.changes(effect, self.context):
                own, of_light = result[path], self._spread_change(-1, change)
                result[path] = (own[0] + of_light[0], own[1] + of_light[1])
        return result

    def _of_response(self, effect: ResponseEffect) -> dict[str, tuple[Array, Array]]:
        light = Signal(self.delivered.distance, self.model_amplitude / self.pixel_gain)
        columns = effect.columns(light, self.context)
        return {path: self._response_change(a * self.pixel_gain) for path, (_, a) in columns.items()}

    def _response_change(self, published: Array | float) -> tuple[Array, Array]:
        """Return the derivatives of the readings by a change of ``published`` amplitudes of the same light.

        Distance terms depend on the light that the measured amplitude stands for: less where more is
        published.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(self.model_slope > 0, published / self.model_slope, 0.0)
        by_latent = self.amplitude_measured * self.delivered.amplitude * self.slope_amplitude
        return np.asarray(-relative * by_latent), np.asarray(published + np.zeros(self.distance.shape))

    def before_effect(self, name: str) -> Signal:
        """Return the light just before an effect, which need not be one of the camera's."""
        found = self.before.get(name)
        if found is not None:
            return found
        place = self.order[name]
        later = [n for n in self.before if self.order[n] > place]
        first = min(later, key=lambda n: self.order[n], default=None)
        return self.delivered if first is None else self.before[first]

    def gain_column(self) -> tuple[Array, Array]:
        """Return the derivatives by the relative power of the emitter."""
        if _POWER not in self._changes:
            self._changes[_POWER] = self.reading_change(0.0, np.ones(self.distance.shape))
        return self._changes[_POWER]

    def pixel_gain_column(self) -> tuple[Array, Array]:
        """Return the derivatives by the relative gain of each pixel, which multiplies readings."""
        return self.gain_column()[0], self.model_reading

    def curve_columns(self, labels: Sequence[str]) -> list[tuple[Array, Array]]:
        """Return the derivatives by curves of the light, in the order of their labels."""
        curves = self.light_curves or LightCurves()
        if labels[0] in RESPONSE:
            changes = curves.response_columns(self.model_amplitude / self.pixel_gain)
            return [self._response_change(self.model_reading * change) for change in changes]
        changes = curves.columns(self.view.geometry, self.context.ambiguity, labels)
        if not self.spread:
            return [self.reading_change(0.0, change) for change in changes]
        # a plane shows few of the angles of a curve; columns that are 0 need no (slow) spreading of light
        none = (np.zeros(self.distance.shape), np.zeros(self.distance.shape))
        return [self.light_change(None, change + 0j) if change.any() else none for change in changes]

    def light_columns(self) -> dict[str, tuple[Array, Array]]:
        """Return the derivatives by light that is added to all pixels [counts], by name of its part.

        The parts are the real and imaginary parts of its mean, and of its gradients over rows and columns (at
        the rim): a second camera does not light the scene evenly.
        """
        level = to_phasor(self.delivered.distance, self.amplitude, self.context.ambiguity)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(level == 0, 0, 1.0 / np.where(level == 0, 1.0, level))
        scale = self.context.ambiguity / (2 * np.pi)
        rows, columns = (np.linspace(-1.0, 1.0, n) for n in level.shape)
        result = {}
        for name, form in (("", 1.0), ("_rows", rows[:, None]), ("_columns", columns[None, :])):
            for part, change in (("real", form * relative), ("imaginary", 1j * form * relative)):
                result[part + name] = self.reading_change(scale * change.imag, change.real)
        return result

    def pose_change(self, column: PoseColumn) -> tuple[Array, Array]:
        """Return the derivatives of the readings by an error of a pose."""
        if column.path not in self._changes:
            wave = 2 * np.pi / self.context.ambiguity
            self._changes[column.path] = (
                self.light_change(None, column.amplitude + 1j * wave * column.distance)
                if self.spread and not column.is_smooth
                else self.reading_change(column.distance, column.amplitude)
            )
        return self._changes[column.path]


def random_effects(
    prediction: Prediction, *, gain_sigma: float, stray_light: float
) -> list[tuple[str, float, float, Array, Array]]:
    """Return a station's random effects: name, 1-sigma, value at the point, derivatives of both channels.

    These are errors of poses; with a ``gain_sigma`` (relative) the emitted power; with ``stray_light``
    [counts] light that is added to all pixels of the station, with gradients of the same size. The images are
    those of the prediction's `inner`, but for that light, which is of the whole array.
    """
    station = prediction.station
    key = f"{station.recording}.{station.pose}"
    result = []
    inner = prediction.inner
    for column in inner.pose_columns:
        if column.path.startswith("scene."):
            continue
        distance, amplitude = inner.pose_change(column)
        name = f"{station.recording}.{station.placed}.{column.path}"
        result.append((name, column.prior, 0.0, distance, amplitude))
    if gain_sigma > 0:
        distance, amplitude = inner.gain_column()
        at = float(np.log(prediction.gain))
        result.append((f"{key}.gain", gain_sigma, at, distance, amplitude))
    if stray_light > 0:
        for part, (distance, amplitude) in prediction.light_columns().items():
            result.append((f"{key}.light.{part}.{station.stamp}", stray_light, 0.0, distance, amplitude))
    return result
