"""Work on several threads: results in order, and what is summed over them the same to the last bit."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.ambient_temperature import AmbientTemperature
from rim_camera_ros.effects.candidate import Block, Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import gain_block, present_blocks
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import NormalEquations, accumulate
from rim_camera_ros.fit.residuals import amplitude_error, huber
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.candidates import candidates
from rim_camera_ros.select.evidence import Scores, folds_of
from rim_camera_ros.select.null_replicates import null_scores
from rim_camera_ros.threads import available, in_order

from .calibrate.helpers import camera, record, scene


def test_as_many_threads_as_cores_at_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {3, 5, 6})
    assert available() == 3
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(64)))
    assert available() == 4
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert available() == 2


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_results_come_in_the_order_of_the_items(threads: int) -> None:
    later = threading.Event()

    def work(item: int) -> int:
        # the first is ready only after the second, where there is a thread for it
        if item == 0 and threads > 1:
            assert later.wait(10)
        if item == 1:
            later.set()
        return item * item

    assert list(in_order(work, range(7), threads=threads)) == [0, 1, 4, 9, 16, 25, 36]


def test_items_are_taken_in_the_calling_thread_and_few_ahead() -> None:
    taken: list[threading.Thread] = []

    def items() -> Iterator[int]:
        for i in range(20):
            taken.append(threading.current_thread())
            yield i

    results = in_order(lambda item: item, items(), threads=2)
    assert next(results) == 0
    assert len(taken) == 3
    assert list(results) == list(range(1, 20))
    assert set(taken) == {threading.current_thread()}


@pytest.mark.parametrize("threads", [1, 2])
def test_what_the_work_or_the_items_raise_is_raised(threads: int) -> None:
    def ends() -> Iterator[int]:
        yield 1
        raise KeyError("cancelled")

    def works(item: int) -> float:
        return 1 / (item - 2)

    with pytest.raises(KeyError, match="cancelled"):
        list(in_order(works, ends(), threads=threads))
    results = in_order(works, range(5), threads=threads)
    assert [next(results), next(results)] == [-0.5, -1.0]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_threads_warn_as_the_calling_thread_does() -> None:
    with np.errstate(divide="raise"), pytest.raises(FloatingPointError):
        list(in_order(lambda one: np.ones(1) / one, [np.zeros(1)], threads=2))


@dataclass(frozen=True)
class _Laboratory:
    data: Dataset
    board: Scene
    camera: Camera
    blocks: list[Block]

    def forward(self, threads: int = 1) -> Forward:
        found = Forward(self.data, self.board, self.camera)
        found.threads = threads
        found.estimate_amplitudes()
        return found


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> _Laboratory:
    """A camera with an effect that keeps a state from frame to frame, and candidates that keep others."""
    tmp_path = tmp_path_factory.mktemp("laboratory")
    truth = camera(
        tmp_path,
        CyclicError((Harmonic(4, 0.011, 0.7),)),
        AmbientTemperature(0.003, 20.0, 300.0),
        Scattering((Kernel(0.02, (5.0, 7.0)),)),
    )
    board = scene(tmp_path)
    data = record(truth, board, poses=9, frames=2, seed=3)
    facts = replace(Facts.of(data, moves=False, surfaces=2, camera=truth), surfaces=2)
    blocks = [*present_blocks(truth), gain_block()]
    blocks += [one.block for one in candidates(truth, facts)]
    bare = camera(tmp_path, *(e for name, e in truth.effects.items() if name != "ambient_temperature"))
    blocks += [one.block for one in candidates(bare, facts) if one.effect == "ambient_temperature"]
    assert sum(block.in_order for block in blocks) > 2
    return _Laboratory(data, board, truth, blocks)


def test_sums_are_those_of_one_station_after_the_other(laboratory: _Laboratory) -> None:
    forward = laboratory.forward()
    whole: Any = 0.0
    for one in forward.predictions():
        columns = [column for block in laboratory.blocks for column in block.columns(one)]
        far = [distance for distance, _ in columns] + [one.residual]
        light = [np.zeros(one.used.shape) if a is None else a for _, a in columns] + [one.amplitude_residual]
        for rows, used, sigma in (
            (far, one.used, one.sigma),
            (light, one.amplitude_used, one.amplitude_sigma),
        ):
            design = np.nan_to_num(np.stack([row[used] / sigma[used] for row in rows]))
            whole = whole + design @ design.T
    (fold,) = accumulate(forward, laboratory.blocks).folds
    own = np.r_[np.arange(len(whole) - 1), len(fold.gram) - 1]
    scale = np.sqrt(np.diag(whole))
    scale = np.where(scale > 0, scale, 1.0)
    difference = (fold.gram[np.ix_(own, own)] - whole) / scale[:, None] / scale
    assert np.abs(difference).max() < 1e-9


def test_equations_are_the_same_with_any_number_of_threads(laboratory: _Laboratory) -> None:
    folds = folds_of(laboratory.data)

    def made(threads: int) -> tuple[NormalEquations, float]:
        forward = laboratory.forward(threads)
        weigh = huber(np.full(forward.camera.shape, 0.001), {"0.0.gain": 0.01})
        error = amplitude_error(forward, {"0.3.gain": 0.02})
        return accumulate(forward, laboratory.blocks, fold_of=folds, weigh=weigh), error

    (one, error), (three, again) = made(1), made(3)
    assert error == again
    for a, b in zip(one.folds, three.folds, strict=True):
        assert a.nuisances == b.nuisances
        assert (a.rows, a.log_sigma) == (b.rows, b.log_sigma)
        for name in ("gram", "pixel", "weight"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
    base = range(3)
    assert Scores(one, base).held_out([4, 7]) == Scores(three, base).held_out([4, 7])
    drawn = [null_scores(Scores(each, base), replicates=5, seed=2).held_out([5]) for each in (one, three)]
    assert np.array_equal(*drawn)
