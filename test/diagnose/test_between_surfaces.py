"""Mixed pixels as measured, against pixels sampled by many rays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.diagnose.between_surfaces import measured_between
from rim_camera_ros.diagnose.where import of_terms
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.geometry import see
from rim_camera_ros.optics import Optics
from rim_camera_ros.scene import Scene, load_scene
from rim_camera_ros.select.effect_sizes import contribution

from ..blind.score import intersection_over_union, region
from ..calibrate.helpers import camera, record

SCENE = """
format: rim_scene/1
surfaces:
- name: wall
  type: plane
  pose: {position: [0, 0, 4.1], orientation: [0.04, 0.03, 0, 0.998749218]}
  reflectivity: 0.95
- {name: board, type: rectangle, pose: truth, size: [0.9, 0.7], reflectivity: 0.05}
"""
AMBIGUITY = 299_792_458.0 / 40e6
#: Rays across a pixel.
RAYS = 7


def sampled(stated: Camera, scene: Scene, poses: Any) -> np.ndarray:
    """Complex image (H, W): the mean over the rays of each pixel of 1 / d^2 in the phase of d."""
    sensor, o = stated.sensor, stated.optics
    fine = replace(
        stated,
        sensor=replace(sensor, width=sensor.width * RAYS, height=sensor.height * RAYS),
        optics=Optics(
            fx=o.fx * RAYS, fy=o.fy * RAYS, cx=(o.cx + 0.5) * RAYS - 0.5, cy=(o.cy + 0.5) * RAYS - 0.5
        ),
    )
    geometry = see(scene, poses, fine.rays)
    light = geometry.reflectivity * geometry.cos_incidence / geometry.distance**2
    image = light * np.exp(2j * np.pi * geometry.distance / AMBIGUITY)
    return np.asarray(image.reshape(sensor.height, RAYS, sensor.width, RAYS).mean(axis=(1, 3)))


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Dataset, Scene, Camera, list[np.ndarray]]:
    """Stations with mixed pixels, the camera with a blur, and what the mixing does [m] at each."""
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    scene, plain = load_scene(path), camera(tmp_path)
    data = record(plain, scene, poses=14, frames=4, seed=3, wrong=0.0)
    stations, moved = [], []
    for one in data.stations:
        poses = {**scene.fixed_poses(), **one.truth}
        centre, whole = see(scene, poses, plain.rays), sampled(plain, scene, poses)
        light = centre.reflectivity * centre.cos_incidence / centre.distance**2
        d = np.angle(whole) % (2 * np.pi) * AMBIGUITY / (2 * np.pi)
        moved.append(d - centre.distance)
        share = np.abs(whole) / light
        # the noise that was drawn, as large as the light that is left
        distance = one.distance + moved[-1]
        stations.append(replace(one, distance=distance, amplitude=one.amplitude * share))
    blurring = with_effects(plain, {"mixed_pixels": MixedPixels(0.3)})
    return replace(data, stations=stations), scene, blurring, moved


def test_where_pixels_are_mixed(recorded: tuple[Dataset, Scene, Camera, list[np.ndarray]]) -> None:
    data, scene, stated, moved = recorded
    forward = Forward(data, scene, stated)
    forward.amplitude_model = AmplitudeModel({}, 0.05)
    fitted: Any = SimpleNamespace(
        forward=forward, camera=stated, scene=scene, pattern=np.zeros(stated.shape), nuisances={}
    )
    wanted, blurred = np.zeros(stated.shape), np.zeros(stated.shape)
    for one, true in zip(forward.predictions(), moved, strict=True):
        sigma = np.hypot(0.003, 6.0 / np.maximum(one.amplitude, 1.0))
        wanted += np.nan_to_num(true / sigma) ** 2
        blurred += (contribution(one, "mixed_pixels", stated) / sigma) ** 2
    found = of_terms(fitted, ["mixed_pixels"], stated).pixels
    overlap = intersection_over_union(region(found), region(wanted))
    assert region(wanted).mean() < 0.5
    assert overlap > 0.6
    assert overlap > intersection_over_union(region(blurred), region(wanted)) + 0.25
    assert 0.3 < found.sum() * len(moved) / wanted.sum() < 1.2
    assert blurred.sum() < 0.01 * wanted.sum()


def test_a_pixel_that_sees_the_other_surface_is_not_mixed(
    recorded: tuple[Dataset, Scene, Camera, list[np.ndarray]],
) -> None:
    """It is metres off, as a pose that is a tenth of a pixel off makes it, yet measures one surface."""
    data, scene, stated, _ = recorded
    forward = Forward(data, scene, stated)
    forward.amplitude_model = AmplitudeModel({}, 0.05)
    one = next(iter(forward.predictions()))
    board = one.view.geometry.surface == 1
    row, column = np.argwhere(board[:, :-1] & ~board[:, 1:])[5]
    behind = one.view.geometry.distance[row - 1 : row + 2, column - 1 : column + 2].max()
    nothing = np.zeros(stated.shape)
    own = one.view.geometry.distance
    results = {}
    for part in (0.0, 0.3, 1.0):
        one.residual = nothing.copy()
        one.residual[row, column] = part * (behind - own[row, column])
        one.station.amplitude[:] = one.model_reading
        results[part] = measured_between(one, nothing, nothing, {})[row, column]
    step = behind - own[row, column]
    assert step > 0.8
    assert results[0.0] == results[1.0] == 0.0
    assert results[0.3] == pytest.approx(0.3 * step, rel=0.01)
    # near one of them it is moved away from that one, and by what the noise does not explain, also where so
    # bright a board would mean that the wall fills most of the pixel
    light = one.before["mixed_pixels"].amplitude
    light[board] *= 1000.0
    sigma = one.sigma[row, column]
    one.sigma[row, column] = 0.003
    for residual, expected in ((0.015, 1.0), (step - 0.015, -1.0), (step - 0.005, 0.0)):
        one.residual[row, column] = residual
        found = measured_between(one, nothing, nothing, {})[row, column]
        assert found == pytest.approx(expected * np.sqrt(0.015**2 - 0.003**2), rel=1e-3)
    one.sigma[row, column] = sigma
    light[board] /= 1000.0
    # in less light than predicted it is so much less compared with its noise
    one.residual[row, column] = 0.3 * step
    one.station.amplitude[row, column] *= 0.5
    sigmas = [np.hypot(0.003, 6.0 / (one.model_amplitude[row, column] * share)) for share in (1.0, 0.5)]
    dim = measured_between(one, nothing, nothing, {})[row, column]
    noisier = sigmas[1] / sigmas[0]
    without_noise = np.sqrt((0.3 * step) ** 2 - (one.sigma[row, column] * noisier) ** 2)
    assert dim == pytest.approx(without_noise / noisier, rel=1e-3)
