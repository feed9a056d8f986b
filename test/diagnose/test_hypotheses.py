"""Set-ups as hypotheses: a true scene is kept, and each wrong one is found by what it really was."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.diagnose import compare_setups as setups
from rim_camera_ros.diagnose.compare_setups import against_physics, compare_setups
from rim_camera_ros.diagnose.hypotheses import Hypothesis, best_setup, poses_elsewhere
from rim_camera_ros.diagnose.inconsistent import with_setups
from rim_camera_ros.diagnose.nuisances import common_pose_beyond
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.diagnose.setup_likelihood import difference, predicted
from rim_camera_ros.effects.candidate import Regressor
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.frame import Pose
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.scene import Scene, load_scene

from ..calibrate.helpers import camera, record, scene, with_footprints

PLATE = """
format: rim_scene/1
surfaces:
- name: board
  type: rectangle
  pose: truth
  size: [1.1, 0.8]
  pose_sigma: [0.001, 0.0005]
  texture: {cell: [0.31, 0.27], values: [[0.1, 0.85, 0.3], [0.6, 0.2, 0.9], [0.45, 0.75, 0.15]]}
- name: wall
  type: plane
  pose: {position: [0.1, 0.0, 4.9], orientation: [0.05, 0.02, 0.0, 0.99855]}
  reflectivity: 0.55
"""


def with_texture(board: Scene, values: np.ndarray | None = None, factor: float = 1.0) -> Scene:
    """The scene with other tiles, or tiles of another size."""
    surface = board.surfaces[0]
    texture = surface.texture
    assert texture is not None
    cell = (texture.cell[0] * factor, texture.cell[1] * factor)
    changed = replace(texture, cell=cell, values=texture.values if values is None else NestedList(values))
    return replace(board, surfaces=(replace(surface, texture=changed), *board.surfaces[1:]))


def tiles(board: Scene) -> np.ndarray:
    """The reflectivities of the board's tiles."""
    texture = board.surfaces[0].texture
    assert texture is not None
    return np.asarray(texture.values.values)


def in_millimetres(data: Dataset) -> Dataset:
    """The dataset with all positions of poses 1000 times as large."""

    def scaled(pose: Pose) -> Pose:
        x, y, z = pose.position
        return Pose((1e3 * x, 1e3 * y, 1e3 * z), pose.orientation)

    stations = [
        replace(one, truth={name: scaled(pose) for name, pose in one.truth.items()}) for one in data.stations
    ]
    return replace(data, stations=stations)


def recorded(tmp_path: Path, *, seed: int = 5) -> tuple[Dataset, Scene, Camera]:
    """A recording of the board by a camera with a cyclic error that its file lacks."""
    given, board = camera(tmp_path), scene(tmp_path)
    cyclic = CyclicError(harmonics=(Harmonic(4, 0.012, 0.7),))
    return record(with_effects(given, {cyclic.name: cyclic}), board, poses=16, seed=seed), board, given


def winner(data: Dataset, board: Scene, given: Camera, found: Camera | None = None) -> Hypothesis | None:
    """The set-up that wins against the files with the camera that was found; None: with that of the file."""
    setups = compare_setups(data, board, given)
    return best_setup(against_physics(setups, data, board, given, found=found or given))


@pytest.mark.long
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_missing_physics_is_no_other_setup(tmp_path: Path, seed: int) -> None:
    data, board, given = recorded(tmp_path, seed=seed)
    assert best_setup(compare_setups(data, board, given)) is None
    assert winner(data, board, given) is None


@pytest.mark.long
@pytest.mark.parametrize(
    ("hypothesis", "change"),
    [
        ("turned_180", lambda board: with_texture(board, tiles(board)[::-1, ::-1].copy())),
        ("mirrored", lambda board: with_texture(board, tiles(board)[:, ::-1].copy())),
        ("inverted", lambda board: with_texture(board, 1.0 - tiles(board))),
        ("scale", lambda board: with_texture(board, factor=1 / 0.9)),
    ],
)
def test_another_board(tmp_path: Path, hypothesis: str, change: object) -> None:
    data, board, given = recorded(tmp_path)
    wrong = change(board)  # type: ignore[operator]
    best = winner(data, wrong, given)
    assert best is not None
    assert best.hypothesis == hypothesis
    assert best.change is not None
    _, mended, _ = best.change(data, wrong, given)
    assert np.allclose(tiles(mended), tiles(board), atol=0.06)
    assert mended.surfaces[0].texture.cell == pytest.approx((0.31, 0.27), rel=1e-6)  # type: ignore[union-attr]


def compensated(data: Dataset, reference: float) -> Dataset:
    """The dataset by a driver that multiplies amplitudes by (distance / reference)^2."""
    stations = []
    for one in data.stations:
        factor = (one.distance / reference) ** 2
        stations.append(
            replace(
                one,
                amplitude=np.where(one.count > 0, one.amplitude * factor, 0.0),
                amplitude_variance=one.amplitude_variance * factor**2,
            )
        )
    return replace(data, stations=stations)


@pytest.mark.parametrize("seed", [5, 6])
def test_amplitudes_that_a_driver_compensates_for_the_distance(tmp_path: Path, seed: int) -> None:
    """As the SwissRanger's library does with AM_CONV_GRAY; with the amplitudes undone all is explained."""
    data, board, given = recorded(tmp_path, seed=seed)
    assert not any(
        one.is_better
        for one in compare_setups(data, board, given)
        if one.hypothesis == "compensated_amplitude"
    )
    wrong = compensated(data, 3.7)
    found = best_setup(compare_setups(wrong, board, given))
    assert found is not None
    assert found.hypothesis == "compensated_amplitude"
    assert found.share > 0.98
    assert re.search(
        r"square of the distance .* record the amplitudes as measured .*AM_CONV_GRAY", found.reason
    )
    assert found.change is not None
    mended, _, _ = found.change(wrong, board, given)
    for one, true in zip(mended.stations, data.stations, strict=True):
        seen = (true.count > 0) & (true.amplitude > 0)
        ratio = one.amplitude[seen] / true.amplitude[seen]
        assert np.ptp(ratio) < 1e-9
        assert ratio[0] == pytest.approx(1.0, abs=0.1)


def test_a_reading_that_may_scatter_more_gains_nothing_by_that(tmp_path: Path) -> None:
    """With ten times the noise of the distances the same residuals are less probable."""
    data, board, given = recorded(tmp_path)
    files = (data, board, given)
    noisier = replace(given, noise=replace(given.noise, floor=10 * given.noise.floor))
    assert difference(predicted(files), predicted((data, board, noisier))).poses.sum() < 0


@pytest.mark.long
def test_greys_in_the_opposite_order_with_errors_of_reflectivities_are_inverted(tmp_path: Path) -> None:
    """Errors of 6 % that the file states with 10 % are no reason for another pattern, which fits them too."""
    data, board, given = recorded(tmp_path)
    greys = np.unique(tiles(board))
    opposite = dict(zip(greys, greys[::-1], strict=True))
    error = np.exp(0.06 * np.random.default_rng(3).standard_normal(tiles(board).shape))
    wrong = np.clip(np.vectorize(opposite.get)(tiles(board)) * error, 0.02, 0.98)
    best = winner(data, with_texture(board, wrong), given)
    assert best is not None
    assert best.hypothesis == "inverted"
    # tiles of any reflectivity are another pattern
    anything = np.random.default_rng(4).permuted(tiles(board).ravel()).reshape(tiles(board).shape)
    best = winner(data, with_texture(board, anything), given)
    assert best is not None
    assert best.hypothesis == "other_pattern"


@pytest.mark.long
def test_physics_that_imitates_a_board_of_another_size_is_none_where_it_is_found(tmp_path: Path) -> None:
    """A board said to be 15 % too large wins against the files and against physics that explains nothing."""
    data, board, given = recorded(tmp_path)
    wrong = with_texture(board, factor=1.15)
    setups = compare_setups(data, wrong, given)
    assert setups[0].hypothesis == "scale"
    found = winner(data, wrong, given)
    assert found is not None
    assert "better than any physics of the camera does" in found.reason
    # held against a scene that explains everything it gains nothing
    assert best_setup(against_physics(setups, data, board, given, found=given)) is None


def test_effects_of_another_lens_that_are_impossible_by_the_files_are_no_physics(tmp_path: Path) -> None:
    """A falloff to 0 halfway to the corners, of a lens of three times the focal length."""
    data, board, given = recorded(tmp_path)
    wrong = with_texture(board, factor=1.15)
    setups = compare_setups(data, wrong, given)
    farthest = float(np.arccos(given.rays[..., 2].min()))
    lens = replace(given, optics=replace(given.optics, fx=3 * given.optics.fx, fy=3 * given.optics.fy))
    found = with_effects(lens, {"emission_pattern": EmissionPattern((-4 / farthest**2, 0.0))})
    best = best_setup(against_physics(setups, data, wrong, given, found=found))
    assert best is not None
    assert best.hypothesis == "scale"
    # as if nothing had been found
    alone = best_setup(against_physics(setups, data, wrong, given, found=given))
    assert alone is not None
    assert (best.gain, best.standard_error) == (alone.gain, alone.standard_error)


def test_a_depth_is_left_to_the_fit_of_poses(tmp_path: Path) -> None:
    """The shortest way for a scale of -2 % to fit is that the nearer surface stands elsewhere."""
    assert not Hypothesis("depth", "wall", 2398.0, 507.0, -50.0, 0.95, fitted=True).wins
    assert Hypothesis("depth", "wall", 2398.0, 507.0, -50.0, 0.95, fitted=True).is_better
    assert Hypothesis("scale", "wall", 2398.0, 507.0, 0.9, 0.95).wins
    assert not Hypothesis("scale", "wall", 2398.0, 507.0, 0.9, 0.85).wins
    assert Hypothesis("scale", "wall", 2398.0, 507.0, 0.9, 0.85, against_physics=True).wins
    depth = Hypothesis("depth", "wall", 659.0, 75.0, -43.0, 0.75, fitted=True)
    lid = Hypothesis("scale", "lid", 34.0, 15.0, 1.05, 0.04, against_physics=True)
    assert best_setup([depth, lid]) is None
    assert best_setup([replace(lid, gain=700.0, share=0.6), depth]) is not None


def test_a_setup_that_explains_less_than_half_is_not_what_differs() -> None:
    """Another lens was 15 % of what did not fit in an SR4000 of which an offset by amplitude was missing."""
    lens = Hypothesis("other_lens", "", 949.0, 110.0, 0.93, 0.15, against_physics=True)
    assert lens.is_better
    assert best_setup([lens]) is None
    assert best_setup([replace(lens, share=0.55)]) is not None


@pytest.mark.long
@pytest.mark.parametrize("seed", [11, 12])
def test_a_plate_before_a_wall_is_no_larger_than_it_is(tmp_path: Path, seed: int) -> None:
    """Pixels have an area: those that an edge crosses fit no set-up, and are no reason for another size."""
    given = camera(tmp_path)
    path = tmp_path / "plate.yaml"
    path.write_text(PLATE)
    both = load_scene(path)
    data = with_footprints(given, both, record(given, both, poses=10, seed=seed), 1.0, seed)
    assert [one.hypothesis for one in compare_setups(data, both, given) if one.is_better] == []
    # the same plate said to be an eighth larger
    large = with_texture(both, factor=1.125)
    plate = replace(large.surfaces[0], size=(1.1 * 1.125, 0.8 * 1.125))
    leader = compare_setups(data, replace(large, surfaces=(plate, both.surfaces[1])), given)[0]
    assert (leader.hypothesis, leader.surface) == ("scale", "board")
    assert leader.value == pytest.approx(0.9)


def test_distances_along_the_axis(tmp_path: Path) -> None:
    data, board, given = recorded(tmp_path)
    along = [replace(one, distance=one.distance * given.rays[..., 2]) for one in data.stations]
    best = winner(replace(data, stations=along), board, given)
    assert best is not None
    assert best.hypothesis == "z_distance"


def test_what_some_poses_do_not_tell_is_decided_by_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A set-up that gains in few of the poses, those far away, is held against the files in each of them."""
    data, board, given = recorded(tmp_path)
    along = [replace(one, distance=one.distance * given.rays[..., 2]) for one in data.stations]
    data = replace(data, stations=along)
    monkeypatch.setattr(setups, "_MOST_POSES", data.poses)
    whole = {one.hypothesis: one for one in compare_setups(data, board, given)}["z_distance"]
    monkeypatch.setattr(setups, "_MOST_POSES", 4)
    unsure = replace(whole, gain=90.0, standard_error=60.0)
    lost, sure = (replace(whole, gain=gain, standard_error=10.0) for gain in (-5.0, 25.0))
    decided = list(setups._decided([unsure, lost, sure], data, board, given))
    assert decided[1:] == [lost, sure]
    assert decided[0].is_better
    assert decided[0].gain == pytest.approx(whole.gain)
    monkeypatch.setattr(setups, "_MOST_POSES", data.poses)
    assert list(setups._decided([unsure], data, board, given)) == [unsure]


@pytest.mark.long
def test_another_lens(tmp_path: Path) -> None:
    data, board, given = recorded(tmp_path)
    for factor in (1.25, 1.17, 0.77):
        optics = replace(given.optics, fx=given.optics.fx / factor, fy=given.optics.fy / factor)
        best = winner(data, board, replace(given, optics=optics))
        assert best is not None
        assert best.hypothesis == "other_lens"
        # also between the factors that are tried, and beyond
        assert best.value == pytest.approx(factor, rel=0.01)


def test_poses_in_millimetres_before_a_board_that_no_ray_meets_then(tmp_path: Path) -> None:
    """A rectangle a kilometre away leaves not one pixel to compare; the report says so all the same."""
    data, board, given = recorded(tmp_path)
    limited = replace(board, surfaces=(replace(board.surfaces[0], type="rectangle", size=(6.0, 5.0)),))
    result = diagnose(in_millimetres(data), limited, given)
    assert result.verdict == "inconsistent_setup"
    assert result.setups[0].hypothesis == "units"
    assert result.setups[0].value == pytest.approx(1e-3)
    assert str(result.reason).startswith("units: distances or poses in other units")
    assert result.camera is given
    # of a set-up that is trusted the files lead, whatever gained a little more
    better = Hypothesis("scale", "board", 42.0, 30.0, 0.9, 0.2)
    trusted = with_setups(replace(result, reason=None), [better, Hypothesis("as_given", "", 0.0, 0.0)])
    assert [one.hypothesis for one in trusted.setups] == ["as_given", "scale"]


def test_what_gains_at_one_pose_most_of_all_is_the_setup_where_nothing_else_can_be_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a room in millimetres a kilometre away, walls fill a few images, and one pose gained nearly all."""
    data, board, given = recorded(tmp_path)
    limited = replace(board, surfaces=(replace(board.surfaces[0], type="rectangle", size=(6.0, 5.0)),))
    far = in_millimetres(data)
    found = [replace(one, standard_error=0.8 * one.gain) for one in compare_setups(far, limited, given)]
    assert best_setup(found) is None
    monkeypatch.setattr("rim_camera_ros.diagnose.begin.compare_setups", lambda *_: found)
    result = diagnose(far, limited, given)
    assert (result.verdict, result.setups[0].hypothesis) == ("inconsistent_setup", "units")
    assert str(result.reason).startswith("units: distances or poses in other units")
    monkeypatch.setattr(
        "rim_camera_ros.diagnose.begin.compare_setups", lambda *_: [Hypothesis("as_given", "", 0.0, 0.0)]
    )
    with pytest.raises(InputError, match=r"no pixel can be used.*rim info BAG lists its poses"):
        diagnose(far, limited, given)


def test_poses_of_a_surface_that_err_alike_are_a_fault(tmp_path: Path) -> None:
    """Of 0.8 mm that are stated: 1.4 mm and -0.9 mm are errors of an instrument, 28 mm are not."""

    def fitted(box: float, wall: float | None = -0.0009) -> Fit:
        labels = {"common_pose.box.offset": box}
        if wall is not None:
            labels["common_pose.wall.offset"] = wall
        regressors = [Regressor(label, "pose", 0.0008) for label in labels]
        return cast(
            Fit,
            SimpleNamespace(
                parameters=labels,
                nuisances={},
                equations=SimpleNamespace(regressors=regressors, folds=[]),
                forward=SimpleNamespace(amplitude_model=SimpleNamespace(pixels=None)),
            ),
        )

    assert common_pose_beyond(fitted(0.0014), camera(tmp_path)) is None
    said = str(common_pose_beyond(fitted(0.028), camera(tmp_path)))
    # the root of the mean square of 28 and 0.9 mm
    assert said.startswith("depth: poses of a surface err alike, by 20 mm (RMS over surfaces), 24.8 times")
    assert "most of all those of box" in said
    assert "rim calibrate" not in said
    alone = str(common_pose_beyond(fitted(0.028, None), camera(tmp_path)))
    assert alone.endswith(
        "an offset or a scale of the camera's distances that its file lacks (rim calibrate)"
    )


def test_poses_that_stand_elsewhere_are_a_set_up() -> None:
    astray = poses_elsewhere(208.0, 2)
    assert (astray.hypothesis, astray.gain, astray.value) == ("pose", 208.0, 2)
    assert astray.is_better
    assert astray.sentence == "2 poses that stand elsewhere"


def test_set_ups_in_which_a_board_looks_the_same_are_both_said(tmp_path: Path) -> None:
    """Two rows of a chequered cell: mirrored, it has dark and bright exchanged."""
    given, board = camera(tmp_path), scene(tmp_path)
    surface = board.surfaces[0]
    assert surface.texture is not None
    chequered = replace(surface.texture, values=NestedList(np.array([[0.2, 0.8], [0.8, 0.2]])))
    stated = replace(board, surfaces=(replace(surface, texture=chequered),))
    exchanged = replace(surface.texture, values=NestedList(np.array([[0.8, 0.2], [0.2, 0.8]])))
    true = replace(board, surfaces=(replace(surface, texture=exchanged),))
    found = best_setup(compare_setups(record(given, true, poses=8, seed=3), stated, given))
    assert found is not None
    said = {found.sentence, *found.alike}
    assert {
        "the pattern of board mirrored",
        "the bright and dark tiles of board exchanged",
    } <= said
    assert f"{found.sentence}, or {', or '.join(found.alike)}, which look the same, explains" in found.reason
