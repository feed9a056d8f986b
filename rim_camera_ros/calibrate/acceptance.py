"""Evidence against a calibration: reasons not to use it, and another form of a term of the amplitude."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.calibrate.effect_status import likelier
from rim_camera_ros.calibrate.held_out import Accuracy
from rim_camera_ros.calibrate.solution import Solution
from rim_camera_ros.effects import CovariateTable
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.covariate_table import empirical_block, empirical_start
from rim_camera_ros.fit.design import COMMON_POSE, common_pose_block
from rim_camera_ros.fit.pose_errors import widening_of_poses
from rim_camera_ros.fit.problem import Fit, Problem, freed
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.evidence import Scores
from rim_camera_ros.select.thresholds import WITHOUT_REPLICATES

#: Ratio of errors after to those before above which they are worse: offsets of pixels that few poses
#: determine add some of their noise to a file that was right.
WORSE = 1.05
#: Errors of the reference instrument, in 1-sigma, by which differences from the scene may increase.
_REFERENCE = 3.0
#: Ratio of the errors of poses to those stated above which the scene is not the one that was recorded.
TENFOLD = 10.0
#: Last step of a number of the camera file, in units of its sigma, above which it has not converged.
_MOVES = 1.0


def refusals(fitted: Fit, accuracy: Accuracy, stated: Scene) -> list[str]:
    """Return the reasons not to use a calibration, in words; none where it is a good one.

    ``accuracy`` is that of held-out poses, ``stated`` the scene as its file describes it.
    """
    return [*_unsettled(fitted), *_worse(accuracy), *_widened(fitted, stated), *_err_alike(fitted, stated)]


def _unsettled(fitted: Fit) -> list[str]:
    own = {
        path: ratio
        for path, ratio in fitted.moving.items()
        if path.startswith(("effects.", "optics.")) and ratio > _MOVES
    }
    if not own:
        return []
    worst = max(own, key=lambda path: own[path])
    return [
        f"it did not converge: the last step moved {worst.removeprefix('effects.')} by "
        f"{own[worst]:.1f} times its standard deviation"
    ]


def _worse(accuracy: Accuracy) -> list[str]:
    whose = f"{accuracy.poses} held-out poses" if accuracy.held_out else "the poses that it was fitted to"
    if accuracy.rigid_after > WORSE * accuracy.rigid_before:
        return [
            f"it does not improve {whose}: {accuracy.rigid_after * 1e3:.2f} mm RMS apart from offset and "
            f"tilts of each pose, {accuracy.rigid_before * 1e3:.2f} mm by the file before"
        ]
    if (
        accuracy.after > WORSE * accuracy.before
        and accuracy.after**2 - accuracy.before**2 > (_REFERENCE * accuracy.reference) ** 2
    ):
        return [
            f"it does not improve {whose}: {accuracy.after * 1e3:.2f} mm RMS against the scene, "
            f"{accuracy.before * 1e3:.2f} mm by the file before, of which the reference instrument explains "
            f"{accuracy.reference * 1e3:.2f} mm"
        ]
    return []


def _widened(fitted: Fit, stated: Scene) -> list[str]:
    result = []
    for surface, ratio in widening_of_poses(stated, fitted.scene).items():
        if ratio >= TENFOLD:
            result.append(
                f"it takes poses of '{surface}' to err {ratio:.0f} times as much as stated: distances, poses "
                "and effects cannot be distinguished here"
            )
    return result


#: Units of a thousandth of an error that poses share (mrad for the others, which are tilts).
_THOUSANDTHS = {"offset": "mm", "scale": "mm/m"}


def _err_alike(fitted: Fit, stated: Scene) -> list[str]:
    """Return which surfaces' poses share an error far beyond the stated one: similar poses allow that."""
    sizes = {regressor.label: regressor.prior for regressor in common_pose_block(stated).regressors}
    worst: dict[str, tuple[float, str]] = {}
    for label, value in fitted.parameters.items():
        if label in sizes:
            surface, _, kind = label.removeprefix(COMMON_POSE).rpartition(".")
            size = f"{abs(value) * 1e3:.2g} {_THOUSANDTHS.get(kind, 'mrad')}"
            worst[surface] = max(worst.get(surface, (0.0, "")), (abs(value) / sizes[label], size))
    return [
        f"it takes all poses of '{surface}' to err alike, by {size}, {ratio:.0f} times as much as stated: "
        "similar poses cannot distinguish that from offsets of the pixels; record other distances and tilts"
        for surface, (ratio, size) in worst.items()
        if ratio >= TENFOLD
    ]


#: Range of the curve's deviations from the form [m] below which they do not matter.
_MATTERS = 0.001
#: Iterations of the fit with both: linear equations at a wrong hyperbola do not show the curve.
_ITERATIONS = 6


def beyond_form(problem: Problem, solution: Solution) -> str | None:
    """Return in words by how much a smooth curve fits better than a fitted term of the amplitude.

    None where it does not, where it deviates by less than a millimetre, and where there are too few poses to
    hold any out. ``problem`` is that of the solution's fit.
    """
    fitted = solution.fit
    labels = list(fitted.parameters)
    names = [
        name
        for name, effect in fitted.camera.effects.items()
        if "amplitude" in effect.own_covariates() <= {"amplitude", "settings"}
    ]
    own = [
        i for i, label in enumerate(labels) if label.startswith(tuple(f"effects.{name}." for name in names))
    ]
    if not own or effect_of(fitted.camera, CovariateTable) or not solution.scores.trained:
        return None
    try:
        curve = empirical_start(fitted.forward, ("amplitude",))
    except InputError:
        return None
    block = empirical_block(curve)
    wide = fit(
        freed(problem, fitted),
        fitted.camera,
        fold_of=solution.folds,
        further=[block],
        views=fitted.forward.views,
        warm=fitted,
        iterations=_ITERATIONS,
    )
    count = len(labels)
    base = range(count)
    instead = [*(i for i in base if i not in own), *range(count, count + len(block.regressors))]
    # the term is held in these equations, so that the curve is the deviation from it
    factor, held = solution.factor, wide.at_bounds
    by_curve = Scores(wide.equations, instead, temper=factor, held=held)
    gain = by_curve.held_out() - Scores(wide.equations, base, temper=factor, held=held).held_out()
    values = by_curve.values()
    departure = np.array([values[regressor.label] for regressor in block.regressors])
    if gain < WITHOUT_REPLICATES or np.ptp(departure) < _MATTERS:
        return None
    knots = curve.knots[0]
    low, high = int(np.argmin(departure)), int(np.argmax(departure))
    return (
        f"a smooth curve in amplitude fits held-out poses better than the form of {' and '.join(names)} "
        f"({likelier(gain)}): it departs by {np.ptp(departure) * 1e3:.1f} mm between {knots[low]:.0f} and "
        f"{knots[high]:.0f} counts; compare with --effects {CovariateTable.name}:amplitude"
    )
