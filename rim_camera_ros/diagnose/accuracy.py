"""The accuracy of the improved camera: residuals of held-out poses, before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects import CovariateTable
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.effects.candidate import Block
from rim_camera_ros.fit.problem import Fit, Problem, blocks_of, clean_by
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.evidence import Scores

Array = NDArray[Any]
#: Changes of parameters, errors of poses and powers, fixed pattern (H, W) [m], NaN where it is not known.
_Parameters = tuple[Mapping[str, float], Mapping[str, float], Array]

#: Ratio of the RMS of held-out distances above which the improved camera is refused, and the note on it.
_WORSE = 1.1
_NO_BETTER = (
    "distances of held-out poses got worse although amplitudes got better: what is named stands for "
    "something else, do not use camera.yaml"
)
#: Chi-square per value of held-out poses above which a model that makes distances worse describes nothing.
_GROSS = 50.0
#: Chi-square per value of held-out poses above which something remains unexplained.
LEFT = 1.1
#: Most values of a table that is estimated again without each fold of the poses.
_MOST_VALUES = 150
_OF_ALL = (
    "the table of unknown physics was fitted to all poses, also to those that it is compared with: it has "
    "too many values to be estimated without them"
)
#: Factor on chi-square per value of held-out poses above which it counts as risen.
_RISEN = 1.05


@dataclass(frozen=True)
class Accuracy:
    """RMS [m] of the residuals of held-out poses and their chi-square per value, before and after.

    ``noise_floor`` [m] is the RMS by the noise of the stations' means. ``table_of_all``: the table of unknown
    physics was fitted to all poses, as it has too many values to be estimated again without each fold.
    ``all_before`` and ``all_after`` are the chi-squares by which names are judged (`judged_by_all_errors`).
    """

    rms_before: float
    rms_after: float
    noise_floor: float
    chi2_before: float
    chi2_after: float
    held_out: bool
    table_of_all: bool = False
    all_before: float | None = None
    all_after: float | None = None

    @property
    def hopeless(self) -> bool:
        """Whether a gross misfit became worse: no fitted model describes the recording."""
        return self.held_out and self.chi2_before > _GROSS and self.rms_after > _WORSE * self.rms_before

    @property
    def got_worse(self) -> bool:
        """Whether held-out poses are evidence against the improved camera."""
        risen = self.chi2_after > _RISEN * max(self.chi2_before, 1.0)
        return self.held_out and (risen or self.rms_after > _WORSE * self.rms_before)

    @property
    def explained(self) -> float:
        """Share of the excess of chi-square over 1 that the model explains; 1 where there is no excess."""
        if not self.held_out or self.chi2_after <= LEFT or self.chi2_before <= LEFT:
            return 1.0
        before, after = self.judged
        return float(np.clip((before - after) / max(before - 1.0, LEFT - 1.0), 0.0, 1.0))

    @property
    def judged(self) -> tuple[float, float]:
        """Chi-squares per value of held-out poses, before and after, from which `explained` is computed."""
        if self.all_before is None or self.all_after is None:
            return self.chi2_before, self.chi2_after
        return self.all_before, self.all_after

    def notes(self) -> list[str]:
        """Return evidence against the improved camera, and misfit that it leaves, in words."""
        return [*self._of_poses(), *([_OF_ALL] if self.held_out and self.table_of_all else [])]

    def _of_poses(self) -> list[str]:
        if not self.held_out:
            return []
        if self.rms_after > _WORSE * self.rms_before:
            return [_NO_BETTER]
        if self.got_worse:
            return [
                f"chi-square per value of held-out poses rose from {self.chi2_before:.3g} to "
                f"{self.chi2_after:.3g}: the residuals are larger than the stated errors; the form that is "
                "named is not quite the true one, or something else is missing"
            ]
        if self.chi2_after <= LEFT or self.chi2_after == self.chi2_before:
            return []
        further = "or something else is missing, which intervals do not allow for"
        if self.all_after is not None and self.all_after <= LEFT:
            further = f"which intervals do not allow for; changed a little, it leaves {self.all_after:.3g}"
        return [
            f"chi-square per value of held-out poses is still {self.chi2_after:.3g}: the form of what was "
            f"found is not quite the true one, {further}"
        ]


def accuracy(camera: Camera, model: Camera, result: Result, unknown: Fit | None = None) -> Accuracy:
    """Compare two cameras on held-out poses.

    ``unknown`` is the fit of a table of unknown physics, where that is the model: the table is estimated
    again without the poses that it is compared with.
    ``camera`` keeps the values of its file. Errors of poses, free poses of the scene, powers and the fixed
    pattern are estimated for both cameras, the pattern from the other folds. Cameras with different optics
    are compared by the pixels that are clean of edges by both.
    """
    compared = _Compared.of(result.problem, camera, model, result, unknown)
    rms_before, chi_before = _held_out(compared.before, compared.frozen, result.folds)
    rms_after, chi_after = rms_before, chi_before
    if compared.after is not compared.before:
        rms_after, chi_after = _held_out(compared.after, compared.own, result.folds)
    floors = [
        prediction.sigma[prediction.used] ** 2
        for prediction in compared.before.forward.predictions(slopes=False)
    ]
    floor = float(np.sqrt(np.mean(np.concatenate(floors)))) if floors else 0.0
    return Accuracy(
        rms_before,
        rms_after,
        floor,
        chi_before,
        chi_after,
        held_out=len(compared.after.equations.folds) > 1,
        table_of_all=compared.table_of_all,
    )


def judged_by_all_errors(
    measure: Accuracy, camera: Camera, model: Camera, result: Result, unknown: Fit | None = None
) -> Accuracy:
    """Return an accuracy with chi-squares of held-out poses that measure how much of all errors is explained.

    Errors that neighbours share (`correlated_errors`) count as misfit here: an effect reduces their variance
    as well. Changes of the forms of named effects, within their priors, count as explained by the effects.
    Arguments are those of `accuracy`. A measure to which neither applies is returned unchanged.
    """
    correlated = result.problem.correlated_error > 0
    if not correlated and measure.explained == 1.0:
        return measure
    forms = result.explorations[-1].forms if model == result.fit.camera else ()
    problem = replace(result.problem, correlated_error=0.0)
    compared = _Compared.of(problem, camera, model, result, unknown, forms)
    before = _chi_square(_scores(compared.before))
    after = before if compared.after is compared.before else _chi_square(_scores(compared.after, forms))
    return replace(measure, all_before=before, all_after=after)


@dataclass(frozen=True)
class _Compared:
    """Fits of the camera with the values of its file, ``before``, and of another one, with their problems."""

    frozen: Problem
    before: Fit
    own: Problem
    after: Fit
    table_of_all: bool

    @classmethod
    def of(
        cls,
        problem: Problem,
        camera: Camera,
        model: Camera,
        result: Result,
        unknown: Fit | None,
        forms: Sequence[Block] = (),
    ) -> _Compared:
        views = result.fit.forward.views
        if model.optics != camera.optics:
            problem = clean_by(model, problem, result.fit.scene, views=views)
        # compared chi-squares require the same noise
        problem = replace(problem, amplitude_error=result.fit.forward.amplitude_model.tau)
        frozen = replace(
            problem,
            scene=result.fit.scene,
            effects=(),
            geometry=(),
            gain=False,
            robust=False,
            reflectance=False,
            response=None,
        )
        # powers and reflectivities begin at their fitted values, free poses at those found
        begin = replace(result.explorations[0].fit.point, parameters={})
        before = fit(frozen, camera, fold_of=result.folds, iterations=1, views=views, warm=begin)
        same_distances = model.effects == camera.effects and model.optics == camera.optics
        own, of_all = frozen, False
        if same_distances and model.noise == camera.noise:
            after = before
        elif same_distances:
            after = fit(frozen, model, fold_of=result.folds, iterations=1, views=views)
        elif unknown is not None:
            own = replace(problem, robust=False, geometry=(), reflectance=False, response=None)
            table = None if effect_of(camera, CovariateTable) else effect_of(model, CovariateTable)
            start, steps = model, 2
            if isinstance(table, CovariateTable) and len(set(result.folds.values())) > 1:
                of_all = table.values.values.size > _MOST_VALUES
                if not of_all:
                    # values that the other poses do not determine are 0, not those of the held-out poses
                    nothing = replace(table, values=NestedList(np.zeros_like(table.values.values)))
                    start, steps = with_effects(model, {**model.effects, table.name: nothing}), 0
                    own = replace(own, effects=tuple(model.effects))
            after = fit(own, start, fold_of=result.folds, iterations=steps, views=views, warm=unknown)
        else:
            own = replace(problem, robust=False)
            warm = result.fit if result.fit.camera == model else None
            if warm is None:
                own = replace(own, scene=result.fit.scene)
            after = fit(own, model, fold_of=result.folds, further=forms, iterations=2, views=views, warm=warm)
        return cls(frozen, before, own, after, of_all)


def _scores(fitted: Fit, forms: Sequence[Block] = ()) -> Scores:
    """Return the scores of a fit's parameters, and of the changes of forms that follow them."""
    count = len(fitted.parameters) + sum(len(form.regressors) for form in forms)
    return Scores(fitted.equations, range(count), held=fitted.at_bounds)


def _chi_square(scores: Scores) -> float:
    """Return chi-square per value of held-out poses."""
    chi_square, rows = scores.chi_square(held_out=True)
    return chi_square / max(rows, 1)


def _held_out(fitted: Fit, problem: Problem, folds: Mapping[tuple[int, int], int]) -> tuple[float, float]:
    """Return RMS [m] and chi-square per value of held-out poses.

    A pose's own errors and power are estimated given the parameters and the fixed pattern of the other
    folds. Only pixels that the other folds saw count, as the offsets of the others are not known.
    """
    scores = _scores(fitted)
    others: list[_Parameters] = []
    parts, pixels = fitted.equations.folds, fitted.equations.pixels
    shape = fitted.camera.shape
    for k, trained in enumerate(scores.trained):
        own = scores.values(leave_out=k)
        values = np.array([own[r.label] for r in scores.regressors])
        _, flat, gains = trained.recover(values)
        gains = None if gains is None else pixels.where_seen(gains)
        own_errors = parts[k].errors_given(values, pixels.where_seen(flat), gains)
        weight = np.sum([part.weight for i, part in enumerate(parts) if i != k], axis=0)
        known = pixels.everywhere(weight) > 0
        others.append((own, own_errors, np.where(known, flat, np.nan).reshape(shape)))
    blocks = blocks_of(problem, fitted.camera, fitted.scene) if others else []
    all_poses: _Parameters = ({}, fitted.nuisances, fitted.pattern)
    total, number = 0.0, 0
    for prediction in fitted.forward.predictions():
        key = (prediction.station.recording, prediction.station.pose)
        changes, errors, pattern = others[folds[key]] if others else all_poses
        rest, _ = after_nuisances(prediction, pattern, errors)
        for block in blocks:
            for regressor, (column, _) in zip(block.regressors, block.columns(prediction), strict=True):
                change = changes.get(regressor.label, 0.0)
                if change:
                    rest = rest - change * np.nan_to_num(column)
        used = prediction.used & np.isfinite(rest)
        total += float(np.sum(rest[used] ** 2))
        number += int(used.sum())
    rms = float(np.sqrt(total / number)) if number else 0.0
    return rms, _chi_square(scores)
