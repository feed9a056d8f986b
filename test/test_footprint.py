"""The light of a pixel's area: against areas worked out by hand, and what the effect makes of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rim_camera_ros.camera import Camera, Optics, Radiometry, Sensor
from rim_camera_ros.camera_file import load_camera, save_camera, with_effects
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.signal import Context
from rim_camera_ros.errors import InputError
from rim_camera_ros.footprint import COARSE, FINE, Cells, FootprintLight
from rim_camera_ros.frame import RawFrame, Settings
from rim_camera_ros.geometry import see, surface_seen
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene, ScenePose, Surface

F, CX, CY = 400.0, 14.3, 10.6
L = 299792458.0 / 40e6


def camera() -> Camera:
    """So long a lens that cosines of rays hardly change within a pixel."""
    sensor = Sensor(width=30, height=22, pixel_pitch=(4e-5, 4e-5), modulation_frequency=20e6)
    optics = Optics(fx=F, fy=F, cx=CX, cy=CY)
    return Camera(sensor=sensor, optics=optics, device="long", radiometry=Radiometry(gain=50.0))


def halves(edge: float, *, near: float = 1.0, far: float = 2.2) -> Scene:
    """A board of 0.8 left of a column [px], before a wall of 0.3."""
    x = (edge - CX) / F * near
    board = Surface(
        name="board",
        type="rectangle",
        size=(2.0, 3.0),
        reflectivity=0.8,
        pose=ScenePose((x - 1.0, 0.0, near)),
    )
    wall = Surface(name="wall", type="plane", reflectivity=0.3, pose=ScenePose((0.0, 0.0, far)))
    return Scene((board, wall))


def context(scene: Scene, cam: Camera | None = None) -> Context:
    simulation = Simulation(camera() if cam is None else cam, scene, noise=False)
    settings = Settings(integration_time=60.0, modulation_frequency=20e6)
    return simulation.context(Exposure(stamp=10**9, settings=settings, poses=scene.fixed_poses()))


def light_of(scene: Scene, cells: Cells = FINE) -> FootprintLight:
    around = context(scene).footprint
    assert around is not None
    return around(cells)


def shared(own: complex, other: complex, part: float) -> complex:
    return 1 - part + part * other / own


def phasor(reflectivity: float, distance: float) -> complex:
    return complex(reflectivity / distance**2 * np.exp(2j * np.pi * distance / L))


def test_without_an_edge_the_light_is_that_of_the_centre() -> None:
    """Of a pose before one wall no pixel is sampled; a sweep of poses has some of these."""
    light = light_of(Scene(halves(12.25).surfaces[1:]))
    assert light.pixels.size == 0
    np.testing.assert_array_equal(light.ratio(0.7), np.ones((22, 30)))
    np.testing.assert_array_equal(light.ratio_column(0.7), np.zeros((22, 30)))


@pytest.mark.parametrize("side", [0.5, 0.7, 1.0, 1.3])
@pytest.mark.parametrize("edge", [12.05, 12.25, 12.35, 11.75])
def test_the_share_of_the_other_surface_is_that_of_the_area(side: float, edge: float) -> None:
    """An edge at a place [px] leaves column 12 the part of its square beyond it; cells are a tenth wide."""
    image = light_of(halves(edge)).ratio(side)
    board, wall = phasor(0.8, 1.0), phasor(0.3, 2.2)
    for column in (11, 12, 13):
        beyond = float(np.clip(column + side / 2 - edge, 0.0, side)) / side
        if column < edge:
            expected = shared(board, wall, beyond)
            slack = abs(wall / board - 1)
        else:
            expected = shared(wall, board, 1 - beyond)
            slack = abs(board / wall - 1)
        assert abs(image[7, column] - expected) < 0.051 / side * slack + 0.01


@pytest.mark.parametrize("side", [0.5, 0.7, 1.0, 1.3])
def test_an_edge_along_the_columns_meets_many_places(side: float) -> None:
    """By one row of cells it would be moved in steps of 0.1 px: shares with an RMS error of 0.03 / side."""
    ratio = phasor(0.3, 2.2) / phasor(0.8, 1.0)
    errors = []
    for edge in np.arange(11.52, 12.5, 0.0271):
        image = light_of(halves(float(edge))).ratio(side)
        for column in (11, 12):
            beyond = float(np.clip(column + side / 2 - edge, 0.0, side)) / side
            share = beyond if column < edge else 1 - beyond
            errors.append(abs((image[7, column] - 1) / ((ratio if column < edge else 1 / ratio) - 1) - share))
    assert np.sqrt(np.mean(np.square(errors))) < 0.008


def test_places_of_cells_are_all_different_and_even() -> None:
    for cells in (FINE, COARSE):
        down, across = cells.places
        for place in (down, across):
            steps = np.sort(place.ravel())
            np.testing.assert_allclose(np.diff(steps), cells.side / cells.number, rtol=1e-9)
            np.testing.assert_allclose(place, -place[::-1, ::-1], atol=1e-15)
        np.testing.assert_array_equal(down, across.T)
        assert np.abs(down - down.mean(axis=1, keepdims=True)).max() <= cells.side / 2


def test_nothing_changes_away_from_edges_nor_by_a_point() -> None:
    light = light_of(halves(12.35))
    image = light.ratio(1.0)
    assert np.all(np.delete(image, range(10, 16), axis=1) == 1)
    np.testing.assert_allclose(light.ratio(1e-3), 1.0, atol=1e-6)


@given(st.floats(0.01, 1.3), st.sampled_from([FINE, COARSE]))
def test_shares_of_cells_sum_to_one_and_their_derivatives_to_none(side: float, cells: Cells) -> None:
    side = min(side, cells.widest)
    weights, change = cells.weights(side)
    assert weights.sum() == pytest.approx(1.0)
    assert change.sum() == pytest.approx(0.0, abs=1e-6 / side)
    assert (weights >= 0).all()


def test_the_derivative_by_the_side() -> None:
    light = light_of(halves(12.23))
    numeric = (light.ratio(0.78) - light.ratio(0.72)) / 0.06
    np.testing.assert_allclose(light.ratio_column(0.75), numeric, atol=0.02 * np.abs(numeric).max())
    assert np.abs(numeric).max() > 0.1


def simulated(effect: MixedPixels | None, scene: Scene) -> RawFrame:
    cam = camera() if effect is None else with_effects(camera(), {"mixed_pixels": effect})
    simulation = Simulation(cam, scene, noise=False, quantised=False)
    settings = Settings(integration_time=60.0, modulation_frequency=20e6)
    return simulation.frame(Exposure(stamp=10**9, settings=settings, poses=scene.fixed_poses()))


def test_pixels_that_an_edge_crosses_measure_between_the_surfaces() -> None:
    """Only those: a third of column 12 sees the wall behind, its neighbours nothing of the other surface."""
    scene = halves(12.0 + 0.9 * (0.5 - 1 / 3))
    plain, mixed = simulated(None, scene), simulated(MixedPixels(0.0, footprint=0.9), scene)
    s = shared(1.0, phasor(0.3, 2.2) / phasor(0.8, 1.0), 1 / 3)
    change = mixed.distance - plain.distance
    assert change[9, 12] == pytest.approx(np.angle(s) * L / (2 * np.pi), abs=0.004)
    assert change[9, 12] > 0.02
    assert mixed.amplitude[9, 12] / plain.amplitude[9, 12] == pytest.approx(abs(s), abs=0.05)
    assert np.abs(np.delete(change, 12, axis=1)).max() < 1e-5
    # a part of the light only
    part = simulated(MixedPixels(0.0, footprint=0.9, share=0.1), scene)
    assert part.amplitude[9, 12] / plain.amplitude[9, 12] == pytest.approx(abs(0.9 + 0.1 * s), abs=0.005)


def test_a_pixel_whose_centre_sees_nothing_stays_dark() -> None:
    scene = Scene(halves(12.1).surfaces[:1])
    frame = simulated(MixedPixels(0.0, footprint=1.0), scene)
    assert np.isfinite(frame.distance[:, :13]).all()
    assert np.isnan(frame.distance[:, 13:]).all()


def test_derivatives_of_the_effect() -> None:
    cam = with_effects(camera(), {"mixed_pixels": MixedPixels(0.31, 0.75, 0.4)})
    seen = context(halves(12.23), cam)
    assert seen.geometry_at is not None
    geometry, amplitude = seen.geometry_at(0.0)
    image = amplitude * np.exp(2j * np.pi * geometry.distance / L)
    effect = MixedPixels(0.31, 0.75, 0.4)
    columns = effect.phasor_columns(image, seen)
    for name, step, slack in (("blur", 1e-4, 1e-3), ("share", 1e-3, 1e-6), ("footprint", 0.03, 0.02)):
        up, down = (
            replace(effect, **{name: getattr(effect, name) + sign * step}).apply(image, seen)
            for sign in (1, -1)
        )
        numeric = (up - down) / (2 * step)
        np.testing.assert_allclose(columns[name], numeric, atol=slack * np.abs(numeric).max())


def test_what_rays_meet_is_what_is_seen() -> None:
    scene, cam = halves(12.23), camera()
    ball = Surface(
        name="ball", type="sphere", radius=0.01, reflectivity=0.5, pose=ScenePose((0.0, -0.01, 0.7))
    )
    scene = Scene((*scene.surfaces, ball))
    poses, geometry = scene.fixed_poses(), see(scene, scene.fixed_poses(), cam.rays)
    np.testing.assert_array_equal(surface_seen(scene, poses, cam.rays), geometry.surface)
    assert (geometry.surface == 2).sum() > 20


def test_camera_files_keep_to_the_blur_where_there_is_no_footprint(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    save_camera(with_effects(camera(), {"mixed_pixels": MixedPixels(0.4)}), path)
    text = path.read_text()
    assert not {"footprint", "share"} & set(text.replace(":", " ").split())
    wide = MixedPixels(0.0, 0.8, 0.2)
    save_camera(with_effects(camera(), {"mixed_pixels": wide}), path)
    assert load_camera(path).effects["mixed_pixels"] == wide
    path.write_text(path.read_text().replace("footprint: 0.8", "footprint: 1.7"))
    with pytest.raises(InputError, match=r"camera\.yaml.*footprint.*1\.3"):
        load_camera(path)


def test_a_share_needs_a_footprint_and_a_footprint_a_scene() -> None:
    with pytest.raises(ValueError, match="give footprint as well"):
        MixedPixels(0.0, share=0.2)
    with pytest.raises(InputError, match=r"mixed_pixels\.footprint needs the scene's geometry"):
        MixedPixels(0.0, 0.5).apply(np.ones((22, 30), complex), Context(camera=camera()))
