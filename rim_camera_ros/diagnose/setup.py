"""Is it the recording of this scene by this camera at all? Poses that no physics explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.diagnose.hypotheses import LEAST_GAIN
from rim_camera_ros.effects import registry
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.fit.variance_components import WILD
from rim_camera_ros.select.effect_sizes import change_by

Array = NDArray[Any]

#: A pose error beyond this many sigma of its instrument is none: elsewhere it gains what a set-up must.
FAR = float(np.sqrt(2 * LEAST_GAIN))
#: Chi-square per value of a pose that stands out.
LARGE = 10.0
#: A pose is wrong by itself only where it stands out by this factor from four fifths of the others, ...
AGAINST_OTHERS = 4.0
#: ... and where such poses are few: what many poses show is physics.
FEW = 0.15
#: Poses below which none stands out from the others.
_LEAST_POSES = 4
#: Share of the poses that may be left out altogether, or one: the others are diagnosed by themselves.
VERY_FEW = 0.05
#: Factor on these limits where physics was found whose form may be wrong.
_STRAINED = 3.0
#: Share of what did not agree before physics was found, from which on that is no explanation of it.
_HALF = 0.5
#: Chi-square that is left, over that which physics makes in a pose, up to which its form is to blame.
_ACTED_ON = 3.0
#: ... and share of it in the pixels that are moved by so many sigmas, where those are few, above which it is.
_MOSTLY = 0.8
_ACTS = 0.3
_FEW_PIXELS = 0.5
#: Median distance residual [m] and relative amplitude error beyond which nothing fits.
GROSS_DISTANCE = 0.10
GROSS_AMPLITUDE = 0.6
#: Share of the pixels that see a surface in the scene and deliver a distance, below which the scene is wrong;
#: unless what it describes agrees, as a part of what there is.
LEAST_OVERLAP = 0.15


@dataclass(frozen=True)
class PoseCheck:
    """One pose: chi-square per value, its greatest error in sigmas, its median residual [m] and name.

    ``acted_on`` is the chi-square per value that the physics found makes there, ``where_acted_on`` the share
    of the pose's own chi-square that lies in the pixels it acts on, where those are few.
    """

    key: tuple[int, int]
    chi_square: float
    error: float
    error_of: str
    median: float
    time: float
    acted_on: float = 0.0
    where_acted_on: float = 0.0


@dataclass
class _Sums:
    """Over the stations of one pose."""

    time: float
    error: float
    error_of: str
    count: int = 0
    square: float = 0.0
    moved: float = 0.0
    acting: float = 0.0
    medians: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Setup:
    """Poses by how badly they agree, and the ``fault`` for which the setup cannot be trusted (None: it can).

    ``bad`` are the (recording, pose) that alone do not agree, ``remedy`` says what to do about them.
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

    ``physics`` are effects of the camera that were found. Poses stated with the same values share an error.
    """
    worst = errors_of_placements(standard_errors(fitted))
    found: dict[tuple[int, int], _Sums] = {}
    for prediction in fitted.forward.predictions():
        station = prediction.station
        if not prediction.used.any():
            continue
        rest_image, _ = after_nuisances(prediction, fitted.pattern, fitted.nuisances)
        # a handful of pixels, as those that some frames see beyond the ambiguity range, is no other pose
        z = np.clip(rest_image[prediction.used] / prediction.sigma[prediction.used], -WILD, WILD)
        moved = _moved(prediction, physics)[prediction.used]
        acting = np.abs(moved) > _ACTS
        # a few saturated pixels may act on every row, though not in other poses
        bleeding = any(registry()[name].from_saturated for name in physics if name in registry()) and bool(
            (station.saturated > 0).any()
        )
        few = bleeding or acting.mean() < _FEW_PIXELS
        sums = found.setdefault(
            (station.recording, station.pose),
            _Sums(station.time, *worst.get((station.recording, station.placed), (0.0, ""))),
        )
        sums.count += z.size
        sums.square += float(np.sum(z**2))
        sums.moved += float(np.sum(moved**2))
        sums.acting += float(np.sum(z[acting] ** 2)) if few else 0.0
        sums.medians.append(float(np.median(prediction.residual[prediction.used])))
    return [
        PoseCheck(
            key,
            one.square / one.count,
            one.error,
            one.error_of,
            max(one.medians, key=abs),
            one.time,
            one.moved / one.count,
            one.acting / max(one.square, 1e-300),
        )
        for key, one in found.items()
    ]


def errors_of_placements(errors: Mapping[str, float]) -> dict[tuple[int, int], tuple[float, str]]:
    """Return the greatest error of each placement, with surface and direction.

    By the numbers of recording and placement; ``errors`` in sigmas of their instrument as `standard_errors`.
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
    """Return how far effects move distances together, (H, W) in sigmas."""
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
    fitted: Fit, *, explained: float = 0.0, physics: Sequence[str] = (), before: Fit | None = None
) -> Setup:
    """Say whether scene, poses and camera belong to the recording.

    ``fitted`` has the residuals and errors to be judged: where physics was found they are conditional on what
    its forms may do otherwise (`nuisances.conditional_on_physics`).
    ``explained`` is the share of the excess chi-square that the physics found explains: what it explains is
    no fault of the setup. Where ``physics`` was found at all, effects of the camera, its form may be wrong
    enough to strain a few poses: then they must stand out by far more, or already in the fit ``before`` and
    half as far still. They must not be those that it acts on: in which it moves distances by about as much as
    is left, or most of what is left lies where it acts, or which lost half of their chi-square since then.
    """
    poses = check_poses(fitted, physics)
    if not poses:
        return Setup((), "no pixel of the recording can be compared with the scene")
    gross = _gross(fitted, poses)
    if gross is not None:
        return Setup(tuple(poses), None if gross.may_be_physics and explained > 0.5 else gross.fault)
    strained = _STRAINED if physics else 1.0
    bad = _few(poses, strained)
    if physics and before is not None:
        first = {pose.key: pose for pose in check_poses(before)}
        already = {pose_check.key: pose_check.error for pose_check in _few([*first.values()], 1.0)}
        # what was found may strain the others, so that these do not stand out any more
        least = {key: max(_STRAINED * FAR, _HALF * error) for key, error in already.items()}
        left = [pose for pose in poses if pose not in bad and pose.error > least.get(pose.key, np.inf)]
        # what many poses show is physics
        bad += left if len(bad) + len(left) <= _most_few(poses) else []
        before_of = {key: pose_check.chi_square for key, pose_check in first.items()}
        bad = [
            pose_check
            for pose_check in bad
            if pose_check.chi_square > _HALF * before_of.get(pose_check.key, 0.0)
        ]
        bad = [
            pose_check for pose_check in bad if pose_check.error > _STRAINED * FAR or not _by_form(pose_check)
        ]
    if not bad:
        return Setup(tuple(poses), None)
    numbers = ",".join(
        str(pose_check.key[1]) for pose_check in sorted(bad, key=lambda pose_check: pose_check.key)
    )
    return Setup(
        tuple(poses),
        _of_few(bad, len(poses), strained),
        tuple(pose_check.key for pose_check in bad),
        f"--without-poses {numbers} leaves them out",
    )


def _by_form(pose: PoseCheck) -> bool:
    """Return whether the form of what was found is to blame for a pose."""
    return pose.chi_square <= _ACTED_ON * pose.acted_on or pose.where_acted_on > _MOSTLY


class _Gross(NamedTuple):
    """What is grossly wrong, and whether physics that was found may be the cause."""

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
    """Return the poses that do not agree where the most of them do, else none."""
    if len(poses) < _LEAST_POSES:
        return []
    bad = []
    for i, pose in enumerate(poses):
        others = [*poses[:i], *poses[i + 1 :]]
        error = float(np.quantile([other.error for other in others], 0.8))
        typical = float(np.quantile([other.chi_square for other in others], 0.8))
        if (pose.error > factor * FAR and pose.error > factor * AGAINST_OTHERS * error) or (
            pose.chi_square > factor * LARGE and pose.chi_square > factor * AGAINST_OTHERS * typical
        ):
            bad.append(pose)
    return bad if len(bad) <= _most_few(poses) else []


def _most_few(poses: Sequence[PoseCheck]) -> float:
    return max(1.0, FEW * len(poses))


def _of_few(bad: list[PoseCheck], count: int, factor: float) -> str:
    worst = sorted(bad, key=lambda pose_check: -max(pose_check.error, pose_check.chi_square))[:5]
    names = ", ".join(str(pose_check.key[1]) for pose_check in worst)
    first = worst[0]
    detail = (
        f"pose {first.key[1]} at {first.time:.1f} s: {first.error_of.removeprefix('pose.')} is off by "
        f"{first.error:.0f} sigma of its instrument"
        if first.error > factor * FAR
        else f"pose {first.key[1]} at {first.time:.1f} s: chi-square per value {first.chi_square:.1f}"
    )
    return f"{len(bad)} of {count} poses do not agree with the rest ({names}); {detail}"


def standard_errors(fitted: Fit) -> Mapping[str, float]:
    """Return every error found of poses and powers in units of its prior."""
    sigma = {name: prior for fold in fitted.equations.folds for name, prior, _ in fold.nuisances}
    return {name: value / sigma[name] for name, value in fitted.nuisances.items() if name in sigma}
