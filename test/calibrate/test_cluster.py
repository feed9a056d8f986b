"""Reductions and fits on a Dask cluster: the same results, also when a worker is lost."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.calibrate.recordings import on_workers, reduce_on_cluster
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.cli import main
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.scene import Scene, load_scene
from rim_camera_ros.select.best_trial import Trials
from rim_camera_ros.select.candidates import candidates
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import explore

from .bags import frames, write
from .helpers import CAMERA, camera, record, scene

#: What the simulated camera has and its file has not.
CYCLIC = CyclicError((Harmonic(4, 0.011, 0.7),), (0.0, 0.0))

SCENE = """
format: rim_scene/1
surfaces:
- {name: wall, type: plane, pose: {position: [0, 0, 2.5]}, reflectivity: 0.7}
schedule:
- {frames: 3, integration_time: 60}
- {frames: 3, integration_time: 100, poses: {wall: {position: [0, 0, 1.7]}}}
"""


@pytest.fixture
def bags(tmp_path: Path) -> tuple[Path, list[Path]]:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "scene.yaml").write_text(SCENE)
    paths = []
    for seed in range(4):
        paths.append(tmp_path / f"bag{seed}")
        arguments = ["simulate", "scene.yaml", "--camera", "camera.yaml", "--seed", str(seed), "--quiet"]
        arguments[1:2] = [str(tmp_path / "scene.yaml")]
        arguments[3] = str(tmp_path / "camera.yaml")
        assert main([*arguments, "--out", str(paths[-1])]) == 0
    return tmp_path / "camera.yaml", paths


def scenes(bags: tuple[Path, list[Path]]) -> list[Scene]:
    return [load_scene(bags[0].with_name("scene.yaml"))] * len(bags[1])


def test_two_workers_reduce_as_one_machine_does(bags: tuple[Path, list[Path]]) -> None:
    distributed = pytest.importorskip("distributed", reason="dask.distributed is an optional extra")
    camera = load_camera(bags[0])
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        parts = reduce_on_cluster(bags[1], camera, scenes(bags), scheduler=cluster.scheduler_address)
    for number, (part, path) in enumerate(zip(parts, bags[1], strict=True)):
        own = reduce_recording(path, camera, recording=number)
        assert [one.pose for one in part.stations] == [one.pose for one in own.stations]
        for one, other in zip(part.stations, own.stations, strict=True):
            assert np.array_equal(one.distance, other.distance, equal_nan=True)
            assert np.array_equal(one.amplitude, other.amplitude)
            assert one.recording == number


def reduced_by_a_worker_that_dies_once(path: Path, camera: Camera, **further: Any) -> Dataset:
    """Reduce a recording; the first worker that begins the second one is killed."""
    marker = path.with_name("a_worker_was_lost")
    if path.name == "bag1" and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return reduce_recording(path, camera, **further)


def test_a_lost_worker_costs_time_and_nothing_else(
    bags: tuple[Path, list[Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="dask.distributed is an optional extra")
    monkeypatch.setattr(
        "rim_camera_ros.calibrate.recordings.reduce_recording", reduced_by_a_worker_that_dies_once
    )
    camera = load_camera(bags[0])
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        parts = reduce_on_cluster(bags[1], camera, scenes(bags), scheduler=cluster.scheduler_address)
    assert (bags[1][0].parent / "a_worker_was_lost").exists()
    for number, (part, path) in enumerate(zip(parts, bags[1], strict=True)):
        own = reduce_recording(path, camera, recording=number)
        assert part.files == [str(path)]
        for one, other in zip(part.stations, own.stations, strict=True):
            assert np.array_equal(one.distance, other.distance, equal_nan=True)


def called_by_a_worker_that_dies_once(marker: Path, function: Callable[[Any], Any], item: Any) -> Any:
    """Call a function; the first worker that begins is killed."""
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return function(item)


@pytest.mark.slow
def test_candidates_are_fitted_as_on_one_machine_though_a_worker_is_lost(tmp_path: Path) -> None:
    """A cyclic error and a wrong scale, each fitted in addition to the camera as it is, to the last bit."""
    distributed = pytest.importorskip("distributed", reason="dask.distributed is an optional extra")
    board = scene(tmp_path)
    data = record(camera(tmp_path, CYCLIC), board, poses=12, seed=3)
    facts = Facts.of(data, moves=False, surfaces=1, camera=camera(tmp_path))
    problem, folds = Problem(data, board), folds_of(data)
    pool = candidates(camera(tmp_path), facts, effects=["cyclic_error", "distance_scale"])
    first = explore(problem, camera(tmp_path), pool, folds, replicates=0)
    choices = [(number,) for number in first.best().values()]
    here = Trials(problem, camera(tmp_path), first, folds).fitted(choices)
    marker = tmp_path / "a_worker_was_lost"
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        on_workers(cluster.scheduler_address) as workers,
    ):

        def dying(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
            return workers(partial(called_by_a_worker_that_dies_once, marker, function), items)

        there = Trials(problem, camera(tmp_path), first, folds, workers=dying).fitted(choices)
    assert marker.exists()
    assert {one.effects[0] for one in there.values()} == {"cyclic_error", "distance_scale"}
    for choice, one in there.items():
        assert one.fitted.fit.parameters == here[choice].fitted.fit.parameters
        assert one.likelihood == here[choice].likelihood
        assert one.fitted.fit.forward.dataset is data


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_diagnosis_on_a_cluster_is_that_of_one_machine_though_a_worker_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cyclic error that the file lacks is fitted by workers, of which the first is killed."""
    distributed = pytest.importorskip("distributed", reason="dask.distributed is an optional extra")
    truth, board = camera(tmp_path, CYCLIC), scene(tmp_path)
    camera(tmp_path)  # the file without it
    write(tmp_path / "bag", frames(truth, board, poses=12, repeats=2, seed=3))
    given = ["diagnose", str(tmp_path / "bag"), "--camera", str(tmp_path / "camera.yaml")]
    given += ["--scene", str(tmp_path / "scene.yaml"), "--quiet"]
    assert main([*given, "--out", str(tmp_path / "here")]) == 0
    marker = tmp_path / "a_worker_was_lost"
    called = []

    @contextlib.contextmanager
    def dying(scheduler: str | None) -> Iterator[Callable[..., Iterator[Any]]]:
        with on_workers(scheduler) as workers:

            def call(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
                called.append(function.__name__)
                return workers(partial(called_by_a_worker_that_dies_once, marker, function), items)

            yield call

    monkeypatch.setattr("rim_camera_ros.commands.diagnose.on_workers", dying)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        scheduler = cluster.scheduler_address
        assert main([*given, "--out", str(tmp_path / "there"), "--scheduler", scheduler]) == 0
    assert marker.exists()
    assert "fit_trial" in called
    here, there = (json.loads((tmp_path / name / "report.json").read_text()) for name in ("here", "there"))
    assert [effect["effect"] for effect in here["missing"]] == ["cyclic_error"]
    assert here == there


def test_without_a_scheduler_the_error_names_the_address(
    bags: tuple[Path, list[Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is an optional extra")
    monkeypatch.setattr("rim_camera_ros.calibrate.recordings._CONNECT_SECONDS", 1)
    with pytest.raises(InputError, match=r"--scheduler tcp://127.0.0.1:1: no scheduler answers"):
        reduce_on_cluster(bags[1], load_camera(bags[0]), scenes(bags), scheduler="tcp://127.0.0.1:1")
