"""Fits to a few poses before those to all: they give starting points and exclude hopeless candidates."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from rim_camera_ros.fit.problem import Problem

#: Pixels of all images, used or not (all are predicted), above which fits begin with a few poses; and about
#: how many pixels those few poses have. In recordings of more than twice `MANY_PIXELS`, poses of about
#: `MANY_PIXELS` are searched for effects before all poses are.
MANY_PIXELS, _FEW_PIXELS = 500_000, 200_000
#: Fewer poses than these determine too little, whatever their number of pixels.
_LEAST_POSES = 8
#: Nats by which a fit to a few poses must be worse than the best of them, in every fold, to be excluded.
_BEHIND = 30.0


def subsample_of(problem: Problem, *, seed: int, hold: int | None = None) -> list[int] | None:
    """Return the numbers of the stations of a few poses, some of each setting; None where all may be fitted.

    They ``hold`` about so many pixels (None: as many as fits begin with). The poses are drawn at random:
    regularly spaced ones could all have the same distance.
    """
    stations = problem.dataset.stations
    pixels = sum(station.distance.size for station in stations)
    poses: dict[float, list[tuple[int, int]]] = {}
    for station in stations:
        placed = poses.setdefault(station.settings.integration_time or 0.0, [])
        if (station.recording, station.placed) not in placed:
            placed.append((station.recording, station.placed))
    count = sum(len(placed) for placed in poses.values())
    wanted = max(_LEAST_POSES, round(count * (hold or _FEW_PIXELS) / max(pixels, 1)))
    if pixels < MANY_PIXELS or 2 * wanted > count:
        return None
    rng = np.random.default_rng(seed)
    kept = {
        placed[i]
        for placed in poses.values()
        for i in rng.permutation(len(placed))[: max(1, round(wanted * len(placed) / count))]
    }
    return [k for k, station in enumerate(stations) if (station.recording, station.placed) in kept]


def at_stations(problem: Problem, numbers: Sequence[int]) -> Problem:
    """Return the problem of some of the stations."""
    dataset = replace(problem.dataset, stations=[problem.dataset.stations[k] for k in numbers])
    masks = None if problem.masks is None else [problem.masks[k] for k in numbers]
    shifts = None if problem.shifts is None else [problem.shifts[k] for k in numbers]
    return replace(problem, dataset=dataset, masks=masks, shifts=shifts)


def dominated[Key: Hashable](likelihoods: Mapping[Key, Sequence[float]], *, least: float = 0.0) -> set[Key]:
    """Return which fits are worse than the best in every fold of poses, and by more than 30 nats in sum.

    ``likelihoods`` of each fit in nats by fold; ``least`` [nats], if it is more, takes the place of the 30.
    """
    if not likelihoods:
        return set()
    best = max(likelihoods.values(), key=sum)
    margin = max(_BEHIND, least)
    return {
        name
        for name, own in likelihoods.items()
        if sum(own) < sum(best) - margin and all(x < y for x, y in zip(own, best, strict=True))
    }
