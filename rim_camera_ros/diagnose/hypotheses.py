"""What else the scene could be: set-up faults as hypotheses that compete with the files as they are given.

A board that is turned, mirrored or inverted, a wrong square size, distances along z, another lens: each is a
change of scene, poses or camera whose prediction is compared with the recording before any physics is looked
for. The comparison is robust and coarse: neighbouring pixels of a tile count as one observation, errors of
distances up to those of a camera that nobody calibrated cost little. Models are compared by the paired
differences of their poses (Vehtari, Gelman & Gabry 2017).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.coarser import coarser_camera, coarser_dataset
from rim_camera_ros.calibrate.forward import AmplitudeModel, Forward
from rim_camera_ros.calibrate.stations import Dataset, Station
from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import RimError
from rim_camera_ros.frame import Pose
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.scene import Scene, Surface, quaternion, rotation_matrix

Array = NDArray[Any]

AS_GIVEN = "as_given"
#: Hypotheses about the tiles of a surface.
_OF_PATTERN = frozenset({"turned_180", "mirrored", "inverted", "turned_90", "other_pattern", "scale"})
#: 1-sigma of distances [m] and relative 1-sigma of amplitudes in which a camera and its file may differ, so
#: that physics is not taken for a set-up.
_CAMERA_DISTANCE, _CAMERA_AMPLITUDE = 0.03, 0.15
#: Squares of standardised residuals count up to this: what is wrong is wrong.
_MOST = 9.0
#: Nats by which another set-up must be better, and standard errors of its paired differences over poses.
LEAST_GAIN = 20.0
STANDARD_ERRORS = 2.0
#: ... and share of what does not fit that it must explain: physics that is missing imitates a part of it.
LEAST_SHARE = 0.5
#: Poses on which hypotheses are compared, at most, and about how many pixels of each.
_MOST_POSES = 8
_ENOUGH_PIXELS = 1600
#: Errors of poses of a surface against the others, in their 1-sigma, from which its depth is tried.
_FAR = 5.0
#: Factors on sizes of tiles and surfaces, on depths, and on the focal length that are tried.
_FACTORS = (0.8, 0.9, 0.95, 1.05, 1.1, 1.25)
#: Factors on the size of another board.
_BOARD_FACTORS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6, 2.0)
#: A focal length nearer to the file's than this is no other lens, but a camera constant that is wrong.
_LEAST_LENS = 0.08
_WORDS = {
    "turned_180": "the pattern of {0} turned by 180 degrees",
    "mirrored": "the pattern of {0} mirrored",
    "inverted": "the bright and dark tiles of {0} exchanged",
    "turned_90": "the pattern of {0} turned by 90 degrees",
    "other_pattern": "another pattern on {0}: its tiles reflect otherwise than the scene file says",
    "other_board": "another board for {0}: {1:.3g} times as large, and its tiles reflect otherwise",
    "moved_poses": "poses of {0} that stand elsewhere",
    "scale": "{0} {1:.3g} times as large as the scene file says",
    "depth": "{0} {1:+.0f} mm farther away than its poses say",
    "pose": "poses of {0} with another sign of an angle",
    "units": "distances or poses in other units, by a factor of {1:g}",
    "z_distance": "distances along the optical axis instead of along the ray",
    "other_lens": "another lens, of {1:.3g} times the focal length",
}


@dataclass(frozen=True)
class Hypothesis:
    """A set-up: what it changes, of which surface, by how much, and what it gains over the files [nats].

    ``standard_error`` [nats] of the gain from its paired differences over poses; ``share`` of what does not
    fit that it explains.
    """

    hypothesis: str
    surface: str
    gain: float
    standard_error: float
    value: float = 0.0
    share: float = 0.0

    @property
    def sentence(self) -> str:
        """The set-up in words."""
        if self.hypothesis == AS_GIVEN:
            return "scene, poses and camera as the files say"
        return _WORDS[self.hypothesis].format(self.surface or "the scene", self.value)

    @property
    def reason(self) -> str:
        """Why the set-up cannot be trusted, and what to do."""
        return (
            f"{self.hypothesis}: {self.sentence} explains the recording better than the files do "
            f"({self.share:.0%} of what does not fit); correct the scene file, the poses or the camera file"
        )

    @property
    def is_better(self) -> bool:
        """Whether it fits the recording better than the files do."""
        significant = self.gain > max(LEAST_GAIN, STANDARD_ERRORS * self.standard_error)
        return self.hypothesis != AS_GIVEN and significant

    @property
    def wins(self) -> bool:
        """Whether it is better and explains most of what does not fit."""
        return self.is_better and self.share > LEAST_SHARE


#: Mean loss and number of patches of each pose.
_Losses = Mapping[tuple[int, int], tuple[float, float]]


@dataclass(frozen=True)
class _Trial:
    hypothesis: str
    surface: str
    value: float
    dataset: Dataset
    scene: Scene
    camera: Camera


def compare_setups(dataset: Dataset, scene: Scene, camera: Camera) -> list[Hypothesis]:
    """Return the set-ups by what they gain over the files as given, the best first; these gain 0."""
    chosen = _some_poses(dataset)
    step = round(np.sqrt(camera.sensor.width * camera.sensor.height / _ENOUGH_PIXELS))
    if step > 1:
        chosen, camera = coarser_dataset(chosen, step), coarser_camera(camera, step)
    given = _score(_Trial(AS_GIVEN, "", 0.0, chosen, scene, camera))
    poses = len({(one.recording, one.pose) for one in dataset.stations})
    found = [Hypothesis(AS_GIVEN, "", 0.0, 0.0)]
    found += _compared(_trials(chosen, scene, camera), given, poses)
    # a surface of which neither size nor pattern is right fits with neither of them alone
    patterned = {one.surface for one in found if one.is_better and one.hypothesis in _OF_PATTERN}
    for name in sorted(patterned):
        found += _compared(_other_boards(chosen, scene, camera, name), given, poses)
    best: dict[tuple[str, str], Hypothesis] = {}
    for one in found:
        key = (one.hypothesis, one.surface)
        if key not in best or one.gain > best[key].gain:
            best[key] = one
    return by_gain(best.values())


def _compared(trials: Iterable[_Trial], given: _Losses, poses: int) -> list[Hypothesis]:
    """Return what trials gain over the losses of poses as ``given``, for a recording of so many ``poses``."""
    found = []
    for trial in trials:
        try:
            score = _score(trial)
        except RimError:
            continue
        difference, short = _differences(given, score)
        if not difference.size:
            continue
        # the poses are a sample of those of the recording
        share = poses / len(difference)
        error = (
            float(np.std(difference, ddof=1) * np.sqrt(len(difference))) if len(difference) > 1 else np.inf
        )
        found.append(
            Hypothesis(
                trial.hypothesis,
                trial.surface,
                float(difference.sum() * share),
                error * share,
                trial.value,
                float(difference.sum()) / max(short, 1e-9),
            )
        )
    return found


def _some_poses(dataset: Dataset) -> Dataset:
    """Return the dataset with one station of each of some poses, spread over the recording."""
    first: dict[tuple[int, int], Station] = {}
    for one in dataset.stations:
        first.setdefault((one.recording, one.pose), one)
    stations = list(first.values())
    step = max(1, -(-len(stations) // _MOST_POSES))
    return replace(dataset, stations=stations[::step])


def _score(trial: _Trial) -> dict[tuple[int, int], tuple[float, float]]:
    """Return, for each pose, the mean loss of its pixels and the number of patches that they make up.

    The loss is twice the negative log likelihood up to a constant that all trials share; that of a pose of
    which a trial predicts no pixel is as great as can be, and its patches are not known (0).
    """
    forward = _coarse_forward(trial.dataset, trial.scene, trial.camera)
    described = np.array([one.is_described for one in trial.scene.surfaces])
    result: dict[tuple[int, int], tuple[float, float]] = {}
    for one in forward.predictions(slopes=False):
        key = (one.station.recording, one.station.pose)
        measured = one.station.count > 0
        if not measured.any():
            continue
        seen = one.view.geometry.hit & measured
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = one.residual**2 / (one.sigma**2 + _CAMERA_DISTANCE**2)
            ratio = np.log(one.station.amplitude / one.model_amplitude)
            noise = one.amplitude_noise / one.model_amplitude
            light = ratio**2 / (noise**2 + _CAMERA_AMPLITUDE**2)
        light[~described[one.view.geometry.surface]] = 0.0
        both = np.minimum(np.nan_to_num(distance, nan=_MOST), _MOST)
        both += np.minimum(np.nan_to_num(light, nan=_MOST), _MOST)
        # what the scene has nothing for is as wrong as can be
        both[measured & ~seen] = 2 * _MOST
        # of the pixels that a trial can judge, those away from its edges; each counts as its share of a patch
        judged = measured & (one.view.clean | ~seen)
        clean = one.view.clean
        patches = (
            measured.sum() / float(np.median(forward.views.alike(one.view)[clean])) if clean.any() else 0.0
        )
        loss = float(both[judged].mean()) if judged.any() else 2 * _MOST
        result[key] = (loss, patches)
    return result


def _differences(given: _Losses, score: _Losses) -> tuple[NDArray[Any], float]:
    """Return each pose's gain, and what all poses as ``given`` fall short of a perfect fit [nats].

    A pose has as many patches under both, those of the files as given where these predict any.
    """
    gains, short = [], 0.0
    for key in sorted(given.keys() & score.keys()):
        patches = given[key][1] or score[key][1]
        gains.append(0.5 * patches * (given[key][0] - score[key][0]))
        short += 0.5 * patches * given[key][0]
    return np.array(gains), short


def _trials(dataset: Dataset, scene: Scene, camera: Camera) -> Iterator[_Trial]:
    for number, surface in enumerate(scene.surfaces):

        def with_surface(changed: Surface, at: int = number) -> Scene:
            others = [*scene.surfaces[:at], changed, *scene.surfaces[at + 1 :]]
            return replace(scene, surfaces=tuple(others))

        if surface.texture is not None:
            for name, values in _patterns(surface.texture.values.values):
                texture = replace(surface.texture, values=NestedList(values))
                changed = with_surface(replace(surface, texture=texture))
                yield _Trial(name, surface.name, 0.0, dataset, changed, camera)
        if surface.texture is not None or surface.size is not None:
            for factor in _FACTORS:
                changed = with_surface(_scaled(surface, factor))
                yield _Trial("scale", surface.name, factor, dataset, changed, camera)
        if surface.pose == "truth":
            for axis in (0, 1):
                turned = _with_poses(dataset, surface.name, partial(_flipped, axis=axis))
                yield _Trial("pose", surface.name, float(axis), turned, scene, camera)
    yield from _as_measured(dataset, scene, camera)
    yield from _of_camera(dataset, scene, camera)


def _as_measured(dataset: Dataset, scene: Scene, camera: Camera) -> Iterator[_Trial]:
    """Yield, for each surface, the pattern and the depth that the recording itself shows."""
    forward = _coarse_forward(dataset, scene, camera)
    ratios = _ratios(forward)
    depths: dict[int, list[float]] = {}
    for one in forward.predictions(slopes=False):
        geometry = one.view.geometry
        for number in np.unique(geometry.surface[one.used]):
            mine = one.used & (geometry.surface == number)
            along = one.residual * geometry.cos_incidence
            depths.setdefault(int(number), []).append(float(np.median(along[mine])))
    for number, surface in enumerate(scene.surfaces):
        others = [value for i, values in depths.items() if i != number for value in values]
        if surface.pose == "truth" and number in depths and others:
            depth = float(np.median(depths[number])) - float(np.median(others))
            if abs(depth) > _FAR * surface.pose_sigma[0]:
                moved = _with_poses(dataset, surface.name, partial(_farther, by=depth))
                yield _Trial("depth", surface.name, 1e3 * depth, moved, scene, camera)
        changed = _repainted(scene, number, ratios)
        if changed is not None:
            yield _Trial("other_pattern", surface.name, 0.0, dataset, changed, camera)


def _ratios(forward: Forward) -> dict[int, list[float]]:
    """Return log ratios of measured and predicted amplitudes by tile, a median for each station."""
    ratios: dict[int, list[float]] = {}
    for one in forward.predictions(slopes=False):
        tiles = one.view.geometry.tile
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.log(one.station.amplitude / one.model_amplitude)
        lit = one.amplitude_used & np.isfinite(ratio)
        for tile in np.unique(tiles[lit]):
            ratios.setdefault(int(tile), []).append(float(np.median(ratio[lit & (tiles == tile)])))
    return ratios


def _repainted(scene: Scene, number: int, ratios: Mapping[int, Sequence[float]]) -> Scene | None:
    """Return the scene with a surface whose tiles reflect as measured; None where it agrees already."""
    surface = scene.surfaces[number]
    if surface.texture is None or not surface.is_described:
        return None
    start = sum(one.tiles for one in scene.surfaces[:number])
    values = surface.texture.values.values.copy()
    limit = 3.0 * max(surface.reflectivity_sigma, _CAMERA_AMPLITUDE)
    for k, value in enumerate(values.ravel()):
        change = float(np.median(ratios.get(start + k, [0.0])))
        if abs(change) > limit:
            values.flat[k] = float(np.clip(value * np.exp(change), 0.0, 1.0))
    if np.array_equal(values, surface.texture.values.values):
        return None
    changed = replace(surface, texture=replace(surface.texture, values=NestedList(values)))
    return replace(scene, surfaces=(*scene.surfaces[:number], changed, *scene.surfaces[number + 1 :]))


def _other_boards(dataset: Dataset, scene: Scene, camera: Camera, name: str) -> Iterator[_Trial]:
    """Yield boards of other sizes whose tiles reflect as the recording shows, in the place of a surface."""
    number = next(i for i, one in enumerate(scene.surfaces) if one.name == name)
    for factor in _BOARD_FACTORS:
        surfaces = list(scene.surfaces)
        surfaces[number] = _scaled(surfaces[number], factor)
        scaled = replace(scene, surfaces=tuple(surfaces))
        forward = _coarse_forward(dataset, scaled, camera)
        changed = _repainted(scaled, number, _ratios(forward))
        if changed is not None:
            yield _Trial("other_board", name, factor, dataset, changed, camera)


def _coarse_forward(dataset: Dataset, scene: Scene, camera: Camera) -> Forward:
    forward = Forward(dataset, scene, camera)
    forward.estimate_amplitudes()
    forward.amplitude_model = AmplitudeModel(dict(forward.amplitude_model.gains), 0.0)
    return forward


def _of_camera(dataset: Dataset, scene: Scene, camera: Camera) -> Iterator[_Trial]:
    for factor in (1e-3, 1e3):
        stations = [replace(one, distance=one.distance * factor) for one in dataset.stations]
        yield _Trial("units", "", 1 / factor, replace(dataset, stations=stations), scene, camera)
        # poses in other units, as light tells the distances of a camera
        yield _Trial("units", "", factor, _in_units(dataset, factor), scene, camera)
    along = camera.rays[..., 2]
    stations = [replace(one, distance=one.distance / along) for one in dataset.stations]
    yield _Trial("z_distance", "", 0.0, replace(dataset, stations=stations), scene, camera)
    for factor in (one for one in _FACTORS if abs(one - 1) > _LEAST_LENS):
        optics = replace(camera.optics, fx=camera.optics.fx * factor, fy=camera.optics.fy * factor)
        yield _Trial("other_lens", "", factor, dataset, scene, replace(camera, optics=optics))


def _patterns(values: Array) -> Iterator[tuple[str, Array]]:
    """Yield textures that a print may be taken for; tiles (i, j) begin at the origin of the surface."""
    yield "turned_180", np.ascontiguousarray(values[::-1, ::-1])
    yield "mirrored", np.ascontiguousarray(values[:, ::-1])
    yield "mirrored", np.ascontiguousarray(values[::-1, :])
    yield "inverted", values.max() + values.min() - values
    if values.shape[0] == values.shape[1]:
        yield "turned_90", np.ascontiguousarray(np.rot90(values))


def _scaled(surface: Surface, factor: float) -> Surface:
    texture = surface.texture
    if texture is not None:
        texture = replace(texture, cell=(texture.cell[0] * factor, texture.cell[1] * factor))
    size = None if surface.size is None else (surface.size[0] * factor, surface.size[1] * factor)
    return replace(surface, texture=texture, size=size)


def _in_units(dataset: Dataset, factor: float) -> Dataset:
    def scaled(pose: Pose) -> Pose:
        x, y, z = pose.position
        return Pose((factor * x, factor * y, factor * z), pose.orientation)

    stations = [
        replace(one, truth={name: scaled(pose) for name, pose in one.truth.items()})
        for one in dataset.stations
    ]
    return replace(dataset, stations=stations)


def _with_poses(dataset: Dataset, name: str, change: Callable[[Pose], Pose]) -> Dataset:
    def changed(truth: Mapping[str, Pose]) -> dict[str, Pose]:
        return {key: change(pose) if key == name else pose for key, pose in truth.items()}

    return replace(dataset, stations=[replace(one, truth=changed(one.truth)) for one in dataset.stations])


def _farther(pose: Pose, *, by: float) -> Pose:
    """Return the pose moved along its normal, away from the camera, by a length [m]."""
    normal = rotation_matrix(pose.orientation)[:, 2]
    normal = normal * np.sign(normal @ np.array(pose.position))
    x, y, z = np.array(pose.position) + by * normal
    return Pose((float(x), float(y), float(z)), pose.orientation)


def _flipped(pose: Pose, *, axis: int) -> Pose:
    """Return the pose with the opposite tilt about an axis of the camera: its normal is mirrored."""
    rotation = rotation_matrix(pose.orientation)
    mirror = np.eye(3)
    mirror[axis, axis] = -1.0
    # the mirror image of the frame is left-handed: its own axis turned back makes it a rotation again
    back = np.eye(3)
    back[axis, axis] = -1.0
    return Pose(pose.position, quaternion(mirror @ rotation @ back))


def by_gain(found: Iterable[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses by what they gain, the best first."""
    return sorted(found, key=lambda one: -one.gain)


def moved_poses(errors: Mapping[tuple[int, int], float]) -> Hypothesis:
    """Return the set-up in which some poses stand elsewhere, by their ``errors`` in stated 1-sigma.

    It gains what the errors of these poses cost as errors of the instrument.
    """
    gain = 0.5 * float(np.sum(np.square(list(errors.values()))))
    return Hypothesis("moved_poses", "", gain, 0.0, float(len(errors)))


def best_setup(found: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the set-up that explains the recording better than the files do; None: they are the best."""
    winners = [one for one in found if one.wins]
    return winners[0] if winners else None
