"""Does the model help? Residuals of poses that it was not fitted to, before and after."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.adjustment import fit
from rim_camera_ros.calibrate.blocks import effect_block, present_priors
from rim_camera_ros.calibrate.outcome import Result
from rim_camera_ros.calibrate.problem import Fit
from rim_camera_ros.calibrate.residuals import after_nuisances
from rim_camera_ros.calibrate.selection import Scores
from rim_camera_ros.camera import Camera

Array = NDArray[Any]

#: Ratio of held-out distances' RMS above which the improved camera is none, and what is said then.
_WORSE = 1.1
_NO_BETTER = (
    "distances of held-out poses got worse although amplitudes got better: what is named stands for "
    "something else, do not use camera.yaml"
)
#: Chi-square per value of held-out poses from which on a model that makes distances worse is none at all.
_GROSS = 50.0
#: Chi-square per value of held-out poses above which something is left.
LEFT = 1.1
#: Factor on chi-square per value of held-out poses above which it is said that it rose.
_RISEN = 1.05


@dataclass(frozen=True)
class Accuracy:
    """RMS [m] of the residuals of held-out poses and their chi-square per value, before and after;
    ``noise_floor`` [m]: RMS that the noise of the stations' means makes.
    """

    rms_before: float
    rms_after: float
    noise_floor: float
    chi2_before: float
    chi2_after: float
    held_out: bool

    @property
    def hopeless(self) -> bool:
        """Whether a gross mismatch became worse: nothing that was fitted describes the recording."""
        return self.held_out and self.chi2_before > _GROSS and self.rms_after > _WORSE * self.rms_before

    @property
    def got_worse(self) -> bool:
        """Whether held-out poses speak against the improved camera."""
        risen = self.chi2_after > _RISEN * max(self.chi2_before, 1.0)
        return self.held_out and (risen or self.rms_after > _WORSE * self.rms_before)

    def notes(self) -> list[str]:
        """Return what speaks against the improved camera or is left of it, in words."""
        if not self.held_out:
            return []
        if self.rms_after > _WORSE * self.rms_before:
            return [_NO_BETTER]
        if self.got_worse:
            return [
                f"chi-square per value of held-out poses rose from {self.chi2_before:.3g} to "
                f"{self.chi2_after:.3g}: what is left is larger than the errors stated for it; the form "
                "named is not quite the true one, or something else is left out"
            ]
        if self.chi2_after <= LEFT or self.chi2_after == self.chi2_before:
            return []
        return [
            f"chi-square per value of held-out poses is still {self.chi2_after:.3g}: the form of what was "
            "found is not quite the true one, or something else is left out, which intervals do not allow for"
        ]


def accuracy(camera: Camera, model: Camera, result: Result, unknown: Any = None) -> Accuracy:
    """Compare two cameras on the poses that their parameters were not fitted to.

    The camera before is as its file says; errors of the poses, powers and the fixed pattern are estimated
    for both, the pattern from the other folds.
    """
    problem = result.problem
    views = result.fit.forward.views
    frozen = replace(
        problem, effects=(), geometry=(), gain=False, robust=False, reflectance=False, response=None
    )
    before = fit(frozen, camera, fold_of=result.folds, iterations=1, views=views)
    same_distances = model.effects == camera.effects and model.optics == camera.optics
    if same_distances and model.noise == camera.noise:
        after = before
    elif same_distances:
        after = fit(frozen, model, fold_of=result.folds, iterations=1, views=views)
    else:
        own = replace(problem, scene=result.fit.scene, robust=False)
        if unknown is not None:
            own = replace(own, geometry=(), reflectance=False, response=None)
        warm = result.fit if result.fit.camera == model else None
        after = fit(own, model, fold_of=result.folds, iterations=2, views=views, warm=warm)
    rms_before, chi_before = _held_out(before, result.folds)
    rms_after, chi_after = (rms_before, chi_before) if after is before else _held_out(after, result.folds)
    floors = [one.sigma[one.used] ** 2 for one in before.forward.predictions(slopes=False)]
    floor = float(np.sqrt(np.mean(np.concatenate(floors)))) if floors else 0.0
    return Accuracy(
        rms_before, rms_after, floor, chi_before, chi_after, held_out=len(after.equations.folds) > 1
    )


def _held_out(fitted: Fit, folds: Mapping[tuple[int, int], int]) -> tuple[float, float]:
    """Return RMS [m] and chi-square per value of held-out poses."""
    count = len(fitted.parameters)
    scores = Scores(fitted.equations, range(count))
    chi_square, rows = scores.chi_square(held_out=True)
    total, number = 0.0, 0
    trained: list[tuple[dict[str, float], Array, dict[str, float]]] = []
    for k in range(len(scores.trained)):
        values = scores.values(leave_out=k)
        _, flat = scores.trained[k].recover(np.array([values[r.label] for r in scores.regressors]))
        trained.append((values, flat.reshape(fitted.camera.shape), {}))
    blocks = {
        name: effect_block(effect, present_priors(effect, fitted.camera))
        for name, effect in fitted.camera.effects.items()
        if any(path.startswith(f"effects.{name}.") for path in fitted.parameters)
    }
    for one in fitted.forward.predictions():
        key = (one.station.recording, one.station.pose)
        fold = folds[key] if trained else 0
        pattern = trained[fold][1] if trained else fitted.pattern
        rest, _ = after_nuisances(one, pattern, fitted.nuisances)
        if trained:
            values = trained[fold][0]
            for block in blocks.values():
                for regressor, (column, _) in zip(block.regressors, block.columns(one), strict=True):
                    change = values.get(regressor.label, 0.0)
                    if change:
                        rest = rest - change * np.nan_to_num(column)
        used = one.used & np.isfinite(rest)
        total += float(np.sum(rest[used] ** 2))
        number += int(used.sum())
    rms = float(np.sqrt(total / number)) if number else 0.0
    return rms, chi_square / max(rows, 1)
