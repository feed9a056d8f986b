"""What to record next: the shipped experiments, simulated, and how well each would distinguish rivals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.plan import SUFFIX, planned_dataset
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.candidate import priors_of
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.design import gain_block, present_blocks
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import accumulate
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.exploration import Exploration

Array = NDArray[Any]

#: Stations of an experiment that are simulated.
_STATIONS = 16
#: Gain [nats] with which a recording decides between rivals, in units of the threshold of this one.
_ENOUGH = 3.0


@dataclass(frozen=True)
class Proposal:
    """An experiment: its duration [min], and the gain [nats] by which it distinguishes the nearest rivals."""

    name: str
    minutes: float
    gain: float


def distinguishing_experiments(
    step: Exploration,
    effects: Sequence[str],
    scenes: Mapping[str, Scene],
    *,
    progress: Callable[[str], None] | None = None,
) -> list[Proposal]:
    """Simulate experiments and return how well each distinguishes effects, the best first.

    Each of the effects in turn is taken for the true one, with the strength that fits the recording of
    ``step`` best. Its rival has the strength that explains that recording, within its covariance: a rival
    that should show in the experiment and does not counts as refuted. All known terms, errors of poses and
    powers and an offset per pixel are fitted anew. The gain is that expected from the experiment's normal
    equations; the least gain of all pairs counts. Experiments that cannot be simulated with this camera are
    skipped.
    """
    best = step.best()
    chosen = [step.candidates[best[name]] for name in effects]
    known = [_known(step, best[name]) for name in effects]
    pairs = list(permutations(range(len(chosen)), 2))
    fitted = step.fit.camera
    camera = with_effects(
        fitted, {name: effect for name, effect in fitted.effects.items() if not effect.stated_by_pixels}
    )
    blocks = [*present_blocks(camera), gain_block(), *(candidate.block for candidate in chosen)]
    proposals = []
    for name, scene in scenes.items():
        if progress is not None:
            progress(f"would {name.removesuffix(SUFFIX)} distinguish {' and '.join(effects)}?")
        try:
            dataset, minutes = planned_dataset(scene, camera, most=_STATIONS)
            equations = accumulate(Forward(dataset, scene, camera), blocks)
            gram = equations.reduced().gram
        except (RimError, np.linalg.LinAlgError):
            continue
        prior = priors_of(equations.regressors)
        matrix = gram * prior[:, None] * prior[None, :] + np.eye(len(prior))
        start = len(prior) - sum(len(candidate.block.regressors) for candidate in chosen)
        spans, at = [], start
        for candidate in chosen:
            spans.append(list(range(at, at + len(candidate.block.regressors))))
            at += len(candidate.block.regressors)
        base = list(range(start))
        own = [i for span in spans for i in span]
        cross = matrix[np.ix_(base, own)]
        left = matrix[np.ix_(own, own)] - np.eye(len(own))
        left = left - cross.T @ np.linalg.solve(matrix[np.ix_(base, base)], cross)
        scale = prior[own]
        left = left / scale[:, None] / scale[None, :]
        gains = [_gain(left, [[i - start for i in span] for span in spans], known, *pair) for pair in pairs]
        proposals.append(Proposal(name, minutes, max(min(gains), 0.0)))
    return sorted(proposals, key=lambda proposal: -proposal.gain)


def _known(step: Exploration, number: int) -> tuple[Array, Array]:
    """Return the strengths (K,) of an effect alone, and their covariance (K, K), by the recording."""
    span, scores = step.spans[number], step.scores
    values = scores.values(span)
    columns = scores.columns(span)
    own = np.searchsorted(columns, span)
    covariance = scores.covariance(columns)[np.ix_(own, own)]
    return np.array([values[scores.regressors[i].label] for i in span]), covariance


def _gain(
    left: Array, spans: Sequence[Sequence[int]], known: Sequence[tuple[Array, Array]], true: int, other: int
) -> float:
    """Return the gain [nats] of the true effect over another with a strength free within its covariance."""
    difference = np.zeros(len(left))
    difference[spans[true]] = known[true][0]
    difference[spans[other]] = -known[other][0]
    pull = left @ difference
    own = list(spans[other])
    freedom = left[np.ix_(own, own)] + np.linalg.inv(known[other][1])
    return 0.5 * float(difference @ pull - pull[own] @ np.linalg.solve(freedom, pull[own]))


def recommended(proposals: Sequence[Proposal], *, threshold: float) -> Proposal | None:
    """Return the shortest experiment that decides, else the one that gains most; None: none gains a nat."""
    settling = [proposal for proposal in proposals if proposal.gain >= _ENOUGH * threshold]
    if settling:
        return min(settling, key=lambda proposal: (proposal.minutes, -proposal.gain))
    return proposals[0] if proposals and proposals[0].gain >= 1.0 else None
