"""Each effect against its definition, computed another way."""

from __future__ import annotations

import math
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from rim_camera_ros.camera import Camera, Optics, Sensor
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.effects import ORDER, Effect
from rim_camera_ros.effects.ambient_temperature import AmbientTemperature
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.covariates import COVARIATES, covariate
from rim_camera_ros.effects.emission_pattern import EmissionPattern, squared_angle
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.integral_table import IntegralTable
from rim_camera_ros.effects.motion import Motion
from rim_camera_ros.effects.multipath import Multipath
from rim_camera_ros.effects.reference_path import ReferencePath
from rim_camera_ros.effects.rows import row_weights
from rim_camera_ros.effects.saturation_bleed import SaturationBleed
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.effects.warm_up_drift import Exponential, WarmUpDrift
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera
from rim_camera_ros.fit.decimation import decimated_camera, full_camera
from rim_camera_ros.frame import Readings, Settings
from rim_camera_ros.geometry import see
from rim_camera_ros.parameters import ArrayFile, NestedList, encode
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import CameraMotion, Scene, ScenePose, Surface

L = 299792458.0 / 40e6
EMPTY = np.empty((0,))
CAMERA = Camera(
    sensor=Sensor(width=24, height=18, pixel_pitch=(1e-4, 1e-4), modulation_frequency=20e6),
    optics=Optics(fx=31.0, fy=29.0, cx=11.2, cy=8.9, d=(-0.08, 0.03, 0.001, -0.002, 0.0)),
)


def context(**settings_: Any) -> Context:
    return Context(camera=CAMERA, settings=Settings(**{"integration_time": 60.0, **settings_}))


def wall(z: float = 2.0, **surface: Any) -> Scene:
    return Scene(surfaces=(Surface(name="wall", type="plane", pose=ScenePose((0, 0, z)), **surface),))


def ideal(scene: Scene, camera: Camera = CAMERA) -> tuple[Signal, Context]:
    simulation = Simulation(camera, scene, noise=False)
    there = simulation.context(
        Exposure(stamp=10**18, settings=Settings(integration_time=60.0), poses=scene.fixed_poses())
    )
    assert there.geometry is not None
    assert there.geometry_at is not None
    return Signal(there.geometry.distance, there.geometry_at(0.0)[1]), there


# --- drift --------------------------------------------------------------------------------------


def lagging(tau: float, seconds: Any, ambient: Any, *, at: Any) -> Any:
    """A body behind air that is linear between samples, from the first of them on."""
    solution = solve_ivp(
        lambda t, y: (np.interp(t, seconds, ambient) - y) / tau,
        (0.0, float(at[-1])),
        [float(ambient[0])],
        t_eval=at,
        rtol=1e-9,
        atol=1e-9,
        max_step=0.5,
    )
    return solution.y[0]


@pytest.mark.parametrize("tau", [40.0, 900.0])
def test_ambient_lag_solves_its_differential_equation(tau: float) -> None:
    """dT_f/dt = (T_a - T_f) / tau from the first sample on, T_a linear between samples."""
    seconds = np.array([0.0, 3.0, 10.0, 11.5, 60.0, 400.0])
    ambient = np.array([20.0, 21.0, 35.0, 35.0, 18.0, 29.0])
    effect = AmbientTemperature(coefficient=0.008, reference=22.0, time_constant=tau)
    memory: dict[str, Any] = {}
    found = []
    for t, value in zip(seconds, ambient, strict=True):
        one = context(ambient_temperature=float(value))
        one.stamp, one.memory = 10**18 + round(t * 1e9), memory
        found.append(effect.term(EMPTY, EMPTY, one))
        # asking twice for one frame changes nothing
        assert effect.term(EMPTY, EMPTY, one) == found[-1]
    body = lagging(tau, seconds, ambient, at=seconds)
    assert found == pytest.approx((0.008 * (body - 22.0)).tolist(), abs=2e-6)


@pytest.mark.parametrize("tau", [40.0, 300.0])
def test_ambient_follows_readings_between_and_before_the_frames(tau: float) -> None:
    """A recording whose first frame comes 75 s after the first reading, in air that changes by the minute."""
    seconds = np.arange(0.0, 500.0, 10.0)
    ambient = 22.0 + 3.0 * np.sin(seconds / 40.0) + 0.01 * seconds
    readings = Readings()
    for t, value in zip(seconds, ambient, strict=True):
        readings.add(10**18 + round(t * 1e9), float(value))
    readings.add(10**18 + 10**15, -40.0)  # by a clock that is 11 days ahead
    readings.add(10**18 + 495 * 10**9, 21.0)
    assert readings.stamps == sorted(readings.stamps)
    frames = np.array([75.0, 170.0, 210.0, 430.0])
    effect = AmbientTemperature(coefficient=0.008, reference=22.0, time_constant=tau)
    signal, _ = ideal(wall())
    step = 1e-3 * tau
    found, by_constant = [], []
    memory: dict[str, Any] = {}
    for t in frames:
        one = context(ambient_temperature=21.0, ambient_readings=readings)
        one.stamp, one.memory = 10**18 + round(t * 1e9), memory
        found.append(effect.term(EMPTY, EMPTY, one))
        more, less = (
            replace(effect, time_constant=tau + sign * step).term(EMPTY, EMPTY, one) for sign in (1, -1)
        )
        column = effect.columns(signal, one)["time_constant"][0]
        by_constant.append((float(np.ravel(column)[0]), float(more - less) / (2 * step)))
    body = lagging(tau, seconds, ambient, at=frames)
    # the last reading holds until the next one: 5 s at most, in which the air changes by 0.43 degC
    assert found == pytest.approx((0.008 * (body - 22.0)).tolist(), abs=0.008 * 0.43 * 5 / tau)
    for analytic, numeric in by_constant:
        assert analytic == pytest.approx(numeric, rel=1e-4, abs=1e-9)


def test_ambient_without_lag_and_without_topic() -> None:
    assert AmbientTemperature(0.008, 21.0, 0.0).term(
        EMPTY, EMPTY, context(ambient_temperature=26.0)
    ) == pytest.approx(0.04)
    nothing = context()
    assert AmbientTemperature(0.008, 21.0, 300.0).term(EMPTY, EMPTY, nothing) == 0.0
    assert nothing.notes == {"ambient_temperature: no ambient temperature recorded, taken as 21 degC"}


def test_ambient_starts_anew_where_the_stamps_jump_back() -> None:
    effect = AmbientTemperature(0.001, 20.0, 500.0)
    memory: dict[str, Any] = {}
    for stamp, ambient, expected in ((100, 10.0, -0.01), (99, 30.0, 0.01)):
        one = context(ambient_temperature=ambient)
        one.stamp, one.memory = stamp * 10**9, memory
        assert effect.term(EMPTY, EMPTY, one) == pytest.approx(expected)


def test_warm_up_by_hand() -> None:
    effect = WarmUpDrift((Exponential(-0.07, 20.0), Exponential(0.01, 300.0)))
    expected = -0.07 * math.exp(-1.5) + 0.01 * math.exp(-0.1)
    assert effect.term(EMPTY, EMPTY, context(uptime=30.0)) == pytest.approx(expected, rel=1e-12)
    nothing = context()
    assert effect.term(EMPTY, EMPTY, nothing) == 0.0
    assert nothing.notes == {"warm_up_drift is off: the recording states no uptime"}
    slope = (
        effect.term(EMPTY, EMPTY, context(uptime=30.01)) - effect.term(EMPTY, EMPTY, context(uptime=29.99))
    ) / 0.02
    assert effect.rate(30.0) == pytest.approx(slope, rel=1e-5)


def test_warm_up_of_the_shipped_cameras() -> None:
    """Secs. 3.3.7, 4.3.1: 7-8 cm in the first 30 s, more than 9 cm over 8 min; stable after 6 and 12 min."""

    def drift(name: str, seconds: float) -> float:
        effect = load_camera(find_camera(name)).effects["warm_up_drift"]
        assert isinstance(effect, WarmUpDrift)
        return float(np.asarray(effect.term(EMPTY, EMPTY, context(uptime=seconds))))

    assert 0.07 <= drift("sr3000", 30) - drift("sr3000", 0) <= 0.08
    assert drift("sr3000", 480) - drift("sr3000", 0) > 0.09
    # stable: within the range noise of a few millimetres
    assert abs(drift("sr3000", 360)) < 0.002
    assert abs(drift("sr2", 720)) < 0.002


def test_ambient_temperature_of_the_sr2() -> None:
    """Sec. 3.3.7: about 8 mm per degree, warmer is longer."""
    effect = load_camera(find_camera("sr2")).effects["ambient_temperature"]
    assert isinstance(effect, AmbientTemperature)
    assert effect.coefficient == pytest.approx(0.008)


def test_reference_path_by_hand() -> None:
    """It reads nominal + drift / scale; back: scale (reading - nominal)."""
    effect = ReferencePath(nominal=0.85, scale=0.8)
    assert effect.reading(0.04) == pytest.approx(0.9)
    assert effect.drift(0.9) == pytest.approx(0.04)


@pytest.mark.parametrize("pixels", [(22, 0, 24, 1), (0, 17, 0, 18), (3, 0, 2, 0), (-1, 0, 2, 0)])
def test_reference_pixels_lie_on_the_sensor(pixels: tuple[int, int, int, int]) -> None:
    effect = ReferencePath(nominal=0.85, pixels=pixels)
    with pytest.raises(InputError, match=r"effects\.reference_path: pixels \[.*\] do not lie within 24 x 18"):
        with_effects(CAMERA, {"reference_path": effect})


# --- electronics --------------------------------------------------------------------------------


def test_amplitude_hyperbola_and_its_pole() -> None:
    """The term is a / (A - b); no measurement where A <= b + 1."""
    effect = AmplitudeOffset(MappingProxyType({60.0: Hyperbola(237.0, 15.71)}))
    a = np.array([16.71, 16.7100001, 17.0, 500.0, 0.0, -4.0, np.nan])
    found = np.asarray(effect.term(a, a, context()))
    assert np.isnan(found).tolist() == [True, False, False, False, True, True, True]
    assert found[2:4].tolist() == pytest.approx([237 / 1.29, 237 / 484.29], rel=1e-12)
    step = (effect.term(a, a[3:4] + 0.01, context()) - effect.term(a, a[3:4] - 0.01, context())) / 0.02
    assert np.asarray(effect.slope(a[3:4], context())) == pytest.approx(step, rel=1e-6)


def test_incidence_is_shorter_and_in_gon() -> None:
    """In gon, x = min(|angle|, 90 gon), 400 gon = 360 deg; the term is minus the polynomial of eq. 3.8."""
    effect = IncidenceAngle(MappingProxyType({60.0: (4.122e-9, -1.806e-7, 1.757e-6, 2.996e-4)}))
    here = context()
    here.incidence = np.radians([0.0, 27.0, -27.0, 54.0, 81.0, 85.0])
    found = np.asarray(effect.term(here.incidence, here.incidence, here))

    def table(x: float) -> float:
        return 4.122e-9 * x**4 - 1.806e-7 * x**3 + 1.757e-6 * x**2 + 2.996e-4 * x

    assert found.tolist() == pytest.approx([-table(x) for x in (0, 30, 30, 60, 90, 90)], rel=1e-12)
    assert found[1] < 0
    with pytest.raises(InputError, match="the angle of incidence is not known"):
        effect.term(EMPTY, EMPTY, context())


def test_compressed_amplitudes() -> None:
    effect = AmplitudeNonlinearity(2e-5)
    a = np.array([0.0, 100.0, 50_000.0])
    assert effect.compressed(a).tolist() == pytest.approx([0.0, 100 / 1.002, 25_000.0])
    assert effect.expanded(effect.compressed(a)).tolist() == pytest.approx(a.tolist())
    # 1 / compression is never reached
    assert np.isinf(effect.expanded(np.array([50_000.0, 65_535.0]))).all()


def test_saturation_bleed_by_hand() -> None:
    here = context()
    here.saturated = np.zeros((4, 5), bool)
    here.saturated[1, 2] = here.saturated[1, 4] = here.saturated[3, 0] = True
    found = SaturationBleed(row=-0.02, column=0.003).term(np.zeros((4, 5)), np.zeros((4, 5)), here)
    r, c = -0.02, 0.003
    expected = [
        [c, 0, c, 0, c],
        [r + c, r, 0, r, 0],
        [c, 0, c, 0, c],
        [0, r, r + c, r, r + c],
    ]
    np.testing.assert_allclose(found, expected, atol=1e-15)


def test_saturation_bleed_is_that_of_the_published_amplitude() -> None:
    """What saturates is decided by the compressed amplitude."""
    scene = wall(1.1)
    bright = float(ideal(scene)[0].amplitude.max())
    limit = replace(CAMERA, sensor=replace(CAMERA.sensor, saturation=bright * 0.995))
    effects: dict[str, Any] = {"saturation_bleed": SaturationBleed(row=-0.05)}
    exposure = Exposure(stamp=0, settings=Settings(integration_time=60.0), poses=scene.fixed_poses())
    options: dict[str, Any] = {"noise": False, "quantised": False}
    bleeding = Simulation(with_effects(limit, effects), scene, **options).frame(exposure)
    plain = Simulation(limit, scene, **options).frame(exposure)
    moved = bleeding.distance - plain.distance
    saturated = ideal(scene)[0].amplitude >= bright * 0.995
    expected = np.where(saturated.any(axis=1, keepdims=True) & ~saturated, -0.05, 0.0)
    assert 0 < saturated.sum() < 60
    np.testing.assert_allclose(moved, expected, atol=1e-12)
    effects["amplitude_nonlinearity"] = AmplitudeNonlinearity(1e-5)
    weaker = Simulation(with_effects(limit, effects), scene, **options).frame(exposure)
    np.testing.assert_allclose(weaker.distance, plain.distance, atol=1e-12)


@settings(derandomize=True, max_examples=60, deadline=None)
@given(
    keys=st.lists(
        st.sampled_from([2.0, 16.0, 33.5, 60.0, 100.0, 255.0]), min_size=2, max_size=5, unique=True
    ),
    time=st.floats(0.5, 300.0),
)
def test_row_weights_are_linear_interpolation(keys: list[float], time: float) -> None:
    rows = {key: math.sin(key) for key in keys}
    found = sum(weight * rows[key] for key, weight in row_weights(rows, lambda: time))
    assert found == pytest.approx(np.interp(time, sorted(keys), [rows[k] for k in sorted(keys)]), abs=1e-12)


# --- emission and scene -------------------------------------------------------------------------


def test_emission_pattern_is_relative_power() -> None:
    signal, here = ideal(wall())
    f1, f2 = -1.3, 0.9
    found = EmissionPattern((f1, f2)).simulate(signal, here)
    angle = np.arctan2(np.hypot(CAMERA.rays[..., 0], CAMERA.rays[..., 1]), CAMERA.rays[..., 2])
    np.testing.assert_allclose(
        found.amplitude / signal.amplitude, 1 + f1 * angle**2 + f2 * angle**4, rtol=1e-9
    )
    np.testing.assert_allclose(found.distance, signal.distance, atol=1e-9)
    with pytest.raises(
        InputError, match="falloff must leave the relative power positive over the whole array"
    ):
        with_effects(CAMERA, {"emission_pattern": EmissionPattern((-9.0, 0.0))})


@pytest.mark.parametrize("step", [2, 3, 4, 5])
def test_an_emission_that_a_coarser_grid_may_have_is_one_of_the_full_array(step: int) -> None:
    """Its outermost pixels are inside the full array's: what ends between them was refused in the end."""
    small = decimated_camera(CAMERA, step)
    inner, outer = (float(squared_angle(one).max()) for one in (small, CAMERA))
    assert inner < outer
    for reach in np.linspace(inner, 1.3 * outer, 40):
        effect = EmissionPattern((-1.0 / reach, 0.0))
        try:
            found = with_effects(small, {effect.name: effect})
        except InputError:
            continue
        full = full_camera(found, CAMERA, step)
        assert np.all(effect.power(full) > 0)


@pytest.mark.parametrize("name", ["sr3000", "sr2"])
def test_emission_of_the_shipped_cameras(name: str) -> None:
    """Sec. 3.3.4: 30-50 % of the centre at 25 gon (the shipped value has the lens' cos^4 in it)."""
    effect = load_camera(find_camera(name)).effects["emission_pattern"]
    assert isinstance(effect, EmissionPattern)
    q = math.radians(22.5) ** 2
    share = 1 + effect.falloff[0] * q + effect.falloff[1] * q * q
    assert 0.30 <= share / math.cos(math.radians(22.5)) ** 4 <= 0.50


def test_emitter_offset_by_hand() -> None:
    """Half the path is (|P| + |P - e|) / 2; distance^2 in the radiometry becomes |P - e|^2."""
    e = np.array([0.06, -0.03, 0.02])
    signal, here = ideal(wall(0.7))
    found = EmitterOffset((0.06, -0.03, 0.02)).simulate(signal, here)
    points = signal.distance[..., None] * CAMERA.rays
    out = np.sqrt(((points - e) ** 2).sum(-1))
    np.testing.assert_allclose(found.distance, (signal.distance + out) / 2, rtol=1e-13)
    np.testing.assert_allclose(found.amplitude, signal.amplitude * signal.distance**2 / out**2, rtol=1e-12)
    back = EmitterOffset((0.06, -0.03, 0.02)).correct(found, here)
    np.testing.assert_allclose(back.distance, signal.distance, rtol=1e-12)
    np.testing.assert_allclose(back.amplitude, signal.amplitude, rtol=1e-12)


def test_a_path_shorter_than_the_way_to_the_emitter_is_no_measurement() -> None:
    effect = EmitterOffset((0.3, 0.0, 0.0))
    found = effect.length(np.array([0.149, 0.151, 1.0]), np.array([0.0, 0.0, 0.0]))
    assert np.isnan(found).tolist() == [True, False, False]


def _moving(speed: float, angular: float = 0.0) -> Scene:
    return replace(wall(2.0), camera_motion=CameraMotion((0.0, 0.0, speed), (0.0, angular, 0.0)))


def test_motion_towards_a_wall() -> None:
    """Sample k at stamp + (k - 1.5) interval, each of another distance and amplitude (eq. 2.5)."""
    interval, speed = 0.005, 1.5
    signal, here = ideal(_moving(speed))
    found = Motion(interval).simulate(signal, here)
    cosine = CAMERA.rays[..., 2]
    c = []
    for k in range(4):
        d = (2.0 - speed * (k - 1.5) * interval) / cosine
        a = 500.0 * 60 * 0.8 * cosine / d**2
        c.append(a * np.cos(2 * np.pi * d / L - k * np.pi / 2))
    phase = np.arctan2(c[1] - c[3], c[0] - c[2]) % (2 * np.pi)
    np.testing.assert_allclose(found.distance, phase / (2 * np.pi) * L, atol=1e-9)
    np.testing.assert_allclose(found.amplitude, np.hypot(c[1] - c[3], c[0] - c[2]) / 2, rtol=1e-9)
    assert np.abs(found.distance - signal.distance).max() > 1e-4


def test_unmodulated_light_does_not_cancel_in_the_samples_of_a_moving_camera() -> None:
    """c_k = A cos(phi_k - k pi / 2) + B_k (eq. 2.5) with B = 1.3 A: bent by how B changes."""
    interval, speed, share = 0.006, -1.2, 1.3
    signal, here = ideal(_moving(speed))
    found = Motion(interval, unmodulated=share).simulate(signal, here)
    cosine = CAMERA.rays[..., 2]
    c = []
    for k in range(4):
        d = (2.0 - speed * (k - 1.5) * interval) / cosine
        a = 500.0 * 60 * 0.8 * cosine / d**2
        c.append(a * (np.cos(2 * np.pi * d / L - k * np.pi / 2) + share))
    phase = np.arctan2(c[1] - c[3], c[0] - c[2]) % (2 * np.pi)
    np.testing.assert_allclose(found.distance, phase / (2 * np.pi) * L, atol=1e-9)
    without = Motion(interval).simulate(signal, here)
    assert np.abs(found.distance - without.distance).max() > 1e-3
    assert "1.3 of unmodulated light" in Motion(interval, share).sentence()
    assert "unmodulated" not in encode(Motion(interval))


def test_nothing_moves_nothing_happens() -> None:
    signal, here = ideal(wall())
    assert Motion(0.02).simulate(signal, here) is signal


def test_motion_keeps_what_earlier_effects_did() -> None:
    """With an emission pattern before it the samples are weaker by it, and no more."""
    scene = _moving(1.0, 0.3)
    signal, here = ideal(scene)
    share = EmissionPattern((-0.8, 0.2)).power(CAMERA)
    plain = Motion(0.004).simulate(signal, here)
    weaker = Motion(0.004).simulate(replace(signal, amplitude=signal.amplitude * share), here)
    np.testing.assert_allclose(weaker.amplitude, plain.amplitude * share, rtol=1e-9)
    np.testing.assert_allclose(weaker.distance, plain.distance, atol=1e-9)


def _corner() -> Scene:
    """A bright wall to the left, a dark one to the right, at an angle of 90 degrees, edge at 1.6 m."""
    left = tuple(float(x) for x in Rotation.from_euler("y", -50, degrees=True).as_quat())
    right = tuple(float(x) for x in Rotation.from_euler("y", 40, degrees=True).as_quat())
    return Scene(
        surfaces=(
            Surface(name="left", type="plane", pose=ScenePose((0, 0, 1.6), left), reflectivity=0.9),  # type: ignore[arg-type]
            Surface(name="right", type="plane", pose=ScenePose((0, 0, 1.6), right), reflectivity=0.4),  # type: ignore[arg-type]
        )
    )


def _bounced_by_directions(signal: Signal, here: Context) -> np.ndarray:
    """rho_i sum_j A_j cos_i cos_j dA_j / (pi r^2 + dA_j), half the path by way of j.

    The senders j are what directions on a sphere (longitude and latitude, 1 degree, up to 75 degrees from the
    axis) meet, within the view and beyond.
    """
    geometry = here.geometry
    assert geometry is not None
    assert geometry.scene is not None
    assert geometry.poses is not None
    step = np.radians(1.0)
    longitude, latitude = np.meshgrid(*2 * [np.arange(-75.0, 75.5) * step])
    ray = np.stack(
        [
            np.sin(longitude) * np.cos(latitude),
            np.sin(latitude),
            np.cos(longitude) * np.cos(latitude),
        ],
        axis=-1,
    )
    there = see(geometry.scene, geometry.poses, ray)
    lit = there.hit & (ray[..., 2] > np.cos(np.radians(75.0)))
    p, n, d, cosine = there.points[lit], there.normals[lit], there.distance[lit], there.cos_incidence[lit]
    area = step**2 * np.cos(latitude)[lit] * d**2 / cosine
    # one power for all: amplitudes are those of Lambert's law
    hit = geometry.hit
    lambert = geometry.reflectivity * geometry.cos_incidence / geometry.distance**2
    power = np.median(signal.amplitude[hit] / lambert[hit])
    a = power * there.reflectivity[lit] * cosine / d**2
    expected = np.zeros(hit.shape, complex)
    for i in zip(*np.nonzero(hit), strict=True):
        between = geometry.points[i] - p
        r2 = np.maximum((between**2).sum(1), 1e-12)
        cos_j = np.maximum((between * n).sum(1), 0) / np.sqrt(r2)
        cos_i = np.maximum(-(between * geometry.normals[i]).sum(1), 0) / np.sqrt(r2)
        form = cos_i * cos_j * area / (np.pi * r2 + area)
        half = (d + np.sqrt(r2) + geometry.distance[i]) / 2
        expected[i] = geometry.reflectivity[i] * np.sum(a * form * np.exp(2j * np.pi * half / L))
    return expected.ravel()


def test_multipath_against_a_plain_sum_over_directions() -> None:
    """One diffuse bounce from all that the emitter lights, within the view and beyond it."""
    camera = replace(CAMERA, optics=replace(CAMERA.optics, d=(0.0,) * 5))
    scene = _corner()
    signal, here = ideal(scene, camera)
    geometry = here.geometry
    assert geometry is not None
    expected = _bounced_by_directions(signal, here)
    ray = camera.rays.reshape(-1, 3)
    found = Multipath(1.0).bounced(signal, here).ravel()
    far = np.abs(ray[:, 0] / ray[:, 2]) > 0.12
    error = np.abs(found - expected) / np.abs(expected)
    assert np.median(error[far]) < 0.02
    assert error[far].max() < 0.1
    assert abs(found.sum() / expected.sum() - 1) < 0.08
    # the dark wall gets more than it gives, and corners look longer
    longer = Multipath(1.0).simulate(signal, here).distance - signal.distance
    assert longer.min() > 0
    right = geometry.surface == 1
    assert longer[right].mean() > 1.5 * longer[~right].mean()


def test_the_emitter_is_no_brighter_beyond_the_array_than_at_its_corner() -> None:
    """1 - 0.9 q + 0.6 q^2, q the angle squared, rises beyond 50 degrees; 1 - 2 q is below 0 from 41 on."""
    angle = np.radians([40.0, 45.0, 75.0])
    rays = np.stack([np.sin(angle), np.zeros(3), np.cos(angle)], axis=-1)
    rising = EmissionPattern((-0.9, 0.6))
    at_corner = float(rising.power(CAMERA).min())
    power = rising.towards(rays, CAMERA)
    assert power[0] == pytest.approx(1 - 0.9 * angle[0] ** 2 + 0.6 * angle[0] ** 4)
    assert power[2] == pytest.approx(at_corner)
    assert EmissionPattern((-2.0, 0.0)).towards(rays, CAMERA)[1:] == pytest.approx([0.0, 0.0])


def test_a_ball_and_a_wall_light_each_other() -> None:
    """A curved surface, before which each pair is looked at by itself; what is not hit gets nothing."""
    camera = replace(CAMERA, optics=replace(CAMERA.optics, d=(0.0,) * 5))
    turned = tuple(float(x) for x in Rotation.from_euler("y", -50, degrees=True).as_quat())
    ball = Surface("ball", "sphere", ScenePose((0.25, 0.1, 1.7)), radius=0.35, reflectivity=0.9)
    wall = Surface("wall", "rectangle", ScenePose((-0.3, 0.0, 1.9), turned), size=(2.5, 1.0))  # type: ignore[arg-type]
    signal, here = ideal(Scene((ball, wall)), camera)
    geometry = here.geometry
    assert geometry is not None
    hit = geometry.hit.ravel()
    assert 0.05 < (~hit).mean() < 0.9
    found = Multipath(1.0).bounced(signal, here).ravel()
    assert not found[~hit].any()
    expected = _bounced_by_directions(signal, here)
    for number in (0, 1):
        own = geometry.surface.ravel() == number
        assert own.sum() > 50
        assert abs(found[own].sum() / expected[own].sum() - 1) < 0.1


def test_the_form_factors_are_those_of_two_rectangles() -> None:
    """Two perpendicular unit squares with a common edge see 0.20004 of each other (Howell, C-14)."""
    camera = Camera(
        sensor=Sensor(width=120, height=80, pixel_pitch=(1e-4, 1e-4), modulation_frequency=1.0),
        optics=Optics(fx=130.0, fy=130.0, cx=59.5, cy=39.5),
    )
    half = math.sqrt(0.5) / 2
    q = {s: Rotation.from_euler("y", 45 * s, degrees=True).as_quat() for s in (-1, 1)}
    surfaces = tuple(
        Surface(
            name=f"s{s}",
            type="rectangle",
            size=(1.0, 1.0),
            reflectivity=1.0,
            pose=ScenePose((s * half, 0.0, 2.2 - half), tuple(float(x) for x in q[s])),  # type: ignore[arg-type]
        )
        for s in (-1, 1)
    )
    scene = Scene(surfaces=surfaces)
    signal, here = ideal(scene, camera)
    geometry = here.geometry
    assert geometry is not None
    area = signal.distance**2 * camera.rays[..., 2] ** 3 / 130.0**2 / geometry.cos_incidence
    sender, receiver = geometry.surface == 0, geometry.surface == 1
    assert np.nansum(area[sender]) == pytest.approx(1, rel=0.03)
    # every point of the one square shines alike; at 1 Hz phases do not turn
    signal = replace(signal, amplitude=np.where(sender, 1.0, 0.0))
    bounced = np.abs(Multipath(1.0).bounced(signal, here))
    found = np.nansum(bounced[receiver] * area[receiver]) / np.nansum(area[sender])
    # blocks of pixels beside the common edge lose some of it
    assert found == pytest.approx(0.20004, rel=0.05)


def test_a_single_plane_lights_nothing_else() -> None:
    signal, here = ideal(wall())
    assert np.abs(Multipath(1.0).bounced(signal, here)).max() < 1e-3 * signal.amplitude.min()


# --- tables -------------------------------------------------------------------------------------


def test_integral_table_is_multilinear_and_held_constant() -> None:
    rng = np.random.default_rng(4)
    knots = ((0.0, 7.0, 23.0), (2.0, 15.0), (0.5, 1.5, 2.0, 6.0))
    values = rng.normal(size=(3, 2, 4))
    effect = IntegralTable(knots=knots, values=ArrayFile("t.npy", values))
    distance = rng.uniform(0.1, 7.4, (18, 24))
    v, u = np.mgrid[:18, :24]
    inside = [np.clip(x, k[0], k[-1]) for x, k in zip((u, v, distance), knots, strict=True)]
    expected = RegularGridInterpolator(knots, values)(np.stack(inside, -1))
    np.testing.assert_allclose(effect.term(distance, distance, context()), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("covariates", "knots", "shape"),
    [
        (("amplitude",), ((100.0, 900.0, 5000.0),), (3,)),
        (("row", "distance"), ((1.0, 9.0), (0.5, 2.0, 6.0)), (2, 3)),
        (("distance", "amplitude"), ((1.0, 3.0, 4.5, 7.0), (50.0, 4000.0)), (4, 2)),
        (("uptime", "column"), ((0.0, 100.0), (3.0, 20.0)), (2, 2)),
        (("height",), ((-0.5, 0.0, 0.4),), (3,)),
        (("integration_time",), ((16.0, 100.0),), (2,)),
        (("row",), ((4.0,),), (1,)),
    ],
)
def test_empirical_is_multilinear_and_held_constant(
    covariates: tuple[str, ...], knots: tuple[tuple[float, ...], ...], shape: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(9)
    values = rng.normal(size=shape)
    here = context(uptime=37.0)
    distance, amplitude = rng.uniform(0.3, 7.4, (18, 24)), rng.uniform(20, 8000, (18, 24))
    found = Empirical(covariates, knots, NestedList(values)).term(distance, amplitude, here)
    v, u = np.mgrid[:18, :24]
    known = {
        "distance": distance,
        "amplitude": amplitude,
        "row": v,
        "column": u,
        "uptime": np.full((18, 24), 37.0),
        "integration_time": np.full((18, 24), 60.0),
        "height": -distance * CAMERA.rays[..., 1],
    }
    if shape == (1,):
        expected = np.full((18, 24), values[0])
    else:
        inside = [np.clip(known[n], k[0], k[-1]) for n, k in zip(covariates, knots, strict=True)]
        expected = RegularGridInterpolator(knots, values)(np.stack(inside, -1))
    np.testing.assert_allclose(np.broadcast_to(found, (18, 24)), expected, atol=1e-12)


def test_empirical_without_its_covariate_is_off_and_says_so() -> None:
    here = context()
    effect = Empirical(("uptime",), ((0.0, 9.0),), NestedList(np.array([1.0, 2.0])))
    assert effect.term(np.ones((2, 2)), np.ones((2, 2)), here) == 0.0
    assert here.notes == {"empirical is off: the recording states no uptime"}


@pytest.mark.parametrize(
    ("covariates", "knots", "values", "words"),
    [
        (("row", "column", "distance"), ((0.0, 1.0),) * 3, np.zeros((2, 2, 2)), "one or two names, found 3"),
        ((), (), np.zeros(()), "one or two names, found 0"),
        (("hight",), ((0.0, 1.0),), np.zeros(2), r"unknown covariate 'hight' \(did you mean 'height'\?\)"),
        (("row",), ((1.0, 1.0),), np.zeros(2), "knots of row must be an increasing list"),
        (("row",), ((),), np.zeros(0), "knots of row must be an increasing list"),
        (("row",), ((0.0, 1.0),), np.zeros(3), r"values have shape \(3,\), expected \(2,\) by the knots"),
        (("row",), ((0.0, 1.0), (0.0, 1.0)), np.zeros((2, 2)), r"expected 1 lists \(row\), found 2"),
    ],
)
def test_tables_that_do_not_fit(
    covariates: tuple[str, ...], knots: Any, values: np.ndarray, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        Empirical(covariates, knots, NestedList(values))


@pytest.mark.parametrize("exact", [True, False], ids=["exact", "fast"])
@pytest.mark.parametrize(
    "covariates",
    [("distance", "uptime"), ("uptime", "row"), ("amplitude", "uptime"), ("distance", "time"), ("time",)],
    ids="-".join,
)
def test_what_changes_with_time_is_not_folded_into_tables(covariates: tuple[str, ...], exact: bool) -> None:
    """One correction, three frames of one setting: each with its own uptime."""
    span = {
        "distance": (1.0, 3.0),
        "uptime": (0.0, 200.0),
        "time": (0.0, 200.0),
        "row": (0.0, 17.0),
        "amplitude": (1000.0, 6000.0),
    }
    values = (
        np.array([0.004, -0.006]) if len(covariates) == 1 else np.array([[0.004, -0.006], [0.009, 0.001]])
    )
    effect = Empirical(covariates, tuple(span[n] for n in covariates), NestedList(values))
    camera = replace(with_effects(CAMERA, {"empirical": effect}), minimum_amplitude=0.0)
    scene = wall()
    simulation = Simulation(camera, scene, noise=False, quantised=False)
    correction = Correction(camera, exact=exact)
    moved = []
    for seconds in (10.0, 90.0, 170.0):
        exposure = Exposure(
            stamp=10**18 + round(seconds * 1e9),
            settings=Settings(integration_time=60.0, uptime=seconds),
            poses=scene.fixed_poses(),
        )
        frame = simulation.frame(exposure)
        corrected = correction.correct(frame)
        truth = simulation.true_distance(exposure)
        np.testing.assert_allclose(corrected.distance, truth, atol=1e-5)
        moved.append(frame.distance - truth)
    assert np.abs(moved[0] - moved[2]).max() > 1e-3


# --- covariates ---------------------------------------------------------------------------------


def test_covariates_by_their_definitions() -> None:
    rng = np.random.default_rng(6)
    shape = (18, 24)
    amplitude = rng.uniform(10, 5000, shape)
    amplitude[3, 4:9] = 0
    distance = np.full(shape, 2.0)
    distance[:, 15:] = 2.049
    distance[5:9, 3:7] = 1.2
    here = context(uptime=12.0, body_temperature=33.0, ambient_temperature=21.0)
    here.time, here.incidence = 4.5, rng.uniform(0, 1, shape)
    here.saturated = np.zeros(shape, bool)
    here.saturated[2, 3:6] = here.saturated[7, 4] = True
    found = {name: covariate(name, distance, amplitude, here) for name in COVARIATES}
    v, u = np.mgrid[:18, :24]
    assert (found["row"] == v).all()
    assert (found["column"] == u).all()
    assert found["time"] == 4.5
    assert found["uptime"] == 12.0
    assert found["temperature"] == 33.0
    assert found["ambient_temperature"] == 21.0
    assert found["integration_time"] == 60.0
    assert found["incidence"] is here.incidence
    np.testing.assert_allclose(found["row_amplitude"][7], amplitude[7].mean())  # type: ignore[index]
    np.testing.assert_allclose(found["column_amplitude"][:, 4], amplitude[:, 4].mean())  # type: ignore[index]
    window = amplitude[8:13, 10:15]
    assert found["contrast"][10, 12] == pytest.approx(window.std() / window.mean(), rel=1e-9)  # type: ignore[index]
    np.testing.assert_allclose(found["height"], -distance * CAMERA.rays[..., 1])
    # steps above 50 mm only: around the near block, both sides of the step
    edge = np.zeros(shape, bool)
    edge[5:9, 2:8] = True
    edge[4:10, 3:7] = True
    edge[6:8, 4:6] = False
    at = np.argwhere(edge)
    expected = np.sqrt(((v[..., None] - at[:, 0]) ** 2 + (u[..., None] - at[:, 1]) ** 2).min(-1))
    np.testing.assert_allclose(found["edge"], expected, atol=1e-4)
    assert found["saturation"][2, 4] == 3 + 2  # type: ignore[index]
    assert found["saturation"][7, 9] == 1  # type: ignore[index]
    assert found["saturation"][0, 3] == 1  # type: ignore[index]
    with pytest.raises(KeyError):
        covariate("colour", distance, amplitude, here)


def test_normals_of_the_rotated_frame() -> None:
    """A guard on the corner above: -z of the frame faces the camera at identity."""
    assert rotation_matrix((0.0, 0.0, 0.0, 1.0))[:, 2].tolist() == [0, 0, 1]


# --- a lens that sees nothing in its corners ------------------------------------------------------

KINECT = Camera(
    sensor=Sensor(width=33, height=27, pixel_pitch=(1e-4, 1e-4), modulation_frequency=20e6),
    optics=Optics(fx=23.0, fy=23.0, cx=16.3, cy=12.6, d=(0.0847, -0.2594, -0.0076, 0.0055, 0.0)),
    minimum_amplitude=0.0,
)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ORDER, ids=lambda one: one.name)
def test_pixels_without_a_ray_see_nothing_and_spoil_nothing(kind: type[Effect]) -> None:
    """Where the lens model has no inverse: no measurement, and the rest as if they were dark."""
    lost = np.isnan(KINECT.rays[..., 0])
    assert 0.01 < lost.mean() < 0.2
    effect = kind.example(KINECT)
    cam = with_effects(KINECT, {kind.name: effect})
    scene = replace(_corner(), camera_motion=CameraMotion((0.0, 0.1, 0.2), (0.0, 0.0, 0.0)))
    simulation = Simulation(cam, scene, noise=False, quantised=False)
    there = Settings(integration_time=60.0, uptime=30.0, ambient_temperature=24.0)
    exposure = Exposure(stamp=10**18, settings=there, poses=scene.fixed_poses())
    frame = simulation.frame(exposure)
    spread = kind.name in ("scattering", "mixed_pixels", "interference")
    if not spread and kind.name != "reference_path":
        assert np.isnan(frame.distance[lost]).all()
    assert np.isfinite(frame.distance[~lost]).all()
    here = simulation.context(exposure)
    assert here.geometry is not None
    assert here.geometry_at is not None
    signal = Signal(here.geometry.distance, here.geometry_at(0.0)[1])
    for by_distance, _ in effect.columns(signal, here).values():
        assert np.isfinite(np.broadcast_to(by_distance, lost.shape)[~lost]).all()
    for exact in (True, False):
        found = Correction(cam, exact=exact).correct(frame)
        seen = ~lost if kind.name != "reference_path" else ~lost & (found.flags == 0)
        assert np.isfinite(found.distance[seen]).all()
        if kind.undo == "exact" and not spread:
            truth = simulation.true_distance(exposure)
            np.testing.assert_allclose(found.distance[seen], truth[seen], atol=1e-5)
