"""Mixed pixels in the pixels beside edges: found, fitted, and distinguished from what is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.scene import Scene, ScenePose, Surface
from rim_camera_ros.select.edge_pixels import refined
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import Exploration, explore
from rim_camera_ros.select.search import search

from ..calibrate.helpers import camera, record, scene, with_footprints


@pytest.mark.long
@pytest.mark.parametrize(("width", "found"), [(0.0, []), (0.5, ["mixed_pixels"])])
def test_a_footprint_of_a_pixel_is_found_beside_edges(tmp_path: Path, width: float, found: list[str]) -> None:
    """Pixels within half a footprint of an edge are mixed, those within 0.3 px excluded from all else."""
    stated, board = camera(tmp_path), scene(tmp_path)
    # of finite size: at a horizon a footprint spans many tiles
    board = Scene((replace(board.surfaces[0], type="rectangle", size=(1.55, 1.35)),))
    data = with_footprints(stated, board, record(stated, board, poses=14, frames=1, seed=9), width, 4)
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    result = search(Problem(data, board), stated, facts, effects=["mixed_pixels"])
    assert [one.effect for one in result.found] == found
    assert result.beside_edges == (1 if found else None)
    # the fit goes on once the effect has joined, by an error of amplitudes that is estimated anew
    assert result.gained == pytest.approx(sum(one.gain for one in result.found), rel=2e-2)


@pytest.mark.long
@pytest.mark.parametrize(("width", "found"), [(0.0, []), (0.5, ["mixed_pixels"])])
def test_a_large_drift_does_not_hide_mixed_pixels(tmp_path: Path, width: float, found: list[str]) -> None:
    """Mixed pixels move distances by 1.2 mm, the drift by 27 mm: its form leaves nothing at edges."""
    stated, board = camera(tmp_path), scene(tmp_path)
    board = Scene((replace(board.surfaces[0], type="rectangle", size=(1.55, 1.35)),))
    data = with_footprints(stated, board, record(stated, board, poses=14, frames=1, seed=9), width, 4)
    for number, one in enumerate(data.stations):
        uptime = 30.0 + 20.0 * one.pose
        data.stations[number] = replace(
            one,
            settings=replace(one.settings, uptime=uptime),
            distance=one.distance + 0.04 * np.exp(-uptime / 120.0),
        )
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    result = search(Problem(data, board), stated, facts)
    assert [one.effect for one in result.found] == ["warm_up_drift", *found]


def before_a_wall(tmp_path: Path) -> Scene:
    """The board before a wall: 1 to 5 m of distance between the two surfaces."""
    board = replace(scene(tmp_path).surfaces[0], type="rectangle", size=(0.93, 0.81))
    wall = Surface(name="wall", type="plane", reflectivity=0.6, pose=ScenePose((0.0, 0.0, 5.6)))
    return Scene((board, wall))


@pytest.mark.long
@pytest.mark.parametrize("width", [0.4, 0.9])
def test_the_footprint_of_a_pixel_is_found_by_the_pixels_that_edges_cross(
    tmp_path: Path, width: float
) -> None:
    """A blur of what centres see cannot tell them from their neighbours: it loses, or fits less."""
    stated, before = camera(tmp_path), before_a_wall(tmp_path)
    data = with_footprints(stated, before, record(stated, before, poses=16, frames=1, seed=3), width, 8)
    facts = Facts.of(data, moves=False, surfaces=2, camera=stated)
    result = search(Problem(data, before), stated, facts)
    assert [one.effect for one in result.found] == ["mixed_pixels"]
    mixed = result.camera.effects["mixed_pixels"]
    assert isinstance(mixed, MixedPixels)
    assert mixed.footprint == pytest.approx(width, abs=0.06)
    # what it gains is of the pixels beside edges, and nothing else gained
    assert result.gained == pytest.approx(result.found[0].gain, rel=0.05)
    assert mixed.blur == 0.0
    # cells of a tenth of a pixel leave side and share some play; their product is the light that crosses
    assert mixed.share is not None
    assert mixed.share * mixed.footprint == pytest.approx(width, abs=0.04)


@pytest.mark.long
def test_a_footprint_in_addition_to_stray_light(tmp_path: Path) -> None:
    """Where pixels alone are mixed that edges cross, the form of the stray light does not leave it."""
    stated, before = camera(tmp_path), before_a_wall(tmp_path)
    data = with_footprints(stated, before, record(stated, before, poses=16, frames=1, seed=3), 0.6, 8)
    # 4 % of the light over 5 px, laid over the measured image
    for number, one in enumerate(data.stations):
        wave = 2 * np.pi / stated.sensor.ambiguity
        image = np.nan_to_num(one.amplitude * np.exp(1j * wave * one.distance))
        halo = gaussian_filter(image.real, 5.0, mode="constant") + 1j * gaussian_filter(
            image.imag, 5.0, mode="constant"
        )
        spread = 0.96 * image + 0.04 * halo
        data.stations[number] = replace(
            one,
            amplitude=np.abs(spread),
            distance=np.mod(np.angle(spread) / wave, stated.sensor.ambiguity),
        )
    facts = Facts.of(data, moves=False, surfaces=2, camera=stated)
    result = search(Problem(data, before), stated, facts)
    assert [one.effect for one in result.found] == ["scattering", "mixed_pixels"]
    mixed = result.camera.effects["mixed_pixels"]
    assert isinstance(mixed, MixedPixels)
    assert mixed.footprint == pytest.approx(0.6, abs=0.08)


@pytest.mark.long
@pytest.mark.parametrize("weight", [0.0, 0.05])
def test_neither_errors_of_poses_nor_stray_light_are_a_footprint(tmp_path: Path, weight: float) -> None:
    """Poses three times as wrong as stated let edges fall on other pixels, which then measure one surface."""
    stated, before = camera(tmp_path), before_a_wall(tmp_path)
    there = [Scattering((Kernel(weight, (3.0, 3.0)),))] if weight else []
    true = camera(tmp_path, *there)
    data = record(true, before, poses=16, frames=2, seed=5, wrong=3.0 if not weight else 1.0)
    facts = Facts.of(data, moves=False, surfaces=2, camera=stated)
    result = search(Problem(data, before), stated, facts)
    at_edges = [one.effect for one in result.found if one.effect in ("scattering", "mixed_pixels")]
    assert at_edges == (["scattering"] if weight else [])


@pytest.mark.parametrize("areas", [True, False])
def test_blurred_light_of_areas_is_distinguished_from_that_of_centres(tmp_path: Path, areas: bool) -> None:
    """A blur of 0.9 px reaches pixels that are clean; how much depends on where in a pixel the edge is."""
    form = MixedPixels(blur=0.85, footprint=1.0) if areas else MixedPixels(blur=0.9)
    board = scene(tmp_path)
    board = Scene((replace(board.surfaces[0], type="rectangle", size=(1.55, 1.35)),))
    data = record(camera(tmp_path, form), board, poses=12, frames=2, seed=9)
    folds, problem = folds_of(data), Problem(data, board)

    def fitted(problem: Problem, own: Camera, step: Exploration | None, _: object) -> Exploration:
        warm = None if step is None else step.fit
        return explore(problem, own, [], folds, warm=warm, replicates=0, iterations=12)

    step = fitted(problem, camera(tmp_path, MixedPixels(blur=0.8)), None, ())
    problem = replace(problem, masks=step.fit.forward.pixels_used())
    found = refined(step, ["mixed_pixels"], problem, fitted)  # type: ignore[arg-type]
    assert (found is not step) == areas
    effect = found.fit.camera.effects["mixed_pixels"]
    assert isinstance(effect, MixedPixels)
    sigma = found.fit.sigma["effects.mixed_pixels.blur"]
    assert effect.blur == pytest.approx(form.blur, abs=4 * sigma)
    assert refined(found, ["distance_scale"], problem, fitted) is found  # type: ignore[arg-type]


@given(blur=st.floats(0.01, 3.0))
def test_the_finest_form_is_as_wide(blur: float) -> None:
    """Variance of a square, a twelfth of its side squared, and of the Gaussian behind it."""
    finest = MixedPixels(blur=blur).finest()
    assert finest.footprint is not None
    assert 0 < finest.footprint <= 1.0
    assert finest.blur**2 + finest.footprint**2 / 12 == pytest.approx(blur**2)
    assert finest.finest() is finest
