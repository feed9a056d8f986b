"""The comparison of set-ups: robust and coarse, so that physics is not taken for one.

Neighbouring pixels of a tile count as one observation, errors of distances up to those of a camera that
nobody calibrated cost little. Models are compared by the paired differences of their poses (Vehtari, Gelman
& Gabry 2017).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.hypotheses import AS_GIVEN, Files, Hypothesis, Trial, by_gain
from rim_camera_ros.diagnose.setup_trials import CAMERA_AMPLITUDE, coarse_forward, other_boards, trials_of
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.decimation import decimated_camera, decimated_dataset
from rim_camera_ros.scene import Scene

#: Hypotheses about the tiles of a surface.
_OF_PATTERN = frozenset({"turned_180", "mirrored", "inverted", "turned_90", "other_pattern", "scale"})
#: 1-sigma of distances [m] in which a camera and its file may differ.
_CAMERA_DISTANCE = 0.03
#: Squares of standardised residuals count up to this: what is wrong is wrong.
_MOST = 9.0
#: Poses on which hypotheses are compared, at most, and about how many pixels of each.
_MOST_POSES = 8
_ENOUGH_PIXELS = 1600
#: Mean loss and number of patches of each pose.
_Losses = Mapping[tuple[int, int], tuple[float, float]]


def compare_setups(dataset: Dataset, scene: Scene, camera: Camera) -> list[Hypothesis]:
    """Return the set-ups by what they gain over the files as given, the best first; these gain 0."""
    chosen = _some_poses(dataset)
    step = round(np.sqrt(camera.sensor.width * camera.sensor.height / _ENOUGH_PIXELS))
    if step > 1:
        chosen, camera = decimated_dataset(chosen, step), decimated_camera(camera, step)
    files = (chosen, scene, camera)
    given = _score(files)
    poses = len({(one.recording, one.pose) for one in dataset.stations})
    found = [Hypothesis(AS_GIVEN, "", 0.0, 0.0)]
    found += _compared(trials_of(*files), files, given, poses)
    # a surface of which neither size nor pattern is right fits with neither of them alone
    patterned = {one.surface for one in found if one.is_better and one.hypothesis in _OF_PATTERN}
    for name in sorted(patterned):
        found += _compared(other_boards(*files, name), files, given, poses)
    best: dict[tuple[str, str], Hypothesis] = {}
    for one in found:
        key = (one.hypothesis, one.surface)
        if key not in best or one.gain > best[key].gain:
            best[key] = one
    return by_gain(best.values())


def _compared(trials: Iterable[Trial], files: Files, given: _Losses, poses: int) -> list[Hypothesis]:
    """Return what trials gain over the losses of poses as ``given``, for a recording of so many ``poses``."""
    found = []
    for trial in trials:
        try:
            score = _score(trial.change(*files))
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
                trial.change,
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


def _score(files: Files) -> dict[tuple[int, int], tuple[float, float]]:
    """Return, for each pose, the mean loss of its pixels and the number of patches that they make up.

    The loss is twice the negative log likelihood up to a constant that all trials share; that of a pose of
    which a trial predicts no pixel is as great as can be, and its patches are not known (0).
    """
    forward = coarse_forward(*files)
    described = np.array([one.is_described for one in files[1].surfaces])
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
            light = ratio**2 / (noise**2 + CAMERA_AMPLITUDE**2)
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
