"""Scene + camera -> raw frames: the effects in order, then noise, read-out and quantisation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import FULL_SCALE, Camera
from rim_camera_ros.chain import Chain, deliver, ideal_amplitude
from rim_camera_ros.effects import InternalReference, mean_reading
from rim_camera_ros.effects.base import DistanceTerm, Effect, effect_of
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.errors import InputError
from rim_camera_ros.footprint import Cells, FootprintLight, footprint_light
from rim_camera_ros.frame import NANOSECONDS, Pose, RawFrame, Settings
from rim_camera_ros.geometry import Geometry, see
from rim_camera_ros.noise import sigma_amplitude
from rim_camera_ros.phasor import Waveform, to_phasor, wrap, wrap_residual
from rim_camera_ros.pipeline.reference import SimulatedReference
from rim_camera_ros.scene import Scene

_MOTION_STEPS = 1e-9
Image = NDArray[Any]


@dataclass(frozen=True)
class Exposure:
    """An exposure: stamp [ns], settings, the pose of every surface, and the station it belongs to."""

    stamp: int
    settings: Settings
    poses: Mapping[str, Pose]
    station: int = 0
    pose_stamp: int | None = None


@dataclass(frozen=True)
class _Kept:
    """The light after the steady effects, and the inputs from which it was computed."""

    geometry: Geometry
    amplitude: NDArray[Any]
    delivered: Signal


@dataclass
class Simulation:
    """A camera that simulates frames of one scene.

    ``waveform``: None evaluates the closed forms of effects on the demodulated signal; with a `Waveform` the
    four samples are computed, from which the cyclic error results. ``seed`` makes noise, interference and the
    emitted power reproducible. Without ``noise`` and ``quantised`` only the effects act. ``reference``:
    errors of an internal reference path, for the laboratory.

    Raises `InputError` where no ray of the camera meets any surface.
    """

    camera: Camera
    scene: Scene
    seed: int = 0
    waveform: Waveform | None = None
    noise: bool = True
    quantised: bool = True
    reference: SimulatedReference = field(default_factory=SimulatedReference)
    notes: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        for surface in self.scene.surfaces:
            if not surface.is_described:
                raise InputError(
                    f"the reflectivity of surface '{surface.name}' is unknown: its light cannot be simulated",
                    place="surfaces",
                    remedy="state reflectivity or texture",
                )
        self._chain = Chain.of(self.camera.effects.values())
        self._rng = np.random.Generator(np.random.SFC64(self.seed))
        self._memory: dict[str, Any] = {}
        self._seen: dict[Any, Geometry] = {}
        self._start: int | None = None
        self._kept: _Kept | None = None
        self._around: tuple[Geometry, FootprintLight] | None = None

    def with_camera(self, camera: Camera, stream: int) -> Simulation:
        """Return a simulation of another camera in the same place, with the same power but its own noise.

        ``stream``: a different number for each. The geometry of the pixels is computed once for both.
        """
        other = replace(self, camera=camera)
        other._rng = np.random.Generator(np.random.SFC64([self.seed, stream]))
        other._seen = self._seen
        return other

    # --- scene ----------------------------------------------------------------------------------

    def geometry(self, poses: Mapping[str, Pose]) -> Geometry:
        """Return the geometry that the pixels see; that of the last few sets of poses is kept."""
        key = tuple(poses[surface.name] for surface in self.scene.surfaces)
        found = self._seen.get(key)
        if found is None:
            found = see(self.scene, poses, self.camera.rays)
            if len(self._seen) >= 8:
                self._seen.pop(next(iter(self._seen)))
            self._seen[key] = found
        return found

    def power(self, station: int) -> float:
        """Return the relative emitted power of a station (``radiometry.gain_sigma``)."""
        sigma = self.camera.radiometry.gain_sigma
        if sigma == 0:
            return 1.0
        child = np.random.default_rng([self.seed, 20070, station])
        return max(1.0 + sigma * float(child.standard_normal()), 0.05)

    # --- one frame ------------------------------------------------------------------------------

    def context(self, exposure: Exposure) -> Context:
        """Return the context in which the effects see this exposure."""
        settings = exposure.settings
        if settings.modulation_frequency is not None:
            # poses may be those of a camera with another modulation frequency
            own = self.camera.sensor.modulation_frequency
            settings = replace(settings, modulation_frequency=own)
        if settings.integration_time is None:
            settings = replace(settings, integration_time=self.camera.integration_time(settings))
        if self._start is None or exposure.stamp < self._start:
            self._start = exposure.stamp
        geometry = self.geometry(exposure.poses)
        if not geometry.hit.any():
            raise InputError(
                "no ray of the camera meets a surface",
                remedy="surfaces must lie before the camera, at positive z",
            )
        scale = self.camera.radiometry.gain * self.camera.integration_time(settings)
        scale *= self.power(exposure.station)
        motion = self.scene.camera_motion

        def geometry_at(seconds: float) -> tuple[Geometry, Any]:
            if abs(seconds) < _MOTION_STEPS or not motion.moves:
                there = geometry
            else:
                moved = {name: motion.carry(pose, seconds) for name, pose in exposure.poses.items()}
                there = see(self.scene, moved, self.camera.rays)
            return there, ideal_amplitude(there, scale)

        def footprint(cells: Cells) -> FootprintLight:
            kept = self._around
            if kept is None or kept[0] is not geometry or kept[1].cells != cells:
                length = self.camera.sensor.ambiguity
                light = footprint_light(
                    self.scene, exposure.poses, geometry, self.camera.rays, ambiguity=length, cells=cells
                )
                kept = self._around = (geometry, light)
            return kept[1]

        return Context(
            camera=self.camera,
            settings=settings,
            stamp=exposure.stamp,
            time=(exposure.stamp - self._start) / NANOSECONDS,
            geometry=geometry,
            geometry_at=geometry_at,
            footprint=footprint,
            moving=motion.moves,
            incidence=geometry.incidence,
            rng=self._rng,
            memory=self._memory,
            notes=self.notes,
        )

    def light(self, exposure: Exposure) -> Image:
        """Return the complex image (H, W) of the light that the optics deliver, in counts.

        It is the light after the effects that are steady while the scene is at rest (emission, multipath,
        mixed pixels, scattering), and before motion and the effects behind the pixels.
        """
        steady = list(takewhile(lambda effect: effect.steady, self._chain.light))
        signal = self._steady(steady, self.context(exposure))
        return to_phasor(signal.distance, signal.amplitude, self.camera.sensor.ambiguity)

    def signal(self, context: Context) -> Signal:
        """Return the noise-free signal after all effects."""
        steady = list(takewhile(lambda effect: effect.steady, self._chain.light))
        signal = deliver(self._chain.light[len(steady) :], self._steady(steady, context), context)
        if self._chain.terms:
            context.saturated = self._full(self._chain.published(signal.amplitude))
        terms = self._chain.evaluated(signal.distance, signal.amplitude, context)
        signal = replace(signal, offset=terms.total, published=self._chain.published(signal.amplitude))
        return signal if self.waveform is None else self._at_sample_level(signal, context)

    def _steady(self, steady: list[Effect], context: Context) -> Signal:
        """Return the light after the first effects, which are steady while the scene is at rest."""
        if context.geometry is None or context.geometry_at is None:
            raise ValueError("the context of a simulation has a geometry")
        _, amplitude = context.geometry_at(0.0)
        kept = self._kept
        if (
            kept is not None
            and kept.geometry is context.geometry
            and np.array_equal(kept.amplitude, amplitude)
        ):
            return kept.delivered
        signal = deliver(steady, Signal(context.geometry.distance, amplitude), context)
        self._kept = _Kept(context.geometry, amplitude, signal)
        return signal

    def _full(self, published: Any) -> NDArray[np.bool_]:
        """Return where amplitude [counts], with the room that unmodulated light leaves, is saturated."""
        sensor = self.camera.sensor
        result: NDArray[np.bool_] = published + sensor.remaining(self.camera.background) >= sensor.saturation
        return result

    def _saturating(self, published: Any) -> Any:
        """Return amplitudes [counts] as they are delivered: a full pixel has the saturation value."""
        return np.where(self._full(published), self.camera.sensor.saturation, published)

    def _at_sample_level(self, signal: Signal, context: Context) -> Signal:
        """Add the error of the phase that demodulating the four samples of the waveform causes."""
        assert self.waveform is not None
        wave = 2 * np.pi / context.ambiguity
        error = self.waveform.phase_error(np.nan_to_num(signal.distance) * wave) / wave
        return replace(signal, offset=signal.offset + error)

    def frame(self, exposure: Exposure) -> RawFrame:
        """Return one raw frame with settings and truth.

        uint16 counts, or where not ``quantised`` float64 metres (wrapped, NaN = no measurement) and counts.
        """
        context = self.context(exposure)
        signal = self.signal(context)
        distance, amplitude, images = self.measured(signal, context, exposure)
        settings, distance = self._reference(distance, context)
        counts_d, counts_a = self._read_out(distance, amplitude)
        if not self.quantised:
            wrapped = wrap(distance, context.ambiguity) if self.camera.sensor.wraps else distance
            counts_d = np.where(counts_d > 0, wrapped, np.nan)
            counts_a = np.where(counts_a > 0, self._saturating(amplitude), 0.0)
        stamp = exposure.stamp if exposure.pose_stamp is None else exposure.pose_stamp
        return RawFrame(
            stamp=exposure.stamp,
            distance=counts_d,
            amplitude=counts_a,
            settings=settings,
            truth=dict(exposure.poses),
            pose_stamps=dict.fromkeys(exposure.poses, stamp),
            intrinsics=self.camera.intrinsics,
            device=self.camera.device,
            images=images,
        )

    def measured(
        self, signal: Signal, context: Context, exposure: Exposure
    ) -> tuple[Image, Image, Mapping[str, Image]]:
        """Return distance [m] (NaN: none), amplitude [counts] before clipping, and further images.

        Further images are by role (`RawFrame.images`); here there are none. Ways of measuring that do not
        demodulate a phase override only this method.
        """
        return (*self._with_noise(signal, context), {})

    def _with_noise(self, signal: Signal, context: Context) -> tuple[Any, Any]:
        """Return distance and amplitude with noise, circular in the complex plane, after the read-out."""
        distance, amplitude = np.array(signal.measured), signal.published_amplitude
        if self.noise:
            shape = distance.shape
            delivered = signal.amplitude
            sigma = self.camera.sigma_distance(delivered)
            lit = delivered > 0
            sigma = np.where(lit, sigma, 0.0)
            sigma_a = sigma_amplitude(sigma, delivered, ambiguity=self.camera.noise_range)
            distance = distance + sigma * self._rng.standard_normal(shape, dtype=np.float32)
            noisy = np.maximum(delivered + sigma_a * self._rng.standard_normal(shape, dtype=np.float32), 0.0)
            amplitude = self._chain.published(noisy)
        distance[~(signal.amplitude > 0)] = np.nan
        return distance, amplitude

    def _reference(self, distance: Any, context: Context) -> tuple[Settings, Any]:
        """Put the reading of the reference path into its pixels, or into the settings if it has none."""
        effect = effect_of(self.camera, InternalReference)
        settings = context.settings
        if effect is None:
            return settings, distance
        drift = drift_of(self.camera, context)
        reading = self.reference.reading(effect, drift, stamp=context.stamp, memory=self._memory)
        given = self.reference.noise
        sigma = 0.0 if not self.noise else self.camera.noise.floor if given is None else given
        region = effect.region()
        if region is None:
            reading += sigma * float(self._rng.standard_normal())
            return replace(settings, reference_distance=reading), distance
        shape = distance[region].shape
        distance[region] = reading + sigma * self._rng.standard_normal(shape)
        return replace(settings, reference_distance=mean_reading(distance[region])), distance

    def _read_out(self, distance: Any, amplitude: Any) -> tuple[NDArray[Any], NDArray[Any]]:
        sensor = self.camera.sensor
        counts_a = np.rint(np.clip(self._saturating(amplitude), 0, FULL_SCALE - 1))
        valid = np.isfinite(distance)
        metres = np.where(valid, distance, 0.0)
        if sensor.wraps:
            counts = np.rint(wrap(metres, sensor.ambiguity) / sensor.lsb)
            period = np.rint(sensor.ambiguity / sensor.lsb)
            counts = np.where(counts >= period, counts - period, counts)
            counts = np.where(counts < 1, 1, counts)
        else:
            counts = np.rint(metres / sensor.lsb)
        valid &= (counts >= 1) & (counts < FULL_SCALE)
        below = counts_a < sensor.amplitude_threshold
        counts = np.where(valid & ~below, counts, 0)
        counts_a = np.where(below, 0, counts_a)
        return counts.astype(np.uint16), counts_a.astype(np.uint16)

    def true_distance(self, exposure: Exposure) -> NDArray[np.float64]:
        """Return the true radial distance (H, W) in metres, NaN where nothing is seen."""
        return self.geometry(exposure.poses).distance


def drift_of(camera: Camera, context: Context) -> float:
    """Return the sum [m] of the drifts in this frame that an internal reference shows, too."""
    empty = np.empty((0,))
    terms = [
        effect for effect in camera.effects.values() if isinstance(effect, DistanceTerm) and effect.drifts
    ]
    return float(sum(float(np.asarray(term.term(empty, empty, context))) for term in terms))


def measured_residual(measured: Any, expected: Any, camera: Camera) -> Any:
    """Return measured - expected in metres, modulo the ambiguity range for a camera that wraps."""
    residual = measured - expected
    return wrap_residual(residual, camera.sensor.ambiguity) if camera.sensor.wraps else residual
