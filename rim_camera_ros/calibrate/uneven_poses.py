"""Do all poses agree with the model equally well? Those that do not weigh less, by their own variance.

Light that is no part of the scene (by way of other surfaces, mirrored by a glossy board, from behind it)
bends all distances of a pose together. Weights pixel by pixel do not see it, because its pixels agree with
each other; a few such poses then rule a curve. Each pose gets a factor on the variance of its distances,
estimated from its residuals (a variance component) relative to the median pose: from means over patches,
because the errors in question are common to neighbours, and the more pixels a pose has the more they outweigh
its noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.adjustment import fit
from rim_camera_ros.calibrate.problem import Fit, Problem, freed
from rim_camera_ros.calibrate.residuals import after_nuisances

Array = NDArray[Any]
Key = tuple[int, int]

#: Chi-square per patch of a pose beyond which, in ratio to the median of all, poses are uneven; poses that it
#: takes to say so, patches of a pose to be judged, their size [px], the most sigma that a residual counts.
UNEVEN = 4.0
LEAST_POSES = 8
LEAST_PATCHES = 4
PATCH = 4
WILD = 30.0
#: Factor on a pose's variance, at most: its errors must still be found, or its residuals are no residuals.
MOST = 100.0
#: Ratio of factors between two fits below which they have settled, and the most rounds that it may take.
_SETTLED = 1.25
_ROUNDS = 8
_NAMED = 5


def pose_chi_squares(fitted: Fit) -> dict[Key, float]:
    """Return chi-square per patch of each pose, by recording and placement.

    A patch is a cell of `PATCH` by `PATCH` pixels of one surface and one reflectivity; its chi-square is that
    of the mean of its residuals after pattern and errors of poses, which is 1 where they are independent.
    Residuals count no more than `WILD` sigma. Poses of few patches are not among them.
    """
    totals: dict[Key, list[Array]] = {}
    for one in fitted.forward.predictions():
        rest, _ = after_nuisances(one, fitted.pattern, fitted.nuisances)
        used = one.used
        z = np.clip(rest[used] / one.sigma[used], -WILD, WILD)
        geometry = one.view.geometry
        rows, columns = np.nonzero(used)
        kinds = np.stack(
            [rows // PATCH, columns // PATCH, geometry.surface[used], geometry.reflectivity[used]]
        )
        _, patch = np.unique(kinds, axis=1, return_inverse=True)
        patch = np.ravel(patch)
        precise = 1.0 / one.sigma[used]
        total = np.bincount(patch, precise * z)
        key = (one.station.recording, one.station.placed)
        totals.setdefault(key, []).append(total**2 / np.bincount(patch, precise**2))
    joined = {key: np.concatenate(parts) for key, parts in totals.items()}
    return {key: float(parts.mean()) for key, parts in joined.items() if len(parts) >= LEAST_PATCHES}


def uneven_poses(problem: Problem, fitted: Fit) -> dict[Key, float] | None:
    """Return the factors on the variances of poses with which they agree with the fit; None: poses are even.

    Factors change the fit and it them, so that it takes some rounds.
    """
    found = pose_chi_squares(fitted)
    if len(found) < LEAST_POSES or max(found.values()) < UNEVEN * _level(found):
        return None
    free = freed(problem, fitted)
    factors: dict[Key, float] = {}
    for _ in range(_ROUNDS):
        before = factors
        whole = {key: chi * before.get(key, 1.0) for key, chi in found.items()}
        level = _level(whole)
        factors = {key: float(np.clip(chi / level, 1.0, MOST)) for key, chi in whole.items()}
        ratios = [one / before.get(key, 1.0) for key, one in factors.items()]
        if max(max(ratios), 1.0 / min(ratios)) < _SETTLED:
            break
        again = fit(replace(free, variance_factors=factors), fitted.camera, iterations=2, warm=fitted)
        found = pose_chi_squares(again)
    return factors


def _level(found: Mapping[Key, float]) -> float:
    """Return the chi-square of the median pose, at least 1: what all disagree with is no pose's fault."""
    return max(1.0, float(np.median(list(found.values()))))


def uneven_note(factors: Mapping[Key, float]) -> str:
    """Return in words which poses weigh less, the worst by name."""
    worst = sorted(factors, key=lambda key: -factors[key])[:_NAMED]
    parts = [f"pose {pose} ({factors[recording, pose]:.0f} times)" for recording, pose in worst]
    return (
        "poses weigh less whose distances agree less with the model than those of the median pose, by their "
        f"variance: {', '.join(parts)}; the scene file does not describe all light, or these poses are wrong"
    )
