"""Whether the recording is of this scene by this camera at all: poses that no physics explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.diagnose.hypotheses import LEAST_GAIN
from rim_camera_ros.diagnose.nuisances import MOST_NAMED
from rim_camera_ros.effects import registry
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.fit.variance_components import WILD
from rim_camera_ros.select.candidates import SHARE
from rim_camera_ros.select.effect_sizes import change_by
from rim_camera_ros.select.moved_poses import MayHaveMoved, MovedPose
from rim_camera_ros.select.thresholds import FEW

Array = NDArray[Any]

#: Chi-square per value of a pose that stands out.
LARGE = 10.0
#: Ratio of a pose's chi-square to that of four fifths of the others above which it is wrong by itself,
#: if such poses are no more than `FEW`: what many poses show is physics.
AGAINST_OTHERS = 4.0
#: Poses below which none stands out from the others.
_LEAST_POSES = 4
#: Share of the poses (one pose at least) that may be excluded; the others are then diagnosed.
VERY_FEW = 0.05
#: Factor on the limits of chi-square where physics was found whose form may be wrong.
_STRAINED = 3.0
#: Share of a pose's chi-square before physics was found that must remain, or the physics has explained it.
_HALF = 0.5
#: Ratio of a pose's chi-square to that by physics in it, up to which the form of that physics is to blame.
_ACTED_ON = 3.0
#: ... and share of the chi-square in pixels that physics moves by `_ACTS` sigmas, above which it is to blame,
#: if such pixels are less than `_FEW_PIXELS` of all.
_MOSTLY = 0.8
_ACTS = 0.3
_FEW_PIXELS = 0.5
#: Median distance residual [m] and relative amplitude error beyond which nothing fits.
GROSS_DISTANCE = 0.10
GROSS_AMPLITUDE = 0.6
#: Share of the measured pixels that see a surface of the scene, below which the scene is wrong; unless the
#: part that it describes agrees.
LEAST_OVERLAP = 0.15


@dataclass(frozen=True)
class PoseCheck:
    """One pose: chi-square per value given its errors, its median residual [m] and its time [s].

    ``acted_on`` is the mean square of the changes by the physics found, in sigmas; ``where_acted_on`` is the
    share of the pose's chi-square in the pixels on which that physics acts, where those are few; ``values``
    is the number of its distances.
    """

    key: tuple[int, int]
    chi_square: float
    median: float
    time: float
    acted_on: float = 0.0
    where_acted_on: float = 0.0
    values: int = 0


@dataclass
class _Sums:
    """Sums over the stations of one pose."""

    time: float
    count: int = 0
    square: float = 0.0
    moved: float = 0.0
    acting: float = 0.0
    medians: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Setup:
    """The checks of poses, and the ``fault`` for which the set-up cannot be trusted (None: it can).

    ``bad`` are the numbers (recording, pose) of single poses that do not agree, ``remedy`` says what to do.
    """

    poses: tuple[PoseCheck, ...]
    fault: str | None
    bad: tuple[tuple[int, int], ...] = ()
    remedy: str = ""

    @property
    def reason(self) -> str | None:
        """The fault and its remedy in words."""
        return f"{self.fault}; {self.remedy}" if self.fault and self.remedy else self.fault

    @property
    def chi_square(self) -> float:
        """Mean chi-square per distance over the poses, after the fit."""
        return float(np.mean([pose.chi_square for pose in self.poses])) if self.poses else 1.0


def check_poses(fitted: Fit, physics: Sequence[str] = ()) -> list[PoseCheck]:
    """Return how well each pose agrees with a fit, after the errors of poses and the fixed pattern.

    ``physics`` are effects of the camera that were found.
    """
    found: dict[tuple[int, int], _Sums] = {}
    for prediction in fitted.forward.predictions():
        station = prediction.station
        if not prediction.used.any():
            continue
        rest_image, _ = after_nuisances(prediction, fitted.pattern, fitted.nuisances)
        # clipped: a few pixels, as those that some frames see beyond the ambiguity range, make no other pose
        z = np.clip(rest_image[prediction.used] / prediction.sigma[prediction.used], -WILD, WILD)
        moved = _moved(prediction, physics)[prediction.used]
        acting = np.abs(moved) > _ACTS
        # a few saturated pixels may act on every row, though not in other poses
        bleeding = any(registry()[name].from_saturated for name in physics if name in registry()) and bool(
            (station.saturated > 0).any()
        )
        few = bleeding or acting.mean() < _FEW_PIXELS
        sums = found.setdefault((station.recording, station.pose), _Sums(station.time))
        sums.count += z.size
        sums.square += float(np.sum(z**2))
        sums.moved += float(np.sum(moved**2))
        sums.acting += float(np.sum(z[acting] ** 2)) if few else 0.0
        sums.medians.append(float(np.median(prediction.residual[prediction.used])))
    return [
        PoseCheck(
            key,
            sums.square / sums.count,
            max(sums.medians, key=abs),
            sums.time,
            sums.moved / sums.count,
            sums.acting / max(sums.square, 1e-300),
            sums.count,
        )
        for key, sums in found.items()
    ]


def errors_of_placements(errors: Mapping[str, float]) -> dict[tuple[int, int], tuple[float, str]]:
    """Return the greatest error of each placement, with surface and direction, by recording and placement.

    ``errors`` are in sigmas of their instrument, as those of `standard_errors`.
    """
    worst: dict[tuple[int, int], tuple[float, str]] = {}
    for name, value in errors.items():
        recording, placed, rest = name.split(".", 2)
        key = (int(recording), int(placed))
        if rest.startswith(("pose.", "scene.")) and abs(value) > worst.get(key, (0.0, ""))[0]:
            worst[key] = (abs(value), rest)
    return worst


def errors_of_poses(fitted: Fit) -> dict[tuple[int, int], float]:
    """Return the greatest error of each pose in sigmas of its instrument, by recording and pose."""
    worst = errors_of_placements(standard_errors(fitted))
    return {
        (station.recording, station.pose): worst.get((station.recording, station.placed), (0.0, ""))[0]
        for station in fitted.forward.dataset.stations
    }


def _moved(prediction: Prediction, physics: Sequence[str]) -> Array:
    """Return the total change of distances by effects, (H, W) in sigmas."""
    total: Any = np.zeros(prediction.used.shape)
    for name in physics:
        if name in prediction.context.camera.effects:
            total = total + np.nan_to_num(change_by(prediction, name)[0]) / prediction.sigma
    return np.asarray(total)


def overlap(fitted: Fit) -> float:
    """Return the share of the pixels with a measurement at which the scene has a surface."""
    both = measured = 0
    for prediction in fitted.forward.predictions(slopes=False):
        valid = prediction.station.count > 0
        measured += int(valid.sum())
        both += int((valid & prediction.view.geometry.hit).sum())
    return both / measured if measured else 0.0


def check_setup(
    fitted: Fit,
    *,
    explained: float = 0.0,
    physics: Sequence[str] = (),
    before: Fit | None = None,
    moved: Sequence[MovedPose] = (),
    form_size: float = SHARE,
) -> Setup:
    """Return whether scene, poses and camera belong to the recording.

    ``fitted`` has the residuals and errors to be judged. Where physics was found they are conditional on
    changes of its forms (`nuisances.conditional_on_physics`). ``moved`` are displaced surfaces; they count
    where they gain more than a change of that physics' form by ``form_size``, as a share of it, would there.
    ``explained`` is the share of the excess chi-square that the physics explains: this share is no fault of
    the set-up. ``physics`` are effects of the camera that were found. Their forms may be inexact enough to
    disturb a few poses, so that a pose must then stand out by far more. Nor do poses count on which the
    physics acts: it moves their distances by about as much as the remaining misfit, or most of that is in
    the pixels where it acts, or it has removed half of their chi-square since the fit ``before``.
    """
    poses = check_poses(fitted, physics)
    if not poses:
        return Setup((), "no pixel of the recording can be compared with the scene")
    gross = _gross(fitted, poses)
    if gross is not None:
        return Setup(tuple(poses), None if gross.may_be_physics and explained > 0.5 else gross.fault)
    stations = fitted.forward.dataset.stations
    moved = _not_by_form(moved, poses, stations, form_size)
    elsewhere = {pose.placement for pose in moved}
    keys = {
        (station.recording, station.pose)
        for station in stations
        if (station.recording, station.placed) in elsewhere
    }
    before_of = {pose.key: pose.chi_square for pose in check_poses(before)} if physics and before else {}
    uneven = [
        pose
        for pose in _few(poses, _STRAINED if physics else 1.0)
        if pose.key not in keys and not (physics and _by_form(pose))
        if pose.chi_square > _HALF * before_of.get(pose.key, 0.0)
    ]
    if len(keys) + len(uneven) > _most_few(len(poses)):
        uneven = []
    bad = tuple(sorted({*keys, *(pose.key for pose in uneven)}))
    if not bad:
        return Setup(tuple(poses), None)
    numbers = ",".join(str(number) for _, number in bad)
    worst = max(moved, key=lambda pose: pose.gain, default=None)
    if worst is None:
        first = max(uneven, key=lambda pose: pose.chi_square)
        detail = f"pose {first.key[1]} at {first.time:.1f} s: chi-square per value {first.chi_square:.1f}"
    else:
        number, time = next(
            (station.pose, station.time)
            for station in stations
            if (station.recording, station.placed) == worst.placement
        )
        detail = f"pose {number} at {time:.1f} s: {worst.sentence}"
    names = ", ".join(numbers.split(",")[:MOST_NAMED])
    return Setup(
        tuple(poses),
        f"{len(bad)} of {len(poses)} poses do not agree with the rest ({names}); {detail}",
        bad,
        f"--without-poses {numbers} excludes them",
    )


def _not_by_form(
    moved: Sequence[MovedPose], poses: Sequence[PoseCheck], stations: Sequence[Station], size: float
) -> list[MovedPose]:
    """Return the poses that gain more than an error of the physics' form of the relative ``size`` explains.

    That is half the chi-square of such an error in the pose. The fit contains smooth changes of the form
    alone, of others only the size is known.
    """
    acted = {pose.key: pose.acted_on * pose.values for pose in poses}
    by_placement: dict[tuple[int, int], float] = {}
    for placement, key in {
        ((station.recording, station.placed), (station.recording, station.pose)) for station in stations
    }:
        by_placement[placement] = by_placement.get(placement, 0.0) + acted.get(key, 0.0)
    return [pose for pose in moved if pose.gain > 0.5 * size**2 * by_placement.get(pose.placement, 0.0)]


def _by_form(pose: PoseCheck) -> bool:
    """Return whether an inexact form of the physics found explains the misfit of a pose."""
    return pose.chi_square <= _ACTED_ON * pose.acted_on or pose.where_acted_on > _MOSTLY


class _Gross(NamedTuple):
    """A gross fault, and whether physics that was found may be its cause."""

    fault: str
    may_be_physics: bool


def _gross(fitted: Fit, poses: list[PoseCheck]) -> _Gross | None:
    median = float(np.median([abs(pose.median) for pose in poses]))
    spread = float(np.std([pose.median for pose in poses]))
    chi_square = float(np.median([pose.chi_square for pose in poses]))
    share = overlap(fitted)
    if share < LEAST_OVERLAP and chi_square > LARGE:
        return _Gross(
            f"only {share:.0%} of the measured pixels see a surface of the scene: the scene file does not "
            "describe this recording",
            may_be_physics=True,
        )
    if chi_square > 50 and (spread > GROSS_DISTANCE or median > 3 * GROSS_DISTANCE):
        return _Gross(
            f"distances differ from the scene's by {median:.2f} m (varying by {spread:.2f} m from pose to "
            "pose) and no physics of a camera explains it: another scene, or poses of another recording",
            may_be_physics=False,
        )
    tau = fitted.forward.amplitude_model.tau
    if tau > GROSS_AMPLITUDE:
        return _Gross(
            f"amplitudes differ from the scene's by a factor of {np.exp(tau):.1f} from pixel to pixel: a "
            "board was swapped or turned, or the scene's reflectivities are others",
            may_be_physics=True,
        )
    return None


def _few(poses: list[PoseCheck], factor: float) -> list[PoseCheck]:
    """Return the poses whose chi-square stands out, if they are few; else none."""
    if len(poses) < _LEAST_POSES:
        return []
    bad = []
    for i, pose in enumerate(poses):
        others = [*poses[:i], *poses[i + 1 :]]
        typical = float(np.quantile([other.chi_square for other in others], 0.8))
        if pose.chi_square > factor * LARGE and pose.chi_square > factor * AGAINST_OTHERS * typical:
            bad.append(pose)
    return bad if len(bad) <= _most_few(len(poses)) else []


def few_of(dataset: Dataset) -> MayHaveMoved:
    """Return in how many placements a surface may be displaced; none where there are too few placements."""
    return MayHaveMoved(_most_few(dataset.placements), LEAST_GAIN)


def _most_few(poses: int) -> int:
    return max(1, int(FEW * poses)) if poses >= _LEAST_POSES else 0


def standard_errors(fitted: Fit) -> Mapping[str, float]:
    """Return every estimated error of poses and powers in units of its prior."""
    sigma = {name: prior for fold in fitted.equations.folds for name, prior, _ in fold.nuisances}
    return {name: value / sigma[name] for name, value in fitted.nuisances.items() if name in sigma}
