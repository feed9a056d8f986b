"""Ordinary imperfections are found as what they are, and raise no alarm. Nulls first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Camera, Covariance
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.light_curves import LOBE
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.effects.sections import light_block
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit import normal_equations
from rim_camera_ros.fit.design import common_pose_block, known_optics, reflectivity_block
from rim_camera_ros.fit.fold_sums import Fold
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import reduce_folds
from rim_camera_ros.fit.pixel_elimination import PixelPriors
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.frame import Pose
from rim_camera_ros.optics import pixel_rays
from rim_camera_ros.parameters import ArrayFile, NestedList
from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.scene import Scene, load_scene
from rim_camera_ros.select.search import search

from ..calibrate.helpers import camera, record, scene


def with_reflectivities(board: Scene, factors: np.ndarray) -> Scene:
    """The board as it is, whose tiles reflect otherwise than the scene file says."""
    surface = board.surfaces[0]
    assert surface.texture is not None
    values = surface.texture.values.values * factors
    return Scene((replace(surface, texture=replace(surface.texture, values=NestedList(values))),))


FACTORS = np.exp(0.06 * np.array([[1.2, -0.7, 0.3], [-1.5, 0.4, -0.2], [0.9, -1.1, 0.8]]))


@pytest.mark.parametrize("seed", [5, 6])
def test_reflectivities_six_percent_off_are_no_physics(tmp_path: Path, seed: int) -> None:
    stated, board = camera(tmp_path), scene(tmp_path)
    data = record(stated, with_reflectivities(board, FACTORS), seed=seed)
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    assert search(Problem(data, board), stated, facts).found == []


def test_reflectivities_are_found_tile_by_tile(tmp_path: Path) -> None:
    stated, board = camera(tmp_path), scene(tmp_path)
    found = fit(Problem(record(stated, with_reflectivities(board, FACTORS), seed=5), board), stated)
    logarithms = np.array([found.parameters[f"reflectivity.board.{k}"] for k in range(9)])
    true = np.log(FACTORS).ravel()
    # the mean of all tiles cannot be distinguished from the gain
    rest = (logarithms - logarithms.mean()) - (true - true.mean())
    sigma = np.array([found.sigma[f"reflectivity.board.{k}"] for k in range(9)])
    assert np.abs(rest / sigma).max() < 3.5
    # dark tiles are known less well: a weak gloss brightens them most
    texture = board.surfaces[0].texture
    assert texture is not None
    bright = texture.values.values.ravel() > 0.4
    assert bright.sum() == 5
    assert np.abs(rest[bright]).max() < 0.03
    assert np.std(true) > 0.05


STRAY_LIGHT = Scattering((Kernel(0.16, (8.0, 8.0)),))


@pytest.mark.parametrize("effects", [(), (STRAY_LIGHT,)])
def test_derivatives_by_reflectivities_are_finite_differences(
    tmp_path: Path, effects: tuple[Effect, ...]
) -> None:
    """Of the darkest tile of a board, at the pixels that see it."""
    stated, board = camera(tmp_path, *effects), scene(tmp_path)
    factors = np.ones((3, 3))
    factors[0, 0] = 1.001
    data = record(stated, board, poses=1, seed=2)
    (before,), (after,) = (
        list(Forward(data, surfaces, stated).predictions())
        for surfaces in (board, with_reflectivities(board, factors))
    )
    column = reflectivity_block(board).columns(before)[0]
    assert column is not None
    assert column[1] is not None
    mine = (before.view.geometry.tile == 0) & before.amplitude_used
    assert mine.sum() > 20
    found = (after.amplitude - before.amplitude)[mine] / np.log(1.001)
    assert np.median(np.abs(found / column[1][mine] - 1)) < 0.02
    # less light of its own turns the phase towards that of the light which is spread
    turned = (after.distance - before.distance)[mine] / np.log(1.001)
    assert np.abs(column[0][mine] - turned).max() < 0.1 * np.abs(turned).max() + 1e-6


def test_groups_are_summed_as_their_columns_by_themselves_are(tmp_path: Path) -> None:
    """Normal matrix, offsets and gains of pixels, with what tiles have in common by stray light."""
    stated, board = camera(tmp_path, STRAY_LIGHT), scene(tmp_path)
    stated = replace(stated, radiometry=replace(stated.radiometry, pattern_sigma=0.02))
    forward = Forward(record(stated, board, poses=3, seed=2), board, stated)
    forward.estimate_amplitudes()
    block = reflectivity_block(board)
    one, other = (
        normal_equations.accumulate(forward, [light_block(LOBE), tiles]).folds[0]
        for tiles in (block, replace(block, grouped=None))
    )
    scale = np.sqrt(np.diag(other.gram).max())
    np.testing.assert_allclose(one.gram, other.gram, rtol=1e-9, atol=1e-10 * scale**2)
    assert one.gain is not None
    assert other.gain is not None
    for mine, theirs in ((one.pixel, other.pixel), (one.gain, other.gain)):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


def test_gains_of_pixels_are_found(tmp_path: Path) -> None:
    stated, board = camera(tmp_path), scene(tmp_path)
    data = record(stated, board, seed=7)
    gains = 0.03 * np.random.default_rng(4).standard_normal(stated.shape)
    data.stations = [replace(one, amplitude=one.amplitude * np.exp(gains)) for one in data.stations]
    found = fit(Problem(data, board), stated).forward.amplitude_model.pixels
    assert found is not None
    seen = np.abs(found) > 1e-3
    assert seen.mean() > 0.5
    assert np.corrcoef(found[seen], gains[seen])[0, 1] > 0.6


def test_offset_and_gain_of_a_pixel_are_eliminated_as_a_dense_solution_does() -> None:
    """The reduced equations against the Schur complement by numpy of the whole normal matrix."""
    rng = np.random.default_rng(11)
    pixels, count, rows = 5, 3, 400
    pixel = rng.integers(0, pixels, rows)
    regressors = rng.standard_normal((rows, count))
    slope = rng.uniform(0.2, 1.5, rows)
    values = rng.standard_normal(rows)
    weight = rng.uniform(0.5, 3.0, rows)
    offset, gain = 0.7, 0.3
    at = 0.1 * rng.standard_normal(pixels)
    design = np.column_stack([regressors, values])
    one_hot = np.eye(pixels)[pixel]
    fold = Fold(
        nuisances=[],
        gram=(design * weight[:, None]).T @ design,
        pixel=one_hot.T @ (design * weight[:, None]),
        weight=one_hot.T @ weight,
        rows=rows,
        gain=one_hot.T @ (design * (weight * slope)[:, None]),
        gain_weight=one_hot.T @ (weight * slope**2),
        cross=one_hot.T @ (weight * slope),
    )
    reduced = reduce_folds([fold], np.full(count, np.inf), PixelPriors(offset, gain, at))
    nuisance = np.column_stack([one_hot, one_hot * slope[:, None]])
    prior = np.concatenate([np.full(pixels, offset**-2), np.full(pixels, gain**-2)])
    inner = (nuisance * weight[:, None]).T @ nuisance + np.diag(prior)
    cross = (nuisance * weight[:, None]).T @ regressors
    right = (nuisance * weight[:, None]).T @ values
    right[pixels:] -= at / gain**2
    expected = fold.gram[:count, :count] - cross.T @ np.linalg.solve(inner, cross)
    assert reduced.gram == pytest.approx(expected, rel=1e-9)
    assert reduced.right == pytest.approx(
        fold.gram[:count, -1] - cross.T @ np.linalg.solve(inner, right), rel=1e-9
    )
    scaled = inner / np.sqrt(np.outer(prior, prior))
    assert reduced.log_norm == pytest.approx(0.5 * np.linalg.slogdet(scaled)[1])
    solution = np.linalg.solve(inner, right - cross @ np.array([0.4, -0.2, 0.1]))
    _, offsets, gains = reduced.recover(np.array([0.4, -0.2, 0.1]))
    assert offsets == pytest.approx(solution[:pixels], rel=1e-9)
    assert gains == pytest.approx(solution[pixels:], rel=1e-9)


@pytest.mark.parametrize("gains", [False, True])
def test_pixels_that_no_station_saw_take_no_part(tmp_path: Path, gains: bool) -> None:
    """The sums of the pixels that were seen alone against those of all pixels."""
    stated, board = camera(tmp_path), scene(tmp_path)
    stated = replace(stated, radiometry=replace(stated.radiometry, pattern_sigma=0.02 if gains else 0.0))
    data = record(stated, board, seed=7)
    unseen = np.ones(stated.shape, bool)
    unseen[5:30, 7:41] = False
    data.stations = [replace(one, count=np.where(unseen, 0, one.count)) for one in data.stations]
    forward = Forward(data, board, stated)
    forward.estimate_amplitudes()
    block = reflectivity_block(board)
    assert block is not None
    few = normal_equations.accumulate(forward, [block])
    everywhere = np.ones(stated.shape, bool).ravel()
    whole = normal_equations.accumulate(forward, [block], seen=everywhere)
    assert len(few.folds[0].weight) <= 25 * 34 < len(whole.folds[0].weight) == unseen.size
    one, other = few.reduced(), whole.reduced()
    np.testing.assert_allclose(one.gram, other.gram, rtol=1e-9, atol=1e-9 * np.abs(other.gram).max())
    np.testing.assert_allclose(one.right, other.right, rtol=1e-7, atol=1e-9 * np.abs(other.right).max())
    assert one.log_norm == pytest.approx(other.log_norm)
    values = 0.01 * np.arange(len(few.regressors))
    for mine, theirs in zip(one.recover(values)[1:], other.recover(values)[1:], strict=True):
        assert (mine is None) == (theirs is None)
        if mine is not None and theirs is not None:
            np.testing.assert_allclose(mine, theirs, rtol=1e-6, atol=1e-9)


def with_covariance(stated: Camera) -> Camera:
    matrix = np.array([[0.09, 0.06], [0.06, 0.05]])
    return replace(
        stated, covariance=Covariance(("optics.fx", "optics.fy"), ArrayFile("covariance.npy", matrix))
    )


def test_known_optics_are_the_principal_axes_of_their_covariance(tmp_path: Path) -> None:
    stated, board = with_covariance(camera(tmp_path)), scene(tmp_path)
    assert stated.covariance is not None
    matrix = stated.covariance.matrix.values
    block = known_optics(stated)
    values, vectors = np.linalg.eigh(matrix)
    assert [one.prior for one in block.regressors] == pytest.approx(np.sqrt(values))
    # along the wider axis: what fx and fy do together, by the rays themselves
    one = next(Forward(record(stated, board, poses=1, frames=1), board, stated).predictions())
    step = 1e-3 * vectors[:, 1]
    optics = replace(stated.optics, fx=stated.optics.fx + step[0], fy=stated.optics.fy + step[1])
    rays = pixel_rays(optics, width=stated.sensor.width, height=stated.sensor.height)
    geometry = one.view.geometry
    distance = np.einsum("ijk,ijk->ij", geometry.points, geometry.normals)
    moved = distance / np.einsum("ijk,ijk->ij", rays, geometry.normals)
    expected = (moved - geometry.distance) / 1e-3
    column = block.columns(one)[1][0]
    assert column[one.used] == pytest.approx(expected[one.used], abs=2e-5)
    assert np.abs(expected[one.used]).max() > 1e-3


def test_poses_share_the_stated_part_of_their_errors(tmp_path: Path) -> None:
    board = scene(tmp_path)
    surface = replace(board.surfaces[0], pose_sigma=(0.003, 0.0007), pose_common=0.25)
    block = common_pose_block(Scene((surface,)))
    assert [one.label for one in block.regressors] == [
        f"common_pose.board.{name}" for name in ("offset", "tilt_x", "tilt_y")
    ]
    assert [one.prior for one in block.regressors] == pytest.approx([0.0015, 0.00035, 0.00035])
    assert common_pose_block(Scene((replace(surface, pose_common=0.0),))).regressors == ()


def test_positions_that_share_a_scale_are_moved_by_it(tmp_path: Path) -> None:
    """Against the predictions for a board that stands 0.1 % farther away at every pose."""
    stated, board = camera(tmp_path), scene(tmp_path)
    surface = replace(board.surfaces[0], pose_scale_sigma=0.002, pose_common=0.0, reflectivity_sigma=0.0)
    block = common_pose_block(Scene((surface,)))
    ((label, prior),) = [(regressor.label, regressor.prior) for regressor in block.regressors]
    assert (label, prior) == ("common_pose.board.scale", 0.002)
    data = record(stated, board, poses=3, seed=4)

    def farther(pose: Pose) -> Pose:
        x, y, z = (1.001 * value for value in pose.position)
        return replace(pose, position=(x, y, z))

    moved = replace(
        data,
        stations=[
            replace(one, truth={name: farther(pose) for name, pose in one.truth.items()})
            for one in data.stations
        ],
    )
    before, after = (list(Forward(one, Scene((surface,)), stated).predictions()) for one in (data, moved))
    for one, other in zip(before, after, strict=True):
        column, _ = block.columns(one)[0]
        used = one.used & other.used
        assert used.sum() > 50
        expected = (other.distance - one.distance)[used] / 0.001
        assert column[used] == pytest.approx(expected, rel=2e-3)
        assert expected.min() > 0.4


def test_a_scale_of_the_camera_is_no_better_known_than_that_of_the_poses(tmp_path: Path) -> None:
    stated, board = camera(tmp_path, DistanceScale(0.0)), scene(tmp_path)
    data = record(stated, board, poses=24, seed=6)
    (prior,) = DistanceScale(0.0).priors().values()
    variances = []
    for scale in (0.0, 0.001):
        surface = replace(board.surfaces[0], pose_scale_sigma=scale)
        found = fit(Problem(data, Scene((surface,))), stated)
        variances.append(1 / (found.sigma["effects.distance_scale.scale"] ** -2 - prior**-2))
    # what the recording alone tells of it
    assert variances[1] == pytest.approx(variances[0] + 0.001**2, rel=0.02)
    assert variances[0] < 0.0005**2


def test_what_is_exactly_known_is_no_nuisance(tmp_path: Path) -> None:
    board = scene(tmp_path)
    known = Scene((replace(board.surfaces[0], reflectivity_sigma=0.0),))
    assert reflectivity_block(known).regressors == ()
    assert len(reflectivity_block(board).regressors) == 9


UNKNOWN = """
format: rim_scene/1
surfaces:
- {name: board, type: plane, pose: truth, reflectivity: unknown}
"""


def test_an_unknown_reflectivity_says_nothing_of_amplitudes(tmp_path: Path) -> None:
    stated, board = camera(tmp_path), scene(tmp_path)
    data = record(stated, board, poses=8, seed=3)
    path = tmp_path / "unknown.yaml"
    path.write_text(UNKNOWN)
    unknown = load_scene(path)
    predictions = list(Forward(data, unknown, stated).predictions())
    assert not any(one.amplitude_used.any() for one in predictions)
    assert all(one.used.any() for one in predictions)
    for one in predictions:
        assert one.amplitude[one.used] == pytest.approx(one.station.amplitude[one.used], rel=1e-6)
    found = fit(Problem(data, unknown), stated)
    assert found.chi_square / found.rows < 1.05
    with pytest.raises(InputError, match="reflectivity of surface 'board' is unknown"):
        Simulation(stated, unknown)


def test_an_unknown_reflectivity_and_a_texture_contradict_each_other(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(UNKNOWN.replace("}", ", texture: {cell: [0.1, 0.1], values: [[0.2]]}}"))
    with pytest.raises(InputError, match="reflectivity is unknown, but texture states it"):
        load_scene(path)
    path.write_text(UNKNOWN.replace("unknown}", "unknwon}"))
    with pytest.raises(InputError, match="unknown value 'unknwon'"):
        load_scene(path)
