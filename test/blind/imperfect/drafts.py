"""Drafts of cases: a world with hidden effects or wrong parameters, and whether an expert could decide it."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .expert import Expert, Judgement, Sight, observe, scaled_to
from .files import THRESHOLD
from .forms import draw_shape
from .imperfections import Stated
from .world import World

#: Nats that an effect must be worth after everything ordinary, and by which its best rival must be worse.
LEAST_NATS, LEAST_RIVAL_NATS = 60.0, 20.0
SIZES = (0.35, 1.3)
#: Effects that such a recording can show: strength to begin with, largest strength, styles in which it shows.
SINGLES: dict[str, tuple[float, float, tuple[str, ...]]] = {
    "cyclic_error": (0.01, 0.06, ("board", "sweep", "boxes", "room")),
    "amplitude_offset": (0.03, 0.3, ("board", "sweep", "boxes")),
    "incidence_angle": (0.01, 0.2, ("board", "sweep", "boxes")),
    "integration_time_offset": (0.01, 0.1, ("board", "sweep", "boxes")),
    "warm_up_drift": (0.03, 0.3, ("board", "sweep", "boxes", "room", "corner")),
    "ambient_temperature": (0.004, 0.03, ("board", "sweep", "boxes", "room")),
    "distance_scale": (0.003, 0.03, ("sweep", "board")),
    "scattering": (0.03, 0.3, ("boxes", "board", "room")),
    "emitter_offset": (0.05, 0.25, ("room", "boxes", "board")),
    "mixed_pixels": (1.0, 2.5, ("board", "boxes", "sweep")),
    "multipath": (0.6, 2.0, ("corner",)),
    "interference": (20.0, 300.0, ("board", "sweep", "boxes", "room")),
    "amplitude_nonlinearity": (2e-5, 3e-4, ("board", "sweep", "room")),
    "emission_pattern": (2.0, 9.0, ("sweep", "room", "board")),
    "lens_distortion": (0.03, 0.12, ("boxes", "room")),
    "camera_constant": (0.01, 0.06, ("room", "boxes", "board")),
    # outside the vocabulary
    "unknown_light_leak": (5.0, 200.0, ("board", "sweep", "boxes", "room")),
    "unknown_crosstalk": (0.02, 0.4, ("board", "sweep", "boxes")),
    "unknown_memory": (0.01, 0.3, ("board", "sweep", "boxes")),
    "unknown_row_brightness": (0.01, 0.2, ("board", "boxes", "sweep")),
    "unknown_warm_gradient": (0.004, 0.05, ("board", "sweep", "boxes", "room")),
}
OUTSIDE = tuple(name for name in SINGLES if name.startswith("unknown"))
VOCABULARY = tuple(name for name in SINGLES if not name.startswith("unknown"))
#: Effects whose size is that of the amplitudes.
OF_AMPLITUDE = ("amplitude_nonlinearity", "emission_pattern")
WRONG = ("amplitude_offset", "cyclic_error", "incidence_angle", "integration_time_offset")
ANY_STYLE = ("board", "room", "boxes", "corner", "sweep")
SETUP_STYLES = ("board", "sweep", "boxes", "room")


@dataclass(frozen=True)
class Draft:
    """A world, what the files believe, what is stated, and what an expert says of the difference."""

    world: World
    believed: World
    stated: Stated
    judgement: Judgement | None = None
    sizes: dict[str, float] | None = None
    setup: str | None = None
    parameters: dict[str, dict[str, Any]] | None = None
    absorbed: float | None = None


def stripped(world: World, effects: tuple[str, ...]) -> World:
    """The world without what the camera file would say of some effects."""
    known = {name: value for name, value in world.known.items() if name not in effects}
    world = replace(world, known=known)
    if "cyclic_error" in effects:
        world = replace(world, sensor=replace(world.sensor, third=0j, fifth=0j))
    return world


def decided(
    expert: Expert, effect: Sight, *, own: set[str], baseline: set[str], fitted: Sequence[Sight] = ()
) -> Judgement | None:
    """What an expert says of an effect, None where that is too little."""
    for whole in (False, True):
        # first with the rivals that cost nothing: most of what is undecided ends here
        found = expert.judge(effect, own=own, baseline=baseline, fitted=fitted, simulated=whole)
        if found.nats < LEAST_NATS or found.rival_nats < LEAST_RIVAL_NATS:
            return None
    return found


def single(
    effects: tuple[str, ...], world: World, stated: Stated, size: float, rng: np.random.Generator
) -> Draft | None:
    """One hidden effect of a size; None where an expert could not decide."""
    (name,) = effects
    start, limit, _ = SINGLES[name]
    world = replace(
        stripped(world, effects), shape={name: draw_shape(name, rng, world.scene.settings)}, memory={}
    )
    believed = replace(world, spot=None) if name == "mixed_pixels" else world
    edges = name == "mixed_pixels"
    expert = Expert(
        believed, noise=stated.noise, threshold=THRESHOLD, power_sigma=stated.power_sigma, edges=edges
    )
    sign = float(rng.choice([-1.0, 1.0])) if name in SIGNED else 1.0

    def effect(strength: float) -> Sight:
        after = observe(world.with_hidden(**{name: strength}), area=edges)
        return after.minus(expert.sight, world.sensor.ambiguity)

    which = int(name in OF_AMPLITUDE)
    strength, _ = scaled_to(size, lambda s: expert.size(effect(s))[which], sign * start, limit=limit)
    known = known_families(world, believed)
    judgement = decided(expert, effect(strength), own={name}, baseline=known - {name})
    if judgement is None:
        return None
    hidden = world.with_hidden(**{name: strength})
    sizes = {name: judgement.amplitude_size if which else judgement.size}
    return Draft(hidden, believed, stated, judgement, sizes, parameters=counterparts(hidden))


#: Effects whose strength may have either sign.
SIGNED = (
    "amplitude_offset",
    "incidence_angle",
    "integration_time_offset",
    "warm_up_drift",
    "ambient_temperature",
    "distance_scale",
    "camera_constant",
)


def known_families(world: World, believed: World) -> set[str]:
    found = set(believed.known) | {"distance_scale"}
    if believed.sensor.third != 0j:
        found.add("cyclic_error")
    if world.scene.falloff != (0.0, 0.0):
        found.add("emission_pattern")
    return found


def wrong(
    effects: tuple[str, ...], world: World, stated: Stated, size: float, rng: np.random.Generator
) -> Draft | None:
    """A term with wrong parameters in the file; None where an expert could not decide."""
    (name,) = effects
    if name != "cyclic_error" and name not in world.known:
        return None
    direction = _deviation(name, world, rng)
    expert = Expert(world, noise=stated.noise, threshold=THRESHOLD, power_sigma=stated.power_sigma)

    def said(strength: float) -> World:
        return _with_deviation(name, world, direction, strength)

    def effect(strength: float) -> Sight:
        return expert.sight.minus(observe(said(strength)), world.sensor.ambiguity)

    strength, _ = scaled_to(size, lambda s: expert.size(effect(s))[0], 0.3, limit=3.0)
    baseline = known_families(world, world) - {name}
    judgement = decided(expert, effect(strength), own={name}, baseline=baseline)
    if judgement is None:
        return None
    believed = said(strength)
    parameters = {name: world.known.get(name) or {"harmonics": world.sensor.cyclic()}}
    return Draft(world, believed, stated, judgement, {name: judgement.size}, parameters=parameters)


def _deviation(name: str, world: World, rng: np.random.Generator) -> Any:
    sign = float(rng.choice([-1.0, 1.0]))
    if name == "cyclic_error":
        return complex(np.exp(2j * np.pi * rng.uniform()))
    return {setting: sign * float(rng.uniform(0.6, 1.4)) for setting in world.scene.settings}


def _with_deviation(name: str, world: World, direction: Any, strength: float) -> World:
    """The world with wrong parameters of a term that it has."""
    if name == "cyclic_error":
        third = world.sensor.third * (1 + strength * direction)
        return replace(world, sensor=replace(world.sensor, third=complex(third)))
    known = copy.deepcopy(world.known)
    entry = known[name]
    for setting, factor in direction.items():
        scale = 1 + strength * factor
        if name == "amplitude_offset":
            entry["hyperbola"][setting]["a"] *= scale
        elif name == "incidence_angle":
            entry["polynomial"][setting] = [one * scale for one in entry["polynomial"][setting]]
        else:
            entry["offset"][setting] += 0.02 * strength * factor * (1 if setting == 16 else -0.5)
    return replace(world, known=known)


def counterparts(world: World) -> dict[str, dict[str, Any]]:
    """True values of parameters that mean the same in the vocabulary, by effect and path."""
    found: dict[str, dict[str, Any]] = {}
    for name, strength in world.hidden.items():
        shape = world.shape[name]
        if name == "distance_scale":
            found[name] = {"scale": strength}
        elif name == "integration_time_offset":
            found[name] = {f"offset.{t}": strength * off for t, off in shape["offset"].items()}
        elif name == "multipath":
            found[name] = {"strength": strength}
        elif name == "ambient_temperature":
            found[name] = {"coefficient": strength, "time_constant": shape["lag"]}
        elif name == "cyclic_error":
            found[name] = {"harmonics.0.amplitude": world.true_sensor.cyclic()[4][0]}
        elif name == "camera_constant":
            found[name] = {"fx": world.true_lens.fx, "fy": world.true_lens.fy}
        elif name == "lens_distortion":
            found[name] = {f"d.{i}": value for i, value in enumerate(world.true_lens.d[:2])}
    return found
