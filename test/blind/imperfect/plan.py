"""Which cases are made: tiers, effects in turn, seeds from one master seed."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from .case import Case
from .drafts import OUTSIDE, VOCABULARY, WRONG
from .imperfections import OFF
from .setups import SETUPS

MASTER_SEED = 20270117
#: Cases of each tier.
COUNTS: dict[str, int] = {
    "null": 60,
    "single": 96,
    "wrong_parameters": 24,
    "setup": 60,
    "two": 40,
    "three": 20,
    "cancelled": 12,
    "concealed": 32,
    "unknown": 30,
}
#: Effects that are met in combinations; their partners are those that the same scenes show.
_TOGETHER = (
    "cyclic_error",
    "amplitude_offset",
    "incidence_angle",
    "scattering",
    "emitter_offset",
    "distance_scale",
    "integration_time_offset",
    "warm_up_drift",
)
_HIDDEN = (
    "scattering",
    "emitter_offset",
    "warm_up_drift",
    "distance_scale",
    "cyclic_error",
    "incidence_angle",
    "integration_time_offset",
    "amplitude_offset",
)
_DECKS: dict[str, tuple[tuple[str, ...], ...]] = {
    "null": ((),),
    "single": tuple((name,) for name in VOCABULARY),
    "wrong_parameters": tuple((name,) for name in WRONG),
    "setup": tuple((name,) for name in SETUPS),
    "two": tuple(combinations(_TOGETHER, 2)),
    "three": tuple(combinations(_TOGETHER, 3)),
    "cancelled": (("amplitude_offset", "incidence_angle"),),
    "concealed": tuple((name,) for name in _HIDDEN),
    "unknown": tuple((name,) for name in OUTSIDE),
}


def plan(
    counts: Mapping[str, int] = COUNTS, *, master_seed: int = MASTER_SEED, imperfections: str = "all"
) -> list[Case]:
    """Return the cases; the first ones of a tier are the same whatever the counts.

    Effects and set-ups come in turn, shuffled anew each round, so that each is met equally often.

    Raises
    ------
    ValueError: a tier or the imperfections are unknown, or a count is negative.
    """
    unknown = sorted(set(counts) - set(COUNTS))
    if unknown or imperfections not in OFF:
        raise ValueError(
            f"no such tiers or imperfections: {', '.join([*unknown, imperfections])}; tiers are "
            f"{', '.join(COUNTS)}, imperfections {', '.join(OFF)}"
        )
    if any(count < 0 for count in counts.values()):
        raise ValueError("counts of cases must not be negative")
    cases = []
    for tier, count in counts.items():
        # the seeds of a tier do not depend on which others are planned
        rng = np.random.default_rng([master_seed, list(COUNTS).index(tier)])
        deck: list[int] = []
        for number in range(count):
            seed = int(rng.integers(1, 2**31))
            deck = deck or [int(one) for one in rng.permutation(len(_DECKS[tier]))]
            effects = _DECKS[tier][deck.pop()]
            cases.append(Case(f"{tier}-{number:03d}", tier, seed, effects, imperfections))
    return cases
