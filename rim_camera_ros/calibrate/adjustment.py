"""The joint adjustment: damped Gauss-Newton steps over the forward chain, effects and nuisances at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.calibrate.blocks import (
    Block,
    gain_block,
    light_block,
    optics_block,
    pose_block,
    present_blocks,
)
from rim_camera_ros.calibrate.empirical_fit import empirical_block
from rim_camera_ros.calibrate.forward import AmplitudeModel, Forward
from rim_camera_ros.calibrate.light_curves import RESPONSE, RIPPLES, SURFACES
from rim_camera_ros.calibrate.normal_equations import PATTERN_PRIOR, NormalEquations, Reduced, accumulate
from rim_camera_ros.calibrate.residuals import amplitude_error, huber
from rim_camera_ros.calibrate.stations import Dataset
from rim_camera_ros.calibrate.steps import (
    GAIN,
    Solved,
    bounds_of,
    in_units,
    longest_steps,
    moved_light,
    moved_scene,
    of_shape,
    poles_of,
    power_factor,
    stepped,
    value_of,
    within_bounds,
)
from rim_camera_ros.calibrate.views import Views
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_numbers
from rim_camera_ros.effects.base import DistanceTerm
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.scene import Scene, ScenePose

Array = NDArray[Any]

#: How well amplitudes are predicted is estimated anew in this many iterations, then kept.
_SETTLED = 3
_SETTLED_WARM = 1
_SETTLED_NEW = 7
#: Iterations in which the shapes (widths, lags) of effects that are new to a fit are held, and how firmly.
_SHAPES_HELD = 2
_HOLD = 1e9
#: Damping of a step that makes things worse, as shares of the diagonal, one after the other; in the end no
#: step. The step after it is damped alike, and so many times less once one is good at its first try.
_DAMPING = (0.01, 0.1, 1.0, np.inf)
_LESS_DAMPED = 10.0
#: Step of a parameter in units of its sigma, and change of chi-square between two iterations (for that
#: tolerance), below which the adjustment has converged.
TOLERANCE = 0.05
_LEVEL = 0.5

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Problem:
    """What is fitted: the data, the scene, which effects are free, and what else.

    ``effects`` None frees all that the camera has; ``geometry`` names of `library.optics_block` to estimate;
    ``robust`` bounds the weight of outliers; ``pattern`` estimates an offset per pixel;
    ``masks`` restrict the pixels, ``shifts`` stand for another simulation (both as in `Forward`);
    ``stray_light`` [counts] as in `accumulate`; ``reflectance`` estimates how surfaces reflect beside
    Lambert's law, ``response`` [counts] what an `amplitude_nonlinearity` leaves, relative to that level.
    ``pattern_prior`` [m] is the 1-sigma of an offset per pixel. ``variance_factors`` as in `Forward`. The
    effect ``empirical`` is fitted only where ``effects`` names it.
    ``tick`` is called for each station in every pass and may raise to end the work.
    """

    dataset: Dataset
    scene: Scene
    effects: tuple[str, ...] | None = None
    geometry: tuple[str, ...] = ()
    gain: bool = True
    pattern: bool = True
    robust: bool = True
    single: bool = False
    masks: Sequence[tuple[Array, Array]] | None = None
    shifts: Sequence[tuple[Array, Array]] | None = None
    stray_light: float = 0.0
    reflectance: bool = False
    response: float | None = None
    pattern_prior: float = PATTERN_PRIOR
    variance_factors: Mapping[tuple[int, int], float] = field(default_factory=dict)
    tick: Callable[[], None] | None = None


@dataclass
class Fit:
    """The result of an adjustment, from the camera ``start`` to ``camera``.

    ``parameters`` by dotted path (``radiometry.gain`` in counts); ``covariance`` in their order;
    ``pattern`` (H, W) m is what the fixed pattern is beyond the camera file's; ``nuisances`` the errors
    found of poses and powers; ``chi_square`` of all residuals after the fit, prior terms left out, with
    ``rows`` observations. ``equations`` are those at the solution, ``forward`` its predictions.
    """

    start: Camera
    camera: Camera
    scene: Scene
    parameters: dict[str, float]
    covariance: Array
    pattern: Array
    nuisances: dict[str, float]
    chi_square: float
    rows: int
    converged: bool
    iterations: int
    equations: NormalEquations
    reduced: Reduced
    forward: Forward
    priors: Array
    notes: list[str] = field(default_factory=list)

    @property
    def sigma(self) -> dict[str, float]:
        """1-sigma of each parameter."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def fit(
    problem: Problem,
    camera: Camera,
    *,
    fold_of: Mapping[tuple[int, int], int] | None = None,
    further: Sequence[Block] = (),
    iterations: int = 8,
    tolerance: float = TOLERANCE,
    views: Views | None = None,
    warm: Fit | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Adjust a camera's parameters to the data.

    Steps end when no parameter moves by more than ``tolerance`` of its sigma. ``further`` blocks of
    regressors stand beside the parameters in the final equations without being fitted (candidates).
    ``warm`` is a fit of the same data whose pattern, errors and powers are started from; with no
    ``iterations`` the result is its own solution with the equations of the further blocks.

    Raises `RimError` where it does not converge to a finite solution, `InputError` without usable data.
    """
    start = camera
    scene = problem.scene
    moved = False
    pattern, nuisances = np.zeros(camera.shape), dict[str, float]()
    offsets: dict[str, float] = {}
    best: Fit | None = None
    gains: Mapping[tuple[int, int], float] | None = None
    tau = 0.0
    previous = np.inf
    last_step: dict[str, float] = {}
    numbers = camera_numbers(camera)
    lows, highs = bounds_of(camera)
    highs |= poles_of(problem.dataset, problem.masks, camera)
    settled = _SETTLED
    if warm is not None and warm.forward.amplitude_model.gains:
        model = warm.forward.amplitude_model
        tau, pattern = model.tau, warm.pattern
        settled = _settled(warm.camera, camera)
        gains = {
            key: g * power_factor(warm.nuisances.get(f"{key[0]}.{key[1]}.gain", 0.0))
            for key, g in model.gains.items()
        }
        nuisances = {name: e for name, e in warm.nuisances.items() if not name.endswith(".gain")}
        if warm.forward.light_curves is not None:
            allowed = {label for labels in _light_groups(problem, camera) for label in labels}
            offsets.update({k: v for k, v in warm.forward.light_curves.values.items() if k in allowed})
    new = set() if warm is None else camera.effects.keys() - warm.camera.effects.keys()
    trying = warm is not None
    converged = exhausted = stuck = False
    solved: Solved | None = None
    objective, tried, damping = np.inf, 0, 0.0
    for count in range(iterations + 2):
        forward = _forward(problem, scene, camera, None if moved else views, offsets)
        views = forward.views
        if gains is None:
            forward.estimate_amplitudes()
            tau = forward.amplitude_model.tau
            gains = forward.amplitude_model.gains
            if problem.gain and camera.radiometry.gain_sigma == 0 and gains:
                camera = with_numbers(camera, {GAIN: numbers[GAIN] * next(iter(gains.values()))})
                offsets[GAIN] = float(np.log(camera.radiometry.gain / numbers[GAIN]))
                gains = dict.fromkeys(gains, 1.0)
                forward = _forward(problem, scene, camera, forward.views, offsets)
        elif count <= settled and iterations:
            forward.amplitude_model = AmplitudeModel(dict(gains), tau)
            tau = amplitude_error(forward, nuisances)
        forward.amplitude_model = AmplitudeModel(dict(gains), tau)
        blocks = _blocks(problem, camera, scene)
        owned = sum(len(block.regressors) for block in blocks)
        weigh = huber(pattern, nuisances) if problem.robust and (count > 0 or warm is not None) else None
        final = count >= iterations or converged or exhausted
        equations = accumulate(
            forward,
            [*blocks, *further] if final else blocks,
            fold_of=fold_of if final else None,
            pattern=problem.pattern,
            weigh=weigh,
            single=problem.single,
            stray_light=problem.stray_light,
            pattern_prior=problem.pattern_prior,
        )
        if not equations.folds or equations.folds[0].rows == 0:
            raise InputError(
                "no pixel can be used: nothing of the recording agrees with scene and camera file",
                remedy="check that the scene file describes the recording (rim info BAG lists its poses)",
            )
        reduced = equations.reduced()
        regressors = equations.regressors[:owned]
        prior = np.array([one.prior for one in regressors])
        away = np.array([offsets.get(one.label, 0.0) for one in regressors])
        own = slice(0, owned)
        matrix = reduced.gram[own, own] + np.diag(prior**-2)
        held = [i for i, one in enumerate(regressors) if of_shape(one.label) and one.owner in new]
        if count < _SHAPES_HELD:
            # from a linear guess the strengths come first: shapes would leave for good
            matrix[held, held] *= _HOLD
        right = reduced.right[own] - away / prior**2
        factor = linalg.cho_factor(matrix)
        step = linalg.cho_solve(factor, right)
        covariance = linalg.cho_solve(factor, np.eye(owned))
        sigma = np.sqrt(np.diag(covariance))
        here = float(reduced.square) + float(np.sum((away / prior) ** 2))
        reached = here + 2 * reduced.log_norm
        worse = trying and reached > objective + _LEVEL and tried < len(_DAMPING) and count <= iterations
        if worse and solved is not None:
            # the step went too far: a shorter one from where it began, or none where no more may be tried
            tried = len(_DAMPING) if final else tried + 1
            damping = max(_DAMPING[tried - 1], damping * _LESS_DAMPED)
            solved = replace(solved, damping=damping)
            try:
                camera, offsets = stepped(start, solved.offsets, solved.changes, lows, highs, numbers)
            except (InputError, ValueError):
                # another direction may lead to no possible camera: where it began is one
                damping, solved = np.inf, replace(solved, damping=np.inf)
                camera, offsets = stepped(start, solved.offsets, solved.changes, lows, highs, numbers)
            within_bounds(offsets, camera, numbers)
            scene, moved = moved_scene(problem.scene, offsets)
            tau = solved.tau
            nuisances, gains, found = solved.errors(pattern)
            pattern = found if problem.pattern else pattern
            exhausted |= bool(np.isinf(damping))
            continue
        if tried == 0:
            damping = damping / _LESS_DAMPED if damping > _DAMPING[0] else 0.0
        objective, tried = reached, 0
        best = Fit(
            start=start,
            camera=camera,
            scene=scene,
            parameters={one.label: value_of(one.label, camera, offsets) for one in regressors},
            covariance=in_units(covariance, regressors, camera),
            pattern=pattern,
            nuisances=nuisances,
            chi_square=float(reduced.square),
            rows=reduced.rows,
            converged=converged,
            iterations=count,
            equations=equations,
            reduced=reduced,
            forward=forward,
            priors=prior,
        )
        if final:
            values = np.zeros(len(equations.regressors))
            best.nuisances, flat = reduced.recover(values)
            best.pattern = flat.reshape(camera.shape) if problem.pattern else np.zeros(camera.shape)
            break
        if progress is not None:
            progress(f"iteration {count + 1}: chi-square per value {here / max(reduced.rows, 1):.4f}")
        if not np.all(np.isfinite(step)):
            raise RimError("the adjustment found no finite solution", remedy="check scene and camera file")
        labels = [one.label for one in regressors]
        most = longest_steps(labels, offsets, numbers)
        before = dict(offsets)
        solved = Solved(reduced, labels, matrix, right, most, tau, dict(gains), before, damping)
        nuisances, gains, found = solved.errors(pattern)
        pattern = found if problem.pattern else pattern
        converged = bool(np.all(np.abs(step) <= tolerance * sigma)) if owned else True
        converged &= not held or count >= _SHAPES_HELD
        # parameters that the data hardly tell apart wander along a valley whose floor is level
        converged |= (
            damping == 0
            and count >= min(settled, _SETTLED)
            and abs(previous - here) < _LEVEL * (tolerance / TOLERANCE) ** 2
        )
        previous = here
        try:
            camera, offsets = stepped(start, offsets, solved.changes, lows, highs, numbers)
        except (InputError, ValueError):
            stuck = converged = True
            continue
        within_bounds(offsets, camera, numbers)
        scene, moved = moved_scene(problem.scene, offsets)
        last_step = solved.changes
    assert best is not None
    best.converged = converged and not stuck
    if stuck:
        best.notes.append("the adjustment stopped where no step leads to a possible camera")
    if not converged and last_step:
        ratios = {path: abs(last_step[path]) / max(best.sigma.get(path, 1.0), 1e-300) for path in last_step}
        worst = max(ratios, key=lambda path: ratios[path])
        # where no step made it better rounding may be all that is left
        if not exhausted or ratios[worst] > 1:
            best.notes.append(f"not converged after {best.iterations} iterations: {worst} still moves")
    return best


def _settled(warm: Camera, camera: Camera) -> int:
    """Return until which iteration it is estimated anew how well amplitudes are predicted."""
    if keeps_amplitude_error(warm, camera):
        return -1
    return _SETTLED_NEW if warm.effects.keys() ^ camera.effects.keys() else _SETTLED_WARM


def keeps_amplitude_error(warm: Camera, camera: Camera) -> bool:
    """Return whether a fit keeps how well another predicts amplitudes: where new effects bend distances.

    Then likelihoods are those of the same noise.
    """
    new = [camera.effects[name] for name in camera.effects.keys() - warm.effects.keys()]
    return bool(new) and all(isinstance(one, DistanceTerm) for one in new)


def freed(problem: Problem, fitted: Fit) -> Problem:
    """Return the problem in which exactly what a fit has estimated, of effects and light, is free."""
    names = {path.split(".")[1] for path in fitted.parameters if path.startswith("effects.")}
    curves = fitted.forward.light_curves
    return replace(
        problem,
        effects=tuple(sorted(names)),
        reflectance=curves is not None and not curves.values.keys().isdisjoint(SURFACES),
        response=curves.level if curves is not None and curves.responds else None,
    )


def _forward(
    problem: Problem, scene: Scene, camera: Camera, views: Views | None, offsets: Mapping[str, float]
) -> Forward:
    forward = Forward(problem.dataset, scene, camera, views=views)
    forward.masks, forward.shifts, forward.tick = problem.masks, problem.shifts, problem.tick
    forward.variance_factors = problem.variance_factors
    forward.light_curves = moved_light(offsets, problem.response)
    return forward


def _light_groups(problem: Problem, camera: Camera) -> list[tuple[str, ...]]:
    """Return the curves of the light that are fitted beside the camera."""
    groups = [RIPPLES] if problem.gain else []
    if problem.reflectance:
        groups.append(SURFACES)
    if problem.response is not None and "amplitude_nonlinearity" in camera.effects:
        groups.append(RESPONSE)
    return groups


def _blocks(problem: Problem, camera: Camera, scene: Scene) -> list[Block]:
    blocks = present_blocks(camera, effects=problem.effects)
    empirical: Any = camera.effects.get("empirical")
    if empirical is not None and problem.effects is not None and "empirical" in problem.effects:
        blocks.append(empirical_block(empirical))
    if problem.gain:
        blocks.append(gain_block())
    blocks += [optics_block(camera, name) for name in problem.geometry]
    blocks += [light_block(labels) for labels in _light_groups(problem, camera)]
    free = [
        (f"scene.{one.name}.{axis}", 1.0 if axis in "xyz" else 0.3)
        for one in scene.surfaces
        if isinstance(one.pose, ScenePose)
        for axis in one.pose.free
    ]
    if free:
        blocks.append(pose_block(free))
    return blocks
