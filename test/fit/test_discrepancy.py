"""What distances err by smoothly in each pose: found by its size, and no reason to move parameters."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import pytest

from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import COMMON_POSE
from rim_camera_ros.fit.discrepancy import discrepancy_columns
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.variance_components import discrepancy_note, likely_discrepancy, pose_chi_squares

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
def test_independent_pixels_have_no_discrepancy(tmp_path: Path, noise: float) -> None:
    """However much they scatter."""
    truth, board = camera(tmp_path, HYPERBOLA), scene(tmp_path)
    loud = replace(truth, noise=replace(truth.noise, amplitude=noise * truth.noise.amplitude))
    problem = Problem(record(loud, board), board)
    assert likely_discrepancy(problem, fit(problem, truth)) is None


@pytest.mark.parametrize("seed", [3, 4])
def test_smooth_errors_are_found_by_their_size_and_move_poses_no_more(tmp_path: Path, seed: int) -> None:
    truth, board = camera(tmp_path, HYPERBOLA), scene(tmp_path)
    problem = Problem(bent(record(truth, board), seed=seed), board)
    plain = fit(problem, truth)
    size = likely_discrepancy(problem, plain)
    assert size is not None
    assert 0.5 * SIZE <= size <= 2 * SIZE
    known = fit(replace(problem, discrepancy=size), truth)
    # errors that poses share are 0 in truth: independent pixels would have moved them for certain
    assert np.abs(pulls(plain)).max() > 5.0
    assert np.abs(pulls(known)).max() < 3.0
    path = "effects.amplitude_offset.hyperbola.60.a"
    assert abs(camera_numbers(known.camera)[path] - 21.0) < 3 * known.sigma[path]
    said = re.search(r"err smoothly over the image, by (\d+\.\d) mm \(RMS\)", discrepancy_note(known))
    assert said is not None
    # tilts of the fields are those of the poses, and what is drawn to 0 is smaller
    assert 0.6 * SIZE < 1e-3 * float(said[1]) <= SIZE
    chi = [float(np.median(list(pose_chi_squares(one).values()))) for one in (plain, known)]
    assert chi[0] > 2.25
    assert chi[1] < 1.2


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


def test_waves_have_mean_squares_of_one_and_are_independent(tmp_path: Path) -> None:
    truth, board = camera(tmp_path), scene(tmp_path)
    forward = Forward(record(truth, board), board, truth)
    view = next(iter(forward.predictions(slopes=False))).view
    columns = discrepancy_columns(view, 0.005)
    waves = np.stack([one.distance[view.geometry.hit] for one in columns])
    assert sum(one.prior**2 for one in columns) == pytest.approx(0.005**2)
    assert view.geometry.hit.all()
    assert waves @ waves.T / waves.shape[1] == pytest.approx(np.eye(len(waves)), abs=1e-9)
