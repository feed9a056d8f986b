"""Is the result of a calibration one to be used? A file that makes distances worse is not written unasked."""

from __future__ import annotations

from rim_camera_ros.calibrate.held_out import Accuracy
from rim_camera_ros.calibrate.pose_errors import widening_of_poses
from rim_camera_ros.calibrate.problem import Fit
from rim_camera_ros.scene import Scene

#: Ratio of errors after to those before from which on they are worse: offsets of pixels that few poses tell
#: add some of their noise to a file that was right.
WORSE = 1.05
#: Errors of the reference instrument, 1-sigma, by which distances may come to differ more from the scene.
_REFERENCE = 3.0
#: Ratio of the errors of poses to those stated from which on the scene is not what was recorded.
TENFOLD = 10.0
#: Last step of a number of the camera file, in units of its sigma, from which on it has no value yet.
_MOVES = 1.0


def refusals(fitted: Fit, accuracy: Accuracy, stated: Scene) -> list[str]:
    """Return the reasons not to use a calibration, in words; none where it is a good one.

    ``accuracy`` of the poses that it was not fitted to, ``stated`` the scene as its file describes it.
    """
    return [*_unsettled(fitted), *_worse(accuracy), *_widened(fitted, stated)]


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


def _worse(one: Accuracy) -> list[str]:
    whose = f"{one.poses} held-out poses" if one.held_out else "the poses that it was fitted to"
    if one.rigid_after > WORSE * one.rigid_before:
        return [
            f"it does not improve {whose}: {one.rigid_after * 1e3:.2f} mm RMS beside offset and tilts of "
            f"each pose, {one.rigid_before * 1e3:.2f} mm by the file before"
        ]
    if one.after > WORSE * one.before and one.after**2 - one.before**2 > (_REFERENCE * one.reference) ** 2:
        return [
            f"it does not improve {whose}: {one.after * 1e3:.2f} mm RMS against the scene, "
            f"{one.before * 1e3:.2f} mm by the file before, of which the reference instrument explains "
            f"{one.reference * 1e3:.2f} mm"
        ]
    return []


def _widened(fitted: Fit, stated: Scene) -> list[str]:
    result = []
    for surface, ratio in widening_of_poses(stated, fitted.scene).items():
        if ratio >= TENFOLD:
            result.append(
                f"it takes poses of '{surface}' to err {ratio:.0f} times as much as stated: distances, poses "
                "and effects cannot be told apart here"
            )
    return result
