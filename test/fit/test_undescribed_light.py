"""Stray light of what the scene file does not describe: it is in the image, and is taken from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.light_curves import SURFACES
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.frame import Pose
from rim_camera_ros.scene import Scene, load_scene

from ..calibrate.helpers import camera, record

BOARD = """
- name: board
  type: rectangle
  size: [0.6, 0.45]
  pose: truth
  pose_sigma: [0.001, 0.0005]
  texture: {cell: [0.15, 0.15], values: [[0.1, 0.85, 0.3], [0.6, 0.2, 0.9], [0.45, 0.75, 0.15]]}
"""
WALL = """
- name: wall
  type: plane
  pose: {position: [0.3, 0.1, 3.2], orientation: [0.0, 0.1, 0.0, 0.99498744]}
  texture: {cell: [0.9, 0.7], values: [[0.9, 0.5], [0.7, 0.95]]}
"""
HALO = Scattering((Kernel(0.15, (5.0, 4.0)),))
#: What the camera adds to the delivered distances: an offset of 0.4 m at 4 m, a wave, and a term of the angle
#: of incidence, which is not known of a wall that the scene file does not describe.
TERMS = {
    "distance_scale": DistanceScale(0.1),
    "cyclic_error": CyclicError((Harmonic(4, 0.01, 0.7),)),
    "incidence_angle": IncidenceAngle({60.0: (0.0, 0.0, 1e-6, 0.0)}),
}


def scene_of(tmp_path: Path, surfaces: str) -> Scene:
    path = tmp_path / "room.yaml"
    path.write_text(f"format: rim_scene/1\nsurfaces:{surfaces}")
    return load_scene(path)


def without_reflectivities(scene: Scene) -> Scene:
    return replace(
        scene, surfaces=tuple(replace(one, texture=None, reflectivity="unknown") for one in scene.surfaces)
    )


def board_before_a_wall(
    tmp_path: Path, truth: Camera, *, poses: int, far: tuple[float, float] = (0.7, 1.2)
) -> Dataset:
    """A recording without noise of the board before a bright wall."""
    room = scene_of(tmp_path, BOARD + WALL)
    data = record(truth, room, poses=poses, frames=1, seed=3)
    placed = np.random.default_rng(9).uniform((-0.15, -0.1, far[0]), (0.15, 0.1, far[1]), (poses, 3))
    stations = []
    for one, position in zip(data.stations, placed, strict=True):
        pose = Pose(tuple(position.tolist()), one.truth["board"].orientation)
        stations.append(replace(one, truth={"board": pose}))
    return noise_free(replace(data, stations=stations), room, truth)


def noise_free(data: Dataset, scene: Scene, truth: Camera) -> Dataset:
    """The stations as a camera sees the scene, without noise."""
    stations = []
    for one, seen in zip(data.stations, predicted(data, scene, truth), strict=True):
        lit = np.isfinite(seen.distance)
        stations.append(
            replace(
                one,
                distance=np.where(lit, seen.distance, np.nan),
                amplitude=np.where(lit, seen.model_reading, 0.0),
                count=np.where(lit, one.frames, 0),
                saturated=np.zeros_like(one.saturated),
            )
        )
    return replace(data, stations=stations)


def noisy(data: Dataset, truth: Camera) -> Dataset:
    """The stations with the noise of the mean of four frames."""
    rng = np.random.default_rng(17)
    stations = []
    for one in data.stations:
        sigma = truth.noise.sigma_distance(np.maximum(one.amplitude, 1.0)) / 2
        stations.append(
            replace(
                one,
                frames=4,
                count=np.where(one.count > 0, 4, 0),
                distance=one.distance + sigma * rng.standard_normal(sigma.shape),
                amplitude=one.amplitude + 3.0 * rng.standard_normal(sigma.shape) * (one.amplitude > 0),
            )
        )
    return replace(data, stations=stations)


def predicted(data: Dataset, scene: Scene, camera_file: Camera) -> Sequence[Prediction]:
    forward = Forward(data, scene, camera_file)
    forward.amplitude_model = AmplitudeModel(tau=0.0)
    return list(forward.predictions())


def test_light_from_around_a_board_is_that_of_the_image(tmp_path: Path) -> None:
    truth = with_effects(camera(tmp_path), {"scattering": HALO, **TERMS})
    data = board_before_a_wall(tmp_path, truth, poses=4)
    board = scene_of(tmp_path, BOARD)
    dark = replace(
        data,
        stations=[
            replace(one, amplitude=np.where(seen.view.geometry.hit, one.amplitude, 0.0))
            for one, seen in zip(data.stations, predicted(data, board, truth), strict=True)
        ],
    )
    for seen, without in zip(predicted(data, board, truth), predicted(dark, board, truth), strict=True):
        used = seen.view.clean
        assert used.sum() > 100
        # the wall's angle of incidence is not known: a thirtieth of the effect
        assert np.abs(seen.residual[used]).max() < 0.0004
        assert np.abs(without.residual[used]).max() > 0.005
        relative = seen.amplitude_residual[used] / seen.model_reading[used]
        assert np.abs(relative).max() < 0.01


def test_surfaces_of_unknown_reflectivity_are_seen_before_their_light_is_spread(tmp_path: Path) -> None:
    truth = with_effects(camera(tmp_path), {"scattering": Scattering((Kernel(0.4, (5.0, 4.0)),))})
    room = scene_of(tmp_path, BOARD + WALL)
    data = board_before_a_wall(tmp_path, truth, poses=3)
    for seen, true in zip(
        predicted(data, without_reflectivities(room), truth), predicted(data, room, truth), strict=True
    ):
        used = np.isfinite(true.distance)
        assert np.allclose(seen.distance[used], true.distance[used], atol=1e-9)
        light, expected = (one.before["scattering"].amplitude[used] for one in (seen, true))
        assert np.allclose(light, expected, rtol=1e-9)
        assert np.ptp(expected) > 5 * np.median(np.abs(true.amplitude[used] - expected))


@pytest.mark.parametrize("described", [True, False])
def test_a_halo_is_found_as_it_is(tmp_path: Path, described: bool) -> None:
    """The light of the wall, or that of all surfaces, is known from the image alone."""
    truth = camera(tmp_path, Scattering((Kernel(0.33, (4.0, 4.0)),)))
    data = noisy(board_before_a_wall(tmp_path, truth, poses=20), truth)
    scene = scene_of(tmp_path, BOARD if described else BOARD + WALL)
    start = camera(tmp_path, Scattering((Kernel(0.05, (3.2, 4.8)),)))
    found = fit(Problem(data, scene if described else without_reflectivities(scene)), start)
    for path, true in (("weight", 0.33), ("sigma.0", 4.0), ("sigma.1", 4.0)):
        name = f"effects.scattering.kernels.0.{path}"
        assert abs(found.parameters[name] - true) < 3.5 * found.sigma[name]
    assert found.sigma["effects.scattering.kernels.0.weight"] < 0.01


@pytest.mark.parametrize("described", [True, False])
def test_derivatives_are_those_of_the_whole_prediction(tmp_path: Path, described: bool) -> None:
    """What a halo spreads over a pixel is missing in the light before it, which changes with the halo."""
    truth = camera(tmp_path, Scattering((Kernel(0.33, (4.0, 4.0)),)))
    data = board_before_a_wall(tmp_path, truth, poses=1)
    scene = (
        scene_of(tmp_path, BOARD) if described else without_reflectivities(scene_of(tmp_path, BOARD + WALL))
    )

    def seen(weight: float, across: float, down: float) -> Prediction:
        return predicted(data, scene, camera(tmp_path, Scattering((Kernel(weight, (across, down)),))))[0]

    at, step = np.array([0.25, 3.5, 4.4]), 1e-4
    here = seen(*at)
    columns = here.columns(here.context.camera.effects["scattering"])
    for number, path in enumerate(("weight", "sigma.0", "sigma.1")):
        change = step * np.eye(3)[number]
        numeric = (seen(*(at + change)).distance - seen(*(at - change)).distance)[here.used] / (2 * step)
        analytic = columns[f"kernels.0.{path}"][0][here.used]
        assert np.abs(numeric).max() > 0.001
        # what distances have in common changes as well
        assert np.abs(analytic - numeric).max() < (0.01 if described else 1e-5) * np.abs(numeric).max()


def test_a_blur_is_not_undone_and_has_the_derivative_of_its_light(tmp_path: Path) -> None:
    plain = camera(tmp_path)
    room = without_reflectivities(scene_of(tmp_path, BOARD + WALL))
    truth = with_effects(plain, {"mixed_pixels": MixedPixels(0.9), "scattering": HALO})
    data = board_before_a_wall(tmp_path, truth, poses=1)

    def seen(blur: float) -> Prediction:
        effects = {"mixed_pixels": MixedPixels(blur), "scattering": HALO}
        return predicted(data, room, with_effects(plain, effects))[0]

    here, step = seen(0.8), 1e-4
    numeric = (seen(0.8 + step).distance - seen(0.8 - step).distance)[here.used] / (2 * step)
    analytic = here.columns(here.context.camera.effects["mixed_pixels"])["blur"][0][here.used]
    assert np.abs(numeric).max() > 0.001
    assert np.abs(analytic - numeric).max() < 1e-3 * np.abs(numeric).max()


def test_what_changes_light_before_it_is_spread_does_not_change_measured_light(tmp_path: Path) -> None:
    """A lobe of surfaces or a map of the beam changes no amplitude that is measured, nor what it spreads."""
    truth = camera(tmp_path, Scattering((Kernel(0.3, (4.0, 3.0)),)))
    data = board_before_a_wall(tmp_path, truth, poses=1)
    room = scene_of(tmp_path, BOARD + WALL)
    (described,), (unknown,) = (predicted(data, one, truth) for one in (room, without_reflectivities(room)))
    beam = EmissionPattern((0.1, 0.0))
    for seen, moves in ((described, True), (unknown, False)):
        columns = [*seen.curve_columns(SURFACES), *seen.columns(beam).values()]
        largest = max(float(np.abs(distance[seen.used]).max()) for distance, _ in columns)
        assert (largest > 1e-3) == moves
        assert moves or largest < 1e-9
    # an emitter beside the lens changes the distances of surfaces as well
    emitter = EmitterOffset((0.02, -0.01, 0.0))
    numeric = []
    for sign in (1.0, -1.0):
        moved = replace(emitter, position=(0.02 + sign * 1e-5, -0.01, 0.0))
        own = with_effects(truth, {"emitter_offset": moved, "scattering": truth.effects["scattering"]})
        numeric.append(predicted(data, without_reflectivities(room), own)[0].distance)
    own = with_effects(truth, {"emitter_offset": emitter, "scattering": truth.effects["scattering"]})
    (seen,) = predicted(data, without_reflectivities(room), own)
    analytic = seen.columns(emitter)["position.0"][0][seen.used]
    difference = ((numeric[0] - numeric[1]) / 2e-5)[seen.used]
    assert np.abs(difference).max() > 0.1
    assert np.abs(analytic - difference).max() < 1e-3 * np.abs(difference).max()


def test_light_around_a_window_is_there_for_effects_that_spread_it(tmp_path: Path) -> None:
    """A camera of pointwise effects is predicted in a window; candidates that spread light see the image."""
    truth = with_effects(camera(tmp_path), TERMS)
    data = board_before_a_wall(tmp_path, truth, poses=4, far=(1.6, 2.4))
    board, room = scene_of(tmp_path, BOARD), scene_of(tmp_path, BOARD + WALL)
    windows = 0
    for seen, true in zip(predicted(data, board, truth), predicted(data, room, truth), strict=True):
        windows += seen.inner is not seen
        outside = ~seen.view.geometry.hit
        light, measured = seen.before_effect("scattering"), seen.station
        wall = true.view.geometry.distance
        assert np.allclose(light.amplitude[outside], measured.amplitude[outside])
        assert np.abs(light.distance - wall)[outside].max() < 0.05
        assert np.abs(measured.distance - wall)[outside].min() > 0.2
    assert windows == 4
