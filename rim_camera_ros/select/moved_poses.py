"""Surfaces that are displaced from their stated poses in a few poses, by the evidence of all data.

The errors of a pose are random effects of a stated size. The gain of a pose is the logarithm of a Bayes
factor (Kass & Raftery 1995): the marginal likelihood of all data with that size a hundred times larger for
this pose over that with the stated size, everything else integrated out. Its penalty for the wider prior is
about 14 nats for an offset and two tilts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.fit.normal_equations import determined
from rim_camera_ros.fit.pixel_elimination import stacked, without_pixels
from rim_camera_ros.select.evidence import Scores
from rim_camera_ros.select.exploration import Exploration

Array = NDArray[Any]
Key = tuple[int, int]

#: Factor on the stated errors of a pose that was moved: 0.1 m where the instrument is good to a millimetre.
#: Another power of ten changes the gain of three errors by 7 nats.
FREEDOM = 100.0


@dataclass(frozen=True)
class MovedPose:
    """A surface that is displaced in one placement of a recording: the ``gain`` of that [nats].

    ``errors`` by direction (``offset`` along the normal, away from the camera [m], ``tilt_x``, ``tilt_y``
    [rad]). With a stated covariance each is without the part that is correlated with those before it.
    ``sigmas`` is the greatest of them in stated sigmas.
    """

    placement: Key
    surface: str
    gain: float
    errors: tuple[tuple[str, float], ...]
    sigmas: float

    @property
    def sentence(self) -> str:
        """The displacement, in words."""
        parts = [
            f"{abs(value) * 1e3:.1f} mm {'farther' if value > 0 else 'nearer'} along its normal"
            if direction == "offset"
            else f"tilted by {abs(value) * 1e3:.1f} mrad about {direction.removeprefix('tilt_')}"
            for direction, value in self.errors
        ]
        return f"'{self.surface}' stands {', '.join(parts)}"


def moved_poses(
    scores: Scores, extra: Iterable[int] = (), *, least_gain: float, most: int
) -> list[MovedPose]:
    """Return the surfaces that are displaced in a pose, each conditional on those before, the best first.

    They are conditional on the ``extra`` regressors as well. Each gains at least ``least_gain`` nats; they
    are of ``most`` placements at most.
    """
    scores = scores.likeliest(extra)
    equations, columns = scores.equations, scores.columns(extra)
    count = len(equations.regressors)
    sums = without_pixels(equations.folds, count, equations.pixels)
    _, nuisances = stacked(equations.folds, count)
    chosen = np.r_[columns, count + np.arange(len(nuisances))]
    prior = np.r_[scores.prior[columns], [sigma for _, sigma, _ in nuisances]]
    away = np.r_[scores.away[columns], [at for _, _, at in nuisances]]
    unit = np.hypot(np.sqrt(sums.diagonal[chosen] / scores.temper), 1.0 / prior)
    gram, directions = determined(sums.gram[np.ix_(chosen, chosen)] / scores.temper, unit)
    right = directions(sums.gram[chosen, -1] / scores.temper) - away / prior**2
    groups: dict[tuple[Key, str], list[int]] = {}
    for number, (name, _, _) in enumerate(nuisances, len(columns)):
        recording, placed, kind, *rest = name.split(".")
        if kind == "pose":
            groups.setdefault(((int(recording), int(placed)), ".".join(rest[:-1])), []).append(number)
    names = {number: name.rsplit(".", 1)[1] for number, (name, _, _) in enumerate(nuisances, len(columns))}
    precision = prior**-2
    found: dict[tuple[Key, str], float] = {}
    while True:
        covariance, mean = _posterior(gram, precision, right)
        gains = {
            key: _gain(covariance[np.ix_(own, own)], mean[own], precision[own])
            for key, own in groups.items()
            if key not in found
        }
        best = max(gains, key=lambda key: gains[key], default=None)
        if best is None or gains[best] < least_gain or len({key for key, _ in (*found, best)}) > most:
            break
        found[best] = gains[best]
        precision[groups[best]] /= FREEDOM**2
    return [
        MovedPose(
            placement=key[0],
            surface=key[1],
            gain=gain,
            errors=tuple((names[i], float(mean[i])) for i in groups[key]),
            sigmas=float(np.max(np.abs(mean[groups[key]]) / prior[groups[key]])),
        )
        for key, gain in found.items()
    ]


@dataclass(frozen=True)
class MayHaveMoved:
    """How many placements may be displaced, ``most``, and the least that each surface must gain [nats]."""

    most: int
    least_gain: float


#: No surface may be displaced.
NONE_MOVED = MayHaveMoved(0, np.inf)


def moved_before_physics(step: Exploration, may: MayHaveMoved) -> list[MovedPose]:
    """Return the displaced surfaces where they explain more than any physics does; none otherwise.

    They must gain ``may.least_gain`` more than the best candidate, smooth function or pair of effects.
    """
    found = moved_poses(step.conditional, least_gain=may.least_gain, most=may.most)
    pair = step.best_pair() if found else None
    rivals = [0.0, *step.gains.tolist(), *([] if pair is None else pair[:1])]
    return found if total_gain(found) > max(rivals) + may.least_gain else []


def moved_given_physics(
    step: Exploration, may: MayHaveMoved, *, extra: Sequence[int] = ()
) -> list[MovedPose]:
    """Return the displaced surfaces conditional on the physics found and on changes of its forms.

    They are conditional on ``extra`` regressors as well. None where more than ``may.most`` placements are
    displaced: what many poses show is physics.
    """
    found = moved_poses(step.conditional, extra, least_gain=may.least_gain, most=may.most + 1)
    return found if len({pose.placement for pose in found}) <= may.most else []


def total_gain(poses: Sequence[MovedPose]) -> float:
    """Return the total gain of displaced surfaces [nats]."""
    return sum(pose.gain for pose in poses)


def _posterior(gram: Array, precision: Array, right: Array) -> tuple[Array, Array]:
    matrix = gram + np.diag(precision)
    unit = 1.0 / np.sqrt(np.diag(matrix))
    factor = linalg.cho_factor(matrix * np.outer(unit, unit), check_finite=False)
    covariance = linalg.cho_solve(factor, np.eye(len(unit)), check_finite=False) * np.outer(unit, unit)
    return covariance, covariance @ right


def _gain(covariance: Array, mean: Array, precision: Array) -> float:
    """Return the log Bayes factor of a prior of some unknowns that is `FREEDOM` times wider, to theirs."""
    narrow = np.linalg.inv(covariance)
    wide = narrow - np.diag(precision) * (1 - FREEDOM**-2)
    right = narrow @ mean
    determinants = np.linalg.slogdet(narrow)[1] - np.linalg.slogdet(wide)[1]
    squares = right @ np.linalg.solve(wide, right) - right @ mean
    return float(0.5 * (determinants + squares) - len(mean) * np.log(FREEDOM))
