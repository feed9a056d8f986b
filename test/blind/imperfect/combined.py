"""Drafts in which several effects are hidden, cancel each other, or are concealed by what was fitted."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np

from .drafts import (
    LEAST_NATS,
    OF_AMPLITUDE,
    SIGNED,
    SINGLES,
    Draft,
    counterparts,
    decided,
    known_families,
    stripped,
)
from .expert import FRAMES, OFFSET, Expert, Judgement, Sight, absorbed, observe, scaled_to
from .files import THRESHOLD
from .forms import GON, draw_shape
from .imperfections import Stated
from .world import World

#: RMS that two effects that cancel leave, as a share of that of the first, at most.
CANCELLED = 0.7


def _prepared(
    effects: tuple[str, ...], world: World, stated: Stated, rng: np.random.Generator
) -> tuple[World, Expert]:
    shape = {name: draw_shape(name, rng, world.scene.settings) for name in effects}
    world = replace(stripped(world, effects), shape=shape, memory={})
    expert = Expert(world, noise=stated.noise, threshold=THRESHOLD, power_sigma=stated.power_sigma)
    return world, expert


def _start(name: str, world: World, expert: Expert, size: float, rng: np.random.Generator) -> float:
    first, limit, _ = SINGLES[name]
    sign = float(rng.choice([-1.0, 1.0])) if name in SIGNED else 1.0
    which = int(name in OF_AMPLITUDE)

    def measure(strength: float) -> float:
        after = observe(world.with_hidden(**{name: strength}))
        return expert.size(after.minus(expert.sight, world.sensor.ambiguity))[which]

    return scaled_to(size, measure, sign * first, limit=limit)[0]


def _all_decided(world: World, bare: World, expert: Expert) -> tuple[Judgement, dict[str, float]] | None:
    """Judgement of all hidden effects together and their sizes; None where one of them is undecided."""
    names, ambiguity = set(world.hidden), world.sensor.ambiguity
    whole = observe(world)
    parts = {name: whole.minus(observe(world.with_hidden(**{name: 0.0})), ambiguity) for name in names}
    baseline = known_families(bare, bare) - names
    judged = {}
    for name, part in parts.items():
        others = [other for key, other in parts.items() if key != name]
        found = decided(expert, part, own=names, baseline=baseline, fitted=others)
        if found is None:
            return None
        judged[name] = found
    total = expert.judge(whole.minus(expert.sight, ambiguity), own=names, baseline=baseline)
    least = min(judged.values(), key=lambda one: one.nats)
    nearest = min(judged.values(), key=lambda one: one.rival_nats)
    total = replace(
        total, nats=least.nats, share=least.share, rival=nearest.rival, rival_nats=nearest.rival_nats
    )
    sizes = {name: one.amplitude_size if name in OF_AMPLITUDE else one.size for name, one in judged.items()}
    return total, sizes


def several(
    effects: tuple[str, ...], world: World, stated: Stated, size: float, rng: np.random.Generator
) -> Draft | None:
    """Two or three effects, each of a size of its own, each of which an expert could find among them."""
    world, expert = _prepared(effects, world, stated, rng)
    strengths = {
        name: _start(name, world, expert, size * float(rng.uniform(0.8, 1.25)), rng) for name in effects
    }
    hidden = world.with_hidden(**strengths)
    found = _all_decided(hidden, world, expert)
    if found is None:
        return None
    return Draft(hidden, world, stated, *found, parameters=counterparts(hidden))


def cancelled(
    effects: tuple[str, ...], world: World, stated: Stated, size: float, rng: np.random.Generator
) -> Draft | None:
    """Amplitude and incidence, of such strengths that most of one cancels the other (sec. 3.3.6)."""
    world, expert = _prepared(effects, world, stated, rng)
    ambiguity, one, other = world.sensor.ambiguity, *effects
    strength = abs(_start(one, world, expert, size * 2, rng))
    first = observe(world.with_hidden(**{one: strength})).minus(expert.sight, ambiguity)
    unit = observe(world.with_hidden(**{other: 0.01})).minus(expert.sight, ambiguity)
    # what pixels' offsets leave of them: neither says anything by what is the same in every pose
    nothing = [np.zeros((1, *world.scene.shape))] * expert.stations
    gram = absorbed([first.distance, unit.distance], expert.weight, nothing, OFFSET)
    against = -gram[0, 1] / gram[1, 1]
    left = np.sqrt(max(1 - gram[0, 1] ** 2 / (gram[0, 0] * gram[1, 1]), 0.0))
    if against <= 0 or left > CANCELLED:
        return None
    hidden = world.with_hidden(**{one: strength, other: 0.01 * float(against)})
    found = _all_decided(hidden, world, expert)
    if found is None:
        return None
    return Draft(hidden, world, stated, *found, parameters=counterparts(hidden), absorbed=1 - float(left))


def concealed(
    effects: tuple[str, ...], world: World, stated: Stated, size: float, rng: np.random.Generator
) -> Draft | None:
    """One hidden effect; the known terms are those that somebody fitted who did not know of it."""
    world, expert = _prepared(effects, world, stated, rng)
    (name,) = effects
    hidden = world.with_hidden(**{name: _start(name, world, expert, size * 1.5, rng)})
    effect = observe(hidden).minus(expert.sight, world.sensor.ambiguity)
    judgement = expert.judge(effect, own={name}, baseline=known_families(world, world) - {name})
    if judgement.nats < LEAST_NATS / 3:
        return None
    believed, share = refitted(world, expert, effect)
    sizes = {name: judgement.size}
    return Draft(hidden, believed, stated, judgement, sizes, parameters=counterparts(hidden), absorbed=share)


def refitted(world: World, expert: Expert, effect: Sight) -> tuple[World, float]:
    """The world with its known terms adjusted to an effect, and the share of its RMS that they took.

    Weighted least squares beside offsets of pixels and errors of poses, every parameter with a prior
    of its own size.
    """
    columns, apply = _parameters(world, expert)
    names = list(columns)
    vectors = [effect.distance] + [columns[key][0] * columns[key][1] for key in names]
    gram = absorbed(vectors, expert.weight * np.sqrt(FRAMES), expert.pose_columns(), OFFSET)
    inner = gram[1:, 1:] + np.eye(len(names))
    found = np.linalg.solve(inner, gram[1:, 0])
    left = gram[0, 0] - 2 * found @ gram[1:, 0] + found @ gram[1:, 1:] @ found
    steps = {key: float(value * columns[key][1]) for key, value in zip(names, found, strict=True)}
    return apply(steps), 1 - float(np.sqrt(max(left, 0.0) / gram[0, 0]))


def _parameters(world: World, expert: Expert) -> tuple[dict[Any, tuple[np.ndarray, float]], Any]:
    """Derivative (stations, height, width) and prior width by parameter, and what applies steps of them."""
    amplitude = np.stack([np.maximum(light.amplitude, 1.0) for light in expert.lights])
    phase = 2 * np.pi * np.stack([light.distance for light in expert.lights]) / world.sensor.ambiguity
    x = np.stack([np.minimum(light.angle * GON, 90) for light in expert.lights])
    out: dict[Any, tuple[np.ndarray, float]] = {}
    for setting in world.scene.settings:
        own = (np.array(world.settings) == setting)[:, None, None]
        if "amplitude_offset" in world.known:
            entry = world.known["amplitude_offset"]["hyperbola"][setting]
            out["a", setting] = own / np.maximum(amplitude - entry["b"], 5.0), 0.5 * abs(entry["a"])
        if "incidence_angle" in world.known:
            for place, value in enumerate(world.known["incidence_angle"]["polynomial"][setting]):
                out["x", setting, place] = -1.0 * own * x ** (4 - place), 0.5 * abs(value)
        if "integration_time_offset" in world.known:
            out["t", setting] = own * np.ones_like(x), 0.02
    if world.sensor.third != 0j:
        out["sin",] = np.sin(4 * phase), 0.01
        out["cos",] = np.cos(4 * phase), 0.01

    def apply(steps: dict[Any, float]) -> World:
        known = copy.deepcopy(world.known)
        for key, step in steps.items():
            if key[0] == "a":
                known["amplitude_offset"]["hyperbola"][key[1]]["a"] += step
            elif key[0] == "x":
                known["incidence_angle"]["polynomial"][key[1]][key[2]] += step
            elif key[0] == "t":
                known["integration_time_offset"]["offset"][key[1]] += step
        turn = 2 * np.pi / world.sensor.ambiguity
        # the cyclic error is Im((fifth - third) exp(4 i phase)) to first order
        more = turn * complex(steps.get(("sin",), 0.0), steps.get(("cos",), 0.0))
        sensor = replace(world.sensor, third=complex(world.sensor.third - more))
        return replace(world, known=known, sensor=sensor)

    return out, apply
