"""Poses that come with their own covariance: it takes the place of the scene's pose_sigma."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.calibrate.run import Request, calibrate
from rim_camera_ros.fit.data import with_stated_errors
from rim_camera_ros.fit.design import common_pose_block
from rim_camera_ros.fit.pose_errors import WiderSurface, wider_poses_note
from rim_camera_ros.fit.views import Views
from rim_camera_ros.frame import Pose, RawFrame
from rim_camera_ros.rotations import rotation_matrix

from ..calibrate.bags import frames, write
from ..calibrate.helpers import camera, record, scene


def _covariance(sigmas: list[float], *, seed: int | None = None) -> tuple[float, ...]:
    """Of x y z [m] and rotations [rad]; correlated where there is a seed."""
    root = np.diag(sigmas)
    if seed is not None:
        root = (
            root
            @ np.linalg.qr(np.random.default_rng(seed).normal(size=(6, 6)))[0]
            @ np.diag([1, 2, 3, 1, 2, 3])
        )
    matrix = root @ root.T
    return tuple(((matrix + matrix.T) / 2).ravel().tolist())


def test_isotropic_errors_are_those_of_pose_sigma(tmp_path: Path) -> None:
    board = scene(tmp_path)
    station = record(camera(tmp_path), board, poses=1, frames=1).stations[0]
    pose = replace(station.truth["board"], covariance=_covariance([0.001] * 3 + [0.0005] * 3))
    given = Views(camera(tmp_path), board).view(station).pose_columns
    own = Views(camera(tmp_path), board).view(replace(station, truth={"board": pose})).pose_columns
    assert [one.path for one in own] == [one.path for one in given]
    for one, other in zip(own, given, strict=True):
        assert one.prior == pytest.approx(other.prior, rel=1e-12)
        np.testing.assert_allclose(one.distance, other.distance, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(one.amplitude, other.amplitude, rtol=1e-9, atol=1e-12)


def test_the_variance_of_distances_is_that_of_moved_poses(tmp_path: Path) -> None:
    board, own = scene(tmp_path), camera(tmp_path)
    station = record(own, board, poses=1, frames=1).stations[0]
    stated = station.truth["board"]
    values = _covariance([3e-4, 5e-4, 9e-4, 4e-4, 7e-4, 2e-4], seed=3)
    view = Views(own, board).view(replace(station, truth={"board": replace(stated, covariance=values)}))
    columns = np.array([one.prior * one.distance[10:30:9, 5:40:11].ravel() for one in view.pose_columns])
    # independently: the surface is moved and turned in the optical frame, and seen anew
    step, changes = 1e-6, []
    for k in range(6):
        seen = []
        for sign in (1, -1):
            move = np.zeros(6)
            move[k] = sign * step
            position = np.array(stated.position) + move[:3]
            turn = rotation_matrix((move[3] / 2, move[4] / 2, move[5] / 2, 1.0))
            matrix = turn @ rotation_matrix(stated.orientation)
            normal = matrix[:, 2]
            seen.append((position @ normal) / (own.rays @ normal))
        changes.append(((seen[0] - seen[1]) / (2 * step))[10:30:9, 5:40:11].ravel())
    jacobian = np.array(changes).T
    expected = jacobian @ np.array(values).reshape(6, 6) @ jacobian.T
    np.testing.assert_allclose(columns.T @ columns, expected, rtol=1e-5, atol=1e-12)


def test_what_poses_have_in_common_is_a_share_of_the_covariance_that_they_bring(tmp_path: Path) -> None:
    """RMS of 3 and 4 mm is 3.54 mm, of which the scene says that 0.3 of the variance is common."""
    board = scene(tmp_path)
    board = replace(board, surfaces=(replace(board.surfaces[0], pose_common=0.3),))
    data = record(camera(tmp_path), board, poses=2, frames=1)
    sizes = ([0.003] * 3 + [0.001] * 3, [0.004] * 3 + [0.002] * 3)
    stations = [
        replace(one, truth={"board": replace(one.truth["board"], covariance=_covariance(own))})
        for one, own in zip(data.stations, sizes, strict=True)
    ]
    stated = with_stated_errors(board, replace(data, stations=stations))
    (surface,) = stated.surfaces
    assert surface.pose_sigma == pytest.approx((np.sqrt(12.5e-6), np.sqrt(2.5e-6)))
    priors = {one.label: one.prior for one in common_pose_block(stated).regressors}
    assert priors == pytest.approx(
        {
            "common_pose.board.offset": np.sqrt(0.3 * 12.5e-6),
            "common_pose.board.tilt_x": np.sqrt(0.3 * 2.5e-6),
            "common_pose.board.tilt_y": np.sqrt(0.3 * 2.5e-6),
        }
    )
    # poses without one are as the scene file says
    assert with_stated_errors(board, data) == board


@pytest.fixture(scope="module")
def shaky(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[RawFrame]]:
    folder = tmp_path_factory.mktemp("shaky")
    return folder, list(frames(camera(folder), scene(folder), seed=4, wrong=6.0))


def _stated(taken: list[RawFrame], factor: float) -> list[RawFrame]:
    """The frames whose poses state errors of ``factor`` times the scene's."""
    covariance = _covariance([0.001 * factor] * 3 + [0.0005 * factor] * 3)

    def certain(pose: Pose) -> Pose:
        return replace(pose, covariance=covariance)

    return [replace(one, truth={name: certain(pose) for name, pose in one.truth.items()}) for one in taken]


def test_larger_errors_that_are_stated_are_not_noticed(shaky: tuple[Path, list[RawFrame]]) -> None:
    folder, taken = shaky
    path = write(folder / "stated", iter(_stated(taken, 6.0)))
    found = calibrate(
        Request((path,), camera(folder), scene(folder), effects=("cyclic_error",)), integral=False
    )
    assert not any("err by" in note for note in found.notes)


@pytest.mark.long
def test_errors_larger_than_stated_are_noticed(shaky: tuple[Path, list[RawFrame]]) -> None:
    folder, taken = shaky
    path = write(folder / "smaller", iter(_stated(taken, 1.0)))
    board = scene(folder)
    found = calibrate(Request((path,), camera(folder), board, effects=("cyclic_error",)), integral=False)
    wider = found.solution.fit.scene
    (surface,) = wider.surfaces
    assert isinstance(surface, WiderSurface)
    assert surface.factors[0] == pytest.approx(6.0, rel=0.6)
    assert surface.factors[1] == pytest.approx(6.0, rel=0.6)
    assert "poses of 'board' err by" in wider_poses_note(board, wider)
    assert any("times what the recording states with them" in note for note in found.notes)
