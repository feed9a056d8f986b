"""Two common ways to name what a model leaves out, over the same library of candidates, for comparison.

*Independent BIC*: every pixel value counts as independent; the known terms are refitted with each candidate,
and the lowest Bayesian information criterion wins. *Correlation*: the residual of the camera file as it is,
multiple correlation with the columns of each candidate; the highest wins where it is significant at 2 %.
Both see distance and amplitude, and powers per pose that were estimated before.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.fit.design import present_blocks
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.scene import load_scene
from rim_camera_ros.select.candidates import candidates

CONSISTENT = "consistent"
#: Chance of an alarm that the correlation's threshold would have if values were independent.
SIGNIFICANCE = 0.02


@dataclass
class Sums:
    """Weighted sums over all values: columns times columns, columns times residual, its square, how many."""

    gram: Any
    right: Any
    square: float
    values: int


def first_named(case: Path) -> dict[str, str]:
    """What either baseline names first for a case's files, `consistent` where nothing."""
    camera, scene = load_camera(case / "camera.yaml"), load_scene(case / "scene.yaml")
    dataset = reduce_recording(case / "recording", camera)
    dataset.with_poses(scene)
    forward = Forward(dataset, scene, camera)
    forward.estimate_amplitudes()
    facts = Facts.of(dataset, moves=scene.camera_motion.moves, surfaces=len(scene.surfaces), camera=camera)
    library = candidates(camera, facts)
    known = present_blocks(camera)
    sums = accumulated(forward, [*known, *(one.block for one in library)])
    count = sum(len(block.regressors) for block in known) + 1
    spans, start = [], count
    for one in library:
        spans.append(list(range(start, start + len(one.block.regressors))))
        start += len(one.block.regressors)
    effects = [one.effect for one in library]
    return {
        "bic": by_bic(sums, list(range(count)), spans, effects),
        "correlation": by_correlation(sums, spans, effects),
    }


def accumulated(forward: Forward, blocks: Any) -> Sums:
    """Sums over all used pixels of all stations; the first column is the emitter's power."""
    gram: Any = 0.0
    right: Any = 0.0
    square, values = 0.0, 0
    for one in forward.predictions():
        columns = [one.gain_column()]
        for block in blocks:
            columns += block.columns(one)
        design, residual = _whitened(one, columns)
        gram = gram + design.T @ design
        right = right + design.T @ residual
        square += float(residual @ residual)
        values += len(residual)
    return Sums(gram, right, square, values)


def _whitened(one: Prediction, columns: Any) -> tuple[Any, Any]:
    """Columns and residual of both channels over their standard deviations, one row a value."""
    used, lit = one.used, one.amplitude_used
    parts = []
    for distance, amplitude in columns:
        first = np.broadcast_to(distance, used.shape)[used] / one.sigma[used]
        second = (
            np.zeros(int(lit.sum()))
            if amplitude is None
            else np.broadcast_to(amplitude, used.shape)[lit] / one.amplitude_sigma[lit]
        )
        parts.append(np.nan_to_num(np.concatenate([first, second])))
    residual = np.concatenate(
        [one.residual[used] / one.sigma[used], one.amplitude_residual[lit] / one.amplitude_sigma[lit]]
    )
    return np.stack(parts, axis=1), residual


def explained(sums: Sums, index: list[int]) -> float:
    """By how much least squares on these columns lowers the chi-square."""
    if not index:
        return 0.0
    matrix, right = sums.gram[np.ix_(index, index)], sums.right[index]
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inner = matrix / scale[:, None] / scale[None, :]
    return float(right / scale @ np.linalg.pinv(inner, rcond=1e-10, hermitian=True) @ (right / scale))


def by_bic(sums: Sums, known: list[int], spans: list[list[int]], effects: list[str]) -> str:
    """The effect of the candidate with the lowest BIC; `consistent` where the known terms alone have it."""
    start = explained(sums, known)
    best, name = 0.0, CONSISTENT
    for span, effect in zip(spans, effects, strict=True):
        gain = explained(sums, known + span) - start - len(span) * np.log(max(sums.values, 2))
        if gain > best:
            best, name = gain, effect
    return name


def by_correlation(sums: Sums, spans: list[list[int]], effects: list[str]) -> str:
    """The effect of the candidate that correlates best with the residual; `consistent` if by chance."""
    per_value = sums.square / max(sums.values, 1)
    found = [explained(sums, span) for span in spans]
    significant = [
        gain > per_value * chi2.isf(SIGNIFICANCE / len(spans), len(span))
        for gain, span in zip(found, spans, strict=True)
    ]
    order = np.argsort(found)[::-1]
    return next((effects[int(k)] for k in order if significant[int(k)]), CONSISTENT)
