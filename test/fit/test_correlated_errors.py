"""What distances err by smoothly in each pose: found by its size, and no reason to move parameters."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace

import cv2
import numpy as np
import pytest

from rim_camera_ros.calibrate.adjustment import Adjustment, adjust, steps_of
from rim_camera_ros.calibrate.large_sensor import LargeSensor
from rim_camera_ros.calibrate.recordings import Watch
from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.fit import decimation
from rim_camera_ros.fit.correlated_errors import correlated_columns, half_waves_of
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import COMMON_POSE
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.variance_components import (
    correlated_error_note,
    correlated_evidences,
    likely_correlated_error,
    pose_chi_squares,
)
from rim_camera_ros.reports.diagnosis.page import page

from ..calibrate.helpers import camera, record, scene

SIZE = 0.008
HYPERBOLA = AmplitudeOffset(MappingProxyType({t: Hyperbola(21.0, 1.5) for t in (16.0, 60.0, 100.0)}))


def bent(dataset: Dataset, *, seed: int) -> Dataset:
    """Distances with a smooth random field of `SIZE` (RMS) in each pose, 8 px wide."""
    rng = np.random.default_rng(seed)
    fields: dict[int, np.ndarray] = {}
    stations = []
    for one in dataset.stations:
        if one.placed not in fields:
            field = cv2.GaussianBlur(rng.standard_normal(one.distance.shape), (0, 0), 8.0)
            fields[one.placed] = SIZE * field / np.std(field)
        stations.append(replace(one, distance=one.distance + fields[one.placed]))
    return replace(dataset, stations=stations)


def pulls(fitted: Fit) -> np.ndarray:
    priors = {one.label: one.prior for one in fitted.equations.regressors}
    return np.array([v / priors[k] for k, v in fitted.parameters.items() if k.startswith(COMMON_POSE)])


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_independent_pixels_have_no_correlated_error(tmp_path: Path, noise: float) -> None:
    """However much they scatter."""
    truth, board = camera(tmp_path, HYPERBOLA), scene(tmp_path)
    loud = replace(truth, noise=replace(truth.noise, amplitude=noise * truth.noise.amplitude))
    problem = Problem(record(loud, board), board)
    assert likely_correlated_error(problem, fit(problem, truth)) is None


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4])
def test_smooth_errors_are_found_by_their_size_and_move_poses_no_more(tmp_path: Path, seed: int) -> None:
    truth, board = camera(tmp_path, HYPERBOLA), scene(tmp_path)
    problem = Problem(bent(record(truth, board), seed=seed), board)
    plain = fit(problem, truth)
    size = likely_correlated_error(problem, plain)
    assert size is not None
    assert 0.5 * SIZE <= size <= 2 * SIZE
    known = fit(replace(problem, correlated_error=size), truth)
    # errors that poses share are 0 in truth: independent pixels would have moved them for certain
    assert np.abs(pulls(plain)).max() > 5.0
    assert np.abs(pulls(known)).max() < 3.0
    path = "effects.amplitude_offset.hyperbola.60.a"
    assert abs(camera_numbers(known.camera)[path] - 21.0) < 3 * known.sigma[path]
    said = re.search(r"err smoothly over the image, by (\d+\.\d) mm \(RMS\)", correlated_error_note(known))
    assert said is not None
    # tilts of the fields are those of the poses, and what is drawn to 0 is smaller
    assert 0.6 * SIZE < 1e-3 * float(said[1]) <= SIZE
    chi = [float(np.median(list(pose_chi_squares(one).values()))) for one in (plain, known)]
    assert chi[0] > 2.25
    assert chi[1] < 1.2


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4])
def test_smooth_errors_of_poses_are_no_set_up_and_no_physics_by_name(tmp_path: Path, seed: int) -> None:
    """Independent pixels would make them a depth, or a drift and a cyclic error."""
    truth, board = camera(tmp_path, HYPERBOLA), scene(tmp_path)
    found = diagnose(bent(record(truth, board), seed=seed), board, truth)
    assert found.verdict == "unknown_physics"
    assert [one.effect for one in found.missing] == ["unknown"]
    assert "distances of every pose err smoothly over the image" in found.missing[0].sentence
    assert 0.5 * SIZE < found.missing[0].magnitude < SIZE
    assert found.where.pixels.min() > 0.0


@pytest.mark.parametrize(("poses", "expected"), [(5, 6), (27, 6), (53, 4), (1000, 1)])
def test_many_poses_have_fewer_waves_each(poses: int, expected: int) -> None:
    assert half_waves_of(poses) == expected
    assert poses * half_waves_of(poses) ** 2 <= 1000


def adjusted(folder: Path, dataset: Dataset, words: tuple[str, ...]) -> Adjustment:
    truth = camera(folder, HYPERBOLA)
    return adjust(
        truth,
        dataset,
        scene(folder),
        words,
        steps=steps_of(truth, words),
        surfaces=1,
        geometry=False,
        seed=1,
        threads=1,
        watch=Watch(None, None),
    )


@pytest.mark.long
def test_a_coarser_grid_tells_as_much_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the pixels gives the parameter that all of them give, with no smaller sigma."""
    words = ("amplitude_offset",)
    dataset = bent(record(camera(tmp_path, HYPERBOLA), scene(tmp_path)), seed=3)
    whole = adjusted(tmp_path, dataset, words)
    monkeypatch.setattr(decimation, "_CORRELATED_PIXELS", 350)  # of the test's 44 x 36
    coarse = adjusted(tmp_path, dataset, words)
    assert whole.large is None
    assert coarse.large is not None
    assert coarse.large.step == 2
    assert any("fitted to one of 2 x 2 pixels" in note for note in coarse.notes)
    for one in (whole, coarse):
        assert any("distances of every pose err smoothly" in note for note in one.notes)
    path = "effects.amplitude_offset.hyperbola.60.a"
    values, sigmas = zip(
        *(
            (camera_numbers(one.outcome.solution.camera())[path], one.outcome.solution.fit.sigma[path])
            for one in (whole, coarse)
        ),
        strict=True,
    )
    assert abs(values[1] - 21.0) < 3 * sigmas[1]
    assert abs(values[1] - values[0]) < 2 * sigmas[0]
    assert sigmas[0] < sigmas[1] < 2 * sigmas[0]


def test_independent_pixels_are_all_fitted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decimation, "_CORRELATED_PIXELS", 350)
    dataset = record(camera(tmp_path, HYPERBOLA), scene(tmp_path))
    assert adjusted(tmp_path, dataset, ("amplitude_offset",)).large is None


@pytest.mark.parametrize(
    ("size", "words", "steps"),
    [
        ((176, 144), None, (1, 2)),
        ((176, 144), ("amplitude_offset",), (1, 2)),
        ((176, 144), ("fixed_pattern_offset",), (1, 1)),
        ((512, 424), None, (3, 6)),
        ((512, 424), ("scattering",), (1, 1)),
        ((88, 72), None, (1, 1)),
    ],
)
def test_grids(
    tmp_path: Path, size: tuple[int, int], words: tuple[str, ...] | None, steps: tuple[int, int]
) -> None:
    given = camera(tmp_path, HYPERBOLA)
    given = replace(given, sensor=replace(given.sensor, width=size[0], height=size[1]))
    assert steps_of(given, words) == steps


def test_offsets_of_all_pixels_of_a_large_sensor_are_without_them(tmp_path: Path) -> None:
    """The pixels that were not fitted have the errors of those that were."""
    truth, board = camera(tmp_path, HYPERBOLA), scene(tmp_path)
    large = LargeSensor(truth, bent(record(truth, board), seed=3), board, 2)
    small, few = large.coarse
    known = fit(Problem(few, board, correlated_error=SIZE), small)
    apart = []
    for size in (SIZE, 0.0):
        known.forward.correlated_error = size
        found, _ = large.finished(SimpleNamespace(fit=known, factor=1.0), edges_within=0, tick=lambda: None)
        offsets = found.effects["fixed_pattern_offset"].map.values
        apart.append(float(np.median(np.abs(offsets[1::2, 1::2] - known.pattern))))
    # where pixels were fitted they are the offsets of the fit, less their noise
    assert apart[0] < 0.001
    assert apart[1] > 0.002


def test_the_evidence_of_a_size_is_that_of_a_fit_with_it(tmp_path: Path) -> None:
    """Pixels are eliminated once for all sizes; an adjustment with another eliminates them anew."""
    truth, board = camera(tmp_path, HYPERBOLA), scene(tmp_path)
    problem = Problem(bent(record(truth, board, poses=10), seed=3), board, robust=False)
    first, other = (
        fit(replace(problem, correlated_error=size), truth, iterations=0) for size in (0.001, 0.008)
    )
    scaled, own = correlated_evidences(first, [0.008])[0], correlated_evidences(other, [0.008])[0]
    assert scaled == pytest.approx(own, rel=1e-9)
    assert own > correlated_evidences(first, [0.001])[0]


def test_waves_have_mean_squares_of_one_and_are_independent(tmp_path: Path) -> None:
    truth, board = camera(tmp_path), scene(tmp_path)
    forward = Forward(record(truth, board), board, truth)
    view = next(iter(forward.predictions(slopes=False))).view
    assert view.geometry.hit.all()
    rows, columns_seen = np.arange(36) >= 7, np.arange(44) < 31
    columns = correlated_columns(view, 0.005, measured=(rows, columns_seen), half_waves=6)
    waves = np.stack([one.distance[rows][:, columns_seen].ravel() for one in columns])
    assert sum(one.prior**2 for one in columns) == pytest.approx(0.005**2)
    assert waves @ waves.T / waves.shape[1] == pytest.approx(np.eye(len(waves)), abs=1e-9)


@pytest.mark.long
def test_a_diagnosis_of_a_large_sensor_looks_at_a_coarser_grid_still(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 88 x 72 pixels one of 2 x 2, and where neighbours share their errors one of 4 x 4."""
    monkeypatch.setattr(decimation, "MANY_PIXELS", 3000)
    monkeypatch.setattr(decimation, "_COARSE_PIXELS", 1600)
    monkeypatch.setattr(decimation, "_CORRELATED_PIXELS", 390)
    truth = camera(tmp_path, HYPERBOLA)
    optics = replace(truth.optics, fx=100.0, fy=100.0, cx=43.4, cy=34.8)
    truth = replace(truth, sensor=replace(truth.sensor, width=88, height=72), optics=optics)
    board = scene(tmp_path)
    found = diagnose(bent(record(truth, board), seed=3), board, truth)
    assert found.verdict == "unknown_physics"
    assert (found.step, found.model.shape, found.camera.shape) == (4, (18, 22), (72, 88))
    assert found.where.pixels.shape == (72, 88)
    assert [note for note in found.notes if "one was looked at" in note] == [
        "of every 4 x 4 pixels one was looked at"
    ]
    text = page(found, recording="bag", camera="camera.yaml", scene="scene.yaml")
    assert "88 × 72 px" in text
