"""The laboratory: the shipped experiments are what the thesis describes, and can be simulated."""

from __future__ import annotations

import math
import re
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import setuptools

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.chain import ideal_amplitude
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.effects.interference import Interference
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera, find_scene, share_folder, shipped
from rim_camera_ros.frame import Flag, Pose
from rim_camera_ros.geometry import see
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.simulate import Exposure, Simulation, measured_residual
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import Scene, load_scene

ROOT = Path(__file__).resolve().parents[1]
NAMES = [
    f"{name}_experiment"
    for name in (
        "board_by_hand", "circle_field", "climate_cell", "cold_start", "grey_wedge", "integration_times",
        "rotating_plate", "scattering", "track_line", "two_cameras", "white_wall",
    )
]  # fmt: skip
CAMERA = load_camera(find_camera("sr3000"))
#: Row and column of the pixel that the thesis observes, and of one near the principal point.
OBSERVED, CENTRE = (71, 87), (82, 90)


def scene_named(name: str) -> Scene:
    return load_scene(find_scene(f"{name}_experiment"))


def stations(name: str) -> list[Exposure]:
    """Return the first exposure of every station."""
    found: dict[int, Exposure] = {}
    for one in Timeline(scene_named(name), CAMERA):
        found.setdefault(one.station, one)
    return list(found.values())


def seen(scene: Scene, exposure: Exposure, pixel: tuple[int, int]) -> Any:
    """Return what one pixel sees (arrays of 1 x 1)."""
    return see(scene, exposure.poses, CAMERA.rays[pixel[0], pixel[1]][None, None, :])


def gon(pose: Pose) -> float:
    """Return the turn about the vertical in gon."""
    normal = rotation_matrix(pose.orientation)[:, 2]
    return math.degrees(math.atan2(normal[0], normal[2])) / 0.9


# --- all of them ----------------------------------------------------------------------------------


def test_experiments_are_found_by_name_as_the_other_scenes_are() -> None:
    others = {one.stem for one in (share_folder() / "config").glob("*.yaml")}
    assert not others & set(NAMES)
    assert set(NAMES) | {"wall", "room"} <= set(shipped("config"))
    assert [one for one in shipped("config") if one.endswith("_experiment")] == NAMES
    with pytest.raises(
        InputError, match=r"did you mean 'grey_wedge_experiment'\?; shipped: board, board_by_hand"
    ):
        find_scene("gray_wedge_experiment")


@pytest.mark.parametrize("name", NAMES)
def test_first_and_last_station_can_be_simulated(name: str) -> None:
    scene = load_scene(find_scene(name))
    assert scene.needs_truth == tuple(one.name for one in scene.surfaces)
    exposures = list(Timeline(scene, CAMERA))
    assert all(5 <= one.frames <= 20 and one.rate <= 12 for one in scene.schedule)
    assert len(exposures) < 2000
    simulation = Simulation(CAMERA, scene)
    for exposure in (exposures[0], exposures[-1]):
        frame = simulation.frame(exposure)
        assert set(frame.truth) == set(scene.needs_truth)
        corrected = Correction(CAMERA).correct(frame)
        truth = simulation.geometry(exposure.poses).distance
        usable = np.isfinite(corrected.distance) & np.isfinite(truth)
        usable &= (corrected.flags & Flag.MIXED_PIXEL.value) == 0
        assert usable.sum() > 250
        error = measured_residual(corrected.distance[usable], truth[usable], CAMERA)
        assert abs(np.median(error)) < max(0.02, np.median(corrected.sigma[usable]))


@pytest.mark.parametrize("name", NAMES)
def test_each_station_is_one_pose_of_the_recording(name: str) -> None:
    found = [one.pose_stamp for one in stations(name.removesuffix("_experiment"))]
    assert None not in found
    assert found == sorted(set(found))  # type: ignore[type-var]
    assert len(found) == len(load_scene(find_scene(name)).schedule)


def test_a_calibration_reads_the_poses_from_the_recording(tmp_path: Path) -> None:
    scene = scene_named("rotating_plate")
    short = replace(scene, schedule=tuple(replace(one, frames=2) for one in scene.schedule[4:7]))
    simulation = Simulation(CAMERA, short)
    with RecordingWriter(tmp_path / "bag") as writer:
        for exposure in Timeline(short, CAMERA, start=10**9):
            writer.write_raw(simulation.frame(exposure))
    with Recording(tmp_path / "bag") as bag:
        poses = [scene.poses_for(frame.truth)["plate"] for frame in bag.frames()]
    assert [gon(one) for one in poses] == pytest.approx([-50, -50, -40, -40, -30, -30], abs=1e-6)
    assert {one.position for one in poses} == {(0.0, 0.0, 2.5)}


def test_the_files_are_those_of_their_script() -> None:
    script = ROOT / "calibration" / "tools" / "experiments.py"
    done = subprocess.run(
        [sys.executable, str(script), "--check"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, f"{done.stdout}{done.stderr}"
    assert "all as this script makes them" in done.stdout


def test_each_has_a_page_that_says_how() -> None:
    folder = ROOT / "docs" / "experiments"
    index = (folder / "README.md").read_text()
    for name in NAMES:
        page = (folder / f"{name}.md").read_text()
        assert f"rim simulate {name} --camera sr3000" in page
        for part in ("## With a real camera", "**Determines** ", "**Takes** ", "## What goes wrong"):
            assert part in page, name
        assert f"[{name}]({name}.md)" in index
    for page_path in folder.glob("*.md"):
        for link in re.findall(r"\]\(([^)]+)\)", page_path.read_text()):
            assert (folder / link).exists(), link


def test_they_are_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(setuptools, "setup", lambda **keywords: given.update(keywords))
    runpy.run_path("setup.py")
    files = dict(given["data_files"])["share/rim_camera_ros/calibration/experiments"]
    assert {f"calibration/experiments/{name}.yaml" for name in NAMES} <= set(files)


# --- one by one -----------------------------------------------------------------------------------


def test_track_line_forth_and_back() -> None:
    """Sec. 3.3.8: equidistant steps of 5 cm, forth and back."""
    scene, there = scene_named("track_line"), stations("track_line")
    z = np.array([one.poses["plate"].position[2] for one in there])
    forth = 0.3 + 0.05 * np.arange(141)
    visited = z[np.concatenate([[True], np.diff(z) != 0])]
    np.testing.assert_allclose(visited, [*forth, *forth[-2::-1]], atol=1e-9)
    for one, distance in zip(there[::30], z[::30], strict=True):
        ray = CAMERA.rays[CENTRE]
        assert seen(scene, one, CENTRE).distance[0, 0] == pytest.approx(distance / ray[2], abs=1e-9)
    far = {one.settings.integration_time for one, d in zip(there, z, strict=True) if d > 1.52}
    near = {one.settings.integration_time for one, d in zip(there, z, strict=True) if d < 1.03}
    assert (near, far) == ({16.0}, {100.0})


def test_grey_wedge_at_three_distances() -> None:
    """Sec. 3.3.5: 1.728, 2.344 and 2.944 m; the observed pixel sees greys from white to black."""
    scene, there = scene_named("grey_wedge"), stations("grey_wedge")
    assert sorted({one.poses["wedge"].position[2] for one in there}) == [1.728, 2.344, 2.944]
    for z in (1.728, 2.344, 2.944):
        for setting in (16.0, 60.0, 100.0):
            mine = [
                seen(scene, one, OBSERVED).reflectivity[0, 0]
                for one in there
                if one.poses["wedge"].position[2] == z and one.settings.integration_time == setting
            ]
            # the plate moves to the right, which brings its left, bright end before the pixel
            assert len(mine) == 20
            assert np.all(np.diff(mine) > 0)
            assert (mine[0], mine[-1]) == (pytest.approx(0.022, abs=0.003), pytest.approx(0.86, abs=0.05))


def test_rotating_plate_angles() -> None:
    """Sec. 3.3.6: -90 to 90 gon in steps of 10 gon at 2.5 m, at three settings."""
    scene, there = scene_named("rotating_plate"), stations("rotating_plate")
    found = [gon(one.poses["plate"]) for one in there]
    np.testing.assert_allclose(found, [*range(-90, 91, 10)] * 3, atol=1e-6)
    assert [one.settings.integration_time for one in there[::19]] == [16, 60, 100]
    axis = np.array([[[0.0, 0.0, 1.0]]])
    for one, angle in zip(there, found, strict=True):
        geometry = see(scene, one.poses, axis)
        assert geometry.distance[0, 0] == pytest.approx(2.5, abs=1e-9)
        assert math.degrees(geometry.incidence[0, 0]) == pytest.approx(0.9 * abs(angle), abs=1e-5)
    straight = see(scene, there[9].poses, CAMERA.rays)
    assert set(np.unique(straight.reflectivity[straight.hit])) == {0.85, 0.30, 0.12}


def test_white_wall_frames() -> None:
    """Secs. 3.3.3, 3.3.9: 1.366 m and 2.463 m, at least 50 frames at each setting, all pixels."""
    scene = scene_named("white_wall")
    count: dict[tuple[float, float | None], int] = {}
    for one in Timeline(scene, CAMERA):
        key = (one.poses["wall"].position[2], one.settings.integration_time)
        count[key] = count.get(key, 0) + 1
    assert count == {(z, t): 60 for z in (1.366, 2.463) for t in (16.0, 60.0, 100.0)}
    assert see(scene, stations("white_wall")[0].poses, CAMERA.rays).hit.all()


def test_cold_start_lasts_forty_minutes_from_power_on() -> None:
    """Sec. 3.3.7; the bursts are short against the drift that is left at their time."""
    exposures = list(Timeline(scene_named("cold_start"), CAMERA))
    uptime = np.array([one.settings.uptime for one in exposures], float)
    stamp = np.array([one.stamp for one in exposures]) / 1e9
    assert (uptime[0], uptime[-1]) == (0.0, pytest.approx(2400.4))
    np.testing.assert_allclose(np.diff(stamp), np.diff(uptime), atol=1e-6)
    drift = CAMERA.effects["warm_up_drift"]
    first, last = uptime[::5], uptime[4::5]
    within = [drift.rate(a) * (b - a) for a, b in zip(first, last, strict=True)]
    assert max(within) == pytest.approx(0.0031, abs=2e-4)
    assert max(w for w, a in zip(within, first, strict=True) if a >= 30) < 2.5e-4
    assert len({one.poses["wall"] for one in exposures}) == 1


def test_climate_cell_temperatures_and_plates() -> None:
    """Sec. 3.3.7, figs. 3.36, 3.37: -10 to 40 degC; pixels 106/87 and 71/87 see 1.628 and 1.996 m."""
    scene, there = scene_named("climate_cell"), stations("climate_cell")
    ambient = np.array([one.settings.ambient_temperature for one in there], float)
    assert (ambient.min(), ambient.max()) == (-10.0, 40.0)
    hours = np.array([one.settings.uptime for one in there], float) / 3600 - 1
    assert ambient[hours == 5.0] == [-10.0]
    assert ambient[np.argmin(abs(hours - 4.25))] == pytest.approx(-5.0)
    assert ambient[-1] == 10.0
    assert np.abs(np.diff(ambient) / np.diff(hours)).max() == pytest.approx(20.0)
    for pixel, distance in (((106, 87), 1.628), (OBSERVED, 1.996)):
        # the lens' distortion moves the pixels by less than one from where the plates were aimed
        assert seen(scene, there[0], pixel).distance[0, 0] == pytest.approx(distance, abs=0.002)


def test_circle_field_is_rigid_and_well_seen() -> None:
    """Sec. 3.2.2: 25 discs of 11.7 cm, rotated and convergent stations; control points known to 0.1 mm."""
    scene, there = scene_named("circle_field"), stations("circle_field")
    discs = [one for one in scene.surfaces if one.type == "disc"]
    assert (len(discs), {one.radius for one in discs}, len(there)) == (25, {0.117 / 2}, 16)
    pixels = np.zeros((16, 25))
    rolls, tilts = [], []
    for k, one in enumerate(there):
        field = one.poses["field"]
        rotation = rotation_matrix(field.orientation)
        for disc in discs:
            i, j = (int(part) for part in disc.name.split("_")[1:])
            local = (np.array(one.poses[disc.name].position) - field.position) @ rotation
            np.testing.assert_allclose(local, [0.2 * (j - 2), 0.2 * (i - 2), -2e-4], atol=1e-7)
        geometry = see(scene, one.poses, CAMERA.rays)
        pixels[k] = [np.count_nonzero(geometry.surface == n + 1) for n in range(25)]
        rolls.append(math.degrees(math.atan2(rotation[1, 0], rotation[0, 0])) % 360)
        tilts.append(math.degrees(math.acos(abs(rotation[2, 2]))))
    assert ((pixels > 40).sum(axis=0) >= 12).all()
    assert set(np.round(rolls[:4])) == {0, 90, 180, 270}
    assert max(tilts) == pytest.approx(45, abs=0.01)


def test_scattering_of_small_targets_and_of_an_object() -> None:
    """Fig. 3.10: white against black wall several centimetres; fig. 3.14: before the object is there."""
    scene, there = scene_named("scattering"), stations("scattering")
    only = {name: CAMERA.effects[name] for name in ("emission_pattern", "mixed_pixels", "scattering")}
    simulation = Simulation(replace(CAMERA, effects=only), scene, noise=False, quantised=False)
    white, black = (simulation.frame(there[k]) for k in (0, 3))
    assert simulation.geometry(there[0].poses).distance[CENTRE] == pytest.approx(1.76, abs=0.03)
    shift = []
    for i, _ in enumerate((0.85, 0.60, 0.40, 0.25, 0.12, 0.06)):
        surface = np.argwhere(simulation.geometry(there[0].poses).surface == i)
        v, u = surface[np.argmin(np.sum((surface - surface.mean(axis=0)) ** 2, axis=1))]
        shift.append(white.distance[v, u] - black.distance[v, u])
    assert np.all(np.diff(shift) > 0), "the darker the target, the farther it seems before a white wall"
    assert 0.02 < shift[-1] < 0.09
    moved = there[9:]
    centre = [simulation.frame(one).distance[CENTRE] for one in moved[:12]]
    covered = [simulation.geometry(one.poses).surface[CENTRE] == 6 for one in moved[:12]]
    assert not any(covered)
    assert simulation.geometry(moved[0].poses).surface.max() == 7, "only the wall is in view"
    assert (simulation.geometry(moved[0].poses).surface == 6).sum() == 0
    assert centre[0] - centre[10] > 0.005, "shorter although the object is elsewhere"


def test_integration_times_back_and_forth() -> None:
    there = stations("integration_times")
    settings = [one.settings.integration_time for one in there]
    assert settings == [16, 60, 100, 100, 60, 16] * 3
    assert [one.poses["board"].position[2] for one in there[::6]] == [1.3, 2.2, 3.6]


def test_second_camera_is_the_shipped_one_with_interference() -> None:
    other = load_camera(find_camera("sr3000_with_second_camera"))
    effect = other.effects["interference"]
    assert isinstance(effect, Interference)
    assert {name: one for name, one in other.effects.items() if name != "interference"} == CAMERA.effects
    assert (other.sensor, other.optics, other.noise) == (CAMERA.sensor, CAMERA.optics, CAMERA.noise)
    assert effect.frequency - 20e6 == pytest.approx(20.0)


def test_two_cameras_add_common_noise() -> None:
    """A phasor a of random phase on A: distance sigma L / (2 pi) a / (sqrt(2) A); a after eq. 2.11."""
    other = load_camera(find_camera("sr3000_with_second_camera"))
    only = replace(other, effects={"interference": other.effects["interference"]})
    scene, there = scene_named("two_cameras"), stations("two_cameras")
    simulation = Simulation(only, scene, noise=False, quantised=False)
    assert there[2].settings.integration_time == 100
    frames = [simulation.frame(replace(there[2], stamp=there[2].stamp + k)) for k in range(400)]
    distance = np.stack([one.distance for one in frames])
    amplitude = ideal_amplitude(simulation.geometry(there[2].poses), other.radiometry.gain * 100.0)
    left = 80.0 * np.sinc(20.0 * 0.0202)
    bright = amplitude > 10 * left
    predicted = 7.49481 / (2 * np.pi) * left / (np.sqrt(2) * amplitude[bright])
    np.testing.assert_allclose(distance.std(axis=0)[bright] / predicted, 1.0, atol=0.1)
    deviation = distance[:, bright] - distance[:, bright].mean(axis=0)
    # at one distance all pixels are shifted by the same phasor, those of other distances by a turned one
    near = np.abs(simulation.geometry(there[2].poses).distance[bright] - 2.6) < 0.05
    correlation = np.corrcoef(deviation[:, near][:, ::50].T)
    assert correlation.min() > 0.9


def test_board_by_hand_varies_everything() -> None:
    scene, there = scene_named("board_by_hand"), stations("board_by_hand")
    poses = list(dict.fromkeys(one.poses["board"] for one in there))
    z = np.array([one.position[2] for one in poses])
    tilt = np.degrees([math.acos(abs(rotation_matrix(one.orientation)[2, 2])) for one in poses])
    assert len(poses) == 40
    assert (z.min(), z.max()) == (0.5, 6.0)
    assert 40 < tilt.max() <= 55
    assert np.count_nonzero(tilt > 25) > 8
    assert abs(np.corrcoef(z, range(40))[0, 1]) < 0.35, "distance is not a drift"
    simulation = Simulation(CAMERA, scene)
    settings: dict[float | None, int] = {}
    for one in there:
        frame, geometry = simulation.frame(one), simulation.geometry(one.poses)
        assert geometry.hit.sum() > 400
        assert frame.amplitude.max() < CAMERA.sensor.saturation
        settings[one.settings.integration_time] = settings.get(one.settings.integration_time, 0) + 1
    assert min(settings[t] for t in (16.0, 60.0, 100.0)) >= 20
