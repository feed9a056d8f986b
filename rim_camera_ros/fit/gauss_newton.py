"""Damped Gauss-Newton steps over the forward chain: the current point of an adjustment, and the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_numbers
from rim_camera_ros.effects.candidate import Block, Regressor, priors_of
from rim_camera_ros.effects.light_curves import FALLOFF, LOBE, tile_labels
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.bounds import BEYOND_POSSIBLE, Bounds, of_shape, sigmas_beyond
from rim_camera_ros.fit.design import GAIN, is_linear
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.linearised import NO_SOLUTION, Linearised, solution
from rim_camera_ros.fit.normal_equations import accumulate
from rim_camera_ros.fit.problem import (
    Fit,
    Point,
    Problem,
    away_from_priors,
    blocks_of,
    forward_of,
    keeps_amplitude_error,
    light_groups,
)
from rim_camera_ros.fit.residuals import amplitude_error, huber
from rim_camera_ros.fit.steps import (
    Solved,
    by_linear,
    in_units,
    moved_scene,
    of_phasors,
    power_factor,
    stepped,
    value_of,
    within_bounds,
)
from rim_camera_ros.fit.views import Views

Array = NDArray[Any]

#: The error of predicted amplitudes is estimated anew in this many iterations, then kept.
_SETTLED = 3
_SETTLED_WARM = 1
#: Iterations in which the shapes (widths, lags) of effects that are new to a fit are held, and how firmly.
_SHAPES_HELD = 2
_HOLD = 1e9
#: Damping of a step that raises the objective, as shares of the diagonal, one after the other; inf: no step.
#: The step after it has the same damping, and `_LESS_DAMPED` times less once a step is good at its first try.
#: Where objectives are strongly curved, as with undescribed light, only steps of a hundredth lower them.
_DAMPING = (0.01, 0.1, 1.0, 10.0, 100.0, np.inf)
_LESS_DAMPED = 10.0
_AT_A_BOUND = "{} is at the end of what is possible: the form of its effect is not quite the true one"
#: Share of the forecast gain of a step by which the objective may rise once, near the solution.
_OVER_THE_BEND = 0.1
#: Ratio of decrements below which a step comes nearer to the solution of the equations, whatever its
#: objective (natural monotonicity; Deuflhard 2004, Newton Methods for Nonlinear Problems, sec. 4.3).
_NEARER = 0.5


class GaussNewton:
    """The current point of an adjustment from the camera ``start``, and its last step.

    Other parameters as in `solver.fit`. Steps that raise the objective are taken back; in a fit without a
    warm start only once the error of predicted amplitudes is settled.
    """

    def __init__(
        self,
        problem: Problem,
        start: Camera,
        *,
        iterations: int,
        tolerance: float,
        views: Views | None,
        warm: Point | None,
        near: bool = False,
    ) -> None:
        self._problem, self._start = problem, start
        self._iterations, self._tolerance = iterations, tolerance
        self._views, self._warm = views, warm is not None
        self._numbers = camera_numbers(start)
        self._away = away_from_priors(problem, start)
        self._bounds = Bounds.of_data(problem.dataset, problem.masks, start)
        # the point
        self._camera, self._scene = start, problem.scene
        self._pattern = np.zeros(start.shape)
        self._pixels: Array | None = None
        self._nuisances: dict[str, float] = {}
        self._offsets: dict[str, float] = {}
        self._gains: Mapping[tuple[int, int], float] | None = None
        self._tau = 0.0
        self._settled = _SETTLED
        self._near, self._new = near, frozenset[str]()
        if warm is not None:
            self._new = frozenset() if near else frozenset(start.effects.keys() - warm.camera.effects.keys())
            if warm.amplitude_model.gains:
                self._begin_at(warm)
        # the last step
        self._solved: Solved | None = None
        self._objective, self._square, self._fell = np.inf, np.inf, np.inf
        self._tried, self._damping = 0, 0.0
        self._return: Solved | None = None
        self._last_step: dict[str, float] = {}
        self._converged = self._exhausted = self._stuck = False

    def _begin_at(self, warm: Point) -> None:
        model = warm.amplitude_model
        self._tau, self._pattern, self._pixels = model.tau, warm.pattern, model.pixels
        self._settled = -1 if keeps_amplitude_error(warm.camera, self._start) else _SETTLED_WARM
        self._gains = {
            key: g * power_factor(warm.nuisances.get(f"{key[0]}.{key[1]}.gain", 0.0))
            for key, g in model.gains.items()
        }
        self._nuisances = {name: e for name, e in warm.nuisances.items() if not name.endswith(".gain")}
        curves = warm.light_curves
        if curves is not None:
            groups = light_groups(self._problem, self._start)
            allowed = {label for labels in groups for label in labels}
            if self._problem.imperfections:
                lobe = FALLOFF if self._problem.reflectance else LOBE
                allowed |= {*lobe, *tile_labels(self._problem.scene)}
            self._offsets.update({k: v for k, v in curves.values.items() if k in allowed})
        self._offsets.update({k: v for k, v in warm.parameters.items() if k.startswith("scene.")})
        self._scene = moved_scene(self._problem.scene, self._offsets)

    @property
    def ended(self) -> bool:
        """Whether no further step is needed, or no step lowers the objective."""
        return self._converged or self._exhausted

    def predicted(self, count: int) -> Forward:
        """Return the predictions in iteration ``count``, with powers and errors of amplitudes."""
        problem, forward = self._problem, self._forward()
        if self._gains is None:
            forward.estimate_amplitudes()
            self._tau, self._gains = forward.amplitude_model.tau, forward.amplitude_model.gains
            if problem.gain and self._camera.radiometry.gain_sigma == 0 and self._gains:
                power = self._numbers[GAIN] * next(iter(self._gains.values()))
                self._camera = with_numbers(self._camera, {GAIN: power})
                self._offsets[GAIN] = float(np.log(self._camera.radiometry.gain / self._numbers[GAIN]))
                self._gains = dict.fromkeys(self._gains, 1.0)
                forward = self._forward()
        elif problem.amplitude_error is None and count <= self._settled and self._iterations:
            forward.amplitude_model = AmplitudeModel(dict(self._gains), self._tau, self._pixels)
            self._tau = amplitude_error(forward, self._nuisances)
        if problem.amplitude_error is not None:
            self._tau = problem.amplitude_error
        forward.amplitude_model = AmplitudeModel(dict(self._gains), self._tau, self._pixels)
        begun = self._iterations > 0 and count >= (0 if self._warm else _SETTLED)
        if begun and problem.masks is None and not problem.moves_edges:
            # objectives of two points can be compared only with the same pixels
            forward.masks = forward.pixels_used()
            self._problem = replace(problem, masks=forward.masks)
        return forward

    def _forward(self) -> Forward:
        forward = forward_of(
            self._problem, self._scene, self._camera, views=self._views, offsets=self._offsets
        )
        self._views = forward.views
        return forward

    def linearised(
        self,
        forward: Forward,
        count: int,
        *,
        further: Sequence[Block] = (),
        fold_of: Mapping[tuple[int, int], int] | None = None,
    ) -> Linearised:
        """Return the equations at the point, with ``further`` regressors, and their solution without them.

        Raises `InputError` without usable data, `RimError` where the equations have none.
        """
        problem = self._problem
        blocks = blocks_of(problem, self._camera, self._scene)
        owned = sum(len(block.regressors) for block in blocks)
        robust = problem.robust and (count > 0 or self._warm)
        equations = accumulate(
            forward,
            [*blocks, *further],
            fold_of=fold_of,
            pattern=problem.pattern,
            weigh=huber(self._pattern, self._nuisances) if robust else None,
            stray_light=problem.stray_light,
            pattern_prior=problem.pattern_prior,
            pixel_gains=problem.pixel_gains,
        )
        if not any(fold.rows for fold in equations.folds):
            raise InputError(
                "no pixel can be used: nothing of the recording agrees with scene and camera file",
                remedy="check that the scene file describes the recording (rim info BAG lists its poses)",
            )
        regressors = equations.regressors[:owned]
        labels = [regressor.label for regressor in regressors]
        away = np.array([self._away.get(label, 0.0) + self._offsets.get(label, 0.0) for label in labels])
        at = {label: self._numbers.get(label, 0.0) + self._offsets.get(label, 0.0) for label in labels}
        regressors, away = of_phasors(regressors, away, at)
        equations.regressors[:owned], equations.away = regressors, away
        reduced = equations.reduced()
        prior = priors_of(regressors)
        own = slice(0, owned)
        matrix = reduced.gram[own, own] + np.diag(prior**-2)
        if count < _SHAPES_HELD:
            # after a linear guess strengths come first: shapes would not come back
            held = self._held(regressors)
            matrix[held, held] *= _HOLD
        right = reduced.right[own] - away / prior**2
        step, stay, covariance = solution(matrix, right, self._bounds.open_sides(labels, self._camera))
        by_nuisances = by_linear(matrix, right, labels)
        square = float(reduced.square) + float(np.sum((away / prior) ** 2)) - by_nuisances
        return Linearised(
            forward=forward,
            equations=equations,
            reduced=reduced,
            regressors=regressors,
            prior=prior,
            matrix=matrix,
            right=right,
            step=step,
            covariance=covariance,
            square=square,
            objective=square + 2 * reduced.log_norm + sum(fold.robust for fold in equations.folds),
            decrement=float(right @ step) - by_nuisances,
            at_bounds=sigmas_beyond(matrix, right, step, stay),
        )

    def _held(self, regressors: Sequence[Regressor]) -> list[int]:
        new = [regressor.owner in self._new and of_shape(regressor.label) for regressor in regressors]
        return np.flatnonzero(new).tolist()

    def went_too_far(self, here: Linearised, count: int) -> bool:
        """Return whether the last step raised the objective, and a shorter one may be tried."""
        solved = self._solved
        # before that, objectives have different errors of amplitudes
        comparable = self._warm or count > _SETTLED
        level = here.level(self._tolerance)
        worse = comparable and here.objective > self._objective + level
        if not worse or self._tried >= len(_DAMPING) or count > self._iterations or solved is None:
            return False
        # weights follow the residuals: the objective need not be least at the solution of the equations
        undamped = abs(replace(solved, damping=0.0).forecast)
        if np.isinf(solved.damping) or undamped < level or here.decrement < _NEARER * solved.decrement:
            return False
        if not self._near or self._tried or self._return is not None or count >= self._iterations:
            return True
        # across a curved valley the next step may lower the objective: short steps would follow the valley
        return here.objective > self._objective + _OVER_THE_BEND * solved.forecast

    def shorten(self, *, final: bool) -> None:
        """Take a shorter step from where the last one began, or no step where none may be tried any more."""
        assert self._solved is not None
        if self._return is not None:
            self._solved, self._return = self._return, None
        if self._solved.holds_shapes:
            # shapes move from where it began
            self._solved = replace(self._solved, damping=np.inf, holds_shapes=False)
        else:
            self._tried = len(_DAMPING) if final else self._tried + 1
            self._damping = max(_DAMPING[self._tried - 1], self._damping * _LESS_DAMPED)
            self._solved = replace(self._solved, damping=self._damping)
        try:
            self._go(self._solved)
        except (InputError, ValueError):
            # a step in another direction may lead to an invalid camera: return to where it began
            self._damping, self._solved = np.inf, replace(self._solved, damping=np.inf)
            self._go(self._solved)
        self._tau = self._solved.tau
        self._find_errors(self._solved)
        self._exhausted |= bool(np.isinf(self._damping))

    def accept(self, here: Linearised) -> None:
        """Accept the point to which the last step led."""
        if self._tried == 0:
            self._damping = self._damping / _LESS_DAMPED if self._damping > _DAMPING[0] else 0.0
        self._tried = 0
        if here.objective > self._objective + here.level(self._tolerance) and self._near:
            self._return = self._solved
            return
        self._fell = self._objective - here.objective
        self._objective, self._return = here.objective, None

    def advance(self, here: Linearised, count: int) -> None:
        """Take the next step, and judge whether the adjustment has converged.

        Raises `RimError` where the step is not finite.
        """
        if not np.all(np.isfinite(here.step)):
            raise RimError(NO_SOLUTION, remedy="check scene and camera file")
        assert self._gains is not None
        limits = self._bounds.step_limits(here.labels, self._offsets, self._numbers, self._start.shape)
        self._solved = Solved(
            here.reduced,
            here.labels,
            here.matrix,
            here.right,
            limits,
            self._tau,
            dict(self._gains),
            dict(self._offsets),
            self._damping,
            self._pixels,
            here.decrement,
            holds_shapes=count < _SHAPES_HELD and bool(self._held(here.regressors)),
        )
        self._find_errors(self._solved)
        self._converged = here.moves_little(self._tolerance) and not self._solved.holds_shapes
        # parameters that are hardly distinguishable wander along a valley with a level floor
        level = here.level(self._tolerance)
        is_level = self._damping == 0 and abs(self._square - here.square) < level
        settled = count >= min(self._settled, _SETTLED) and not self._solved.holds_shapes
        # or no step within the bounds that lowers the objective gains anything (Moré 1978, sec. 8)
        left, forecast = here.decrement, self._solved.forecast
        if self._damping:
            is_level |= abs(self._fell) < level and forecast < level
        else:
            left = forecast
        self._converged |= settled and (is_level or abs(left) < self._tolerance * here.unit_variance)
        # chi-square that was level while shapes were held need not be once they move
        self._square = np.inf if self._solved.holds_shapes else here.square
        try:
            self._go(self._solved)
        except (InputError, ValueError):
            self._stuck = self._converged = True
            return
        self._last_step = self._solved.changes

    def _go(self, solved: Solved) -> None:
        self._camera, self._offsets = stepped(
            self._start, solved.offsets, solved.changes, self._bounds, self._numbers
        )
        within_bounds(self._offsets, self._camera, self._numbers)
        self._scene = moved_scene(self._problem.scene, self._offsets)

    def _find_errors(self, solved: Solved) -> None:
        self._nuisances, self._gains, found, pixels = solved.errors(self._pattern)
        if self._problem.pattern:
            self._pattern, self._pixels = found, pixels

    def result(self, here: Linearised, count: int, *, final: bool) -> Fit:
        """Return the fit at the point; ``final`` with the errors and offsets of these equations."""
        nuisances, pattern = self._nuisances, self._pattern
        if final:
            nuisances, flat = here.errors_and_offsets()
            pattern = flat.reshape(pattern.shape) if self._problem.pattern else np.zeros(pattern.shape)
        return Fit(
            start=self._start,
            camera=self._camera,
            scene=self._scene,
            parameters={
                label: nuisances.get(label, 0.0)
                if is_linear(label)
                else value_of(label, self._camera, self._offsets)
                for label in here.labels
            },
            covariance=in_units(here.covariance, here.regressors, self._camera),
            pattern=pattern,
            nuisances=nuisances,
            chi_square=float(here.reduced.square),
            rows=here.reduced.rows,
            converged=self._converged,
            iterations=count,
            equations=here.equations,
            reduced=here.reduced,
            forward=here.forward,
            priors=here.prior,
            at_bounds=here.at_bounds,
            response=self._problem.response,
        )

    def judge(self, best: Fit) -> None:
        """State in the best fit whether the adjustment converged."""
        best.converged = self._converged and not self._stuck
        if self._stuck:
            best.notes.append("the adjustment stopped where no step leads to a possible camera")
        beyond = [i for i, sigmas in best.at_bounds.items() if sigmas > BEYOND_POSSIBLE]
        best.notes += [_AT_A_BOUND.format(list(best.parameters)[i]) for i in beyond]
        if self._converged or not self._last_step:
            return
        sigma = best.sigma
        ratios = {
            path: abs(step) / max(sigma.get(path, 1.0), 1e-300) for path, step in self._last_step.items()
        }
        worst = max(ratios, key=lambda path: ratios[path])
        # where no step lowered the objective, the rest may be rounding
        if not self._exhausted or ratios[worst] > 1:
            best.moving = ratios
            best.notes.append(f"not converged after {best.iterations} iterations: {worst} still moves")
