"""The comparison of set-ups: robust and coarse, so that physics is not taken for one.

Neighbouring pixels of a tile count as one observation. Errors of distances up to those of a camera that
nobody calibrated cost little, and so do errors of reflectivities up to those that the scene states. Models
are compared by the paired differences of their poses (Vehtari, Gelman & Gabry 2017).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.hypotheses import AS_GIVEN, Files, Hypothesis, Trial, by_gain
from rim_camera_ros.diagnose.setup_trials import (
    CAMERA_AMPLITUDE,
    LEAST_LENS,
    coarse_forward,
    other_boards,
    trials_of,
)
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.decimation import decimated_camera, decimated_dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.scene import Scene

Array = NDArray[Any]

#: Hypotheses about the tiles of a surface.
_OF_PATTERN = frozenset({"turned_180", "mirrored", "inverted", "turned_90", "other_pattern", "scale"})
#: 1-sigma of distances [m] in which a camera and its file may differ.
_CAMERA_DISTANCE = 0.03
#: Squares of standardised residuals count up to this: what is wrong is wrong.
_MOST = 9.0
#: 1-sigma of reflectivities that the scene file calls known.
_EXACT = 1e-3
#: Poses on which hypotheses are compared, at most, and about how many pixels of each.
_MOST_POSES = 8
_ENOUGH_PIXELS = 1600
#: A pose (recording, pose).
_Key = tuple[int, int]


@dataclass(frozen=True)
class _Judged:
    """The judged pixels (N,) of a pose: losses of their distances, log ratios of measured and predicted
    amplitudes with their variances and tiles; ``blind`` further pixels of which nothing is predicted.

    ``patches`` is what all of them count; ``expected`` the mean loss by noise and stated errors alone.
    """

    key: _Key
    distance: Array
    ratio: Array
    variance: Array
    tile: Array
    blind: int
    patches: float
    expected: float

    @property
    def weight(self) -> float:
        """Patches that a pixel makes up."""
        return self.patches / max(len(self.distance) + self.blind, 1)

    def light(self, reflectivities: Array) -> Array:
        """Return the losses (N,) of the amplitudes, given log errors of the reflectivity of each tile."""
        return np.minimum((self.ratio - reflectivities[self.tile]) ** 2 / self.variance, _MOST)

    def loss(self, reflectivities: Array) -> float:
        """Return the mean loss; that of a pose of which no pixel is predicted is as great as can be."""
        total = len(self.distance) + self.blind
        if total == 0:
            return 2 * _MOST
        own = float(self.distance.sum() + self.light(reflectivities).sum())
        return (own + 2 * _MOST * self.blind) / total


@dataclass(frozen=True)
class _Score:
    """Mean loss and patches of each pose, the losses beyond the expected, and those of the reflectivities.

    ``offset`` [m]: what all distances have in common; ``hits`` (H, W): the pixels described. Losses are twice
    the negative log likelihood up to a constant that all set-ups share.
    """

    poses: dict[_Key, tuple[float, float]]
    excess: dict[_Key, float]
    reflectivities: float
    beyond: float
    offset: float
    hits: dict[_Key, Array]


def compare_setups(dataset: Dataset, scene: Scene, camera: Camera) -> list[Hypothesis]:
    """Return the set-ups by what they gain over the files as given, the best first; these gain 0."""
    files = _coarse(dataset, scene, camera)
    given = _score(files)
    poses = dataset.poses
    found = [Hypothesis(AS_GIVEN, "", 0.0, 0.0, value=given.offset)]
    found += _compared(trials_of(*files), files, given, poses)
    # a surface of which neither size nor pattern is right fits with neither of them alone
    patterned = {one.surface for one in found if one.is_better and one.hypothesis in _OF_PATTERN}
    for name in sorted(patterned):
        found += _compared(other_boards(*files, name), files, given, poses)
    return _best_of_each(found)


def against_physics(
    setups: Iterable[Hypothesis], dataset: Dataset, scene: Scene, camera: Camera, *, found: Camera
) -> list[Hypothesis]:
    """Return set-ups by what they gain over the files as given with the camera ``found``, the best first.

    Those that gained nothing over the files alone, and those that are fitted, stay as they are. Of the others
    each is taken with the camera of the file and with that which was found, as both may be wrong. A camera
    constant that is found to be another lens' is no physics but that set-up.
    """
    setups = list(setups)
    if abs(found.optics.fx / camera.optics.fx - 1) > LEAST_LENS:
        found = replace(found, optics=camera.optics)
    given = _score(_coarse(dataset, scene, found))
    again = [one for one in setups if one.fitted or not one.is_better]
    for one in setups:
        if one.fitted or not one.is_better or one.change is None:
            continue
        trial = Trial(one.hypothesis, one.surface, one.value, one.change)
        for own in (camera, found):
            files = _coarse(dataset, scene, own)
            compared = _compared([trial], files, given, dataset.poses)
            again += [replace(each, share=one.share, against_physics=True) for each in compared]
    return _best_of_each(again)


def _coarse(dataset: Dataset, scene: Scene, camera: Camera) -> Files:
    """Return files of some poses and about `_ENOUGH_PIXELS` pixels."""
    chosen = _some_poses(dataset)
    step = round(np.sqrt(camera.sensor.width * camera.sensor.height / _ENOUGH_PIXELS))
    if step > 1:
        chosen, camera = decimated_dataset(chosen, step), decimated_camera(camera, step)
    return chosen, scene, camera


def _best_of_each(found: Iterable[Hypothesis]) -> list[Hypothesis]:
    best: dict[tuple[str, str], Hypothesis] = {}
    for one in found:
        key = (one.hypothesis, one.surface)
        if key not in best or one.gain > best[key].gain:
            best[key] = one
    return by_gain(best.values())


def _compared(trials: Iterable[Trial], files: Files, given: _Score, poses: int) -> list[Hypothesis]:
    """Return what trials gain over the losses of poses as ``given``, for a recording of so many ``poses``."""
    found = []
    for trial in trials:
        try:
            score = _score(trial.change(*files), given.hits)
        except RimError:
            continue
        difference, short = _differences(given, score)
        if not difference.size:
            continue
        # the poses are a sample of those of the recording, the tiles are the same in all of them
        share = poses / len(difference)
        tiles = 0.5 * (given.reflectivities - score.reflectivities)
        error = (
            float(np.std(difference, ddof=1) * np.sqrt(len(difference))) if len(difference) > 1 else np.inf
        )
        found.append(
            Hypothesis(
                trial.hypothesis,
                trial.surface,
                float(difference.sum() * share + tiles),
                error * share,
                trial.value,
                float(difference.sum() + tiles) / max(short, 1e-9),
                trial.change,
                fitted=trial.fitted,
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


def _score(files: Files, within: Mapping[_Key, Array] | None = None) -> _Score:
    """Return how badly a set-up fits the poses, without the offset that all its distances share.

    That is the camera's, whatever the set-up. ``within`` are the pixels that the files as given describe;
    None: these are the files.
    """
    scene = files[1]
    forward = coarse_forward(*files)
    predictions = list(forward.predictions(slopes=False))
    offset = _common_offset(predictions)
    hits = {(one.station.recording, one.station.pose): one.view.geometry.hit for one in predictions}
    regions = hits if within is None else within
    looks = (_judged(forward, one, offset, regions) for one in predictions)
    judged = [one for one in looks if one is not None]
    sigma = np.concatenate(
        [np.full(one.tiles, max(one.reflectivity_sigma, _EXACT)) for one in scene.surfaces]
    )
    found, cost = _reflectivities(judged, sigma)
    poses = {one.key: (one.loss(found), one.patches) for one in judged}
    excess = {one.key: one.loss(found) - one.expected for one in judged}
    beyond = float(np.sum(found**2 / sigma**2))
    return _Score(poses, excess, float(cost.sum()), beyond, offset, hits)


def _common_offset(predictions: Sequence[Prediction]) -> float:
    """Return the median [m] of what distances differ by, over all pixels of a set-up; 0 without any."""
    apart = np.concatenate(
        [np.zeros(0), *(one.residual[one.view.clean & (one.station.count > 0)] for one in predictions)]
    )
    apart = apart[np.isfinite(apart)]
    return float(np.median(apart)) if apart.size else 0.0


def _judged(forward: Forward, one: Prediction, offset: float, within: Mapping[_Key, Array]) -> _Judged | None:
    """Return what is judged of a station without ``offset`` [m]; None where nothing was measured.

    Of the pixels ``within`` those (H, W) of each pose that the files as given describe: a scene need not
    describe all that there is, and who describes more of it is not right therefore.
    """
    key = (one.station.recording, one.station.pose)
    measured = one.station.count > 0
    if not measured.any():
        return None
    hit, clean = one.view.geometry.hit, one.view.clean
    if within[key].any():
        measured = measured & within[key]
    # what a set-up has nothing for is as wrong as can be, except half covered pixels at its borders
    blind = measured & (cv2.dilate(hit.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    pixels = measured & hit & clean
    described = np.array([each.is_described for each in forward.scene.surfaces])
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = one.sigma**2 + _CAMERA_DISTANCE**2
        distance = np.minimum(np.nan_to_num((one.residual - offset) ** 2 / scatter, nan=_MOST), _MOST)
        ratio = np.log(one.station.amplitude / one.model_amplitude)
        noise = (one.amplitude_noise / one.model_amplitude) ** 2
        variance = noise + CAMERA_AMPLITUDE**2
        expected = one.sigma**2 / scatter + noise / variance
    # no amplitude is as wrong as can be; that of a surface which nobody described says nothing
    ratio = np.where(np.isfinite(ratio), ratio, np.inf)
    ratio[~described[one.view.geometry.surface]] = 0.0
    patches = measured.sum() / float(np.median(forward.views.alike(one.view)[clean])) if clean.any() else 0.0
    return _Judged(
        key,
        distance[pixels],
        ratio[pixels],
        variance[pixels],
        one.view.geometry.tile[pixels],
        int(blind.sum()),
        patches,
        float(np.nan_to_num(expected[pixels], posinf=0.0).mean()) if pixels.any() else 0.0,
    )


def _reflectivities(judged: Sequence[_Judged], sigma: Array) -> tuple[Array, Array]:
    """Return the log error of the reflectivity of each tile and what they cost, as losses (T,).

    An error is the same in all poses: nuisance parameters with normal priors of 1-``sigma`` (T,), integrated
    out by Laplace's method (Kass & Raftery 1995, eq. 5).
    """
    found, cost = np.zeros_like(sigma), np.zeros_like(sigma)
    if not judged:
        return found, cost
    tile = np.concatenate([one.tile for one in judged])
    ratio = np.concatenate([one.ratio for one in judged])
    variance = np.concatenate([one.variance for one in judged])
    weight = np.concatenate([np.full(len(one.tile), one.weight) for one in judged])
    for number in np.unique(tile[np.isfinite(ratio)]):
        own = (tile == number) & np.isfinite(ratio)
        precision = float(np.sum(weight[own] / variance[own]))
        prior = sigma[number] ** 2
        error = float(np.median(ratio[own])) * precision * prior / (1 + precision * prior)
        change = np.minimum((ratio[own] - error) ** 2 / variance[own], _MOST)
        change = change - np.minimum(ratio[own] ** 2 / variance[own], _MOST)
        if float(weight[own] @ change) + error**2 / prior < 0:
            found[number] = error
        cost[number] = found[number] ** 2 / prior + np.log1p(precision * prior)
    return found, cost


def _differences(given: _Score, score: _Score) -> tuple[Array, float]:
    """Return each pose's gain, and how much worse poses as ``given`` fit than stated errors explain [nats].

    A pose has as many patches under both, those of the files as given where these predict any.
    """
    gains, short = [], 0.5 * given.beyond
    for key in sorted(given.poses.keys() & score.poses.keys()):
        (loss, patches), (other, of_other) = given.poses[key], score.poses[key]
        patches = patches or of_other
        gains.append(0.5 * patches * (loss - other))
        short += 0.5 * patches * given.excess[key]
    return np.array(gains), short
