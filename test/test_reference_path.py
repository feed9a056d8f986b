"""The internal reference path over time (Kahlmann 2007, chapter 4): simulation, filter, linearity, scale."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera, Sensor
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.ambient_temperature import AmbientTemperature
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.reference_path import ReferencePath, estimate_reference_scale, fit_line
from rim_camera_ros.effects.warm_up_drift import Exponential, WarmUpDrift
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import RawFrame, Settings
from rim_camera_ros.noise import Noise
from rim_camera_ros.optics import Optics
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.reference import (
    GAP,
    RATES,
    FilterState,
    Linearity,
    SimulatedReference,
    advance_filter,
    start_filter,
)
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene, ScenePose, Surface

Array = NDArray[np.float64]
L = 7.49481145
NOMINAL = 0.85
SIGMA = 0.0045
#: The cyclic error of the shipped SR-3000: at 0.85 m it measures 25 % less of a change than there is.
LINEARITY = Linearity((Harmonic(4, 0.08, 0.6),), L)
CAMERA = Camera(
    sensor=Sensor(width=24, height=18, pixel_pitch=(4e-5, 4e-5), modulation_frequency=20e6),
    optics=Optics(fx=199.9, fy=199.9, cx=11.3, cy=8.1),
    noise=Noise(floor=SIGMA, shot=0.0, amplitude=28.0),
    minimum_amplitude=0.0,
)
#: Sec. 4.3.2.1: a white target at 1.166 m.
WALL = Scene((Surface("wall", "plane", ScenePose((0.0, 0.0, 1.166)), reflectivity=0.8),))
TRUTH = Simulation(CAMERA, WALL).geometry(WALL.fixed_poses()).distance


def with_reference(*, scale: float = 1.0, nominal: float = NOMINAL, **more: Any) -> Camera:
    pixels = more.pop("pixels", None)
    return with_effects(
        CAMERA, {"reference_path": ReferencePath(nominal=nominal, scale=scale, pixels=pixels), **more}
    )


def exposure(seconds: float, **settings: Any) -> Exposure:
    return Exposure(
        stamp=10**9 + round(seconds * 1e9),
        settings=Settings(integration_time=100.0, **settings),
        poses=WALL.fixed_poses(),
    )


def filtered(
    times: Array, readings: Array, *, sigma: float = SIGMA, uptime: Array | None = None
) -> tuple[Array, FilterState]:
    """Return the filtered readings and the last state."""
    state: FilterState | None = None
    levels = []
    for i, (t, reading) in enumerate(zip(times, readings, strict=True)):
        given: dict[str, Any] = {
            "stamp": round(t * 1e9),
            "uptime": None if uptime is None else float(uptime[i]),
            "sigma": sigma,
        }
        first = state is None
        state = start_filter(reading, **given) if first else advance_filter(state, reading, **given)
        levels.append(state.level)
    assert state is not None
    return np.array(levels), state


# --- linearity ------------------------------------------------------------------------------------


def test_linearity_by_hand() -> None:
    one = Linearity((Harmonic(4, 0.08, 0.6), Harmonic(8, 0.01, -1.1)), 7.5)
    angle = 2 * np.pi * 0.9 / 7.5
    measured = 0.9 + 0.08 * np.sin(4 * angle + 0.6) + 0.01 * np.sin(8 * angle - 1.1)
    assert one.measured(0.9) == pytest.approx(measured, abs=1e-12)
    assert one.distance(measured) == pytest.approx(0.9, abs=1e-11)
    assert Linearity().distance(0.7) == Linearity().measured(0.7) == 0.7


def test_linearity_of_the_cameras_own_pixels() -> None:
    """The phase at reference pixels (19..21, 2..3) is that of the cyclic error's gradient there."""
    cyclic = CyclicError((Harmonic(4, 0.05, 0.3),), gradient=(0.02, -0.01))
    camera = with_reference(pixels=(19, 2, 21, 3), cyclic_error=cyclic)
    own = Linearity.of_camera(camera)
    assert own.harmonics[0].phase == pytest.approx(0.3 + 0.02 * (20 - 11.3) - 0.01 * (2.5 - 8.1))
    assert own.ambiguity == pytest.approx(L, abs=1e-6)
    assert Linearity.of_camera(with_reference(cyclic_error=cyclic)).harmonics[0].phase == 0.3
    assert Linearity.of_camera(with_reference()) == Linearity()


# --- simulation -----------------------------------------------------------------------------------


def test_a_reference_lags_behind_a_ramp_by_its_time_constant() -> None:
    """After a ramp r t, t >> tau, a first-order lag is r tau behind, at any frame rate."""
    effect = ReferencePath(nominal=NOMINAL, scale=0.8)
    for step in (0.5, 7.0, 40.0):
        memory: dict[str, Any] = {}
        one = SimulatedReference(lag=60.0)
        for t in np.arange(0.0, 1200.1, step):
            reading = one.reading(effect, 2e-5 * t, stamp=round(t * 1e9), memory=memory)
        assert reading == pytest.approx(NOMINAL + 2e-5 * (t - 60 * (1 - np.exp(-t / 60))) / 0.8, abs=1e-9)


def test_a_reference_without_drift_reads_nominal_whatever_its_linearity() -> None:
    """With drift it follows its own cyclic error's slope: 1 + 4 (2 pi / L) 0.08 cos(angle) = 0.74 here."""
    effect = ReferencePath(nominal=NOMINAL, scale=0.85)
    one = SimulatedReference(linearity=LINEARITY)
    assert one.reading(effect, 0.0, stamp=0, memory={}) == pytest.approx(NOMINAL, abs=1e-12)
    there = LINEARITY.distance(NOMINAL)
    slope = 1 + 0.08 * 4 * 2 * np.pi / L * np.cos(4 * 2 * np.pi / L * there + 0.6)
    found = (one.reading(effect, 1e-5, stamp=0, memory={}) - NOMINAL) / 1e-5
    assert found == pytest.approx(slope / 0.85, rel=1e-4)
    assert 0.72 < slope < 0.78


def test_simulated_noise_of_a_message_and_of_pixels() -> None:
    for pixels, expected in ((None, 0.002), ((20, 1, 23, 4), 0.002 / 4)):
        camera = with_reference(pixels=pixels)
        simulation = Simulation(camera, WALL, reference=SimulatedReference(noise=0.002))
        readings = [simulation.frame(exposure(0.1 * k)).settings.reference_distance for k in range(600)]
        assert np.std(np.array(readings, float)) == pytest.approx(expected, rel=0.1)
    with pytest.raises(ValueError, match="lag and noise of the reference path must not be negative"):
        SimulatedReference(lag=-1.0)


# --- filter ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.04, 1.0])
def test_the_time_constant_is_the_best_one_for_noise_and_drift_rate(step: float) -> None:
    """The one that minimises sigma^2 dt / (2 tau) + (r tau)^2: tau^3 = sigma^2 dt / (4 r^2)."""
    times = np.arange(0, 6000 * step, step)
    _, state = filtered(times, NOMINAL + SIGMA * np.random.default_rng(1).standard_normal(len(times)))
    checked = 0
    for rate, after in zip(RATES, state.sigmas, strict=True):
        tau = np.arange(0.05, 4000, 0.05) * step
        best = tau[np.argmin(SIGMA**2 * step / (2 * tau) + (rate * tau) ** 2)]
        gain = after**2 / (SIGMA**2 * state.noise)
        if step / best < 0.1 and 20 * best < times[-1]:
            assert step / gain == pytest.approx(best, rel=0.08)
            checked += 1
    assert checked >= 2


def test_the_noise_of_the_reference_is_not_passed_on() -> None:
    """At 5 Hz and rest a thirteenth of it is left at most; at 25 Hz a twentieth."""
    rng = np.random.default_rng(3)
    for rate, share in ((5.0, 13), (25.0, 20)):
        times = np.arange(0, 1800, 1 / rate)
        levels, state = filtered(times, NOMINAL + SIGMA * rng.standard_normal(len(times)))
        settled = levels[times > 120] - NOMINAL
        assert np.sqrt(np.mean(settled**2)) < SIGMA / share
        assert np.abs(settled).max() < SIGMA / 2
        # what it says of itself is not optimistic
        assert state.sigma > np.std(settled) / 1.5


@pytest.mark.parametrize("rate", [5.0, 25.0])
def test_a_warm_up_is_followed(rate: float) -> None:
    """Sec. 4.3.1: 7 cm in 30 s; better than the reading all the time, at once and later."""
    rng = np.random.default_rng(11)
    times = np.arange(0, 1200, 1 / rate)
    drift = -0.065 * np.exp(-times / 10) - 0.02 * np.exp(-times / 110)
    errors = []
    for _ in range(5):
        levels, _ = filtered(times, NOMINAL + drift + SIGMA * rng.standard_normal(len(times)))
        errors.append(levels - NOMINAL - drift)
    for begin, end, bound in ((0, 30, 0.8), (30, 360, 0.3), (360, 1200, 0.08)):
        part = np.array(errors)[:, (times >= begin) & (times < end)]
        assert np.sqrt(np.mean(part**2)) < bound * SIGMA


def test_a_jump_is_followed_within_seconds() -> None:
    """A fan that starts (fig. 3.41): 3 cm at once, after half an hour of rest."""
    rng = np.random.default_rng(4)
    times = np.arange(0, 2400, 0.2)
    drift = np.where(times < 1800, 0.0, 0.03)
    levels, _ = filtered(times, NOMINAL + drift + SIGMA * rng.standard_normal(len(times)))
    late = np.abs(levels - NOMINAL - drift)
    assert late[(times > 1805) & (times < 1830)].max() < 0.006
    assert np.sqrt(np.mean(late[times > 2200] ** 2)) < 0.0005


def test_frames_may_come_at_any_time() -> None:
    """0.3 Hz to 30 Hz and gaps of a minute, in a room that warms by 10 mm/h of distance."""
    rng = np.random.default_rng(8)
    times = np.cumsum(rng.choice([0.033, 0.2, 3.0, 60.0], size=4000, p=[0.5, 0.4, 0.09, 0.01]))
    drift = 0.01 / 3600 * times
    levels, _ = filtered(times, NOMINAL + drift + SIGMA * rng.standard_normal(len(times)))
    error = (levels - NOMINAL - drift)[times > 60]
    assert np.sqrt(np.mean(error**2)) < SIGMA / 6


def test_it_starts_anew_after_a_gap_and_when_time_or_uptime_goes_back() -> None:
    times = np.arange(0, 100, 0.2)
    rng = np.random.default_rng(5)
    readings = NOMINAL + SIGMA * rng.standard_normal(len(times))
    _, state = filtered(times, readings, uptime=times + 500)
    assert abs(state.level - NOMINAL) < 0.001
    last = state.stamp
    given: dict[str, Any] = {"uptime": 700.0, "sigma": SIGMA}
    for stamp, changed in (
        (last + round((GAP + 1) * 1e9), {}),
        (last - 1, {}),
        (last + 200_000_000, {"uptime": 2.0}),
        (last + 200_000_000, {"uptime": 600.0 + GAP + 1}),
    ):
        again = advance_filter(state, 0.77, stamp=stamp, **{**given, **changed})
        assert (again.level, again.sigma) == (0.77, SIGMA)
    soon = advance_filter(state, 0.87, stamp=last + 200_000_000, **{**given, "uptime": 600.0})
    assert soon.level != 0.87


def test_uptime_counts_where_stamps_do_not_wait() -> None:
    """A schedule that skips 200 s of warming: stamps advance by 0.1 s, the reading by 2 cm."""
    times = np.arange(0, 60, 0.1)
    rng = np.random.default_rng(12)
    _, state = filtered(times, 0.83 + SIGMA * rng.standard_normal(600), uptime=times)
    stamp = state.stamp + 100_000_000
    held = advance_filter(state, 0.85, stamp=stamp, uptime=None, sigma=SIGMA)
    skipped = advance_filter(state, 0.85, stamp=stamp, uptime=260.0, sigma=SIGMA)
    assert held.level < 0.842
    assert skipped.level > 0.845


@pytest.mark.parametrize("ratio", [0.3, 4.0])
def test_noise_that_is_not_the_stated_one_is_found_out(ratio: float) -> None:
    """A fibre whose light is noisier than the floor says, or a message that is a mean already."""
    rng = np.random.default_rng(13)
    times = np.cumsum(rng.choice([0.05, 0.2, 0.7], size=4000))
    true = ratio * SIGMA
    levels, state = filtered(times, NOMINAL + true * rng.standard_normal(len(times)))
    assert np.sqrt(state.noise) == pytest.approx(ratio, rel=0.12)
    settled = levels[times > 300] - NOMINAL
    assert np.sqrt(np.mean(settled**2)) < true / 10


def test_a_message_that_is_seen_again_tells_nothing_new() -> None:
    """A topic at 1 Hz with frames at 25 Hz: the result is that of 1 Hz."""
    rng = np.random.default_rng(6)
    slow = np.arange(0, 600, 1.0)
    readings = NOMINAL + SIGMA * rng.standard_normal(len(slow))
    fast = np.arange(0, 600, 0.04)
    once, _ = filtered(slow, readings)
    repeated, _ = filtered(fast, readings[np.floor(fast + 1e-6).astype(int)])
    np.testing.assert_allclose(repeated[::25], once, atol=1e-12)


# --- correction -----------------------------------------------------------------------------------


def raw(seconds: float, reading: float | None, camera: Camera, drift: float = 0.0) -> RawFrame:
    """A noise-free frame of the wall with a reading."""
    settings = Settings(integration_time=100.0, reference_distance=reading)
    distance = TRUTH + drift
    if reading is not None and (effect := camera.effects["reference_path"]).pixels is not None:
        distance = distance.copy()
        distance[effect.region()] = reading
    return RawFrame(
        stamp=10**9 + round(seconds * 1e9),
        distance=distance,
        amplitude=np.full(TRUTH.shape, 20000.0),
        settings=settings,
    )


@pytest.mark.parametrize("pixels", [None, (20, 1, 23, 4)])
@pytest.mark.parametrize("exact", [True, False])
def test_the_correction_is_quieter_than_the_reading(
    pixels: tuple[int, int, int, int] | None, exact: bool
) -> None:
    camera = with_reference(pixels=pixels)
    correction = Correction(camera, exact=exact)
    rng = np.random.default_rng(9)
    noise = SIGMA * rng.standard_normal(600)
    centre = [
        float(correction.correct(raw(0.2 * k, NOMINAL + e, camera)).distance[9, 7] - TRUTH[9, 7])
        for k, e in enumerate(noise)
    ]
    assert centre[0] == pytest.approx(-noise[0], abs=2e-6)
    assert np.std(centre[300:]) < np.std(noise[300:]) / 8
    frame = raw(120.0, NOMINAL, camera)
    one, two = correction.correct(frame), correction.correct_distance(frame)
    np.testing.assert_array_equal(one.distance, two.distance)
    assert one.settings.reference_distance == NOMINAL


def test_a_new_correction_carries_the_filter_on() -> None:
    camera = with_reference()
    before = Correction(camera)
    rng = np.random.default_rng(2)
    for k in range(200):
        before.correct(raw(0.2 * k, NOMINAL + SIGMA * rng.standard_normal(), camera))
    after, fresh = Correction(camera), Correction(camera)
    after.carry_on(before)
    odd = raw(40.0, NOMINAL + 0.009, camera)
    assert abs(after.correct(odd).distance[9, 7] - TRUTH[9, 7]) < 0.001
    assert fresh.correct(odd).distance[9, 7] - TRUTH[9, 7] == pytest.approx(-0.009, abs=1e-6)
    # time goes back: another recording begins
    back = after.correct(raw(1.0, NOMINAL - 0.007, camera))
    assert back.distance[9, 7] - TRUTH[9, 7] == pytest.approx(0.007, abs=1e-6)


def test_without_a_reading_nothing_is_filtered() -> None:
    camera = with_reference()
    corrected = Correction(camera).correct(raw(0.0, None, camera, drift=0.02))
    assert corrected.distance[9, 7] - TRUTH[9, 7] == pytest.approx(0.02, abs=1e-6)


def test_the_linearity_of_the_reference_is_undone() -> None:
    """Eq. 4.6 additive: exact with its cyclic error known; eq. 4.5 with the true scale is 27 % off."""
    camera = with_reference(scale=0.85)
    drift = 0.025
    reading = SimulatedReference(linearity=LINEARITY).reading(
        camera.effects["reference_path"], drift, stamp=0, memory={}
    )
    frame = raw(0.0, reading, camera, drift=drift)
    known = Correction(camera, exact=True, reference_linearity=LINEARITY).correct(frame)
    np.testing.assert_allclose(known.distance, TRUTH, atol=1e-6)
    left = Correction(camera, exact=True).correct(frame).distance - TRUTH
    assert np.median(left) == pytest.approx(drift * 0.24, abs=0.001)


# --- what chapter 4 measured ----------------------------------------------------------------------


def climate(seconds: float) -> float:
    """Sec. 4.3.2.1: 10, 0, 10, 20, 30 and back to 10 degC, each change within half an hour."""
    hours = [0, 1, 1.5, 3, 3.5, 5, 5.5, 7, 7.5, 9, 10, 12]
    return float(np.interp(seconds / 3600, hours, [10, 10, 0, 0, 10, 10, 20, 20, 30, 30, 10, 10]))


def cycle(*, seed: int, step: float, corrections: list[Correction]) -> Array:
    """Return per frame: mean raw error, reading, and the mean error after each correction, in metres."""
    ambient = AmbientTemperature(coefficient=0.0017, reference=15.0, time_constant=900.0)
    camera = with_reference(scale=0.85, pixels=(21, 0, 23, 2), ambient_temperature=ambient)
    reference = SimulatedReference(lag=60.0, linearity=LINEARITY)
    simulation = Simulation(camera, WALL, seed=seed, reference=reference)
    scene = np.ones(TRUTH.shape, bool)
    scene[0:3, 21:24] = False
    rows = []
    for t in np.arange(0, 12 * 3600, step):
        frame = simulation.frame(exposure(t, uptime=3600.0 + t, ambient_temperature=climate(t)))
        error = frame.distance[scene] * CAMERA.sensor.lsb - TRUTH[scene]
        after = [
            float(np.mean(one.correct_distance(frame).distance[scene] - TRUTH[scene])) for one in corrections
        ]
        rows.append([float(np.mean(error)), float(frame.settings.reference_distance or np.nan), *after])
    return np.array(rows)


def variation(errors: Array, *, step: float) -> float:
    """Return half the range in metres of the floating mean over 100 s (501 frames at 5 Hz in the thesis)."""
    n = max(1, round(100 / step))
    return float(np.ptp(np.convolve(errors, np.ones(n) / n, "valid"))) / 2


@pytest.mark.long
def test_the_climate_cycle_of_chapter_4() -> None:
    """Secs. 4.3.2.1, 4.3.2.3: +-2-3 cm go down to about +-4 mm by eq. 4.4, further with a scale."""
    first = cycle(seed=1, step=20.0, corrections=[])
    found = estimate_reference_scale(
        drift=first[:, 0], reading=first[:, 1], drift_sigma=SIGMA / 20, reading_sigma=SIGMA / 3
    )
    assert found.scale_sigma < 0.01
    pixels = (21, 0, 23, 2)
    corrections = [
        Correction(with_reference(pixels=pixels)),
        Correction(with_reference(pixels=pixels, scale=found.scale, nominal=found.nominal)),
        Correction(with_reference(pixels=pixels, scale=0.85), reference_linearity=LINEARITY),
    ]
    step = 4.0
    errors = cycle(seed=7, step=step, corrections=corrections)
    before, by_4_4, by_4_5, by_4_6 = (variation(errors[:, k], step=step) for k in (0, 2, 3, 4))
    print(f"half range [mm]: {before * 1e3:.2f} {by_4_4 * 1e3:.2f} {by_4_5 * 1e3:.2f} {by_4_6 * 1e3:.2f}")
    assert 0.02 < before < 0.03
    assert 0.002 < by_4_4 < 0.004
    assert by_4_5 < 0.002
    assert by_4_6 < 0.002
    # from frame to frame it is the filter that keeps the reference's 1.5 mm out
    rough = np.std(np.diff(errors[:, 3])) / np.sqrt(2)
    assert rough < 2 * np.std(np.diff(errors[:, 0])) / np.sqrt(2) < SIGMA / 3


def test_the_warm_up_of_chapter_4() -> None:
    """Sec. 4.3.1: 8 cm in 30 s, the reference 7 cm and lagging; about 20 % are left by eq. 4.4."""
    warm_up = WarmUpDrift((Exponential(-0.075, 10.0), Exponential(-0.02, 110.0)))
    camera = with_reference(scale=8 / 7, warm_up_drift=warm_up)
    simulation = Simulation(camera, WALL, seed=3, reference=SimulatedReference(lag=1.0, noise=0.002))
    plain = Correction(replace(with_reference(), noise=replace(CAMERA.noise, floor=0.002)))
    rows = []
    for t in np.arange(0, 30, 0.2):
        frame = simulation.frame(exposure(t, uptime=t))
        raw_error = np.mean(frame.distance * CAMERA.sensor.lsb - TRUTH)
        rows.append([raw_error, np.mean(plain.correct_distance(frame).distance - TRUTH)])
    drift, left = np.ptp(np.convolve(np.array(rows)[:, 0], np.ones(5) / 5, "valid")), np.array(rows)[:, 1]
    assert drift == pytest.approx(0.08, abs=0.01)
    remaining = np.ptp(np.convolve(left, np.ones(5) / 5, "valid")) / drift
    assert 0.08 < remaining < 0.25


# --- scale ----------------------------------------------------------------------------------------


def test_pearsons_data_with_yorks_weights() -> None:
    """York et al. 2004, table: intercept 5.47991 +- 0.29497, slope -0.480533 +- 0.057985, S / 8 = 1.4833."""
    x = [0.0, 0.9, 1.8, 2.6, 3.3, 4.4, 5.2, 6.1, 6.5, 7.4]
    y = [5.9, 5.4, 4.4, 4.6, 3.5, 3.7, 2.8, 2.8, 2.4, 1.5]
    wx = np.array([1000, 1000, 500, 800, 200, 80, 60, 20, 1.8, 1.0])
    wy = np.array([1, 1.8, 4, 8, 20, 20, 70, 70, 100, 500])
    line = fit_line(x, y, x_sigma=wx**-0.5, y_sigma=wy**-0.5)
    assert (line.intercept, line.slope) == (pytest.approx(5.47991022, abs=1e-7), pytest.approx(-0.480533407))
    assert line.intercept_sigma == pytest.approx(0.29497, abs=2e-5)
    assert line.slope_sigma == pytest.approx(0.057985, abs=2e-6)
    assert line.chi2 == pytest.approx(1.4833, abs=1e-4)


def test_the_scale_is_unbiased_and_its_sigma_true() -> None:
    """Noise in the reading alone would pull an ordinary fit of this set down by 26 %."""
    rng = np.random.default_rng(21)
    drift = np.linspace(-0.01, 0.012, 150)
    deviations, ordinary = [], []
    for _ in range(300):
        reading = 0.85 + drift / 0.8 + 0.0045 * rng.standard_normal(len(drift))
        measured = drift + 0.001 * rng.standard_normal(len(drift))
        found = estimate_reference_scale(
            drift=measured, reading=reading, drift_sigma=0.001, reading_sigma=0.0045
        )
        deviations.append(
            [(found.scale - 0.8) / found.scale_sigma, (found.nominal - 0.85) / found.nominal_sigma]
        )
        ordinary.append(np.polyfit(reading, measured, 1)[0])
    assert np.mean(ordinary) < 0.65
    scaled = np.array(deviations)
    np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=0.2)
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, atol=0.12)


def test_larger_residuals_raise_the_sigma() -> None:
    rng = np.random.default_rng(1)
    drift = np.linspace(0.0, 0.05, 400)
    reading = 0.85 + drift / 1.2 + 0.003 * rng.standard_normal(400)
    right, small = (
        estimate_reference_scale(drift=drift, reading=reading, drift_sigma=0.0002, reading_sigma=sigma)
        for sigma in (0.003, 0.001)
    )
    assert small.scale_sigma == pytest.approx(right.scale_sigma, rel=0.1)
    assert right.rms == pytest.approx(0.003 * 1.2, rel=0.1)


@pytest.mark.parametrize(
    ("drift", "reading", "message"),
    [
        (
            [0.0, 0.01],
            [0.85, 0.86],
            r"a line needs three points or more \(record a fixed scene from power-on",
        ),
        ([0.0, 0.01, 0.02], [0.85, 0.85, 0.85], r"a line needs points at different x"),
        ([0.0, np.nan, 0.02], [0.85, 0.86, 0.87], r"a line needs finite points"),
        ([0.0, 0.001, -0.001, 0.0], [0.85, 0.851, 0.8505, 0.8493], r"the reference moves too little to de"),
        ([0.04, 0.02, 0.0], [0.81, 0.83, 0.85], r"the scene drifts against the reference \(scale -1\)"),
    ],
)
def test_what_does_not_tell_a_scale(drift: list[float], reading: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        estimate_reference_scale(drift=drift, reading=reading, drift_sigma=0.001, reading_sigma=0.001)
