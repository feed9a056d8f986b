"""Gates: shares of a pulse in closed form, distance and bound, reflectivity, terms, stray light, input."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.background_light import BackgroundLight
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.gate_timing import GateTiming
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.gated.estimation import GateEstimator
from rim_camera_ros.gated.gates import Gate, GatedShutter
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.scene import Scene, ScenePose, Surface

SPEED_OF_LIGHT = 299_792_458.0
PULSE = 20e-9
#: of such a pulse, there and back
DEPTH = SPEED_OF_LIGHT * PULSE / 2
START = 9_000_000_000


def shutter(*delays: float, rise_time: float = 1e-12, read_noise: float = 0.0) -> GatedShutter:
    return GatedShutter(
        gates=tuple(Gate(delay=one, width=PULSE) for one in delays),
        pulse_width=PULSE,
        rise_time=rise_time,
        read_noise=read_noise,
        pulse_rate=10e6,
    )


TWO = shutter(0.0, PULSE)
THREE = shutter(0.0, PULSE, 75e-9, rise_time=1e-9, read_noise=5.0)


def camera(*effects: Effect) -> Camera:
    whole = load_camera(find_camera("gated"))
    cut = replace(
        whole,
        sensor=replace(whole.sensor, width=16, height=12),
        optics=replace(whole.optics, cx=7.5, cy=5.5),
    )
    return with_effects(cut, {one.name: one for one in effects})


def wall(distance: float, reflectivity: float = 0.8) -> Scene:
    return Scene(
        (Surface(name="w", type="plane", pose=ScenePose((0.0, 0.0, distance)), reflectivity=reflectivity),)
    )


def simulated(camera: Camera, scene: Scene, **options: int) -> tuple[RawFrame, np.ndarray]:
    simulation = measurement_of(camera).simulation(camera, scene, **options)
    exposure = next(iter(Timeline(scene, camera, start=START, integration_time=10.0)))
    return simulation.frame(exposure), simulation.true_distance(exposure)


# --- gates and estimates ------------------------------------------------------------------------


def test_two_gates_share_a_pulse_by_its_distance() -> None:
    """Sharp edges: the second gate sees 2 d / (c T) of the light, the first one the rest."""
    distance = np.linspace(0.05, 2.95, 30)
    first, second = TWO.shares(distance)
    assert second == pytest.approx(distance / DEPTH, abs=1e-6)
    assert first + second == pytest.approx(1.0, abs=1e-9)


def test_soft_edges_are_the_overlap_with_gaussian_edges() -> None:
    """Against the overlap of gate and pulse summed over time, edges by the error function."""
    distance, time = 1.7, np.linspace(-30e-9, 120e-9, 300_001)
    begin = 2 * distance / SPEED_OF_LIGHT
    pulse = (time >= begin) & (time < begin + PULSE)
    for i, gate in enumerate(THREE.gates[:2]):
        edges = [(time - gate.delay - late) / (1e-9 * math.sqrt(2)) for late in (0.0, gate.width)]
        erf = np.vectorize(math.erf)
        open_ = (erf(edges[0][pulse]) - erf(edges[1][pulse])) / 2
        share = open_.sum() * (time[1] - time[0]) / PULSE
        assert THREE.shares(np.array([distance]))[i, 0] == pytest.approx(share, abs=2e-5)


def test_distance_and_bound_of_two_gates_in_closed_form() -> None:
    """D = (c T / 2) q1 / (q0 + q1), sigma^2 = (c T / 2)^2 x (1 - x) / A of photons alone."""
    distance = np.linspace(0.3, 2.7, 25)
    found = GateEstimator(TWO).estimate(5e4 * TWO.shares(distance))
    assert found.distance == pytest.approx(distance, abs=1e-5)
    assert found.amplitude == pytest.approx(5e4, rel=1e-5)
    x = distance / DEPTH
    assert found.sigma == pytest.approx(DEPTH * np.sqrt(x * (1 - x) / 5e4), rel=2e-3)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.2, 2.8), st.floats(1e2, 5e4), st.floats(0.0, 5e3))
def test_three_gates_cancel_reflectivity_and_other_light(
    distance: float, amplitude: float, background: float
) -> None:
    light = amplitude * THREE.shares(np.array([distance])) + background * THREE.windows[:, None]
    found = GateEstimator(THREE).estimate(light)
    assert found.distance[0] == pytest.approx(distance, abs=2e-4)
    assert found.amplitude[0] == pytest.approx(amplitude, rel=1e-3)


@pytest.mark.parametrize(("amplitude", "background"), [(2000.0, 0.0), (2000.0, 500.0), (20000.0, 3000.0)])
def test_errors_are_those_of_the_bound(amplitude: float, background: float) -> None:
    rng = np.random.default_rng(11)
    distance = rng.uniform(0.4, 2.6, 20_000)
    light = amplitude * THREE.shares(distance) + background * THREE.windows[:, None]
    found = GateEstimator(THREE).estimate(rng.poisson(light) + 5.0 * rng.standard_normal(light.shape))
    error = (found.distance - distance) / found.sigma
    assert error.std() == pytest.approx(1.0, abs=0.03)
    assert abs(error.mean()) < 0.05


def test_light_that_two_gates_cannot_subtract_leaves_a_residue_of_the_reflectivity() -> None:
    """Unmodulated light B, taken for none, draws d to the middle: by B (1 - 2 x) / (A + 2 B) of the depth."""
    distance, background = 0.9, 300.0
    x = distance / DEPTH
    estimator = GateEstimator(TWO)
    for amplitude in (1e3, 1e4):
        light = amplitude * TWO.shares(np.array([distance])) + background
        residue = estimator.estimate(light).distance[0] - distance
        expected = DEPTH * background * (1 - 2 * x) / (amplitude + 2 * background)
        assert residue == pytest.approx(expected, rel=1e-3)
    known = GateEstimator(TWO, background=background).estimate(light)
    assert known.distance[0] == pytest.approx(distance, abs=1e-5)


def test_narrow_gates_are_slices_of_depth() -> None:
    slices = shutter(*(i * PULSE for i in range(5)))
    for i in range(5):
        near, far = slices.slice_of(i)
        at = np.array([near + 0.01, far - 0.01, near - 0.01, far + 0.01])
        share = slices.shares(np.mod(at, slices.ambiguity))[i]
        assert np.all(share[:2] > 0.5)
        assert np.all(share[2:] < 0.5)
    distance = np.linspace(0.2, 11.8, 40)
    found = GateEstimator(slices).estimate(1e4 * slices.shares(distance))
    assert found.distance == pytest.approx(distance, abs=1e-3)


def test_gates_that_do_not_overlap_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="do not overlap: at no distance do two of them see the same pulse"):
        GateEstimator(shutter(0.0, 60e-9))
    text = find_camera("gated").read_text()
    cut = text[: text.index("  gates:")] + "  gates:\n  - {delay: 0.0, width: 20.0e-9}\n"
    for more, problem in (
        ("", "one gate cannot separate"),
        ("  - {delay: 50.0e-9, width: 20.0e-9}\n", "overlap"),
    ):
        (tmp_path / "camera.yaml").write_text(cut + more)
        with pytest.raises(InputError, match=problem) as caught:
            load_camera(tmp_path / "camera.yaml")
        assert "measurement" in str(caught.value)
        assert "\n" not in str(caught.value)


# --- behind the chain ---------------------------------------------------------------------------


def test_noise_of_the_file_follows_from_the_gates() -> None:
    one = load_camera(find_camera("gated"))
    derived = measurement_of(one).noise(one)  # type: ignore[attr-defined]
    for key in ("shot", "amplitude", "circular_range"):
        assert getattr(one.noise, key) == pytest.approx(getattr(derived, key), rel=0.02)


def test_reflectivity_is_cancelled_and_the_residue_of_a_compressed_response_is_undone() -> None:
    """Ratios of compressed images depend on the reflectivity, until the response is undone image by image."""
    for effects, raw_limit in (((), 0.001), ((AmplitudeNonlinearity(compression=8e-6),), None)):
        one = camera(*effects)
        raw, corrected = [], []
        for reflectivity in (0.1, 0.8):
            frame, truth = simulated(one, wall(1.9, reflectivity), noise=False)
            raw.append(float(np.mean(frame.distance * one.sensor.lsb - truth)))
            corrected.append(measurement_of(one).correction(one).correct(frame).distance - truth)
        residue = abs(raw[1] - raw[0])
        if raw_limit is None:
            assert 0.005 < residue < 0.1
        else:
            assert residue < raw_limit
        assert np.abs(corrected).max() < 0.002


def test_stray_light_is_undone_gate_by_gate() -> None:
    stray = Scattering(kernels=(Kernel(weight=0.15, sigma=(3.0, 4.0)),))
    box = Surface(
        name="box", type="rectangle", size=(2.0, 4.0), pose=ScenePose((-1.0, 0.0, 0.8)), reflectivity=0.8
    )
    scene = Scene((box, *wall(2.3, 0.2).surfaces))
    one = camera(stray)
    frame, truth = simulated(one, scene, noise=False)
    corrected = measurement_of(one).correction(one).correct(frame)
    raw = frame.distance * one.sensor.lsb - truth
    assert np.abs(raw).max() > 0.1
    assert np.abs(corrected.distance - truth).max() < 0.004


def test_unmodulated_light_of_the_chain_is_what_the_third_gate_subtracts() -> None:
    one = camera(BackgroundLight(level=5000.0, offset=0.0))
    frame, truth = simulated(one, wall(1.2), noise=False)
    # on the black level of 100 counts
    assert frame.images["gates"][..., 2] == pytest.approx(5100.0, abs=1.0)
    assert measurement_of(one).correction(one).correct(frame).distance == pytest.approx(truth, abs=1e-3)


def test_gate_timing_is_what_true_gates_do_to_stated_ones() -> None:
    """Images of gates that open late and long, evaluated as stated, against the term; and its derivatives."""
    stated = camera(GateTiming(delay=(0.0,) * 3, width=(0.0,) * 3))
    wrong = GateTiming(delay=(0.0, 4e-10, 0.0), width=(2e-10, 0.0, 0.0))
    way = stated.measurement
    late = replace(way.gates[1], delay=way.gates[1].delay + 4e-10)
    longer = replace(way.gates[0], width=way.gates[0].width + 2e-10)
    true = replace(way, gates=(longer, late, way.gates[2])).shutter(stated)
    distance = np.linspace(0.3, 2.7, 25)
    evaluated = way.estimator(stated).estimate(3e4 * true.shares(distance)).distance
    term = wrong.term(distance, distance, Context(camera=stated))
    assert evaluated - distance == pytest.approx(term, abs=3e-4)
    assert np.ptp(term) > 0.02
    none = stated.effects["gate_timing"]
    columns = none.columns(Signal(distance, np.full(25, 1e4)), Context(camera=stated))
    linear = columns["delay.1"][0] * 4e-10 + columns["width.0"][0] * 2e-10
    assert linear == pytest.approx(term, abs=1e-3)
    # late by t means short by c t / 2
    both = GateTiming(delay=(3e-10,) * 3, width=(0.0,) * 3)
    short = both.term(distance, distance, Context(camera=stated))
    assert short == pytest.approx(-SPEED_OF_LIGHT / 2 * 3e-10, abs=2e-4)
    # and it is corrected
    one = camera(wrong)
    frame, truth = simulated(one, wall(1.6), noise=False)
    assert np.abs(frame.distance * one.sensor.lsb - truth).min() > 0.02
    assert measurement_of(one).correction(one).correct(frame).distance == pytest.approx(truth, abs=5e-4)


def test_gate_timing_needs_gates(tmp_path: Path) -> None:
    timing = GateTiming(delay=(0.0, 0.0), width=(0.0, 0.0))
    with pytest.raises(InputError, match="this camera has no gates"):
        with_effects(load_camera(find_camera("pmd3ks")), {"gate_timing": timing})
    with pytest.raises(InputError, match="give 3 numbers for delay and for width"):
        camera(timing)
