"""The light that reaches the pixels of a station: from the emitter over the scene to what spreads it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.chain import Chain, deliver, ideal_amplitude
from rim_camera_ros.effects import effects_of, registry
from rim_camera_ros.effects.base import ComplexEffect, Effect
from rim_camera_ros.effects.light_curves import LightCurves
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.fit.data import Station
from rim_camera_ros.fit.undescribed import Undescribed, with_measured_light
from rim_camera_ros.fit.views import View, Views
from rim_camera_ros.geometry import Geometry, see
from rim_camera_ros.phasor import to_phasor
from rim_camera_ros.scene import Scene

Array = NDArray[Any]

#: Relative change of the light up to which effects reuse what they computed of a geometry: light bounced
#: between surfaces is then wrong by a ten thousandth of all light.
_SAME_LIGHT = 0.01
#: Counts below which there is no light.
DARK = 1e-6


@dataclass
class SpreadLight:
    """The light of the whole array before effects that spread it, by name, in a ``context``."""

    before: dict[str, Signal]
    context: Context
    _images: dict[str, tuple[Array, Array]] = field(default_factory=dict)

    def through(self, effect: ComplexEffect) -> tuple[Array, Array]:
        """Return the image before a spreading effect, and the inverse of that after it (0 where dark)."""
        found = self._images.get(effect.name)
        if found is None:
            light = self.before[effect.name]
            before = to_phasor(light.distance, light.amplitude, self.context.ambiguity)
            image = effect.apply(before, self.context)
            # far from all light, halos are so small that their inverse exceeds single precision
            dark = np.abs(image) < DARK
            inverse = np.where(dark, 0, 1.0 / np.where(dark, 1.0, image))
            found = (before.astype(np.complex64), inverse.astype(np.complex64))
            self._images[effect.name] = found
        return found

    def before_spreading(self, spread: Sequence[Effect]) -> Array:
        """Return the amplitude (H, W) [counts] before the first of the effects that spread light."""
        first = spread[0]
        assert isinstance(first, ComplexEffect)
        return np.nan_to_num(np.abs(self.through(first)[0]), posinf=0.0)


@dataclass(frozen=True)
class Light:
    """Light that is ``delivered`` to the pixels of a station, and that ``before`` each effect, by its name.

    Amplitudes of ``nameless`` pixels (H, W) are measured: the scene does not describe what they see.
    """

    context: Context
    before: dict[str, Signal]
    delivered: Signal
    nameless: NDArray[np.bool_]
    undescribed: Undescribed | None
    spread: SpreadLight


class LightPath:
    """What changes the light of a camera before it is measured, in the order along the light."""

    def __init__(self, camera: Camera, scene: Scene, chain: Chain) -> None:
        self._camera, self._scene, self._chain = camera, scene, chain
        # the last entry is for rays that meet nothing, whose surface number is -1
        self._undescribed = np.array([*(not surface.is_described for surface in scene.surfaces), False])
        order = {name: i for i, name in enumerate(effects_of(camera))}
        self._of_geometry = [name for name, effect in registry().items() if effect.remembers_geometry]
        # where light spreads over the array, that of undescribed surfaces comes in as measured
        self._first = min(order[name] for name, effect in registry().items() if effect.spreads)
        self._emitting = [effect for effect in chain.light if order[effect.name] < self._first]
        self._spreading = chain.light[len(self._emitting) :]

    def is_undescribed(self, geometry: Geometry) -> NDArray[np.bool_]:
        """Return the pixels (H, W) that see a surface of unknown reflectivity."""
        return np.asarray(self._undescribed[geometry.surface])

    @property
    def margin(self) -> int | None:
        """Pixels around the scene with which light that changes there can be spread alone (None: all)."""
        margins = [
            effect.margin if isinstance(effect, ComplexEffect) else None
            for effect in self._chain.light
            if effect.spreads
        ]
        return None if None in margins else sum(margin for margin in margins if margin is not None)

    def delivered(
        self,
        station: Station,
        view: View,
        *,
        power: float,
        views: Views,
        curves: LightCurves | None,
        measured: Callable[[Station, Array], Array],
        memory: dict[str, Any],
        notes: set[str],
    ) -> Light:
        """Return the light that reaches the pixels of a ``view`` of the whole array.

        ``power`` [counts m^2] is that of the emitter; ``curves`` change the light in addition to the effects.
        ``measured`` returns the measured light (H, W) [counts] of a station, or what is given where there is
        none. ``memory`` is that of effects from station to station.
        """
        camera, geometry, motion = self._camera, view.geometry, self._scene.camera_motion
        settings = replace(station.settings, integration_time=camera.integration_time(station.settings))

        def ideal_of(seen: Geometry) -> Array:
            light = ideal_amplitude(seen, power)
            if curves is None:
                return light
            return np.where(seen.hit, light * curves.factor(seen, camera.sensor.ambiguity), 0.0)

        ideal = ideal_of(geometry)
        nameless = self.is_undescribed(geometry) & (station.amplitude > 0)
        if nameless.any():
            ideal = np.where(nameless, measured(station, ideal), ideal)

        def geometry_at(seconds: float) -> tuple[Geometry, Array]:
            if not motion.moves or abs(seconds) < 1e-9:
                return geometry, ideal
            moved = {name: motion.carry(pose, seconds) for name, pose in view.poses.items()}
            there = see(self._scene, moved, camera.rays)
            return there, ideal_of(there)

        for name in self._of_geometry:
            memory.pop(name, None)
            if name in view.memory:
                memory[name] = view.memory[name]
        context = Context(
            camera=camera,
            settings=settings,
            stamp=station.stamp,
            time=station.time,
            geometry=geometry,
            geometry_at=geometry_at,
            footprint=lambda cells: views.footprint(view, cells, ambiguity=camera.sensor.ambiguity),
            moving=motion.moves,
            incidence=geometry.incidence,
            saturated=station.saturated > 0,
            memory=memory,
            light_tolerance=_SAME_LIGHT,
            notes=notes,
        )
        before: dict[str, Signal] = {}
        signal = deliver(self._emitting, Signal(geometry.distance, ideal), context, before=before)
        signal, undescribed = with_measured_light(
            signal,
            station,
            context,
            chain=self._chain,
            light=measured,
            nameless=nameless,
            effects=self._spreading,
            place=self._first,
        )
        signal = deliver(self._spreading, signal, context, before=before)
        view.memory.update({name: memory[name] for name in self._of_geometry if name in memory})
        if nameless.any():
            shown = measured(station, signal.amplitude)
            signal = Signal(signal.distance, np.where(nameless, shown, signal.amplitude))
        return Light(context, before, signal, nameless, undescribed, SpreadLight(before, context))
