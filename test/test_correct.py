"""The correction as a whole: near the ends of the range, float frames, settings, flags, its short form."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rim_camera_ros.camera import Camera, Noise, Optics, Radiometry, Sensor, Validity
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.effects.integration_time_offset import IntegrationTimeOffset
from rim_camera_ros.effects.saturation_bleed import SaturationBleed
from rim_camera_ros.effects.scattering import Ghost, Kernel, Scattering
from rim_camera_ros.effects.warm_up_drift import Exponential, WarmUpDrift
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import Flag, Pose, RawFrame, Settings
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.mixed import mixed_pixels
from rim_camera_ros.pipeline.normals import IncidenceEstimator
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene, ScenePose, Surface

L = 299792458.0 / 40e6
SETTINGS = Settings(integration_time=60.0, uptime=100.0, ambient_temperature=20.0)
CYCLIC = CyclicError((Harmonic(4, 0.05, 0.4), Harmonic(8, 0.01, -0.7)), (0.012, -0.021))


def camera(**sensor: Any) -> Camera:
    return Camera(
        sensor=Sensor(width=38, height=29, pixel_pitch=(1e-4, 1e-4), modulation_frequency=20e6, **sensor),
        optics=Optics(fx=51.0, fy=48.0, cx=18.2, cy=15.1, d=(-0.1, 0.04, 0.002, -0.001, 0.0)),
        noise=Noise(floor=0.003, shot=0.0, amplitude=15.0),
        minimum_amplitude=0.0,
    )


def wall(z: float = 2.5, reflectivity: float = 0.7) -> Scene:
    pose = ScenePose((0.0, 0.0, z), tuple(Rotation.from_euler("xy", [0.2, -0.3]).as_quat().tolist()))  # type: ignore[arg-type]
    return Scene(surfaces=(Surface(name="wall", type="plane", pose=pose, reflectivity=reflectivity),))


def simulated(
    cam: Camera, scene: Scene, settings: Settings = SETTINGS, **options: Any
) -> tuple[RawFrame, np.ndarray]:
    """An exact frame and its true distances."""
    simulation = Simulation(cam, scene, **{"noise": False, "quantised": False, **options})
    exposure = Exposure(stamp=10**18, settings=settings, poses=scene.fixed_poses())
    return simulation.frame(exposure), simulation.true_distance(exposure)


@pytest.mark.parametrize("exact", [True, False], ids=["exact", "fast"])
@pytest.mark.parametrize("z", [0.02, 0.3, 3.9, 7.4, L, 9.3])
def test_up_to_the_ends_of_the_range(z: float, exact: bool) -> None:
    """The representative in [0, L), also where the error carries it over an end."""
    cam = replace(camera(), radiometry=Radiometry(gain=80.0 * z**2))
    cam = with_effects(cam, {"cyclic_error": CYCLIC})
    frame, truth = simulated(cam, wall(z))
    found = Correction(cam, exact=exact).correct(frame).distance
    assert np.isfinite(found).all()
    assert found.min() >= 0
    assert found.max() < L + 1e-6
    error = np.abs(np.remainder(found - truth + L / 2, L) - L / 2)
    assert error.max() < 1e-5


@pytest.mark.parametrize("exact", [True, False], ids=["exact", "fast"])
def test_a_camera_that_resolves_its_ambiguity(exact: bool) -> None:
    """Nothing is taken modulo L: 11 m stay 11 m."""
    effects = {"cyclic_error": CYCLIC, "distance_scale": DistanceScale(0.004)}
    cam = with_effects(camera(distance_lsb=0.0005), effects)
    assert not cam.sensor.wraps
    frame, truth = simulated(cam, wall(11.0))
    found = Correction(cam, exact=exact).correct(frame)
    np.testing.assert_allclose(found.distance, truth, atol=1e-5)
    counts, _ = simulated(cam, wall(11.0), quantised=True)
    found = Correction(cam, exact=exact).correct(counts)
    # half a count, and what the steepest term makes of it
    np.testing.assert_allclose(found.distance, truth, atol=0.00026 * 1.3)


@pytest.mark.parametrize("exact", [True, False], ids=["exact", "fast"])
def test_counts_and_metres_are_corrected_alike(exact: bool) -> None:
    effects = {
        "cyclic_error": CYCLIC,
        "amplitude_offset": AmplitudeOffset(MappingProxyType({60.0: Hyperbola(237.0, 15.71)})),
    }
    cam = with_effects(camera(), effects)
    counts, _ = simulated(cam, wall(), quantised=True)
    assert counts.distance.dtype == np.uint16
    for dtype in (np.float32, np.float64):
        metres = replace(
            counts,
            distance=(counts.distance * cam.sensor.lsb).astype(dtype),
            amplitude=counts.amplitude.astype(dtype),
        )
        one, other = (
            Correction(cam, exact=exact).correct(counts),
            Correction(cam, exact=exact).correct(metres),
        )
        np.testing.assert_allclose(one.distance, other.distance, atol=3e-6)
        np.testing.assert_allclose(one.sigma, other.sigma, rtol=1e-4)
        np.testing.assert_array_equal(one.flags, other.flags)


@pytest.mark.parametrize("exact", [True, False], ids=["exact", "fast"])
@pytest.mark.parametrize("name", ["sr3000", "sr2", "pmd3ks"])
def test_distances_alone_are_the_same(name: str, exact: bool) -> None:
    """`correct_distance` leaves sigma and flags out, and nothing else."""
    cam = load_camera(find_camera(name))
    rng = np.random.default_rng(2)
    scene = wall(2.2)
    simulation = Simulation(cam, scene, seed=4)
    settings = replace(SETTINGS, integration_time=20.0 if name == "pmd3ks" else 60.0)
    frame = simulation.frame(Exposure(stamp=10**18, settings=settings, poses=scene.fixed_poses()))
    distance, amplitude = frame.distance.copy(), frame.amplitude.copy()
    distance[rng.uniform(size=cam.shape) < 0.02] = 0
    amplitude[rng.uniform(size=cam.shape) < 0.02] = 65535
    amplitude[rng.uniform(size=cam.shape) < 0.02] = 3
    frame = replace(frame, distance=distance, amplitude=amplitude)
    full, short = (
        Correction(cam, exact=exact).correct(frame),
        Correction(cam, exact=exact).correct_distance(frame),
    )
    np.testing.assert_array_equal(full.distance, short.distance)
    np.testing.assert_array_equal(full.amplitude, short.amplitude)


def test_frames_are_left_as_they_were_and_results_are_new() -> None:
    effects = {
        "scattering": Scattering((Kernel(0.1, (6.0, 5.0)),), Ghost(0.01, (3.0, 1.0))),
        "cyclic_error": CYCLIC,
    }
    cam = with_effects(camera(), effects)
    frame, _ = simulated(cam, wall(), quantised=True)
    before = frame.distance.copy(), frame.amplitude.copy()
    correction = Correction(cam)
    one = correction.correct(frame)
    kept = [
        one.distance.copy(),
        one.amplitude.copy(),
        one.sigma.copy(),
        one.flags.copy(),
        correction.cloud(one),
    ]
    cloud = kept[-1].copy()
    other, _ = simulated(cam, wall(1.4), quantised=True)
    correction.cloud(correction.correct(other))
    np.testing.assert_array_equal(frame.distance, before[0])
    np.testing.assert_array_equal(frame.amplitude, before[1])
    for now, then in zip((one.distance, one.amplitude, one.sigma, one.flags), kept, strict=False):
        np.testing.assert_array_equal(now, then)
    np.testing.assert_array_equal(kept[-1], cloud)


def test_cloud_and_depth() -> None:
    cam = camera()
    frame, truth = simulated(cam, wall())
    frame = replace(frame, distance=np.where(np.arange(38) == 5, np.nan, frame.distance))
    correction = Correction(cam)
    corrected = correction.correct(frame)
    cloud, depth = correction.cloud(corrected), correction.depth(corrected)
    assert (cloud.shape, cloud.dtype, depth.dtype) == ((29, 38, 4), np.float32, np.float32)
    assert np.isnan(cloud[:, 5, :3]).all()
    assert np.isfinite(cloud[..., 3]).all()
    assert np.isnan(depth[:, 5]).all()
    rest = np.arange(38) != 5
    np.testing.assert_allclose(cloud[:, rest, :3], (truth[..., None] * cam.rays)[:, rest], atol=1e-6)
    np.testing.assert_allclose(depth[:, rest], (truth * cam.rays[..., 2])[:, rest], atol=1e-6)
    np.testing.assert_allclose(cloud[..., 3], frame.amplitude, rtol=1e-6)


def test_amplitude_is_without_compression_and_stray_light_but_with_falloff() -> None:
    cam = load_camera(find_camera("sr3000_every_effect"))
    names = ("emission_pattern", "scattering", "amplitude_nonlinearity")
    cam = with_effects(cam, {name: cam.effects[name] for name in names})
    frame, _ = simulated(cam, wall(2.0, 0.5))
    plain = with_effects(cam, {"emission_pattern": cam.effects["emission_pattern"]})
    expected, _ = simulated(plain, wall(2.0, 0.5))
    found = Correction(cam, exact=True).correct(frame)
    np.testing.assert_allclose(found.amplitude, expected.amplitude, rtol=1e-5)


# --- settings -----------------------------------------------------------------------------------

ROWS = {"integration_time_offset": IntegrationTimeOffset(MappingProxyType({16.0: -0.1, 60.0: 0.02}))}


def test_the_camera_files_setting_is_used_and_judged_like_a_frames() -> None:
    """Without frame_info: sensor.integration_time; outside the rows flag 8 as well."""
    cam = with_effects(camera(integration_time=100.0), ROWS)
    frame, truth = simulated(cam, wall(), quantised=False)
    unknown = replace(frame, settings=replace(SETTINGS, integration_time=None))
    found = Correction(cam).correct(unknown)
    np.testing.assert_allclose(found.distance, truth, atol=1e-5)
    assert (found.flags & Flag.OUTSIDE_CALIBRATION.value).all()


def test_the_camera_files_setting_is_held_against_validity() -> None:
    cam = replace(camera(integration_time=100.0), validity=Validity(integration_time=(16.0, 60.0)))
    frame, _ = simulated(cam, wall())
    bit = Flag.OUTSIDE_CALIBRATION.value
    assert not (Correction(cam).correct(frame).flags & bit).any()
    unknown = replace(frame, settings=replace(SETTINGS, integration_time=None))
    assert (Correction(cam).correct(unknown).flags & bit).all()


def test_settings_may_change_from_frame_to_frame() -> None:
    """More settings than are kept folded, there and back."""
    cam = with_effects(camera(), ROWS)
    correction = Correction(cam)
    for time in [16.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0, 55.0, 60.0, 16.0, 20.0, 61.0]:
        frame, truth = simulated(cam, wall(), replace(SETTINGS, integration_time=time))
        np.testing.assert_allclose(correction.correct(frame).distance, truth, atol=1e-5)


@pytest.mark.parametrize("time", [0.0, -5.0])
def test_a_setting_of_nothing_is_bad_input(time: float) -> None:
    frame, _ = simulated(camera(), wall())
    frame = replace(frame, settings=Settings(integration_time=time))
    with pytest.raises(InputError, match="integration_time must be positive"):
        Correction(camera()).correct(frame)


def test_an_effect_may_be_left_in() -> None:
    cam = with_effects(camera(), {"cyclic_error": CYCLIC, **ROWS})
    frame, truth = simulated(cam, wall())
    found = Correction(cam, without=["cyclic_error"]).correct(frame)
    plain, _ = simulated(with_effects(camera(), {"cyclic_error": CYCLIC}), wall())
    np.testing.assert_allclose(found.distance, plain.distance, atol=1e-6)
    assert np.abs(found.distance - truth).max() > 0.01
    with pytest.raises(
        InputError, match=r"effect 'cyclic' is not in the camera file \(did you mean 'cyclic_error'\?\)"
    ):
        Correction(cam, without=["cyclic"])


def test_what_is_off_is_said() -> None:
    cam = with_effects(camera(), {"warm_up_drift": WarmUpDrift((Exponential(-0.05, 20.0),))})
    frame, _ = simulated(cam, wall(), replace(SETTINGS, uptime=None))
    correction = Correction(cam)
    correction.correct(frame)
    assert correction.notes == {"warm_up_drift is off: the recording states no uptime"}


def test_another_modulation_frequency() -> None:
    """Counts of 30 MHz are not those of 20 MHz; poses of such a recording may be simulated."""
    cam = camera()
    frame, truth = simulated(cam, wall(), replace(SETTINGS, modulation_frequency=30e6))
    assert frame.settings.modulation_frequency == 20e6
    np.testing.assert_allclose(Correction(cam).correct(frame).distance, truth, atol=1e-5)
    other = replace(frame, settings=replace(SETTINGS, modulation_frequency=30e6))
    with pytest.raises(
        InputError, match=r"frame_info: it was recorded at .* 30 MHz, the camera file says 20 MHz"
    ):
        Correction(cam).correct(other)


def test_images_of_another_sensor() -> None:
    frame, _ = simulated(camera(), wall())
    other = replace(camera(), sensor=replace(camera().sensor, width=29, height=38))
    with pytest.raises(InputError, match=r"images of 38 x 29 px, but the camera file is for 29 x 38"):
        Correction(other).correct(frame)


# --- flags ----------------------------------------------------------------------------------------


def test_flags_of_single_pixels() -> None:
    """1 low amplitude, 2 saturated, 16 no measurement; NaN in all three, and finite elsewhere."""
    cam = replace(camera(saturation=30000.0), minimum_amplitude=50.0)
    distance = np.full(cam.shape, 20000, np.uint16)
    amplitude = np.full(cam.shape, 900, np.uint16)
    amplitude[4, 5], amplitude[4, 7], amplitude[4, 9] = 49, 50, 0
    amplitude[8, 5], amplitude[8, 7] = 30000, 29999
    distance[12, 5] = 0
    frame = RawFrame(stamp=1, distance=distance, amplitude=amplitude, settings=SETTINGS)
    for exact in (True, False):
        found = Correction(cam, exact=exact).correct(frame)
        assert found.flags[4, 5] == Flag.LOW_AMPLITUDE
        assert found.flags[4, 7] == 0
        assert found.flags[4, 9] & Flag.LOW_AMPLITUDE
        assert found.flags[8, 5] == Flag.SATURATED
        assert found.flags[8, 7] == 0
        assert found.flags[12, 5] == Flag.NO_MEASUREMENT
        bad = np.zeros(cam.shape, bool)
        bad[4, 5] = bad[4, 9] = bad[8, 5] = bad[12, 5] = True
        np.testing.assert_array_equal(np.isnan(found.distance), bad)
        np.testing.assert_array_equal(np.isnan(found.sigma), bad)
        np.testing.assert_array_equal(found.flags > 0, bad)


def test_no_measurement_at_the_pole_of_the_hyperbola() -> None:
    """Where A <= b + 1, whatever the minimum amplitude."""
    effect = AmplitudeOffset(MappingProxyType({60.0: Hyperbola(0.5, 15.71)}))
    cam = with_effects(camera(), {"amplitude_offset": effect})
    amplitude = np.full(cam.shape, 900, np.uint16)
    amplitude[3, 3:7] = [15, 16, 17, 18]
    frame = RawFrame(
        stamp=1, distance=np.full(cam.shape, 20000, np.uint16), amplitude=amplitude, settings=SETTINGS
    )
    for exact in (True, False):
        found = Correction(cam, exact=exact).correct(frame)
        assert np.isnan(found.distance[3, 3:7]).tolist() == [True, True, False, False]
        assert (found.flags[3, 3:5] == Flag.NO_MEASUREMENT).all()
        expected = 20000 * cam.sensor.lsb - 0.5 / (17 - 15.71)
        assert found.distance[3, 5] == pytest.approx(expected, abs=1e-5)


def test_the_simulator_agrees_on_the_pole() -> None:
    effect = AmplitudeOffset(MappingProxyType({60.0: Hyperbola(237.0, 15.71)}))
    cam = replace(with_effects(camera(), {"amplitude_offset": effect}), radiometry=Radiometry(gain=2.5))
    frame, _ = simulated(cam, wall(2.0), quantised=True)
    plain, _ = simulated(replace(cam, effects=MappingProxyType({})), wall(2.0))
    dark = plain.amplitude <= 16.71
    assert 0.1 < dark.mean() < 0.9
    np.testing.assert_array_equal(frame.distance == 0, dark)
    np.testing.assert_array_equal(frame.amplitude, np.rint(plain.amplitude))


# --- terms of whole frames ------------------------------------------------------------------------


def test_saturation_bleed_is_undone_beside_saturated_pixels() -> None:
    cam = with_effects(camera(saturation=13000.0), {"saturation_bleed": SaturationBleed(-0.03, 0.011)})
    frame, truth = simulated(cam, wall(1.3))
    found = Correction(cam).correct(frame)
    saturated = (found.flags & Flag.SATURATED.value) > 0
    assert 0 < saturated.mean() < 0.5
    np.testing.assert_allclose(found.distance[~saturated], truth[~saturated], atol=1e-5)
    assert np.nanmax(np.abs(frame.distance - truth)[~saturated]) > 0.01


@pytest.mark.parametrize("exact", [True, False], ids=["exact", "fast"])
def test_a_term_of_distance_and_row_amplitude(exact: bool) -> None:
    """The distance in it is the delivered one, not the one with the cyclic error in it."""
    effect = Empirical(
        ("distance", "row_amplitude"),
        ((1.0, 4.0), (0.0, 9000.0)),
        NestedList(np.array([[-0.012, 0.004], [0.011, 0.02]])),
    )
    cam = with_effects(camera(), {"empirical": effect, "cyclic_error": CYCLIC})
    frame, truth = simulated(cam, wall())
    found = Correction(cam, exact=exact).correct(frame)
    np.testing.assert_allclose(found.distance, truth, atol=1e-5)


@pytest.mark.parametrize("other", ["distance", "height"])
def test_a_table_of_the_angle_and_something_else(other: str) -> None:
    """Its distance is the measured one, not none: to what the plane's angle is uncertain by."""
    effect = Empirical(
        ("incidence", other),
        ((0.0, 1.2), (0.5, 4.0) if other == "distance" else (-1.5, 1.5)),
        NestedList(np.array([[-0.03, 0.05], [0.06, -0.04]])),
    )
    cam = with_effects(camera(), {"empirical": effect})
    frame, truth = simulated(cam, wall())
    assert np.nanmax(np.abs(frame.distance - truth)) > 0.01
    found = Correction(cam, exact=True).correct(frame)
    inner = np.isfinite(found.distance)
    assert inner.mean() > 0.9
    assert np.median(np.abs(found.distance - truth)[inner]) < 2e-4
    assert np.max(np.abs(found.distance - truth)[inner]) < 3e-3


# --- estimates from the frame ---------------------------------------------------------------------


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.3, -0.5), (-0.6, 0.35), (0.0, 1.0)])
def test_angles_of_incidence_on_planes(angles: tuple[float, float]) -> None:
    """|ray . normal| of planes of any tilt, known in closed form."""
    rays = camera().rays
    normal = Rotation.from_euler("xy", angles).apply([0.0, 0.0, 1.0])
    along = rays @ normal
    distance = 2.0 * normal[2] / along
    valid = (along > 0.2) & (distance < 7)
    found = IncidenceEstimator(rays).cosine(np.where(valid, distance, np.nan))
    assert np.isfinite(found[valid]).mean() > 0.95
    error = np.degrees(np.abs(np.arccos(np.clip(found, 0, 1)) - np.arccos(np.clip(along, 0, 1))))
    # near 0 the angle is the square root of a small difference
    assert np.nanmax(error[valid & (along < 0.999)]) < 0.2
    assert np.isnan(found[~valid]).all()


def test_angles_stop_at_a_step() -> None:
    """Two planes before each other: each pixel has its own plane's angle, not one across the step."""
    rays = camera().rays
    near = Rotation.from_euler("xy", [0.1, 0.6]).apply([0.0, 0.0, 1.0])
    far = Rotation.from_euler("xy", [-0.4, -0.2]).apply([0.0, 0.0, 1.0])
    left = np.broadcast_to(np.arange(38) < 17, (29, 38))
    distance = np.where(left, 1.1 * near[2] / (rays @ near), 2.3 * far[2] / (rays @ far))
    truth = np.where(left, rays @ near, rays @ far)
    found = IncidenceEstimator(rays).cosine(distance)
    known = np.isfinite(found)
    assert known.mean() > 0.95
    error = np.degrees(np.abs(np.arccos(np.clip(found, 0, 1)) - np.arccos(truth)))
    assert np.nanmax(error[truth < 0.999]) < 1.0


def test_noise_does_not_tilt_planes_on_average() -> None:
    """Over 5 x 5 pixels alone this noise would turn planes by 24 degrees, and 12 would become 29."""
    shipped = load_camera(find_camera("sr3000"))
    rays = shipped.rays
    normal = Rotation.from_euler("xy", [0.05, 0.21]).apply([0.0, 0.0, 1.0])
    along = rays @ normal
    rng = np.random.default_rng(3)
    sigma = 0.0075
    distance = 0.5 * normal[2] / along + sigma * rng.standard_normal(along.shape)
    found = IncidenceEstimator(rays).cosine(distance, np.full(along.shape, sigma))
    error = np.degrees(np.arccos(found) - np.arccos(np.minimum(along, 1.0)))
    assert np.isfinite(error).mean() > 0.99
    assert abs(np.nanmean(error)) < 0.5
    assert np.sqrt(np.nanmean(error**2)) < 2.5


def test_wide_planes_stop_at_a_step_in_noise() -> None:
    """A tilted plane before another one, at noise that needs windows of 45 pixels: each keeps its angle."""
    shipped = load_camera(find_camera("sr3000"))
    rays = shipped.rays
    near = Rotation.from_euler("xy", [0.1, 0.6]).apply([0.0, 0.0, 1.0])
    far = Rotation.from_euler("xy", [-0.3, -0.2]).apply([0.0, 0.0, 1.0])
    left = np.broadcast_to(np.arange(rays.shape[1]) < 80, rays.shape[:2])
    distance = np.where(left, 1.1 * near[2] / (rays @ near), 2.6 * far[2] / (rays @ far))
    truth = np.where(left, rays @ near, rays @ far)
    sigma = np.where(left, 0.006, 0.02)
    distance = distance + sigma * np.random.default_rng(4).standard_normal(distance.shape)
    found = IncidenceEstimator(rays).cosine(distance, sigma)
    error = np.degrees(np.arccos(found) - np.arccos(np.minimum(truth, 1.0)))
    assert np.isfinite(error).mean() > 0.98
    away = np.abs(np.arange(rays.shape[1]) - 80) > 12
    for side in (left, ~left):
        inner = error[side & away]
        assert abs(np.nanmedian(inner)) < 0.5
        assert np.nanquantile(np.abs(inner), 0.9) < 4.0
        # beside the step no window reaches far
        assert np.nanmedian(np.abs(error[side & ~away])) < 12.0


@pytest.mark.parametrize(("metres", "setting"), [(0.5, 16.0), (0.9, 16.0), (2.2, 60.0), (4.5, 100.0)])
def test_stated_noise_is_the_noise_and_single_frames_are_right_on_average(
    metres: float, setting: float
) -> None:
    shipped = load_camera(find_camera("sr3000"))
    wall = Scene((Surface("wall", "plane", "truth", reflectivity=0.8),))
    simulation = Simulation(shipped, wall, seed=11)
    turned = np.sin(np.radians(15) / 2)
    poses = {"wall": Pose((0.0, 0.0, metres), (0.0, float(turned), 0.0, float(np.sqrt(1 - turned**2))))}
    settings = Settings(
        integration_time=setting, modulation_frequency=20e6, uptime=3000.0, ambient_temperature=20.0
    )
    truth = simulation.geometry(poses).distance
    correction = Correction(shipped)
    errors, stated = [], []
    for k in range(20):
        exposure = Exposure(stamp=10**9 + k * 10**8, settings=settings, poses=poses)
        found = correction.correct(simulation.frame(exposure))
        errors.append(found.distance - truth)
        stated.append(found.sigma)
    always = np.isfinite(errors).all(axis=0)
    assert always.sum() > 10_000
    noise = np.std(errors, axis=0, ddof=1)[always]
    sigma = np.mean(stated, axis=0)[always]
    ratio = np.sqrt(np.mean(noise**2 / sigma**2))
    assert 0.9 < ratio < 1.25  # the angle's own noise is not in it
    # without wide planes 16 to 20 mm at these short distances
    assert abs(np.mean(np.array(errors)[:, always])) < 0.002


def test_mixed_pixels_lie_between_two_surfaces() -> None:
    distance = np.full((20, 30), 1.2)
    distance[:, 15:] = 2.1
    assert not mixed_pixels(distance).any()
    distance[:, 15] = 1.6
    found = mixed_pixels(distance)
    expected = np.zeros_like(found)
    expected[:, 15] = True
    np.testing.assert_array_equal(found[3:-3], expected[3:-3])
    # along columns as along rows
    turned = mixed_pixels(np.ascontiguousarray(distance.T))
    np.testing.assert_array_equal(turned[:, 3:-3], expected.T[:, 3:-3])
    # noise as large as the step explains it
    assert not mixed_pixels(distance, np.full((20, 30), 0.2)).any()


def test_a_slope_is_not_mixed() -> None:
    u = np.arange(40.0)
    assert not mixed_pixels(np.broadcast_to(1.0 + 0.06 * u, (25, 40)).copy()).any()
