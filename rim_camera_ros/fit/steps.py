"""Steps of the adjustment: parameters, poses and curves of the light moved within their bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_numbers
from rim_camera_ros.effects.candidate import Regressor
from rim_camera_ros.effects.light_curves import TILES, LightCurves, of_light, tile_labels
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.bounds import Bounds, least_within
from rim_camera_ros.fit.covariate_table import LABEL, with_empirical_changes
from rim_camera_ros.fit.design import GAIN, is_linear
from rim_camera_ros.fit.normal_equations import Reduced
from rim_camera_ros.fit.pose_columns import OPTICAL_AXES
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Scene, ScenePose

Array = NDArray[Any]

#: Least amplitude [m] of a sinusoid in derivatives: at amplitude 0 there is no derivative by its phase.
_LEAST_PHASOR = 1e-8


@dataclass(frozen=True)
class Solved:
    """The point at which a step began, with its equations (``matrix`` and ``right`` with priors, by label).

    ``tau``, ``gains``, ``pixels`` and ``offsets`` are the errors of amplitudes, powers, gains of pixels and
    offsets of parameters there. ``limits`` are how far each parameter may go down (not above 0) and up in one
    step; the others are optimal given those at a limit. ``decrement`` is the forecast decrease of the
    objective by a step without limits and ``damping``; ``holds_shapes`` says that widths and lags of new
    effects are held in the step.
    """

    reduced: Reduced
    labels: Sequence[str]
    matrix: Array
    right: Array
    limits: tuple[Array, Array]
    tau: float
    gains: Mapping[tuple[int, int], float]
    offsets: Mapping[str, float]
    damping: float = 0.0
    pixels: Array | None = None
    decrement: float = 0.0
    holds_shapes: bool = False

    @cached_property
    def step(self) -> Array:
        """The step by equations whose diagonal is larger by the share ``damping`` (Marquardt 1963).

        Damping shortens first the directions that the equations determine least. With infinite damping only
        linear nuisances move; these are always at their optimum.
        """
        if np.isinf(self.damping):
            step, linear = np.zeros_like(self.right), linear_of(self.labels)
            if linear:
                factor = linalg.cho_factor(self.matrix[np.ix_(linear, linear)])
                step[linear] = linalg.cho_solve(factor, self.right[linear])
            return step
        diagonal = np.diag(self.matrix)
        damping = [0.0 if is_linear(label) else self.damping for label in self.labels]
        return least_within(self.matrix + np.diag(damping * diagonal), self.right, *self.limits)[0]

    @property
    def forecast(self) -> float:
        """The forecast decrease of the objective by the step."""
        whole = float(2 * self.right @ self.step - self.step @ self.matrix @ self.step)
        return whole - by_linear(self.matrix, self.right, self.labels)

    @property
    def changes(self) -> dict[str, float]:
        """The step by label, without linear nuisances."""
        pairs = zip(self.labels, self.step.tolist(), strict=True)
        return {label: value for label, value in pairs if not is_linear(label)}

    def errors(
        self, pattern: Array
    ) -> tuple[dict[str, float], dict[tuple[int, int], float], Array, Array | None]:
        """Return errors of poses and set-up, powers, the pattern, and gains of pixels for the step.

        The pattern has the shape of ``pattern``, which is returned where none is estimated.
        """
        values = np.zeros(self.reduced.gram.shape[0])
        values[: len(self.step)] = self.step
        found, flat, more = self.reduced.recover(values)
        pairs = zip(self.labels, self.step.tolist(), strict=True)
        found |= {label: value for label, value in pairs if is_linear(label)}
        pixels = self.pixels
        if more is not None:
            pixels = more.reshape(pattern.shape) + (0.0 if pixels is None else pixels)
        gains = {
            key: g * power_factor(found.get(f"{key[0]}.{key[1]}.gain", 0.0)) for key, g in self.gains.items()
        }
        nuisances = {name: e for name, e in found.items() if not name.endswith(".gain")}
        if flat.size == pattern.size:
            pattern = flat.reshape(pattern.shape)
        return nuisances, gains, pattern, pixels


def linear_of(labels: Sequence[str]) -> list[int]:
    """Return the places of linear nuisances among the labels."""
    return [i for i, label in enumerate(labels) if is_linear(label)]


def by_linear(matrix: Array, right: Array, labels: Sequence[str]) -> float:
    """Return the decrease of chi-square by linear nuisances at their optimum, other parameters at the point.

    Every step moves linear nuisances as well, so objectives of two points can be compared only with them at
    their optimum (variable projection, Golub & Pereyra 1973).
    """
    linear = linear_of(labels)
    if not linear:
        return 0.0
    factor = linalg.cho_factor(matrix[np.ix_(linear, linear)])
    return float(right[linear] @ linalg.cho_solve(factor, right[linear]))


def stepped(
    start: Camera,
    offsets: Mapping[str, float],
    changes: Mapping[str, float],
    bounds: Bounds,
    numbers: Mapping[str, float],
) -> tuple[Camera, dict[str, float]]:
    """Take a step, or the largest part of it, by halving, that leads to a valid camera.

    Amplitude and phase of a sinusoid move as its phasor does: stepped by themselves, an amplitude through 0
    would change its sign, and the phase of a small amplitude would run away. The sign stays that of the
    camera file, the phase within half a period of its phase. Raises `InputError` where not even a thousandth
    of the step leads to a valid camera.
    """
    share = 1.0
    while True:
        moved = dict(offsets)
        for path, change in changes.items():
            moved[path] = moved.get(path, 0.0) + share * change
        for path in changes:
            phase = path.removesuffix("amplitude") + "phase"
            if path != phase and phase in changes:
                begun = numbers[path] + offsets.get(path, 0.0)
                phasor = begun + share * (changes[path] + 1j * begun * changes[phase])
                phasor *= float(np.copysign(1.0, numbers[path]))
                turned = offsets.get(phase, 0.0) + float(np.angle(phasor))
                moved[path] = float(np.copysign(abs(phasor), numbers[path])) - numbers[path]
                moved[phase] = (turned + np.pi) % (2 * np.pi) - np.pi
        try:
            return _moved(start, moved, bounds, numbers), moved
        except (InputError, ValueError):
            share /= 2
            if share < 1e-3:
                raise


def of_phasors(
    regressors: Sequence[Regressor], away: Array, values: Mapping[str, float]
) -> tuple[list[Regressor], Array]:
    """Return regressors and their deviations ``away`` from the priors, with priors on phasors of sinusoids.

    The prior of a sinusoid's phasor is isotropic, with the width of the amplitude's prior: the phase of a
    small one is free. ``values`` are those of amplitudes [m] and phases [rad] by label. In these coordinates,
    which are orthogonal, the prior stays diagonal, exact in value, slope and Gauss-Newton curvature. A prior
    of the phase itself would penalise the turn by pi where an amplitude goes through 0.
    """
    number = {regressor.label: i for i, regressor in enumerate(regressors)}
    found, moved = list(regressors), away.copy()
    for path, i in number.items():
        phase = path.removesuffix("amplitude") + "phase"
        if phase not in number:
            continue
        j = number[phase]
        size = float(np.copysign(max(abs(values[path]), _LEAST_PHASOR), values[path]))
        begun, turn = values[path] - away[i], away[j]
        found[j] = replace(regressors[j], prior=regressors[i].prior / abs(size))
        moved[i] = size - begun * np.cos(turn)
        moved[j] = begun * np.sin(turn) / size
    return found, moved


def power_factor(change: float) -> float:
    """Return the factor on a pose's power for a step of its logarithm."""
    return float(np.exp(np.clip(change, -1.0, 1.0)))


def value_of(path: str, camera: Camera, offsets: Mapping[str, float]) -> float:
    """Return a parameter's value: that of the camera, or the change of one of the scene or of a table."""
    is_change = of_scene(path) or is_linear(path) or path.startswith(LABEL)
    return offsets.get(path, 0.0) if is_change else camera_numbers(camera)[path]


def moved_light(offsets: Mapping[str, float], level: float | None, scene: Scene) -> LightCurves | None:
    """Return the curves of the light in ``offsets``; None: light by Lambert's law and the scene file."""
    values = {path: value for path, value in offsets.items() if of_light(path)}
    tiles = tile_labels(scene) if any(path.startswith(TILES) for path in values) else ()
    if level is not None:
        return LightCurves(values, level, tiles)
    return LightCurves(values, tiles=tiles) if values else None


def in_units(covariance: Array, regressors: Sequence[Any], camera: Camera) -> Array:
    """Convert a covariance of steps to one of parameters: the gain in counts, not its logarithm."""
    scale = np.array([camera.radiometry.gain if regressor.label == GAIN else 1.0 for regressor in regressors])
    return np.asarray(covariance * scale[:, None] * scale[None, :])


def _moved(
    camera: Camera,
    offsets: Mapping[str, float],
    bounds: Bounds,
    numbers: Mapping[str, float],
) -> Camera:
    """Return the camera with its numbers moved, kept within their bounds and within reach."""
    values: dict[str, float] = {}
    for path, offset in offsets.items():
        if of_scene(path) or is_linear(path) or path.startswith(LABEL):
            continue
        value = (
            numbers[path] * float(np.exp(np.clip(offset, -3, 3))) if path == GAIN else numbers[path] + offset
        )
        values[path] = float(np.clip(value, *bounds.range_of(path, numbers[path])))
    return with_empirical_changes(with_numbers(camera, values) if values else camera, offsets)


def moved_scene(scene: Scene, offsets: Mapping[str, float]) -> Scene:
    """Return the scene with its free poses moved."""
    if not any(path.startswith("scene.") for path in offsets):
        return scene
    surfaces = []
    for surface in scene.surfaces:
        pose = surface.pose
        if isinstance(pose, ScenePose) and pose.free:
            shift = [offsets.get(f"scene.{surface.name}.{axis}", 0.0) for axis in "xyz"]
            rotation = rotation_matrix(pose.orientation)
            for name, axis in OPTICAL_AXES.items():
                angle = offsets.get(f"scene.{surface.name}.{name}", 0.0)
                half = np.array(axis) * np.sin(angle / 2)
                turn = rotation_matrix((half[0], half[1], half[2], float(np.cos(angle / 2))))
                rotation = turn @ rotation
            position = (pose.position[0] + shift[0], pose.position[1] + shift[1], pose.position[2] + shift[2])
            pose = replace(pose, position=position, orientation=quaternion(rotation))
        surfaces.append(replace(surface, pose=pose))
    return replace(scene, surfaces=tuple(surfaces))


def moved_from(origin: Camera | None, start: Camera) -> dict[str, float]:
    """Return by path how far numbers of effects and optics of a start are from those of the origin."""
    if origin is None or origin is start:
        return {}
    numbers, centres = camera_numbers(start), camera_numbers(origin)
    moved = {
        path: value - centres[path]
        for path, value in numbers.items()
        if path in centres and path.startswith(("effects.", "optics."))
    }
    turn = 2 * np.pi
    return {
        path: (change + np.pi) % turn - np.pi if path.endswith(".phase") else change
        for path, change in moved.items()
        if change
    }


def of_scene(path: str) -> bool:
    """Whether a parameter belongs to the scene: an error of a pose, or how surfaces reflect."""
    return path.startswith("scene.") or of_light(path)


def within_bounds(offsets: dict[str, float], camera: Camera, numbers: Mapping[str, float]) -> None:
    """Reduce the offsets to those that the camera reached within the bounds of its parameters."""
    reached = camera_numbers(camera)
    for path in offsets:
        if path in numbers and path != GAIN:
            offsets[path] = reached[path] - numbers[path]
