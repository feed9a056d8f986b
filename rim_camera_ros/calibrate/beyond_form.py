"""Has a term of the amplitude the right form? Compared with a smooth curve by held-out poses."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.calibrate.adjustment import fit
from rim_camera_ros.calibrate.empirical_fit import empirical_block, empirical_start
from rim_camera_ros.calibrate.exploration import LEAST_THRESHOLD
from rim_camera_ros.calibrate.problem import Problem, freed
from rim_camera_ros.calibrate.selection import Scores
from rim_camera_ros.calibrate.solution import Solution
from rim_camera_ros.effects import CovariateTable
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.errors import InputError

#: Range of the curve's departures from the form [m] below which it does not matter.
_MATTERS = 0.001
#: Steps of the fit with both: linear equations at a wrong hyperbola do not show the curve.
_ITERATIONS = 6


def beyond_form(problem: Problem, solution: Solution) -> str | None:
    """Return in words by how much a smooth curve fits better than a fitted term of the amplitude.

    None where it does not, where it departs by less than a millimetre, and where there are too few poses to
    hold any out. ``problem`` is that of the solution's fit.
    """
    fitted = solution.fit
    labels = list(fitted.parameters)
    names = [
        name
        for name, one in fitted.camera.effects.items()
        if "amplitude" in one.own_covariates() <= {"amplitude", "settings"}
    ]
    own = [i for i, label in enumerate(labels) if label.startswith(tuple(f"effects.{one}." for one in names))]
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
    # the term stays where it is in these equations, so that the curve is what departs from it
    by_curve = Scores(wide.equations, instead, temper=solution.factor)
    gain = by_curve.held_out() - Scores(wide.equations, base, temper=solution.factor).held_out()
    values = by_curve.values()
    departure = np.array([values[one.label] for one in block.regressors])
    if gain < LEAST_THRESHOLD or np.ptp(departure) < _MATTERS:
        return None
    knots = curve.knots[0]
    low, high = int(np.argmin(departure)), int(np.argmax(departure))
    return (
        f"a smooth curve in amplitude fits held-out poses better than the form of {' and '.join(names)} "
        f"({gain:.0f} nats): it departs by {np.ptp(departure) * 1e3:.1f} mm between {knots[low]:.0f} and "
        f"{knots[high]:.0f} counts; compare with --effects {CovariateTable.name}:amplitude"
    )
