"""The blind generator's own physics against numbers from outside it."""

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.integrate import solve_ivp

from test.blind.generator import Truth, make_case, seal
from test.blind.generator.__main__ import main
from test.blind.generator.base import FORMS, State
from test.blind.generator.catalogue import OUTSIDE, SCENES_FOR, VOCABULARY
from test.blind.generator.electronics import gate_waveform, led_waveform, sampled_phasor, since
from test.blind.generator.freeze import digest
from test.blind.generator.known import draw_camera
from test.blind.generator.lighting import cook_torrance_lobe, oren_nayar_ratio
from test.blind.generator.multipath import Patches, transfer
from test.blind.generator.scenes import SCENES, draw_scene, reference_error
from test.blind.generator.sensor import PLUMB_BOB, Sensor
from test.blind.generator.strength import amount_for, size_of
from test.blind.generator.thermal import convective_warm_up, lagged, linear_warm_up
from test.blind.generator.tracing import Poses, Surface, moved, trace
from test.blind.generator.world import World

SMALL = (44, 36)
INTERVAL = 7.49481145
"""c / (2 f) at 20 MHz, metres."""


def world_of(
    scene: str, *, seed: int = 3, size: tuple[int, int] = SMALL, without: tuple[str, ...] = ()
) -> World:
    return World(draw_camera(Sensor(*size), seed).without(without), draw_scene(scene, seed, stations=12))


def effect_of(world: World, name: str, form: str, seed: int = 5):
    return {**VOCABULARY, **OUTSIDE}[name](world, form, np.random.default_rng(seed))


def read(case: Path) -> dict[str, np.ndarray]:
    """Counts (frames, height, width) of both images, read back from the recording."""
    images: dict[str, list[np.ndarray]] = {"distance": [], "amplitude": []}
    with AnyReader([case / "recording"], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, _, raw in reader.messages():
            role = connection.topic.split("/")[2]
            if role in images:
                message = reader.deserialize(raw, connection.msgtype)
                images[role].append(np.frombuffer(message.data, "<u2").reshape(message.height, message.width))
    return {role: np.array(frames) for role, frames in images.items()}


# geometry


def test_rays_are_those_of_opencv():
    sensor = Sensor(88, 72)
    rays = sensor.rays()[[0, 11, 71], [0, 60, 87]]
    (fx, fy), (cx, cy) = sensor.focal_lengths, sensor.principal_point
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    points, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(PLUMB_BOB))
    np.testing.assert_allclose(points[:, 0], [[0, 0], [60, 11], [87, 71]], atol=1e-6)


def test_tilted_plane_and_plate_before_it():
    tilt = np.radians(20.0)
    rotation = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    wall = Surface("wall", 0.8, cell=(0.5, 0.25), tiles=np.array([[0.1, 0.2], [0.3, 0.4]]))
    plate = Surface("plate", 0.7, size=(0.2, 0.1))
    poses = {
        "wall": Poses(np.array([[0.0, 0.0, 2.5]]), rotation[None]),
        "plate": Poses(np.array([[0.3, 0.0, 1.0]]), np.eye(3)[None]),
    }
    rays = np.array([[0.0, 0.0, 1.0], [0.3, 0.02, 1.0], [0.3, 0.06, 1.0]])
    seen = trace(rays / np.linalg.norm(rays, axis=1, keepdims=True), [wall, plate], poses)
    # third ray: (0, -sin, cos) . p = 2.5 cos, so the length along z is 2.5 cos / (cos - 0.06 sin)
    depth = 2.5 / (1.0 - 0.06 * np.tan(tilt))
    np.testing.assert_allclose(
        seen.range[0], [2.5, np.sqrt(1.0 + 0.09 + 0.0004), depth * np.sqrt(1.0936)], rtol=1e-12
    )
    np.testing.assert_allclose(seen.cosine[0, 0], np.cos(tilt), rtol=1e-12)
    assert seen.surface[0].tolist() == [0, 1, 0]
    # y in the wall's frame is 0.06 depth / cos(20 deg) = 0.163: row 0; x = 0.767: column 1
    np.testing.assert_allclose(seen.reflectivity[0], [0.1, 0.7, 0.2])


def test_moved_camera_sees_the_wall_nearer():
    poses = {"wall": Poses(np.array([[0.0, 0.0, 2.5]]), np.eye(3)[None])}
    after = moved(poses, linear=np.array([0.1, 0.0, 0.5]), angular=np.array([0.0, 0.2, 0.0]), seconds=0.5)
    np.testing.assert_allclose(
        after["wall"].position[0], [-2.25 * np.sin(0.1) - 0.05 * np.cos(0.1), 0.0, 2.2338], atol=6e-3
    )
    # turning right by 0.1 rad leaves the wall's normal turned left
    np.testing.assert_allclose(after["wall"].rotation[0][:, 2], [-np.sin(0.1), 0.0, np.cos(0.1)], atol=1e-12)


def test_pose_errors_have_the_stated_size_and_heavier_tails():
    count = 20000
    true = Poses(np.tile([0.0, 0.0, 2.0], (count, 1)), np.tile(np.eye(3), (count, 1, 1)))
    stated = reference_error(np.random.default_rng(1), true, (0.001, 0.0006))
    offset = stated.position[:, 2] - 2.0
    assert offset.std() == pytest.approx(0.001, rel=0.03)
    assert stated.rotation[:, 0, 2].std() == pytest.approx(0.0006, rel=0.03)
    # kurtosis of Student t with 8 degrees of freedom: 3 + 6 / (8 - 4)
    assert np.mean(offset**4) / np.mean(offset**2) ** 2 == pytest.approx(4.5, abs=0.6)


def test_corner_is_rectangular_and_seen_from_inside():
    scene = draw_scene("corner", 4, stations=10)
    left, right = (scene.exposures.true[name] for name in ("left", "right"))
    np.testing.assert_allclose(
        np.einsum("nk,nk->n", left.rotation[:, :, 2], right.rotation[:, :, 2]), 0.0, atol=1e-12
    )
    # camera in front of both walls: the origin is on the side of the normal -z
    for poses in (left, right):
        assert np.all(np.einsum("nk,nk->n", poses.rotation[:, :, 2], poses.position) > 0.0)
    both = world_of("corner").geometry.surface
    assert np.all([(both == 0).any(), (both == 1).any()])


# effects


def test_square_wave_and_ideal_gate_give_the_triangle_wave():
    relative = sampled_phasor(led_waveform(1024, rise=1e-3, fall=1e-3), gate_waveform(1024, ramp=0.0), 1.0)
    for step in (64, 64 + 256, 64 + 512):
        # taps of a triangle wave at pi/8 past a corner: atan2(1/4, 3/4) instead of pi/8
        assert np.angle(relative[step]) == pytest.approx(np.arctan2(0.25, 0.75) - np.pi / 8.0, abs=2e-3)
    assert np.angle(relative[128]) == pytest.approx(0.0, abs=2e-3)
    # four periods of the error per period, as Kahlmann 2007, sec. 2.1.2.2 says
    spectrum = np.abs(np.fft.rfft(np.angle(relative)))
    assert np.argmax(spectrum) == 4
    none = sampled_phasor(led_waveform(1024, rise=0.6, fall=1.2), gate_waveform(1024, ramp=0.3), 0.0)
    np.testing.assert_allclose(none, np.mean(none), atol=1e-12)


def test_led_waveform_is_the_steady_state_of_its_circuit():
    rise, fall = 0.7, 1.3
    state = 0.0
    for _ in range(20):
        state = 1.0 - (1.0 - state) * np.exp(-np.pi / rise)
        top = state
        state *= np.exp(-np.pi / fall)
    wave = led_waveform(1000, rise=rise, fall=fall)
    assert wave[0] == pytest.approx(state, rel=1e-9)
    assert wave[500] == pytest.approx(top, rel=1e-9)


@pytest.mark.parametrize("form", FORMS)
def test_stray_light_is_the_double_sum(form):
    world = world_of("rich", size=(16, 18))
    effect = effect_of(world, "scattering", form)
    kernel = effect.kernel()
    assert kernel.sum() == pytest.approx(1.0)
    assert kernel.shape == (35, 31)
    light = np.zeros((1, 18, 16), complex)
    light[0, 3, 5], light[0, 16, 2] = 1.0 + 2.0j, -3.0j
    stray = effect.stray(light)
    share = 1.0 if form == "tuning" else 1.0 - effect.drawn["ghost"]
    # far from where the ghosts of the two points are
    for v, u in ((4, 7), (0, 0), (9, 1)):
        expected = (1.0 + 2.0j) * kernel[17 + v - 3, 15 + u - 5] - 3.0j * kernel[17 + v - 16, 15 + u - 2]
        assert stray[0, v, u] == pytest.approx(share * expected, abs=3e-4)
    if form == "tuning":
        assert kernel[17, 17] / kernel[17, 15] == pytest.approx(
            np.exp(-2.0 / effect.drawn["aspect"] / effect.drawn["length"]), rel=1e-9
        )


def test_mixed_pixel_kernels():
    world = world_of("rich")
    square, disc = (effect_of(world, "mixed_pixels", form) for form in FORMS)
    for effect in (square, disc):
        for amount in (0.3, 1.0, 2.5):
            kernel = effect.kernel(amount)
            assert kernel.sum() == pytest.approx(1.0)
            assert kernel.shape[0] % 2 == 1
    offset = (np.arange(square.kernel(3.0).shape[0]) - square.kernel(3.0).shape[0] // 2) / 3.0
    variance = (square.kernel(3.0).sum(axis=0) * offset**2).sum()
    # a box of width w has a variance of w^2 / 12
    assert variance == pytest.approx(0.75, rel=0.08)


def test_mixed_pixels_lie_between_fore_and_background():
    world = world_of("rich")
    effect = effect_of(world, "mixed_pixels", "tuning")
    state = world.image([(effect, 1.0)])
    change = np.abs(state.distance - world.geometry.range)
    edge = np.abs(np.diff(world.geometry.range, axis=2)) > 0.5
    near_edge = np.zeros(change.shape, bool)
    near_edge[:, :, 1:] |= edge
    near_edge[:, :, :-1] |= edge
    assert edge.sum() > 50
    assert change[near_edge].mean() > 50.0 * np.median(change)


def test_two_masses_warm_up_as_their_equations_say():
    times = np.array([0.0, 20.0, 75.0, 300.0, 1500.0])
    circuit = {"emitter": 60.0, "body": 400.0, "ratio": 3.0}

    def linear(_, y):
        flow = (y[0] - y[1]) / 60.0
        return [1.0 - flow, (flow - 3.0 / 400.0 * y[1]) / 3.0]

    final = 400.0 / 3.0 + 60.0
    solution = solve_ivp(linear, (0.0, 1500.0), [0.0, 0.0], t_eval=times, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(linear_warm_up(times, **circuit), 1.0 - solution.y[0] / final, atol=1e-8)

    def air(t):
        convection = t * (t / 25.0) ** 0.25
        return 3.0 / 400.0 * (0.6 * convection + 0.4 * ((293.0 + t) ** 4 - 293.0**4) / (4.0 * 293.0**3))

    def convective(_, y):
        flow = (y[0] - y[1]) / 60.0
        return [air(25.0) - flow, (flow - air(max(y[1], 0.0))) / 3.0]

    solution = solve_ivp(convective, (0.0, 1500.0), [0.0, 0.0], t_eval=times, rtol=1e-9, atol=1e-10)
    relative = solution.y[0] / (25.0 + 60.0 * air(25.0))
    expected = 1.0 - (relative + 0.15 * relative**2) / 1.15
    np.testing.assert_allclose(convective_warm_up(times, **circuit), expected, atol=2e-4)


def test_lag_behind_a_ramp():
    grid = np.arange(0.0, 1001.0, 2.0)
    # the answer to a ramp r t is r (t - tau (1 - exp(-t / tau)))
    answer = 0.02 * (grid - 180.0 * (1.0 - np.exp(-grid / 180.0)))
    np.testing.assert_allclose(lagged(15.0 + 0.02 * grid, 180.0) - 15.0, answer, atol=2e-4)


def test_emitter_beside_the_lens():
    world = world_of("tilted", without=("emission_pattern",))
    effect = effect_of(world, "emitter_offset", "tuning")
    wall = Poses(np.tile([0.0, 0.0, 2.0], (12, 1)), np.tile(np.eye(3), (12, 1, 1)))
    world.exposures.true["wall"] = wall
    effect.drawn["direction"] = [1.0, 0.0]
    light = effect.image(world.light, 0.3)
    v, u = 20, 22
    point = world.rays[v, u] * world.geometry.range[0, v, u]
    # mean over the LEDs of (|P| + |P - e|) / 2
    led = [np.linalg.norm(point - [0.3 + x, y, 0.0]) for x in (-0.015, 0.015) for y in (-0.012, 0.0, 0.012)]
    path = (np.linalg.norm(point) + np.mean(led)) / 2.0
    turn = np.angle(light[0, v, u] / world.light[0, v, u])
    assert world.geometry.range[0, v, u] + turn * INTERVAL / (2.0 * np.pi) == pytest.approx(path, abs=1e-5)
    assert path - np.linalg.norm(point) == pytest.approx(0.0113, abs=2e-3)
    power = np.mean([point @ point / d**2 for d in led])
    assert abs(light[0, v, u] / world.light[0, v, u]) == pytest.approx(power, rel=1e-4)


def test_rough_and_glossy_surfaces():
    # sigma^2 = 0.3: A = 1 - 0.15 / 0.63, B = 0.135 / 0.39; at 60 degrees sin tan = 1.5
    assert oren_nayar_ratio(np.radians([0.0, 60.0]), 0.3) == pytest.approx([1.0, 1.68145], abs=1e-4)
    lobe = cook_torrance_lobe(np.radians([0.0, 30.0, 60.0]), 0.35)
    assert lobe[0] == pytest.approx(1.0)
    # GGX at 30 degrees: D / D(0) = (a^2 / (0.75 (a^2 - 1) + 1))^2, G = 0.9798, over cos^2 = 0.75
    assert lobe[1] == pytest.approx((0.1225 / (0.75 * (0.1225 - 1.0) + 1.0)) ** 2 * 0.9800 / 0.75, rel=2e-3)
    # at 60 degrees: (0.1225 / 0.780625)^2 * (1 / (0.5 + 0.58456))^2 / 0.25
    assert lobe[2] == pytest.approx(0.024625 * 0.85015 / 0.25, rel=1e-3)


def test_radiosity_transfer_is_the_view_factor_of_two_perpendicular_squares():
    count = 24
    middle = (np.arange(count) + 0.5) / count
    a, b = (array.ravel() for array in np.meshgrid(middle, middle))
    patches = object.__new__(Patches)
    patches.points = np.stack([a, np.zeros_like(a), b], axis=1)
    patches.normals = np.tile([0.0, 1.0, 0.0], (count**2, 1))
    patches.area = np.full(count**2, 1.0 / count**2)
    points = np.stack([a, b, np.zeros_like(a)], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (count**2, 1))
    factors = transfer(points, normals, patches, 0.0)
    # textbook value for unit squares with a common edge
    assert factors.sum(axis=1).mean() == pytest.approx(0.20004, abs=0.004)
    one = transfer(points[:1], normals[:1], patches, 0.7)[0, 200]
    length = np.linalg.norm(patches.points[200] - points[0])
    assert np.angle(one) == pytest.approx(0.7 * length, abs=1e-12)


def test_multipath_makes_a_concave_corner_longer():
    world = world_of("corner")
    for form in FORMS:
        effect = effect_of(world, "multipath", form)
        image = world.image([(effect, 1.0)])
        longer = image.distance - world.geometry.range
        assert np.percentile(longer, 1.0) > -0.001
        assert 0.002 < np.median(longer) < 0.2
        assert np.median(image.amplitude / np.abs(world.light)) > 1.01


def test_second_camera_is_a_phasor_with_an_image():
    world = world_of("whitedist")
    effect = effect_of(world, "interference", "tuning")
    beat = effect.drawn["beat"]
    rng = np.random.default_rng(5)
    assert rng.uniform(0.1, 0.5) == beat
    psi = rng.uniform(0.0, 2.0 * np.pi, 12)
    k = np.arange(4)
    expected = 0.25 * (
        np.exp(1j * psi) * np.exp(1j * beat * k).sum()
        + np.exp(-1j * psi) * ((-1.0) ** k * np.exp(-1j * beat * k)).sum()
    )
    np.testing.assert_allclose(effect.phasor[:, 0, 0], expected, atol=1e-12)
    np.testing.assert_allclose(
        (effect.image(world.light, 7.0) - world.light)[:, 4, 9], 7.0 * expected, atol=1e-9
    )


@pytest.mark.parametrize("form", FORMS)
def test_motion_is_four_exposures(form):
    world = world_of("passage")
    world.scene.exposures.twist = (np.array([0.0, 0.0, 1.5]), np.zeros(3))
    effect = effect_of(world, "motion", form)
    image = effect.image(world.light, 0.008)
    n, v, u = 4, 30, 7
    pose, ray = world.exposures.true["wall"], world.rays[v, u]
    normal, before = pose.rotation[n][:, 2], world.geometry.range[n, v, u]
    taps = []
    for k in range(4):
        distance = normal @ (pose.position[n] - [0.0, 0.0, 1.5 * (k - 1.5) * 0.008]) / (normal @ ray)
        amplitude = abs(world.light[n, v, u]) * (before / distance) ** 2
        phase = 2.0 * np.pi * distance / INTERVAL - k * np.pi / 2.0
        taps.append(amplitude * (np.cos(phase) + effect.drawn["intensity"]))
    expected = 0.5 * ((taps[0] - taps[2]) + 1j * (taps[1] - taps[3]))
    assert image[n, v, u] == pytest.approx(expected, rel=1e-7)


def test_steps_since_a_saturated_pixel():
    flags = np.array([[[False, True, False, False, True, False]]])
    assert since(flags, axis=2)[0, 0].tolist() == [np.inf, 0.0, 1.0, 2.0, 0.0, 1.0]


def test_missing_codes():
    world = world_of("whitedist")
    coarse = effect_of(world, "missing_codes", "tuning")
    np.testing.assert_allclose(coarse.convert(np.array([1.234, 2.57]), 0.1), [1.2, 2.6])
    bits = effect_of(world, "missing_codes", "scoring")
    bits.drawn = {"bits": [10, 12], "weights": [1.0, -0.5]}
    # code 5 * 1024 = bits 10 and 12 set: + 0.5 - 0.25; code 4 * 1024: - 0.5 - 0.25
    metres = (np.array([5.0, 4.0]) * 1024.0 + 0.5) / 65536.0 * INTERVAL
    np.testing.assert_allclose(bits.convert(metres, 0.02) - metres, [0.005, -0.015], atol=1e-9)


@pytest.mark.parametrize("name", [*VOCABULARY, *OUTSIDE])
def test_the_two_forms_differ_and_reach_their_strength(name):
    scene = SCENES_FOR[name][0]
    world = world_of(scene, without=(name,))
    if name == "saturation_bleed":
        world = World(world.camera.__class__(**{**vars(world.camera), "saturation": 4000}), world.scene)
    if VOCABULARY.get(name, OUTSIDE.get(name)).per_frame:
        world = world.with_exposures(world.exposures.frame_by_frame())
    fields = []
    for form in FORMS:
        effect = effect_of(world, name, form)
        amount = amount_for(world, effect, 0.6)
        size = size_of(world, [(effect, amount)])
        assert size.strength == pytest.approx(0.6, rel=0.03)
        assert size.per_pixel().shape == (36, 44)
        fields.append(np.where(size.lit, size.metres, 0.0).ravel())
    likeness = abs(fields[0] @ fields[1]) / np.linalg.norm(fields[0]) / np.linalg.norm(fields[1])
    assert likeness < 0.99995


def test_metres_of_forms_by_hand():
    world = world_of("whitedist")
    settings = world.exposures.integration_time[:, None, None]
    state = State(
        distance=np.full((12, 36, 44), 2.2), amplitude=150.0 * settings / 100.0 * np.ones((12, 36, 44))
    )
    offset = effect_of(world, "amplitude_offset", "scoring")
    offset.drawn["signal"] = 0.5
    # P / P0 = 3: 1 / (1 + 3.94822) = 0.202093
    np.testing.assert_allclose(offset.metres(state, 0.1), 0.0202093, atol=1e-7)
    offset = effect_of(world, "amplitude_offset", "tuning")
    offset.drawn["signal"] = 0.5
    np.testing.assert_allclose(offset.metres(state, 0.1), 0.1 * np.log(4.0 / 3.0), rtol=1e-9)
    incidence = effect_of(world, "incidence_angle", "scoring")
    assert incidence.shape(np.array([0.5]))[0] == pytest.approx(
        np.tan(0.4) * (1.0 - 0.3 * np.exp(-4.0)), rel=1e-12
    )
    clock = effect_of(world, "distance_scale", "scoring")
    clock.drawn["sign"] = 1.0
    uptime = world.exposures.uptime
    expected = 0.002 * 2.6 * (1.0 + 0.1 * np.exp(-uptime / 400.0))
    np.testing.assert_allclose(clock.metres(state, 0.002)[:, 3, 3], expected, rtol=1e-12)


# cases


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cases")


def test_case_is_what_its_truth_says(folder):
    """The recording with the effect minus the one without it, of the same seed, is the effect."""
    common = {"scene": "whitedist", "seed": 21, "size": SMALL}
    with_it = make_case(
        folder / "with", tier="plain", effect="distance_scale", strength=1.5, forms="tuning", **common
    )
    without = make_case(folder / "without", tier="null", masked=False, **common)
    images = {name: read(folder / name) for name in ("with", "without")}
    assert images["with"]["distance"].shape == (120, 36, 44)
    # on a white wall with one setting the noise is the same in both
    metres = [images[name]["distance"].astype(float) * INTERVAL / 65536.0 for name in ("with", "without")]
    lit = np.all([images[name]["amplitude"] >= 120 for name in images], axis=0)
    lit &= np.abs(metres[0] - metres[1]) < 1.0
    rms = np.sqrt(np.mean((metres[0] - metres[1])[lit] ** 2))
    assert rms == pytest.approx(with_it.hidden_rms_m, rel=0.01)
    assert rms / with_it.sigma_median_m == pytest.approx(1.5, rel=0.02)
    truth_map = np.load(folder / "with" / "truth.npy")
    assert truth_map.dtype == np.float32
    assert truth_map.shape == (36, 44)
    assert with_it.strength["distance_scale"] == pytest.approx(1.5, rel=0.011)
    assert np.all(np.load(folder / "without" / "truth.npy") == 0.0)
    assert without.verdict == "consistent"


def test_noise_is_what_the_camera_file_says(folder):
    make_case(folder / "noise", tier="null", masked=False, scene="rich", seed=8, size=SMALL)
    camera = yaml.safe_load((folder / "noise" / "camera.yaml").read_text())
    images = read(folder / "noise")
    distance, amplitude = (
        images[role].reshape(40, 3, 36, 44).astype(float) for role in ("distance", "amplitude")
    )
    good = np.all(amplitude > 150.0, axis=1)
    mean = np.maximum(amplitude.mean(axis=1), 1.0)
    noise = camera["noise"]
    sigma = np.sqrt(noise["floor"] ** 2 + noise["shot"] ** 2 / mean + (noise["amplitude"] / mean) ** 2)
    lsb = INTERVAL / 65536.0
    scaled = ((distance[:, 1] - distance[:, 0]) * lsb / sigma)[good]
    assert np.sqrt(np.mean(scaled**2)) == pytest.approx(np.sqrt(2.0), rel=0.015)
    counts = ((amplitude[:, 2] - amplitude[:, 0]) / (2.0 * np.pi / INTERVAL * mean * sigma))[good]
    assert np.sqrt(np.mean(counts**2)) == pytest.approx(np.sqrt(2.0), rel=0.015)
    assert np.all((images["distance"] == 0) == (images["amplitude"] == 0))
    assert images["amplitude"][images["amplitude"] > 0].min() >= 40


def test_null_is_explained_by_the_camera_file_at_the_stated_poses(folder):
    truth = make_case(folder / "null", tier="null", masked=False, scene="whitedist", seed=9, size=SMALL)
    world = world_of("whitedist", seed=9)
    world = World(world.camera, draw_scene("whitedist", 9))
    images = read(folder / "null")
    distance = images["distance"].reshape(40, 3, 36, 44).mean(axis=1) * INTERVAL / 65536.0
    near, amplitude = world.told.range, images["amplitude"].reshape(40, 3, 36, 44).mean(axis=1)
    residual = (
        distance
        - near
        - world.camera.metres(near, np.abs(world.light), world.told.incidence, np.full(40, 100))
    )
    good = amplitude > 200.0
    # fixed pattern 2.9 mm, pose 1 mm, mean noise of three frames: nothing else
    expected = 0.0025**2 + 0.0015**2 + 0.001**2 + np.mean(world.camera.sigma(amplitude)[good] ** 2 / 3.0)
    assert np.sqrt(np.mean(residual[good] ** 2)) == pytest.approx(np.sqrt(expected), rel=0.1)
    assert truth.effects == []


def test_masking_hides_part_in_the_known_terms(folder):
    options = {"effect": "scattering", "scene": "rich", "seed": 12, "strength": 1.5, "size": SMALL}
    plain = make_case(folder / "plain", tier="plain", **options)
    masked = make_case(folder / "masked", tier="masked", **options)
    files = [yaml.safe_load((folder / name / "camera.yaml").read_text()) for name in ("plain", "masked")]
    assert (folder / "plain" / "truth.npy").read_bytes() == (folder / "masked" / "truth.npy").read_bytes()
    assert plain.left_after_masking is None
    assert 0.3 < masked.left_after_masking < 0.99
    assert masked.known_before_masking["integration_time_offset"]["offset"] == {
        16: -0.031,
        60: -0.004,
        100: 0.003,
    }
    assert "scattering" not in files[1]["effects"]
    assert files[0]["effects"]["integration_time_offset"]["offset"] == {16: -0.031, 60: -0.004, 100: 0.003}
    shift = [
        files[1]["effects"]["amplitude_offset"]["hyperbola"][T]["a"] / a for T, a in _a_of(files[0]).items()
    ]
    assert np.max(np.abs(np.array(shift) - 1.0)) > 0.02


def _a_of(camera):
    return {T: row["a"] for T, row in camera["effects"]["amplitude_offset"]["hyperbola"].items()}


def test_masked_null_keeps_the_camera_nearly_as_it_was(folder):
    make_case(folder / "masked_null", tier="null", masked=True, scene="rich", seed=5, size=SMALL)
    camera = yaml.safe_load((folder / "masked_null" / "camera.yaml").read_text())
    before = draw_camera(Sensor(*SMALL), 5)
    assert camera["radiometry"]["gain"] == pytest.approx(60.0, rel=0.01)
    assert camera["radiometry"]["gain"] != 60.0
    for T, a in _a_of(camera).items():
        assert a == pytest.approx(before.hyperbola[T][0], rel=0.06)


@pytest.mark.parametrize("form", FORMS)
def test_cancelled_pair_leaves_at_most_a_tenth(folder, form):
    truth = make_case(
        folder / f"cancelled_{form}", tier="cancelled", seed=2, strength=1.0, size=SMALL, forms=form
    )
    assert truth.effects == ["incidence_angle", "amplitude_offset"]
    assert truth.cancellation < 0.1
    assert truth.strength["incidence_angle"] == pytest.approx(1.0, rel=0.011)
    camera = yaml.safe_load((folder / f"cancelled_{form}" / "camera.yaml").read_text())
    assert not {"incidence_angle", "amplitude_offset"} & set(camera["effects"])


def test_confounded_is_a_monotonic_sweep(folder):
    truth = make_case(folder / "sweep", tier="confounded", effect="warm_up_drift", seed=6, size=SMALL)
    assert truth.scene == "sweep"
    assert truth.masked
    steps = np.diff(draw_scene("sweep", 6).exposures.true["wall"].position[:, 2])
    assert np.all(steps > 0.0) or np.all(steps < 0.0)


def test_two_at_once_and_unknown(folder):
    two = make_case(
        folder / "two", tier="two", effect="scattering+warm_up_drift", seed=1, strength=0.7, size=SMALL
    )
    assert set(two.strength) == {"scattering", "warm_up_drift"}
    assert list(two.strength.values()) == pytest.approx([0.7, 0.7], rel=0.03)
    unknown = make_case(folder / "unknown", tier="unknown", effect="height", seed=1, strength=0.7, size=SMALL)
    assert (unknown.verdict, unknown.covariates) == ("unknown_physics", ["height"])


def test_same_seed_same_case_and_seal(folder):
    options = {"tier": "unknown", "seed": 33, "size": SMALL}
    first, second = (make_case(folder / name, **options) for name in ("one", "other"))
    assert isinstance(first, Truth)
    assert first == second
    for name in ("camera.yaml", "scene.yaml", "truth.json", "truth.npy", "recording/recording.mcap"):
        assert (folder / "one" / name).read_bytes() == (folder / "other" / name).read_bytes()
    assert seal(folder / "one") == hashlib.sha256((folder / "one" / "truth.json").read_bytes()).hexdigest()
    (folder / "one" / "truth.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"truth\.json"):
        seal(folder / "one")


def test_command_line(folder, capsys):
    out = folder / "command"
    arguments = ["--out", str(out), "--tier", "plain", "--effect", "motion", "--seed", "4", "--size", "48x40"]
    assert main([*arguments, "--storage", "sqlite3", "--forms", "tuning"]) == 0
    assert capsys.readouterr().out.strip() == seal(out)
    truth = json.loads((out / "truth.json").read_text())
    assert (truth["size"], truth["forms"], truth["scene"]) == ([48, 40], "tuning", "passage")
    assert len(read(out)["distance"]) == 40
    assert "camera_motion" in yaml.safe_load((out / "scene.yaml").read_text())
    assert main(arguments) == 2
    assert "exists" in capsys.readouterr().err


def test_wrong_requests_are_refused(folder):
    with pytest.raises(ValueError, match=r"tier 'plain' takes 1 of .*, not 'height'"):
        make_case(folder / "wrong", tier="plain", effect="height", seed=1)
    with pytest.raises(ValueError, match=r"motion is seen in the scene 'passage' only, not in 'rich'"):
        make_case(folder / "wrong", tier="plain", effect="motion", scene="rich", seed=1)
    with pytest.raises(ValueError, match=r"no scene shows saturation_bleed and multipath together"):
        make_case(folder / "wrong", tier="two", effect="saturation_bleed+multipath", seed=1)
    with pytest.raises(ValueError, match=r"scene 'attic' is none of"):
        draw_scene("attic", 1)
    assert set(sum(SCENES_FOR.values(), ())) <= set(SCENES)


def test_generator_shares_no_code_with_the_package():
    sources = sorted((Path(__file__).parent / "generator").glob("*.py"))
    assert len(sources) > 10
    assert not [
        path.name
        for path in sources
        if "import rim_camera_ros" in path.read_text() or "from rim_" in path.read_text()
    ]
    assert len(digest()) == 64
