"""Errors of poses that a fit finds to be larger than scene files or recordings state."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.frame import Pose
from rim_camera_ros.scene import Scene, Surface

#: Ratio of the errors found to those stated above which they count as larger, and least number of poses.
WIDER = 1.5
LEAST_POSES = 8
#: Rounds of widening, at most.
_ROUNDS = 8
_TILTS = ("tilt_x", "tilt_y")


@dataclass(frozen=True)
class WiderSurface(Surface):
    """A surface whose recorded poses have larger errors than stated, by ``factors`` (normal, tilt)."""

    factors: tuple[float, float] = (1.0, 1.0)

    def pose_covariance(self, pose: Pose) -> NDArray[np.float64]:
        covariance = super().pose_covariance(pose)
        if pose.covariance is None:
            return covariance
        wider = np.array([self.factors[0], self.factors[1], self.factors[1]])
        return covariance * np.outer(wider, wider)


def _wider(plane: Surface, offset: float, tilt: float, *, own: bool) -> Surface:
    """Return the surface with larger errors of its poses; ``own``: its recorded poses bring a covariance."""
    sigma = (plane.pose_sigma[0] * offset, plane.pose_sigma[1] * tilt)
    if not own:
        return replace(plane, pose_sigma=sigma)
    before = plane.factors if isinstance(plane, WiderSurface) else (1.0, 1.0)
    values = {field.name: getattr(plane, field.name) for field in fields(Surface)} | {"pose_sigma": sigma}
    return WiderSurface(**values, factors=(before[0] * offset, before[1] * tilt))


def pose_error_ratios(fitted: Fit) -> dict[str, tuple[float, float]]:
    """Return, for each surface, the ratios of errors found to those stated: along the normal, and of tilts.

    They are from medians, so that single bad poses do not count; 0 for too few poses. Errors that the
    distances do not determine make a ratio smaller, never larger.
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
    stations = fitted.forward.dataset.stations
    own = {
        name for station in stations for name, pose in station.truth.items() if pose.covariance is not None
    }
    surfaces = []
    for surface in scene.surfaces:
        offset, tilt = (max(ratio, 1.0) for ratio in ratios.get(surface.name, (1.0, 1.0)))
        surfaces.append(_wider(surface, offset, tilt, own=surface.name in own))
    return replace(scene, surfaces=tuple(surfaces))


def settled_poses(problem: Problem, fitted: Fit) -> Scene | None:
    """Return the scene with errors of poses that agree with those found by a fit of all effects.

    None where they are as stated. It takes some rounds: priors that are too narrow make errors too small.
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


def widening_of_poses(stated: Scene, found: Scene) -> dict[str, float]:
    """Return, by surface, how many times larger than stated errors of poses were found, where they were."""
    result = {}
    for old, new in zip(stated.surfaces, found.surfaces, strict=True):
        ratios = [
            after / before for before, after in zip(old.pose_sigma, new.pose_sigma, strict=True) if before
        ]
        if isinstance(new, WiderSurface):
            ratios = list(new.factors)
        if max(ratios, default=1.0) > 1.0:
            result[new.name] = max(ratios)
    return result


def wider_poses_note(stated: Scene, found: Scene) -> str:
    """Return in words how much larger the errors of poses are than stated."""
    parts = [
        f"poses of '{new.name}' err by {new.factors[0]:.2g} (along the normal) and {new.factors[1]:.2g} "
        "(tilt) times what the recording states with them"
        if isinstance(new, WiderSurface)
        else f"pose_sigma of '{new.name}' is [{old.pose_sigma[0]:.2g}, {old.pose_sigma[1]:.2g}] in the scene "
        f"file, but "
        f"its poses err by [{new.pose_sigma[0]:.2g}, {new.pose_sigma[1]:.2g}] (m, rad)"
        for old, new in zip(stated.surfaces, found.surfaces, strict=True)
        if old.pose_sigma != new.pose_sigma
    ]
    return "; ".join(parts) + ": that is taken, or the scene is not what the recordings show"
