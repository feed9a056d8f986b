"""Whether a further effect shows also where the effects found before it do not act.

The form of a large effect is never quite the true one, and what it leaves where it acts looks like small
other effects. A true further effect is seen by the other pixels as well, in proportion to what they tell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.adjustment import fit
from rim_camera_ros.calibrate.exploration import LEAST_THRESHOLD, Exploration
from rim_camera_ros.calibrate.forms import form_blocks
from rim_camera_ros.calibrate.problem import Fit, Problem
from rim_camera_ros.calibrate.selection import Scores
from rim_camera_ros.calibrate.shuffled_times import follows_time
from rim_camera_ros.calibrate.sizes import change_by
from rim_camera_ros.effects.candidate import Candidate

Array = NDArray[Any]

#: An effect does not act on a pixel that it changes by less than this, in sigmas of the pixel's mean.
_QUIET = 0.3
#: Share of the pixels that must be left for the question to be asked.
_LEAST_LEFT = 0.05
#: A further effect must gain this share of what the pixels left tell of it.
_LEAST_PART = 0.3


def shows_elsewhere(
    problem: Problem,
    step: Exploration,
    number: int,
    found: Sequence[str],
    folds: Mapping[tuple[int, int], int],
) -> bool:
    """Return whether a candidate of an exploration gains where the effects ``found`` do not act.

    Also where that cannot be told: too few pixels are left, or they would tell too little, or what was found
    are parameters of the optics or surfaces, which act everywhere.
    """
    names = [name for name in found if name in step.fit.camera.effects]
    if not names:
        return True
    masks = quiet_pixels(step.fit, names)
    if masks is None:
        return True
    candidate, span = step.candidates[number], step.spans[number]
    fitted = fit(
        replace(problem, masks=masks),
        step.fit.camera,
        fold_of=folds,
        further=[candidate.block],
        views=step.fit.forward.views,
        warm=step.fit,
        iterations=0,
    )
    count = len(fitted.parameters)
    own = list(range(count, count + len(span)))
    scores = Scores(fitted.equations, range(count))
    values = step.scores.values(span)
    strength = np.array([values[one.label] for one in candidate.block.regressors])
    whole = step.scores.expected_gain(span, strength)
    if whole <= 0:
        return True
    wanted = float(step.gains[number]) * scores.expected_gain(own, strength) / whole
    if wanted < 2 * LEAST_THRESHOLD:
        return True
    return float(scores.gain(own)) > _LEAST_PART * wanted


def quiet_pixels(fitted: Fit, names: Sequence[str]) -> list[tuple[Array, Array]] | None:
    """Return the pixels of each station and channel (H, W) that effects do not change.

    None where too few are left.
    """
    masks, used, kept = [], 0, 0
    for one in fitted.forward.predictions():
        distance, light = one.used, one.amplitude_used
        used += int(distance.sum())
        for name in names:
            moved, changed = change_by(one, name)
            distance = distance & (np.abs(np.nan_to_num(moved)) < _QUIET * one.sigma)
            if changed is not None:
                light = light & (np.abs(np.nan_to_num(changed)) < _QUIET * one.amplitude_sigma)
        kept += int(distance.sum())
        masks.append((distance, light))
    return masks if kept >= _LEAST_LEFT * max(used, 1) else None


def follows_time_elsewhere(
    fitted: Fit,
    name: str,
    problem: Problem,
    folds: Mapping[tuple[int, int], int],
    *,
    found: Sequence[str],
    drifts: Sequence[Candidate],
    curves: Sequence[Candidate],
    variants: Sequence[Candidate],
    seed: int,
) -> bool:
    """Return whether a drift ``name`` of a fit follows time, as `follows_time`, where others do not act.

    These are the effects ``found`` before it, whose form is never quite the true one: beside it stand
    ``curves`` of what they depend on, and changes of their forms by their ``variants``. ``drifts`` are its
    own candidates.
    """
    # such a form leaves what changes with its own covariates, and these with time
    effects = [fitted.camera.effects[one] for one in found if one in fitted.camera.effects]
    covariates = {covariate for one in effects for covariate in one.own_covariates()}
    own = [one.block for one in curves if one.variant in covariates]
    beside = [*own, *form_blocks(fitted, found, variants)]
    masks = quiet_pixels(fitted, [one.name for one in effects])
    there = problem if masks is None else replace(problem, masks=masks)
    return follows_time(fitted, name, drifts, folds, there, beside=beside, seed=seed)
