"""The set-ups that are tried, and the changes that make the files of each from those given."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.hypotheses import DEPTH, Change, Files, Hypothesis, Trial
from rim_camera_ros.diagnose.other_readings import (
    along_the_ray,
    falloff,
    times,
    to_amplitudes,
    to_distances,
)
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.views import Views
from rim_camera_ros.frame import Pose
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Scene, Surface

Array = NDArray[Any]
#: A function that returns the gains of trials over the files as given.
Compared = Callable[[Iterable[Trial]], Sequence[Hypothesis]]

#: Relative 1-sigma of the difference in amplitude between a camera and its file.
CAMERA_AMPLITUDE = 0.15
#: 1-sigma of the logarithm of an unknown reflectivity: that of a uniform one between 0.05 and 1.
ANY_REFLECTIVITY = 0.86
#: Depth of a surface relative to the others, in 1-sigma of its poses, above which it is tried.
_FAR = 5.0
#: Factors on sizes of tiles and surfaces, on depths, and on the focal length that are tried.
_FACTORS = (0.8, 0.9, 0.95, 1.05, 1.1, 1.25)
#: ... and the tolerance of the search for the best factor between them.
_FINENESS = 0.002
#: Factors on the size of another board.
_BOARD_FACTORS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6, 2.0)
#: Relative change of the focal length below which it is a wrong camera constant and not another lens.
LEAST_LENS = 0.08


def trials_of(dataset: Dataset, scene: Scene, camera: Camera) -> Iterator[Trial]:
    """Yield the set-ups that compete with the files as given."""
    for number, surface in enumerate(scene.surfaces):

        def with_surface(changed: Surface, at: int = number) -> Scene:
            others = [*scene.surfaces[:at], changed, *scene.surfaces[at + 1 :]]
            return replace(scene, surfaces=tuple(others))

        if surface.texture is not None:
            for name, values in _patterns(surface.texture.values.values):
                texture = replace(surface.texture, values=NestedList(values))
                changed = with_surface(replace(surface, texture=texture))
                yield Trial(name, surface.name, 0.0, _to_scene(changed))
        if surface.texture is not None or surface.size is not None:
            for factor in _FACTORS:
                yield _other_scale(surface, with_surface, factor)
        if surface.pose == "truth":
            for axis in (0, 1):
                turned = to_poses(surface.name, partial(_flipped, axis=axis))
                yield Trial("pose", surface.name, float(axis), turned)
            for axis in (0, 1, 2):
                turned = to_poses(surface.name, partial(_other_sign, axis=axis))
                yield Trial("pose", surface.name, float(axis), turned)
    yield from _as_measured(dataset, scene, camera)
    yield from _of_camera()


def _as_measured(dataset: Dataset, scene: Scene, camera: Camera) -> Iterator[Trial]:
    """Yield, for each surface, the pattern and the depth that the recording shows."""
    forward = coarse_forward(dataset, scene, camera)
    ratios = _ratios(forward)
    depths: dict[int, list[float]] = {}
    for prediction in forward.predictions(slopes=False):
        geometry = prediction.view.geometry
        for number in np.unique(geometry.surface[prediction.used]):
            mine = prediction.used & (geometry.surface == number)
            along = prediction.residual * geometry.cos_incidence
            depths.setdefault(int(number), []).append(float(np.median(along[mine])))
    for number, surface in enumerate(scene.surfaces):
        others = [value for i, values in depths.items() if i != number for value in values]
        if surface.pose == "truth" and number in depths and others:
            depth = float(np.median(depths[number])) - float(np.median(others))
            if abs(depth) > _FAR * surface.pose_sigma[0]:
                moved = to_poses(surface.name, partial(_farther, by=depth))
                yield Trial(DEPTH, surface.name, 1e3 * depth, moved, fitted=True)
        changed = _repainted(scene, number, ratios)
        if changed is not None:
            yield Trial("other_pattern", surface.name, 0.0, _to_scene(changed))


def _ratios(forward: Forward) -> dict[int, list[float]]:
    """Return log ratios of measured to predicted amplitudes by tile, a median for each station."""
    ratios: dict[int, list[float]] = {}
    for prediction in forward.predictions(slopes=False):
        tiles = prediction.view.geometry.tile
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.log(prediction.station.amplitude / prediction.model_amplitude)
        lit = prediction.amplitude_used & np.isfinite(ratio)
        for tile in np.unique(tiles[lit]):
            ratios.setdefault(int(tile), []).append(float(np.median(ratio[lit & (tiles == tile)])))
    return ratios


def _repainted(scene: Scene, number: int, ratios: Mapping[int, Sequence[float]]) -> Scene | None:
    """Return the scene with measured reflectivities of a surface's tiles; None where they agree already."""
    surface = scene.surfaces[number]
    if surface.texture is None or not surface.is_described:
        return None
    start = sum(plane.tiles for plane in scene.surfaces[:number])
    values = surface.texture.values.values.copy()
    limit = 3.0 * max(surface.reflectivity_sigma, CAMERA_AMPLITUDE)
    for k, value in enumerate(values.ravel()):
        change = float(np.median(ratios.get(start + k, [0.0])))
        if abs(change) > limit:
            values.flat[k] = float(np.clip(value * np.exp(change), 0.0, 1.0))
    if np.array_equal(values, surface.texture.values.values):
        return None
    texture = replace(surface.texture, values=NestedList(values))
    changed = replace(surface, texture=texture, reflectivity_sigma=ANY_REFLECTIVITY)
    return replace(scene, surfaces=(*scene.surfaces[:number], changed, *scene.surfaces[number + 1 :]))


def other_boards(files: Files, name: str) -> Iterator[Trial]:
    """Yield boards of other sizes in the place of a surface, with reflectivities from the recording.

    A board of the stated size with tiles of half the size is yielded as well.
    """
    yield from _other_board(files, name, (1.0, 1.0), halved=True)
    for factor in _BOARD_FACTORS:
        yield from _other_board(files, name, (factor, factor))


def _other_board(
    files: Files, name: str, sides: tuple[float, float], *, halved: bool = False
) -> Iterator[Trial]:
    dataset, scene, camera = files
    number = next(i for i, surface in enumerate(scene.surfaces) if surface.name == name)
    surfaces = list(scene.surfaces)
    board = _scaled(surfaces[number], *sides)
    surfaces[number] = _with_halved_tiles(board) if halved else board
    scaled = replace(scene, surfaces=tuple(surfaces))
    changed = _repainted(scaled, number, _ratios(coarse_forward(dataset, scaled, camera)))
    if changed is None:
        return
    if sides == (1.0, 1.0):
        yield Trial("other_pattern", name, 0.0, _to_scene(changed))
    else:
        size = float(np.sqrt(sides[0] * sides[1]))
        yield Trial("other_board", name, size, _to_scene(changed), sides=sides)


def _with_halved_tiles(surface: Surface) -> Surface:
    """Return the surface with tiles of half the size and the same reflectivities.

    They cover a surface of finite size without repetition, so that each may get its own reflectivity.
    """
    texture = surface.texture
    if texture is None:
        return surface
    width, height = (side / 2 for side in texture.cell)
    rows, columns = (2 * count for count in texture.values.values.shape)
    if surface.size is not None:
        # even numbers, as tiles begin in the middle
        columns, rows = (
            2 * int(np.ceil(side / (2 * tile)))
            for side, tile in zip(surface.size, (width, height), strict=True)
        )
    down, across = np.meshgrid(_places(rows, height), _places(columns, width), indexing="ij")
    values = NestedList(texture.reflectivity(across, down))
    return replace(surface, texture=replace(texture, cell=(width, height), values=values))


def _places(count: int, side: float) -> Array:
    """Return the centres (N,) [m] of so many tiles about the origin, the one right of it first."""
    numbers = np.arange(count)
    return np.asarray((np.where(numbers < count / 2, numbers, numbers - count) + 0.5) * side)


def of_any_sides(files: Files, best: Hypothesis, compared: Compared) -> Hypothesis:
    """Return the board, of any width and height, that fits a recording best.

    The search begins at the ``best`` board of the stated shape, one side after the other.
    """
    for factors in (_BOARD_FACTORS, ()):
        for axis in (0, 1):
            made = partial(_of_side, files, best, axis)
            coarse = [hypothesis for factor in factors for hypothesis in compared(made(factor))]
            best = _best([best, *coarse])
            made = partial(_of_side, files, best, axis)
            best = _best([best, *_maximised(made, compared, _sides(best)[axis], _BOARD_FACTORS)])
    return _best([best, *compared(_other_board(files, best.surface, _sides(best), halved=True))])


def _of_side(files: Files, board: Hypothesis, axis: int, factor: float) -> Iterator[Trial]:
    """Yield the ``board`` with another width (axis 0) or height (1)."""
    across, down = _sides(board)
    return _other_board(files, board.surface, (factor, down) if axis == 0 else (across, factor))


def _sides(board: Hypothesis) -> tuple[float, float]:
    return board.sides or (board.value, board.value)


def _best(found: Iterable[Hypothesis]) -> Hypothesis:
    return max(found, key=lambda hypothesis: hypothesis.gain)


def coarse_forward(dataset: Dataset, scene: Scene, camera: Camera, *, views: Views | None = None) -> Forward:
    """Return predictions with a power for each pose and no error of the amplitudes.

    ``views`` are those of the same rays, if there are any.
    """
    own = None if views is None else views.of_scene(camera, scene)
    forward = Forward(dataset, scene, camera, views=own)
    forward.estimate_amplitudes()
    forward.amplitude_model = AmplitudeModel(dict(forward.amplitude_model.gains), 0.0)
    return forward


def _of_camera() -> Iterator[Trial]:
    for factor in (1e-3, 1e3):
        yield Trial("units", "", 1 / factor, to_distances(partial(times, factor=factor)))
        # poses in other units (the amplitudes distinguish this from distances in other units)
        yield Trial("units", "", factor, to_poses(None, partial(_nearer, factor=factor)))
    yield Trial("z_distance", "", 0.0, to_distances(along_the_ray))
    yield Trial("compensated_amplitude", "", 0.0, to_amplitudes(falloff))
    for factor in _FACTORS:
        yield _other_lens(factor)


def _other_scale(surface: Surface, with_surface: Callable[[Surface], Scene], factor: float) -> Trial:
    changed = _to_scene(with_surface(_scaled(surface, factor, factor)))
    at = partial(_other_scale, surface, with_surface)
    return Trial("scale", surface.name, factor, changed, at=at)


def _other_lens(factor: float) -> Trial:
    near = abs(factor - 1) < LEAST_LENS
    through = partial(_through_lens, factor=factor)
    return Trial("other_lens", "", factor, through, fitted=near, at=_other_lens)


def refined(
    at: Callable[[float], Trial],
    best: Hypothesis,
    compared: Compared,
) -> list[Hypothesis]:
    """Return the gains, by ``compared``, of trials ``at`` values between the neighbours of the ``best``."""
    return _maximised(lambda factor: iter([at(factor)]), compared, best.value, _FACTORS)


def _maximised(
    made: Callable[[float], Iterator[Trial]], compared: Compared, best: float, factors: Sequence[float]
) -> list[Hypothesis]:
    """Return the gains of set-ups with factors between the neighbours of the ``best`` one (Brent 1973)."""
    tried = sorted({1.0, *factors})
    number = int(np.argmin(np.abs(np.array(tried) - best)))
    step = tried[1] / tried[0]
    low, high = (
        tried[k] if 0 <= k < len(tried) else tried[number] * step ** (k - number)
        for k in (number - 1, number + 1)
    )
    found: list[Hypothesis] = []

    def loss(factor: float) -> float:
        gained = compared(made(float(factor)))
        found.extend(gained)
        return -gained[0].gain if gained else 0.0

    minimize_scalar(loss, bounds=(low, high), method="bounded", options={"xatol": _FINENESS})
    return found


def _through_lens(dataset: Dataset, scene: Scene, camera: Camera, *, factor: float) -> Files:
    optics = replace(camera.optics, fx=camera.optics.fx * factor, fy=camera.optics.fy * factor)
    return dataset, scene, replace(camera, optics=optics)


def _to_scene(changed: Scene) -> Change:
    return lambda dataset, scene, camera: (dataset, changed, camera)


def to_poses(name: str | None, change: Callable[[Pose], Pose]) -> Change:
    """Return a change of files by a function of the poses of a surface; None: of all surfaces."""

    def changed(dataset: Dataset, scene: Scene, camera: Camera) -> Files:
        stations = [
            replace(
                station,
                truth={
                    key: change(pose) if name in (None, key) else pose for key, pose in station.truth.items()
                },
            )
            for station in dataset.stations
        ]
        return replace(dataset, stations=stations), scene, camera

    return changed


def _patterns(values: Array) -> Iterator[tuple[str, Array]]:
    """Yield textures with which a print may be confused; tiles (i, j) begin at the origin of the surface."""
    yield "turned_180", np.ascontiguousarray(values[::-1, ::-1])
    yield "mirrored", np.ascontiguousarray(values[:, ::-1])
    yield "mirrored", np.ascontiguousarray(values[::-1, :])
    # greys in the opposite order, or as far from white as they were from black
    greys, number = np.unique(values, return_inverse=True)
    yield "inverted", greys[::-1][number].reshape(values.shape)
    yield "inverted", values.max() + values.min() - values
    if values.shape[0] == values.shape[1]:
        yield "turned_90", np.ascontiguousarray(np.rot90(values))


def _scaled(surface: Surface, across: float, down: float) -> Surface:
    texture = surface.texture
    if texture is not None:
        texture = replace(texture, cell=(texture.cell[0] * across, texture.cell[1] * down))
    size = None if surface.size is None else (surface.size[0] * across, surface.size[1] * down)
    return replace(surface, texture=texture, size=size)


def _nearer(pose: Pose, *, factor: float) -> Pose:
    x, y, z = pose.position
    return Pose((factor * x, factor * y, factor * z), pose.orientation)


def normal_of(pose: Pose) -> Array:
    """Return the normal (3,) of a surface at a pose, away from the camera."""
    normal = rotation_matrix(pose.orientation)[:, 2]
    return np.asarray(normal * np.sign(normal @ np.array(pose.position)))


def moved(pose: Pose, shift: Array) -> Pose:
    """Return a pose moved by a vector (3,) [m]."""
    x, y, z = np.array(pose.position) + shift
    return Pose((float(x), float(y), float(z)), pose.orientation)


def _farther(pose: Pose, *, by: float) -> Pose:
    """Return the pose moved along its normal, away from the camera, by a length [m]."""
    return moved(pose, by * normal_of(pose))


def _flipped(pose: Pose, *, axis: int) -> Pose:
    """Return the pose with the opposite tilt about an axis of the camera: its normal is mirrored."""
    rotation = rotation_matrix(pose.orientation)
    mirror = np.eye(3)
    mirror[axis, axis] = -1.0
    # the mirror image of the frame is left-handed: its own axis turned back makes it a rotation again
    back = np.eye(3)
    back[axis, axis] = -1.0
    return Pose(pose.position, quaternion(mirror @ rotation @ back))


def _other_sign(pose: Pose, *, axis: int) -> Pose:
    """Return the pose with the opposite sign of a component of its rotation vector."""
    vector = cv2.Rodrigues(rotation_matrix(pose.orientation))[0].ravel()
    vector[axis] = -vector[axis]
    return Pose(pose.position, quaternion(np.asarray(cv2.Rodrigues(vector)[0], float)))
