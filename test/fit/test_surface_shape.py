"""Boards that are not flat: a bow and a twist, the same in all poses."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.nuisances import flatness_beyond, nuisances_of
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.effects.candidate import Regressor
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.surface_shape import FORMS, surface_shape_block
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import Scene

from ..calibrate.helpers import camera, record, scene

WIDTH, HEIGHT = 2.4, 1.6


def board_of(tmp_path: Path, **changes: object) -> Scene:
    """The board as a rectangle of 2.4 x 1.6 m."""
    surface = replace(scene(tmp_path).surfaces[0], type="rectangle", size=(WIDTH, HEIGHT), **changes)  # type: ignore[arg-type]
    return Scene((surface,))


def bent(data: Dataset, model: Camera, bow_x: float, bow_y: float, twist: float) -> Dataset:
    """The recording of a board whose middle is nearer than its edges, by lengths along the rays.

    The surface z = h(x, y) is met where the ray has gone h(x, y) / (n . r) farther, to first order.
    """
    stations = []
    for one in data.stations:
        pose = one.truth["board"]
        rotation, position = rotation_matrix(pose.orientation), np.array(pose.position)
        along = model.rays @ rotation[:, 2]
        length = (position @ rotation[:, 2]) / along
        local = (length[..., None] * model.rays - position) @ rotation
        x, y = 2 * local[..., 0] / WIDTH, 2 * local[..., 1] / HEIGHT
        height = bow_x * x**2 + bow_y * y**2 + twist * x * y
        stations.append(replace(one, distance=one.distance + height / along))
    return replace(data, stations=stations)


def test_columns_are_derivatives_of_a_sphere(tmp_path: Path) -> None:
    """A cap of a sphere bows by x^2 / 2 R: against the lengths at which rays meet the sphere itself."""
    model, board = camera(tmp_path), board_of(tmp_path, reflectivity_sigma=0.0)
    radius = 2000.0
    (one,) = Forward(record(model, board, poses=1, frames=1, seed=3), board, model).predictions()
    pose = one.station.truth["board"]
    rotation, position = rotation_matrix(pose.orientation), np.array(pose.position)
    sphere = replace(board.surfaces[0], type="sphere", size=None, radius=radius, texture=None)
    away = rotation[:, 2] * np.sign(position @ rotation[:, 2])
    centre = replace(pose, position=tuple((position + radius * away).tolist()))
    lengths = sphere.lengths(centre, np.zeros(3), model.rays.reshape(-1, 3)).reshape(model.shape)
    columns = dict(zip(FORMS, surface_shape_block(board).columns(one), strict=True))
    sign = np.sign(position @ rotation[:, 2])
    bows = sign * np.array([WIDTH**2, HEIGHT**2]) / (8 * radius)
    normal_change = 1 / (model.rays @ away)
    # a form has the mean zero over the board: the cap touches the plane in the middle
    expected = lengths - one.view.geometry.distance - (bows.sum() * sign / 3) * normal_change
    found = bows[0] * columns["bow_x"][0] + bows[1] * columns["bow_y"][0]
    assert one.used.sum() > 100
    assert found[one.used] == pytest.approx(expected[one.used], abs=1e-6)
    assert np.ptp(found[one.used]) > 6e-5


def test_a_bow_and_a_twist_are_found_with_their_signs(tmp_path: Path) -> None:
    model, board = camera(tmp_path), board_of(tmp_path)
    data = bent(record(model, board, poses=30, seed=5), model, 0.0031, -0.0014, 0.0022)
    found = fit(Problem(data, board), model)
    for form, true in (("bow_x", 0.0031), ("bow_y", -0.0014), ("twist", 0.0022)):
        path = f"surface_shape.board.{form}"
        assert abs(found.parameters[path] - true) < 3 * found.sigma[path]
        assert found.sigma[path] < 0.0005
    (flatness,) = [one for one in nuisances_of(found, model) if one.name == "flatness"]
    assert flatness.stated == 0.001
    assert flatness.found == pytest.approx(np.sqrt(np.mean(np.square([3.1, 1.4, 2.2]))) * 1e-3, rel=0.25)
    assert flatness_beyond(found) is None


def test_a_shape_beyond_is_that_of_one_surface_in_its_stated_sizes(tmp_path: Path) -> None:
    """Forty boards of chance shapes are not beyond together; a small one that is stated to be flatter is."""
    model, board = camera(tmp_path), board_of(tmp_path)
    found = fit(Problem(record(model, board, poses=3, seed=5), board), model)
    stated = {f"surface_shape.b{i}.{form}": 0.001 for i in range(40) for form in FORMS}
    stated["surface_shape.plate.twist"] = 0.0002
    regressors = tuple(Regressor(label, "shape", size) for label, size in stated.items())
    sizes = np.random.default_rng(3).standard_normal(len(stated))
    for flat, message in ((0.0005, None), (-0.0017, r"shape: plate is twisted by 1\.7 mm, 8 times what")):
        values = {label: z * size for (label, size), z in zip(stated.items(), sizes, strict=True)}
        values["surface_shape.plate.twist"] = flat
        several = replace(found, equations=replace(found.equations, regressors=regressors), parameters=values)
        beyond = flatness_beyond(several)
        assert (beyond is None) == (message is None)
        if message is not None:
            assert re.match(message, str(beyond))


def test_only_what_has_an_extent_and_a_stated_size_may_bow(tmp_path: Path) -> None:
    assert surface_shape_block(scene(tmp_path)).regressors == ()  # a plane without end
    assert surface_shape_block(board_of(tmp_path, flatness_sigma=0.0)).regressors == ()
    disc = replace(scene(tmp_path).surfaces[0], type="disc", radius=0.4, flatness_sigma=0.0002)
    assert [one.prior for one in surface_shape_block(Scene((disc,))).regressors] == [0.0002] * 3


@pytest.mark.parametrize(("bow", "verdict"), [(0.003, "consistent"), (0.012, "inconsistent_setup")])
@pytest.mark.long
def test_a_bowed_board_is_no_physics(tmp_path: Path, bow: float, verdict: str) -> None:
    model, board = camera(tmp_path), board_of(tmp_path)
    data = bent(record(model, board, poses=24, seed=8), model, bow, 0.5 * bow, 0.0)
    found = diagnose(data, board, model)
    assert (found.verdict, found.missing) == (verdict, [])
    if verdict == "inconsistent_setup":
        size = re.match(r"shape: board bows along its x axis by ([\d.]+) mm, \d+ times", str(found.reason))
        # the stated millimetre pulls
        assert size is not None
        assert 7 < float(size[1]) < 12.5
        assert "state a larger flatness_sigma" in str(found.reason)
    # without the nuisance it was an effect or unknown physics
    rigid = diagnose(data, board_of(tmp_path, flatness_sigma=0.0), model)
    assert rigid.verdict in ("missing_physics", "unknown_physics", "inconsistent_setup")
