"""The comparison of set-ups: robust and coarse, so that physics is not mistaken for another set-up.

Neighbouring pixels of a tile count as one observation. Errors of distances are penalised little up to those
of an uncalibrated camera, errors of reflectivities up to those that the scene states. Models are compared by
the paired differences of their poses (Vehtari, Gelman & Gabry 2017).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import in_order
from rim_camera_ros.diagnose.hypotheses import (
    AS_GIVEN,
    LEAST_GAIN,
    Files,
    Hypothesis,
    Trial,
    by_gain,
    share_explained,
)
from rim_camera_ros.diagnose.setup_likelihood import Difference, SetupPrediction, difference, predicted
from rim_camera_ros.diagnose.setup_trials import LEAST_LENS, of_any_sides, other_boards, refined, trials_of
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.decimation import decimated_camera, decimated_dataset
from rim_camera_ros.fit.views import Views
from rim_camera_ros.scene import Scene

#: Hypotheses about the tiles of a surface.
_OF_PATTERN = frozenset({"turned_180", "mirrored", "inverted", "turned_90", "other_pattern", "scale"})
#: Most poses by which hypotheses are compared, and about how many pixels of each.
_MOST_POSES = 8
_ENOUGH_PIXELS = 1600


def compare_setups(dataset: Dataset, scene: Scene, camera: Camera) -> list[Hypothesis]:
    """Return the set-ups by their gain over the files as given, whose gain is 0; the best first."""
    files = _coarse(dataset, scene, camera)
    views = Views(files[2], files[1], decimation=files[0].decimation)
    given = predicted(files, views=views)
    poses = dataset.poses
    found = [Hypothesis(AS_GIVEN, "", 0.0, 0.0, value=given.offset)]
    found += _compared(trials_of(*files), files, given, poses, views)
    # a surface with wrong size and wrong pattern fits only where both are changed
    patterned = {
        hypothesis.surface
        for hypothesis in found
        if hypothesis.is_better and hypothesis.hypothesis in _OF_PATTERN
    }
    for name in sorted(patterned):
        found += _compared(other_boards(files, name), files, given, poses, views)
    best = _best_of_each(found)
    # sizes and focal lengths between the tried ones
    near = next((hypothesis for hypothesis in best if hypothesis.is_better and hypothesis.at), None)
    if near is not None and near.at is not None:
        around = refined(near.at, near, lambda trials: _compared(trials, files, given, poses, views))
        best = _best_of_each([*best, *around])
    board = _board_of_other_size(best)
    if board is not None:
        other = of_any_sides(files, board, lambda trials: _compared(trials, files, given, poses, views))
        best = _best_of_each([other, *best])
    return by_gain(_decided(best, dataset, scene, camera))


def _board_of_other_size(best: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the board of another size for a leader whose other pattern explains too little, or None."""
    leader = best[0]
    if not leader.is_better or leader.wins or not leader.is_repainted:
        return None
    boards = (board for board in best if board.sides is not None and board.surface == leader.surface)
    return next(boards, None)


def against_physics(
    setups: Iterable[Hypothesis],
    dataset: Dataset,
    scene: Scene,
    camera: Camera,
    *,
    found: Camera,
) -> list[Hypothesis]:
    """Return set-ups by their gain over the files as given with the camera ``found``, the best first.

    Set-ups that gained nothing over the files alone, and those that are parameters of the fit, stay as they
    are. Each of the others is compared with the camera of the file and with that found, as both may be wrong.
    A focal length of another lens in the camera found is that set-up and no physics; effects that are valid
    only with its rays are no physics either.
    """
    try:
        if abs(found.optics.fx / camera.optics.fx - 1) > LEAST_LENS:
            found = in_order(replace(found, optics=camera.optics))
        given = predicted(_coarse(dataset, scene, found))
    except InputError:
        found = camera
        given = predicted(_coarse(dataset, scene, found))
    again = []
    for setup in setups:
        trial = setup.trial
        if not setup.is_better or setup.fitted or trial is None:
            again.append(setup)
            continue
        for own in (camera, found):
            files = _coarse(dataset, scene, own)
            views = Views(files[2], files[1], decimation=files[0].decimation)
            compared = _compared([trial], files, given, dataset.poses, views)
            again += [replace(each, share=setup.share, against_physics=True) for each in compared]
    return _best_of_each(again)


def _decided(
    found: Iterable[Hypothesis], dataset: Dataset, scene: Scene, camera: Camera
) -> Iterator[Hypothesis]:
    """Yield set-ups; those whose gain by some of the poses is not significant are compared by all poses."""
    if dataset.poses <= _MOST_POSES:
        yield from found
        return
    files: Files | None = None
    for hypothesis in found:
        trial = hypothesis.trial
        if trial is None or hypothesis.is_better or hypothesis.gain <= LEAST_GAIN:
            yield hypothesis
            continue
        if files is None:
            files = _coarse(dataset, scene, camera, most=dataset.poses)
            views = Views(files[2], files[1], decimation=files[0].decimation)
            given = predicted(files, views=views)
        yield from _compared([trial], files, given, dataset.poses, views)


def _coarse(dataset: Dataset, scene: Scene, camera: Camera, *, most: int | None = None) -> Files:
    """Return files with about `_ENOUGH_PIXELS` pixels of ``most`` poses at most (None: `_MOST_POSES`)."""
    chosen = _some_poses(dataset, most or _MOST_POSES)
    step = round(np.sqrt(camera.sensor.width * camera.sensor.height / _ENOUGH_PIXELS))
    if step > 1:
        chosen, camera = decimated_dataset(chosen, step), decimated_camera(camera, step)
    return chosen, scene, camera


def _best_of_each(found: Iterable[Hypothesis]) -> list[Hypothesis]:
    best: dict[tuple[str, str], Hypothesis] = {}
    for hypothesis in found:
        key = (hypothesis.hypothesis, hypothesis.surface)
        if key not in best or hypothesis.gain > best[key].gain:
            best[key] = hypothesis
    return by_gain(best.values())


def _compared(
    trials: Iterable[Trial], files: Files, given: SetupPrediction, poses: int, views: Views
) -> list[Hypothesis]:
    """Return the gains of trials over the files as ``given``, for a recording of so many ``poses``.

    ``views`` are those of the files.

    A trial that gains in none of a few poses, and loses there as much as it would have to gain in all, is not
    compared any further.
    """
    found = []
    few, others = _split(files)
    for trial in trials:
        try:
            seen = predicted(trial.change(*few), views=views)
            own = difference(given, seen)
            if others is not None and not _is_worse(own):
                own = difference(given, predicted(trial.change(*others), seen, views=views))
        except RimError:
            continue
        count = own.poses.size
        if not count:
            continue
        gain = float(own.poses.sum())
        error = float(np.std(own.poses, ddof=1) * np.sqrt(count)) if count > 1 else np.inf
        # the poses are a sample of those of the recording, the tiles are the same in all of them
        share = poses / count
        # penalty for sizes that were chosen (Schwarz, The Annals of Statistics 6, 1978)
        chosen = 0.5 * trial.free * float(np.log(max(own.count * share, 1.0)))
        found.append(
            Hypothesis(
                trial.hypothesis,
                trial.surface,
                gain * share + own.reflectivities - chosen,
                error * share,
                trial.value,
                share_explained(own.short - own.left, own.short),
                trial.change,
                fitted=trial.fitted,
                at=trial.at,
                sides=trial.sides,
            )
        )
    return found


def _is_worse(own: Difference) -> bool:
    return bool(own.poses.size and own.poses.max() <= 0 and own.poses.sum() < -LEAST_GAIN)


def _split(files: Files) -> tuple[Files, Files | None]:
    """Return files with the first, a middle and the last station, and files with the others, if any."""
    dataset, scene, camera = files
    count = len(dataset.stations)
    few = {0, count // 2, count - 1}
    parts = [
        [station for k, station in enumerate(dataset.stations) if (k in few) is kept]
        for kept in (True, False)
    ]
    first, rest = (replace(dataset, stations=part) for part in parts)
    return (first, scene, camera), (rest, scene, camera) if rest.stations else None


def _some_poses(dataset: Dataset, most: int) -> Dataset:
    """Return the dataset with one station each of ``most`` poses at most, spread over the recording."""
    first: dict[tuple[int, int], Station] = {}
    for station in dataset.stations:
        first.setdefault((station.recording, station.pose), station)
    stations = list(first.values())
    step = max(1, -(-len(stations) // most))
    return replace(dataset, stations=stations[::step])
