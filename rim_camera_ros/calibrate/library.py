"""Every effect as regressors: those of a camera file, and those that it lacks, linear at strength zero.

A candidate is one variant of one effect (a time constant, a width of a halo) with the columns that are
linear in what is left of its parameters, and with the way back from coefficients to the effect, from where
the non-linear fit goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.blocks import (
    TERM_SIZE,
    effect_block,
    light_block,
    optics_block,
    optics_value,
    present_priors,
    together,
)
from rim_camera_ros.calibrate.candidate import Candidate, Coefficients, Facts, added
from rim_camera_ros.calibrate.coarser import MANY_PIXELS
from rim_camera_ros.calibrate.light_curves import SURFACES
from rim_camera_ros.calibrate.mixed_candidates import blurred
from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.ambient_temperature import AmbientTemperature
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.base import Effect, row_name
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.integration_time_offset import IntegrationTimeOffset
from rim_camera_ros.effects.motion import Motion
from rim_camera_ros.effects.multipath import Multipath
from rim_camera_ros.effects.saturation_bleed import SaturationBleed
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.effects.warm_up_drift import Exponential, WarmUpDrift
from rim_camera_ros.parameters import with_values

Array = NDArray[Any]


#: Least time between samples [s] at which the fit of a moving camera begins.
_SHORTEST = 1e-4


def candidates(camera: Camera, facts: Facts, *, effects: Sequence[str] | None = None) -> list[Candidate]:
    """Return the variants of every effect that the camera lacks and the recordings could contain."""
    found: list[Candidate] = []
    for name, make in _MAKERS.items():
        if name in camera.effects or (effects is not None and name not in effects):
            continue
        found += make(camera, facts)
    for name, make in GEOMETRY.items():
        if effects is None or name in effects:
            found += make(camera, facts)
    return found


def _linear(effect: Effect, priors: Mapping[str, float], variant: str = "") -> Candidate:
    """A variant that is linear in the named parameters, which the given effect has at zero."""
    block = effect_block(effect, priors, label=f"@{variant}" if variant else "")
    labels = dict(zip(priors, (one.label for one in block.regressors), strict=True))

    def build(camera: Camera, values: Coefficients) -> Camera:
        own = {path: values[label] for path, label in labels.items()}
        bounds = effect.bounds()
        clipped = {path: float(np.clip(v, *bounds.get(path, (-np.inf, np.inf)))) for path, v in own.items()}
        return added(camera, with_values(effect, clipped))

    positive = tuple(label for path, label in labels.items() if effect.bounds().get(path, (-1.0,))[0] == 0.0)
    return Candidate(effect.name, variant, block, build, positive)


def _large(camera: Camera) -> bool:
    """Say whether so many pixels make every variant expensive: then there are fewer."""
    return camera.sensor.width * camera.sensor.height > MANY_PIXELS


def _cyclic(camera: Camera, facts: Facts) -> list[Candidate]:
    orders = ((4,), (4, 8), (4, 8, 12), (8,), (2,), (1,))
    return [_harmonics(one) for one in orders]


def _harmonics(orders: tuple[int, ...]) -> Candidate:
    base = CyclicError(harmonics=tuple(Harmonic(order, 1.0, 0.0) for order in orders))
    priors: dict[str, float] = {}
    for i in range(len(orders)):
        priors |= {f"harmonics.{i}.amplitude": 0.02, f"harmonics.{i}.phase": 0.02}
    variant = "+".join(str(order) for order in orders)
    block = effect_block(base, priors, label=f"@{variant}")
    names = [one.label for one in block.regressors]

    def build(camera: Camera, values: Coefficients) -> Camera:
        harmonics = []
        for i, order in enumerate(orders):
            sine, cosine = values[names[2 * i]], values[names[2 * i + 1]]
            size, phase = float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))
            harmonics.append(Harmonic(order, max(size, 1e-5), phase))
        return added(camera, CyclicError(harmonics=tuple(harmonics)))

    return Candidate("cyclic_error", variant, block, build)


def _amplitude(camera: Camera, facts: Facts) -> list[Candidate]:
    """A / (A - b) ~ a / A + a b / A^2, per integration time."""
    found = []
    size = TERM_SIZE * max(facts.amplitude, 1.0)
    for curved in (False, True):
        base = AmplitudeOffset(
            hyperbola=MappingProxyType({t: Hyperbola(1.0, 0.0) for t in facts.integration_times})
        )
        priors: dict[str, float] = {}
        for t in facts.integration_times:
            priors[f"hyperbola.{row_name(t)}.a"] = size
            if curved:
                priors[f"hyperbola.{row_name(t)}.b"] = size * 0.2 * facts.amplitude
        variant = "a,b" if curved else "a"
        block = effect_block(base, priors, label=f"@{variant}")
        labels = dict(zip(priors, (one.label for one in block.regressors), strict=True))
        found.append(
            Candidate("amplitude_offset", variant, block, _amplitude_builder(labels, facts, curved=curved))
        )
    return found


def _amplitude_builder(
    labels: Mapping[str, str], facts: Facts, *, curved: bool
) -> Callable[[Camera, Coefficients], Camera]:
    def build(camera: Camera, values: Coefficients) -> Camera:
        rows = {}
        lowest = max(camera.sensor.amplitude_threshold, 0.02 * facts.amplitude)
        for t in facts.integration_times:
            a = values[labels[f"hyperbola.{row_name(t)}.a"]]
            square = values[labels[f"hyperbola.{row_name(t)}.b"]] if curved else 0.0
            b = float(np.clip(square / a, -0.5 * lowest, 0.5 * lowest)) if abs(a) > 1e-9 else 0.0
            rows[t] = Hyperbola(float(a), b)
        return added(camera, AmplitudeOffset(hyperbola=MappingProxyType(rows)))

    return build


def _incidence(camera: Camera, facts: Facts) -> list[Candidate]:
    base = IncidenceAngle(
        polynomial=MappingProxyType(dict.fromkeys(facts.integration_times, (0.0, 0.0, 0.0, 0.0)))
    )
    return [_linear(base, present_priors(base, camera))]


def _integration(camera: Camera, facts: Facts) -> list[Candidate]:
    if len(facts.integration_times) < 2:
        return []
    base = IntegrationTimeOffset(offset=MappingProxyType(dict.fromkeys(facts.integration_times, 0.0)))
    return [_linear(base, dict(base.priors()))]


def _warm_up(camera: Camera, facts: Facts) -> list[Candidate]:
    if facts.uptime is None or facts.uptime[1] - facts.uptime[0] < 1.0:
        return []
    grid = [t for t in (15.0, 40.0, 100.0, 250.0, 600.0, 1500.0) if t > facts.uptime[0] / 6]
    found = [
        _linear(WarmUpDrift(terms=(Exponential(0.0, t),)), {"terms.0.amplitude": TERM_SIZE}, f"{t:g} s")
        for t in grid
    ]
    for slow, fast in ((600.0, 60.0), (250.0, 25.0)):
        base = WarmUpDrift(terms=(Exponential(0.0, fast), Exponential(0.0, slow)))
        priors = {"terms.0.amplitude": TERM_SIZE, "terms.1.amplitude": TERM_SIZE}
        found.append(_linear(base, priors, f"{fast:g}+{slow:g} s"))
    return found


def _ambient(camera: Camera, facts: Facts) -> list[Candidate]:
    if facts.ambient is None or facts.ambient[1] - facts.ambient[0] < 0.5:
        return []
    middle = round(sum(facts.ambient) / 2, 1)
    return [
        _linear(AmbientTemperature(0.0, middle, lag), {"coefficient": 0.005}, f"{lag:g} s")
        for lag in (0.0, 60.0, 150.0, 300.0, 600.0, 1200.0, 2400.0)
    ]


def _scale(camera: Camera, facts: Facts) -> list[Candidate]:
    return [_linear(DistanceScale(scale=0.0), {"scale": 0.02})]


def _scattering(camera: Camera, facts: Facts) -> list[Candidate]:
    width = camera.sensor.width
    sizes = [max(width * share, 1.0) for share in (0.02, 0.045, 0.1, 0.2, 0.4, 0.9)]
    if _large(camera):
        return [
            _linear(Scattering(kernels=(Kernel(0.0, (s, s)),)), {"kernels.0.weight": 0.05}, f"{s:.3g} px")
            for s in sizes[::2]
        ]
    found = [
        _linear(Scattering(kernels=(Kernel(0.0, (s, s)),)), {"kernels.0.weight": 0.05}, f"{s:.3g} px")
        for s in sizes
    ]
    for narrow, wide in ((sizes[1], sizes[4]), (sizes[2], sizes[5]), (sizes[0], sizes[3])):
        base = Scattering(kernels=(Kernel(0.0, (narrow, narrow)), Kernel(0.0, (wide, wide))))
        priors = {"kernels.0.weight": 0.05, "kernels.1.weight": 0.05}
        found.append(_linear(base, priors, f"{narrow:.3g}+{wide:.3g} px"))
    return found


def _emitter(camera: Camera, facts: Facts) -> list[Candidate]:
    base = EmitterOffset(position=(0.0, 0.0, 0.0))
    return [_linear(base, {"position.0": 0.05, "position.1": 0.05, "position.2": 0.05})]


def _emission(camera: Camera, facts: Facts) -> list[Candidate]:
    return [_linear(EmissionPattern(falloff=(0.0, 0.0)), {"falloff.0": 2.0, "falloff.1": 4.0})]


def _mixed(camera: Camera, facts: Facts) -> list[Candidate]:
    if _large(camera):
        return [blurred(b) for b in (0.5, 1.0)]
    return [blurred(b) for b in (0.25, 0.35, 0.5, 0.65, 0.8, 1.0, 1.3, 1.7)]


def _bleed(camera: Camera, facts: Facts) -> list[Candidate]:
    if not facts.saturated:
        return []
    return [_linear(SaturationBleed(row=0.0, column=0.0), {"row": 0.02, "column": 0.02})]


def _multipath(camera: Camera, facts: Facts) -> list[Candidate]:
    if facts.surfaces < 2:
        return []
    return [_linear(Multipath(strength=0.0), {"strength": 1.0})]


def _motion(camera: Camera, facts: Facts) -> list[Candidate]:
    if not facts.moves:
        return []
    prior = {"sample_interval": 0.003}
    plain = _linear(Motion(sample_interval=0.0), prior)
    # linear in the interval and in its product with the share of unmodulated light
    alone = effect_block(Motion(sample_interval=0.0), prior, label="@modulated")
    both = effect_block(Motion(sample_interval=0.0, unmodulated=1.0), prior, label="@unmodulated")

    def build(one: Camera, values: Coefficients) -> Camera:
        product = max(values[both.regressors[0].label], 0.0)
        interval = max(values[alone.regressors[0].label] + product, _SHORTEST)
        return added(one, Motion(sample_interval=interval, unmodulated=product / interval))

    positive = (both.regressors[0].label,)
    return [plain, Candidate("motion", "unmodulated", together(alone, both), build, positive)]


def _compression(camera: Camera, facts: Facts) -> list[Candidate]:
    return [_linear(AmplitudeNonlinearity(0.0), {"compression": 0.1 / max(facts.amplitude, 1.0)})]


def _geometry(name: str) -> Callable[[Camera, Facts], list[Candidate]]:
    def make(camera: Camera, facts: Facts) -> list[Candidate]:
        block = optics_block(camera, name)

        def build(one: Camera, values: Coefficients) -> Camera:
            moved = {
                label.removeprefix("optics."): optics_value(one, label.removeprefix("optics."))
                + values[label]
                for label in (r.label for r in block.regressors)
            }
            return replace(one, optics=with_values(one.optics, moved))

        return [Candidate(name, "", block, build)]

    return make


def _radiometry(camera: Camera, facts: Facts) -> list[Candidate]:
    """Surfaces that do not reflect as Lambert says: their fit frees `Problem.light_curves`."""
    return [Candidate("radiometry", "incidence", light_block(SURFACES), lambda one, values: one)]


#: Names of the vocabulary that no parameter of a camera file describes: they belong to the scene.
OF_SURFACES = frozenset({"radiometry"})


_MAKERS: dict[str, Callable[[Camera, Facts], list[Candidate]]] = {
    "cyclic_error": _cyclic,
    "amplitude_offset": _amplitude,
    "incidence_angle": _incidence,
    "integration_time_offset": _integration,
    "warm_up_drift": _warm_up,
    "ambient_temperature": _ambient,
    "distance_scale": _scale,
    "scattering": _scattering,
    "emitter_offset": _emitter,
    "emission_pattern": _emission,
    "mixed_pixels": _mixed,
    "saturation_bleed": _bleed,
    "multipath": _multipath,
    "motion": _motion,
    "amplitude_nonlinearity": _compression,
    "radiometry": _radiometry,
}


#: Parameters that every camera file has beside its effects.
GEOMETRY: dict[str, Callable[[Camera, Facts], list[Candidate]]] = {
    name: _geometry(name) for name in ("camera_constant", "lens_distortion")
}
