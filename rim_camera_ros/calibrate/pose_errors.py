"""Is the reference instrument as good as the scene file says? Else its errors are taken as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rim_camera_ros.calibrate.adjustment import fit
from rim_camera_ros.calibrate.problem import Fit, Problem
from rim_camera_ros.scene import Scene

#: Errors found in this ratio to those stated count as larger, and poses that it takes to say so.
WIDER = 1.5
LEAST_POSES = 8
_ROUNDS = 5
_TILTS = ("tilt_x", "tilt_y")


def pose_error_ratios(fitted: Fit) -> dict[str, tuple[float, float]]:
    """Return, for each surface, the errors found over those stated: along the normal, and of the tilts.

    By the median, so that single bad poses do not count; 0 for too few poses. What the poses' distances leave
    undetermined makes the ratio smaller, never larger.
    """
    stated = {name: prior for fold in fitted.equations.folds for name, prior, _ in fold.nuisances}
    found: dict[str, tuple[list[float], list[float]]] = {}
    for name, value in fitted.nuisances.items():
        parts = name.split(".", 2)[-1].split(".")
        if parts[0] != "pose" or name not in stated:
            continue
        surface, kind = ".".join(parts[1:-1]), parts[-1]
        lists = found.setdefault(surface, ([], []))
        lists[1 if kind in _TILTS else 0].append(abs(value) / stated[name])

    def ratio(values: list[float], least: int) -> float:
        return 1.4826 * float(np.median(values)) if len(values) >= least else 0.0

    return {
        surface: (ratio(offsets, LEAST_POSES), ratio(tilts, 2 * LEAST_POSES))
        for surface, (offsets, tilts) in found.items()
    }


def with_wider_poses(scene: Scene, fitted: Fit) -> Scene | None:
    """Return the scene with the errors of its poses as large as a fit found them; None: as stated."""
    ratios = pose_error_ratios(fitted)
    if not any(max(pair) > WIDER for pair in ratios.values()):
        return None
    surfaces = []
    for one in scene.surfaces:
        offset, tilt = ratios.get(one.name, (0.0, 0.0))
        sigma = (one.pose_sigma[0] * max(offset, 1.0), one.pose_sigma[1] * max(tilt, 1.0))
        surfaces.append(replace(one, pose_sigma=sigma))
    return replace(scene, surfaces=tuple(surfaces))


def settled_poses(problem: Problem, fitted: Fit) -> Scene | None:
    """Return the scene with errors of poses that agree with what a fit of all effects finds; None: as stated.

    Errors that are held too small come out too small, and so it takes some rounds.
    """
    wider = with_wider_poses(problem.scene, fitted)
    if wider is None:
        return None
    free = replace(problem, effects=None)
    for _ in range(_ROUNDS):
        again = fit(replace(free, scene=wider), fitted.camera, iterations=3)
        further = with_wider_poses(wider, again)
        if further is None:
            break
        wider = further
    return wider


def wider_poses_note(stated: Scene, found: Scene) -> str:
    """Return in words by how much poses err more than the scene file states."""
    parts = [
        f"pose_sigma of '{new.name}' is [{old.pose_sigma[0]:.2g}, {old.pose_sigma[1]:.2g}] in the scene "
        f"file, but "
        f"its poses err by [{new.pose_sigma[0]:.2g}, {new.pose_sigma[1]:.2g}] (m, rad)"
        for old, new in zip(stated.surfaces, found.surfaces, strict=True)
        if old.pose_sigma != new.pose_sigma
    ]
    return "; ".join(parts) + ": that is taken, or the scene is not what the recordings show"
