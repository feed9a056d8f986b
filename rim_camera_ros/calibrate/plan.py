"""The shortest set of experiments that determines everything: identifiability before any data are taken."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.effects import vocabulary
from rim_camera_ros.effects.candidate import Block, Candidate, Facts, Regressor, priors_of
from rim_camera_ros.files import find_scene, shipped
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.decimation import decimated_camera
from rim_camera_ros.fit.design import gain_block, present_blocks
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import accumulate
from rim_camera_ros.frame import NANOSECONDS, Pose, Settings
from rim_camera_ros.scene import Scene, load_scene
from rim_camera_ros.select.candidates import candidates

Array = NDArray[Any]

#: How names of experiments end.
SUFFIX = "_experiment"
#: An effect is determined where the data narrow its parameters by this factor (geometric mean).
NARROWED = 5.0
#: Columns of the coarse sensor of a plan, most stations of an experiment, most experiments of a plan.
_COLUMNS = 44
_STATIONS = 40
_MOST_EXPERIMENTS = 4


@dataclass(frozen=True)
class Experiment:
    """An experiment: its duration [min], and the normal matrix of all parameters (K, K)."""

    name: str
    minutes: float
    gram: Array


@dataclass(frozen=True)
class Plan:
    """The experiments, with the effects that each determines alone, and the shortest set of experiments.

    ``determined`` maps effects to the factor by which the set narrows their parameters.
    """

    alone: Mapping[str, Mapping[str, float]]
    minutes: Mapping[str, float]
    chosen: tuple[str, ...]
    determined: Mapping[str, float]
    open: tuple[str, ...]


def shipped_experiments() -> dict[str, Scene]:
    """Return the scenes of the shipped experiments by name."""
    return {name: load_scene(find_scene(name)) for name in shipped("config") if name.endswith(SUFFIX)}


def plan(
    camera: Camera, scenes: Mapping[str, Scene], *, progress: Callable[[str], None] | None = None
) -> Plan:
    """Find the shortest set of experiments that determines as many effects as all of them together.

    All effects are estimated jointly: those of the camera file about their values, the others about zero.
    Errors of poses and powers and an offset per pixel are nuisances in every experiment.
    """
    small, step = planning_camera(camera)
    built = {name: planned_dataset(scene, small, decimation=step) for name, scene in scenes.items()}
    regressors, experiments = _equations(small, scenes, built, progress)

    def narrowed(chosen: Iterable[Experiment]) -> dict[str, float]:
        return narrowing(regressors, np.sum([experiment.gram for experiment in chosen], axis=0))

    everything = narrowed(experiments)
    wanted = {name for name, factor in everything.items() if factor >= NARROWED}
    best: tuple[int, float, tuple[Experiment, ...]] | None = None
    for size in range(1, _MOST_EXPERIMENTS + 1):
        for subset in combinations(experiments, size):
            got = {name for name, factor in narrowed(subset).items() if factor >= NARROWED}
            entry = (len(got & wanted), -sum(experiment.minutes for experiment in subset), subset)
            if best is None or entry[:2] > best[:2]:
                best = entry
    assert best is not None
    chosen = best[2]
    final = narrowed(chosen)
    return Plan(
        alone={experiment.name: narrowed([experiment]) for experiment in experiments},
        minutes={experiment.name: experiment.minutes for experiment in experiments},
        chosen=tuple(experiment.name for experiment in chosen),
        determined={name: f for name, f in final.items() if f >= NARROWED},
        open=tuple(name for name, f in final.items() if f < NARROWED),
    )


def narrowing(regressors: Sequence[Regressor], gram: Array) -> dict[str, float]:
    """Return by effect the factor by which data narrow its parameters (geometric mean of their sigmas).

    ``gram`` (K, K) is the normal matrix of the ``regressors``, from which nuisances are eliminated. All
    effects are estimated jointly, within their priors.
    """
    prior = priors_of(regressors)
    covariance = np.linalg.inv(gram * prior[:, None] * prior[None, :] + np.eye(len(prior)))
    owners = [regressor.owner for regressor in regressors]
    known = vocabulary()
    result = {}
    for name in (owner for owner in dict.fromkeys(owners) if owner in known and known[owner].planned):
        own = [i for i, owner in enumerate(owners) if owner == name]
        log_det = np.linalg.slogdet(covariance[np.ix_(own, own)])[1]
        result[name] = float(np.exp(-0.5 * log_det / len(own)))
    return result


def blocks_of(camera: Camera, dataset: Dataset) -> list[Block]:
    """Return the regressors of the camera file's effects, the power, and the effects that it may lack.

    Each family of variants is represented by its middle one.
    """
    facts = Facts.of(dataset, moves=False, surfaces=1, camera=camera)
    variants: dict[str, list[Candidate]] = {}
    known = vocabulary()
    for candidate in candidates(camera, facts):
        if known[candidate.effect].planned:
            variants.setdefault(candidate.effect, []).append(candidate)
    middle = [found[len(found) // 2].block for found in variants.values()]
    return [*present_blocks(camera), gain_block(), *middle]


def planning_camera(camera: Camera) -> tuple[Camera, int]:
    """Return the camera on the coarse grid of plans, without tables, and the step of the grid [px]."""
    step = max(1, round(camera.sensor.width / _COLUMNS))
    physics = {name: effect for name, effect in camera.effects.items() if not effect.stated_by_pixels}
    camera = with_effects(camera, physics)
    return (decimated_camera(camera, step) if step > 1 else camera), step


def _equations(
    camera: Camera,
    scenes: Mapping[str, Scene],
    built: Mapping[str, tuple[Dataset, float]],
    progress: Callable[[str], None] | None,
) -> tuple[list[Regressor], list[Experiment]]:
    stations = [station for dataset, _ in built.values() for station in dataset.stations]
    blocks = blocks_of(camera, Dataset(stations))
    experiments = []
    regressors: list[Regressor] = []
    for name, (dataset, minutes) in built.items():
        if progress is not None:
            progress(name)
        forward = Forward(dataset, scenes[name], camera)
        equations = accumulate(forward, blocks)
        regressors = equations.regressors
        experiments.append(Experiment(name, minutes, equations.reduced().gram))
    return regressors, experiments


def planned_dataset(
    scene: Scene, camera: Camera, *, most: int = _STATIONS, decimation: int = 1
) -> tuple[Dataset, float]:
    """Return the stations of a schedule with their expected amplitudes, and its duration in minutes.

    Of more than about ``most`` stations some are skipped, and the others get their frames. The camera has
    every ``decimation``-th pixel of the sensor.
    """
    groups = [
        list(group) for _, group in groupby(Timeline(scene, camera), key=lambda exposure: exposure.station)
    ]
    start, end = groups[0][0].stamp, groups[-1][-1].stamp
    thinned = max(1, len(groups) // most)
    stations = []
    for number, group in enumerate(groups[::thinned]):
        middle = group[len(group) // 2]
        stations.append(
            planned_station(
                camera,
                pose=number,
                frames=len(group) * thinned,
                stamp=middle.stamp,
                time=(middle.stamp - start) / NANOSECONDS,
                settings=middle.settings,
                truth=middle.poses,
            )
        )
    expected = with_expected_light(Dataset(stations, decimation=decimation), scene, camera)
    return expected, (end - start) / NANOSECONDS / 60


def planned_station(
    camera: Camera,
    *,
    pose: int,
    frames: int,
    stamp: int,
    time: float,
    settings: Settings,
    truth: Mapping[str, Pose],
    recording: int = 0,
) -> Station:
    """Return a station that was not recorded: every pixel measures; ``stamp`` in ns, ``time`` in s."""
    shape = camera.shape
    return Station(
        recording=recording,
        pose=pose,
        frames=frames,
        stamp=stamp,
        time=time,
        settings=settings,
        truth=truth,
        distance=np.ones(shape),
        amplitude=np.ones(shape, np.float32),
        distance_variance=np.full(shape, np.nan, np.float32),
        amplitude_variance=np.full(shape, np.nan, np.float32),
        count=np.full(shape, frames, np.int32),
        saturated=np.zeros(shape, np.uint16),
    )


def with_expected_light(dataset: Dataset, scene: Scene, camera: Camera) -> Dataset:
    """Return planned stations with their expected amplitudes."""
    predictions = Forward(dataset, scene, camera).predictions(slopes=False)
    expected = [
        replace(prediction.station, amplitude=np.nan_to_num(prediction.model_reading).astype(np.float32))
        for prediction in predictions
    ]
    return replace(dataset, stations=expected)


def table(result: Plan) -> str:
    """Return the plan as text."""
    lines = ["experiment                     minutes  determines by itself"]
    for name, found in result.alone.items():
        own = ", ".join(effect for effect, factor in found.items() if factor >= NARROWED) or "-"
        lines.append(f"{name:<30} {result.minutes[name]:>7.0f}  {own}")
    total = sum(result.minutes[name] for name in result.chosen)
    lines += ["", f"shortest plan: {' + '.join(result.chosen)} ({total:.0f} min)"]
    lines.append("it determines, with uncertainties smaller than without a recording by a factor of:")
    lines += [f"  {name:<26} {factor:>6.0f}" for name, factor in sorted(result.determined.items())]
    if result.open:
        lines.append(f"not determined by any of them: {', '.join(result.open)}")
    return "\n".join(lines)
