"""Which cases the benchmark makes: tiers, effects in turn, seeds from one master seed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .generator.base import FORMS
from .generator.catalogue import CONFOUNDED, MASKABLE, OUTSIDE, TIERS, VOCABULARY

MASTER_SEED = 20261225
SMALL, LARGE = (88, 72), (176, 144)

FAINT, TWICE = "faint", "large"
#: Kinds of cases and how many of each: the generator's tiers, faint effects for the sensitivity curves, and
#: cases of the other kinds anew at 176 x 144.
COUNTS: dict[str, int] = {
    "null": 100,
    "plain": 100,
    "masked": 60,
    "cancelled": 40,
    "confounded": 40,
    "two": 40,
    "unknown": 40,
    FAINT: 57,
    TWICE: 20,
}
#: Forty cases that continuous integration runs.
CI_COUNTS: dict[str, int] = {
    "null": 12,
    "plain": 12,
    "masked": 5,
    "cancelled": 3,
    "confounded": 2,
    "two": 3,
    "unknown": 3,
}
#: Strengths of faint cases, RMS of effect over median sigma: below what the other tiers draw.
FAINT_STRENGTHS = (0.015, 0.25)
_DECKS: dict[str, tuple[str, ...]] = {
    "plain": tuple(VOCABULARY),
    "masked": MASKABLE,
    "confounded": CONFOUNDED,
    "unknown": tuple(OUTSIDE),
    FAINT: tuple(VOCABULARY),
}


@dataclass(frozen=True)
class Case:
    """One case to make: arguments of the generator, the kind it counts for, and whose larger twin it is."""

    name: str
    kind: str
    tier: str
    seed: int
    forms: str
    master_seed: int
    effect: str | None = None
    strength: float | None = None
    masked: bool | None = None
    size: tuple[int, int] = SMALL
    twin_of: str | None = None


def plan(
    counts: Mapping[str, int] = COUNTS, *, forms: str = "scoring", master_seed: int = MASTER_SEED
) -> list[Case]:
    """Return the cases; the first ones of a kind are the same whatever the counts.

    Effects come in turn, shuffled anew each round, so that each is met equally often; scene and strength
    are the generator's to draw. Half of the nulls are masked.

    Raises
    ------
    ValueError: a kind or the forms are unknown, or a count is negative.
    """
    unknown = sorted(set(counts) - set(COUNTS))
    if unknown or forms not in FORMS:
        raise ValueError(
            f"no such tiers or forms: {', '.join([*unknown, forms])}; tiers are {', '.join(COUNTS)}, "
            f"forms {', '.join(FORMS)}"
        )
    if any(count < 0 for count in counts.values()):
        raise ValueError("counts of cases must not be negative")
    cases = [
        case
        for kind, count in counts.items()
        if kind != TWICE
        for case in _of_kind(kind, count, forms=forms, master_seed=master_seed)
    ]
    return cases + _larger(cases, counts.get(TWICE, 0))


def _of_kind(kind: str, count: int, *, forms: str, master_seed: int) -> Iterator[Case]:
    # one generator of random numbers a kind and form: seeds of tuning are not those of scoring
    rng = np.random.default_rng([master_seed, FORMS.index(forms), list(COUNTS).index(kind)])
    deck: list[str] = []
    for number in range(count):
        seed = int(rng.integers(1, 2**31))
        strength = float(np.exp(rng.uniform(*np.log(FAINT_STRENGTHS))))
        if kind in _DECKS and not deck:
            deck = [str(name) for name in rng.permutation(_DECKS[kind])]
        yield Case(
            name=f"{kind}-{number:03d}",
            kind=kind,
            tier="plain" if kind == FAINT else kind,
            seed=seed,
            forms=forms,
            master_seed=master_seed,
            effect=deck.pop() if kind in _DECKS else None,
            strength=strength if kind == FAINT else None,
            masked=number % 2 == 1 if kind == "null" else None,
        )


def _larger(cases: Sequence[Case], count: int) -> list[Case]:
    """The first cases of every tier in turn, at 176 x 144."""
    by_tier = [[case for case in cases if case.kind == tier] for tier in TIERS]
    longest = max((len(one) for one in by_tier), default=0)
    turn = [one[i] for i in range(longest) for one in by_tier if i < len(one)]
    return [
        Case(
            name=f"{TWICE}-{number:03d}",
            kind=TWICE,
            tier=case.tier,
            seed=case.seed,
            forms=case.forms,
            master_seed=case.master_seed,
            effect=case.effect,
            strength=case.strength,
            masked=case.masked,
            size=LARGE,
            twin_of=case.name,
        )
        for number, case in enumerate(turn[:count])
    ]
