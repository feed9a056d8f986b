"""Scene files, what rays meet, and how a simulation goes on from frame to frame."""

from __future__ import annotations

# ruff: noqa: E501 -- one fault a line
import math
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rim_camera_ros.camera import Camera, Noise, Optics, Radiometry, Sensor
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.multipath import Multipath
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose, Settings
from rim_camera_ros.geometry import see
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.phasor import Waveform
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import CameraMotion, Scene, ScenePose, Surface, Texture, load_scene

L = 299792458.0 / 40e6
HEAD = "format: rim_scene/1\nsurfaces:\n"
SETTINGS = Settings(integration_time=60.0)
CAMERA = Camera(
    sensor=Sensor(width=31, height=23, pixel_pitch=(1e-4, 1e-4), modulation_frequency=20e6),
    optics=Optics(fx=40.0, fy=38.0, cx=14.6, cy=11.3),
    noise=Noise(floor=0.003, shot=0.0, amplitude=15.0),
)


def load(tmp_path: Path, text: str) -> Scene:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    return load_scene(path)


def seen(surface: Surface, directions: Any) -> Any:
    rays = np.atleast_2d(np.asarray(directions, float))
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True))[None]
    scene = Scene(surfaces=(surface,))
    return see(scene, scene.fixed_poses(), rays)


def quat(axes: str, angles: Any) -> tuple[float, float, float, float]:
    return tuple(float(x) for x in Rotation.from_euler(axes, angles).as_quat())  # type: ignore[return-value]


# --- files ----------------------------------------------------------------------------------------


def test_defaults(tmp_path: Path) -> None:
    scene = load(
        tmp_path,
        HEAD
        + "- {name: a, type: plane, pose: {position: [0, 0, 2]}}\n- {name: b, type: disc, radius: 1, pose: truth}\nschedule:\n- {}\n",
    )
    a, b = scene.surfaces
    assert a.pose == ScenePose((0.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0), ())
    assert (a.reflectivity, a.texture, a.pose_sigma) == (0.8, None, (0.001, 0.0005))
    assert b.pose == "truth"
    assert scene.needs_truth == ("b",)
    assert scene.fixed_poses() == {"a": Pose((0.0, 0.0, 2.0))}
    assert not scene.camera_motion.moves
    assert (scene.schedule[0].frames, scene.schedule[0].rate) == (100, 25.0)
    pose = Pose((1.0, 0.0, 3.0))
    assert scene.poses_for({"b": pose, "a": pose}) == {"a": Pose((0.0, 0.0, 2.0)), "b": pose}
    with pytest.raises(
        InputError, match=r"surface 'b' has pose: truth, but no pose is known .*/ground_truth/b/pose"
    ):
        scene.poses_for({})


def test_quaternions_are_normalised_everywhere(tmp_path: Path) -> None:
    """Four printed digits are enough; also in the schedule."""
    text = (
        HEAD
        + "- {name: a, type: plane, pose: {position: [1, 0, 2], orientation: [0, 0.7073, 0, 0.7073]}}\nschedule:\n- {poses: {a: {position: [0, 1, 3], orientation: [0.7073, 0, 0, 0.7073], free: [y, yaw]}}}\n"
    )
    scene = load(tmp_path, text)
    pose, later = scene.surfaces[0].pose, scene.schedule[0].poses["a"]
    assert isinstance(pose, ScenePose)
    assert pose.orientation == pytest.approx((0, math.sqrt(0.5), 0, math.sqrt(0.5)), abs=1e-15)
    assert later.orientation == pytest.approx((math.sqrt(0.5), 0, 0, math.sqrt(0.5)), abs=1e-15)
    assert later.free == ("y", "yaw")


WALL = "- {name: a, type: plane, pose: {position: [0, 0, 2]}}\n"
FAULTS = {
    "no surfaces": ("format: rim_scene/1\n", r"scene\.yaml: line 1: key 'surfaces' is missing"),
    "no format": ("surfaces: []\n", r"not a scene file: format is None \(expected format: rim_scene/1\)"),
    "a list": ("- 1\n", r"expected a group of keys, found a list"),
    "no pose": (HEAD + "- {name: a, type: plane}\n", r"surfaces\.0 \(line 3\): key 'pose' is missing"),
    "no name": (HEAD + "- {type: plane, pose: truth}\n", r"surfaces\.0 \(line 3\): key 'name' is missing"),
    "name that is a number": (HEAD + "- {name: 3, type: plane, pose: truth}\n", r"surfaces\.0\.name \(line 3\): expected a text, found the number 3"),
    "pose misspelt": (HEAD + "- {name: a, type: plane, pose: thruth}\n", r"surfaces\.0 \(line 3\): pose must be a group with position and orientation, or truth, not 'thruth'"),
    "pose that is a list": (HEAD + "- {name: a, type: plane, pose: [0, 0, 1]}\n", r"surfaces\.0\.pose \(line 3\): expected a group of keys, found a list"),
    "NaN": (HEAD + "- {name: a, type: plane, pose: {position: [0, .nan, 2]}}\n", r"surfaces\.0\.pose\.position\.1 \(line 3\): must be finite, found nan"),
    "distance with a unit": (HEAD + "- {name: a, type: plane, pose: {position: [0, 0, 2 m]}}\n", r"position\.2 \(line 3\): expected a number in m, found the text '2 m'"),
    "three of a quaternion": (HEAD + "- {name: a, type: plane, pose: {position: [0, 0, 2], orientation: [0, 0, 1]}}\n", r"orientation \(line 3\): expected 4 values, found 3"),
    "quaternion of 0": (HEAD + "- {name: a, type: plane, pose: {position: [0, 0, 2], orientation: [0, 0, 0, 0]}}\n", r"not a unit quaternion x y z w \(its norm is 0\)"),
    "disc without radius": (HEAD + "- {name: a, type: disc, pose: truth}\n", r"a disc or sphere needs 'radius', and only they have one"),
    "plane with size": (HEAD + "- {name: a, type: plane, size: [1, 1], pose: truth}\n", r"a rectangle needs 'size: \[width, height\]', and only a rectangle has one"),
    "rectangle with radius": (HEAD + "- {name: a, type: rectangle, size: [1, 1], radius: 2, pose: truth}\n", r"a disc or sphere needs 'radius'"),
    "radius 0": (HEAD + "- {name: a, type: sphere, radius: 0, pose: truth}\n", r"surfaces\.0\.radius \(line 3\): must be greater than 0 m"),
    "texture without tiles": (HEAD + "- {name: a, type: plane, pose: truth, texture: {cell: [1, 1], values: []}}\n", r"surfaces\.0\.texture \(line 3\): values must be a list of rows of reflectivities"),
    "texture of one row": (HEAD + "- {name: a, type: plane, pose: truth, texture: {cell: [1, 1], values: [0.1]}}\n", r"values must be a list of rows"),
    "texture too bright": (HEAD + "- {name: a, type: plane, pose: truth, texture: {cell: [1, 1], values: [[0.1, 1.2]]}}\n", r"surfaces\.0\.texture\.values\.0\.1 \(line 3\): must be at most 1, found 1\.2"),
    "cell 0": (HEAD + "- {name: a, type: plane, pose: truth, texture: {cell: [0, 1], values: [[0.1]]}}\n", r"texture\.cell\.0 \(line 3\): must be greater than 0 m"),
    "negative sigma": (HEAD + "- {name: a, type: plane, pose: truth, pose_sigma: [0.001, -1]}\n", r"pose_sigma\.1 \(line 3\): must be at least 0"),
    "free angle": (HEAD + "- {name: a, type: plane, pose: {position: [0, 0, 2], free: [z, tilt]}}\n", r"surfaces\.0\.pose\.free\.1 \(line 3\): unknown value 'tilt'"),
    "motion": (HEAD + WALL + "camera_motion: {linear: [0, 1]}\n", r"camera_motion\.linear \(line 4\): expected 3 values, found 2"),
    "frames 0": (HEAD + WALL + "schedule:\n- {frames: 0}\n", r"schedule\.0\.frames \(line 5\): must be at least 1, found 0"),
    "rate 0": (HEAD + WALL + "schedule:\n- {rate: 0}\n", r"schedule\.0\.rate \(line 5\): must be at least 0.001 Hz"),
    "setting 0": (HEAD + WALL + "schedule:\n- {integration_time: 0}\n", r"schedule\.0\.integration_time \(line 5\): must be greater than 0"),
    "uptime before": (HEAD + WALL + "schedule:\n- {uptime: -1}\n", r"schedule\.0\.uptime \(line 5\): must be at least 0 s"),
    "key of a surface": (HEAD + WALL + "reflectivity_sigma: 0.5\n", r"reflectivity_sigma \(line \d+\): unknown key \(it is a key of surfaces\)"),
    "key in a station": (HEAD + WALL + "schedule:\n- {frames: 3, ambeint: 20}\n", r"schedule\.0\.ambeint \(line 5\): unknown key \(did you mean 'ambient'\?\)"),
    "plane at the lens": (HEAD + "- {name: a, type: plane, pose: {position: [0, 0, 1e-100]}}\n", r"scene\.yaml: surfaces\.0\.pose\.position \(line 3\): 'a' lies 1e-100 m from the optical centre \(place it 0\.001 m away or more, x y z in metres"),
    "plane through the lens": (HEAD + "- {name: a, type: plane, pose: {position: [3, 4, 0]}}\n", r"position \(line 3\): 'a' lies 0 m from the optical centre"),
    "station at the lens": (HEAD + WALL + "schedule:\n- {poses: {a: {position: [0, 0, 1e-300]}}}\n", r"schedule\.0\.poses\.a\.position \(line 5\): 'a' lies 1e-300 m from the optical centre"),
    "disc at the lens": (HEAD + "- {name: a, type: disc, radius: 0.5, pose: {position: [0.4, 0, 0.0009]}}\n", r"position \(line 3\): 'a' lies 0\.0009 m from the optical centre"),
    "sphere through the lens": (HEAD + "- {name: a, type: sphere, radius: 5, pose: {position: [3, 4, 0]}}\n", r"position \(line 3\): 'a' lies 0 m from the optical centre"),
    "schedule that is a group": (HEAD + WALL + "schedule: {frames: 3}\n", r"schedule \(line 4\): expected a list, found a group of keys"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults(tmp_path: Path, fault: str) -> None:
    text, match = FAULTS[fault]
    with pytest.raises(InputError, match=match):
        load(tmp_path, text)


# --- geometry -------------------------------------------------------------------------------------


@settings(derandomize=True, max_examples=80, deadline=None)
@given(
    angles=st.tuples(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3)),
    position=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.5, 4)),
    ray=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)),
)
def test_a_point_on_a_plane(
    angles: tuple[float, float, float], position: tuple[float, float, float], ray: tuple[float, float]
) -> None:
    """Whatever is met lies on it, before the camera, and is seen from either side."""
    rotation = Rotation.from_euler("xyz", angles)
    found = seen(Surface(name="a", type="plane", pose=ScenePose(position, quat("xyz", angles))), [*ray, 1.0])
    unit = np.array([*ray, 1.0]) / math.hypot(*ray, 1.0)
    normal = rotation.as_matrix()[:, 2]
    along, height = unit @ normal, np.array(position) @ normal
    if abs(along) < 1e-6:
        return
    length = height / along
    if length <= 0:
        assert not found.hit[0, 0]
        assert np.isnan(found.distance[0, 0])
        return
    assert found.distance[0, 0] == pytest.approx(length, rel=1e-9)
    np.testing.assert_allclose(found.points[0, 0], length * unit, rtol=1e-9, atol=1e-9)
    assert found.cos_incidence[0, 0] == pytest.approx(abs(along), abs=1e-12)
    # towards the camera
    assert found.normals[0, 0] @ unit == pytest.approx(-abs(along), abs=1e-12)
    assert found.incidence[0, 0] == pytest.approx(math.acos(min(abs(along), 1)), abs=1e-7)


def test_edges_of_a_turned_rectangle() -> None:
    """Full width along its own x, height along its own y, at z = 2 turned by 0.5 rad about the axis."""
    board = Surface(
        name="a", type="rectangle", size=(1.0, 0.4), pose=ScenePose((0.1, -0.2, 2.0), quat("z", 0.5))
    )
    c, s = math.cos(0.5), math.sin(0.5)
    for x, y, inside in (
        (0.499, 0.199, True),
        (0.501, 0.0, False),
        (0.0, -0.201, False),
        (-0.499, -0.199, True),
        (0.3, 0.3, False),
    ):
        point = [0.1 + c * x - s * y, -0.2 + s * x + c * y, 2.0]
        assert bool(seen(board, point).hit[0, 0]) is inside, (x, y)


def test_texture_lies_in_the_surfaces_frame() -> None:
    texture = Texture((0.2, 0.1), NestedList(np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])))
    surface = Surface(
        name="a",
        type="plane",
        texture=texture,
        reflectivity=0.99,
        pose=ScenePose((0.3, 0.1, 2.0), quat("xyz", [0.2, -0.3, 0.7])),
    )
    rotation = Rotation.from_euler("xyz", [0.2, -0.3, 0.7]).as_matrix()
    for x, y in ((0.05, 0.05), (0.25, 0.05), (-0.05, 0.05), (-0.25, -0.15), (0.61, -0.05), (-0.41, 0.33)):
        point = np.array([0.3, 0.1, 2.0]) + rotation[:, 0] * x + rotation[:, 1] * y
        expected = texture.values.values[math.floor(y / 0.1) % 2, math.floor(x / 0.2) % 3]
        assert seen(surface, point).reflectivity[0, 0] == expected, (x, y)


def test_spheres_are_seen_from_outside_only() -> None:
    def ball(z: float) -> Surface:
        return Surface(name="a", type="sphere", radius=0.5, pose=ScenePose((0.0, 0.0, z)))

    found = seen(ball(2.0), [[0, 0, 1], [0.1, 0.2, 1], [0, 0.25, 1], [0, 0.27, 1]])
    assert found.hit[0].tolist() == [True, True, True, False]
    # tangent where sin = r / z
    for x, y in ((0.1, 0.2), (0.0, 0.25)):
        unit = np.array([x, y, 1]) / math.hypot(x, y, 1)
        b, c = -2 * 2.0 * unit[2], 4 - 0.25
        length = (-b - math.sqrt(b * b - 4 * c)) / 2
        k = [(0.1, 0.2), (0.0, 0.25)].index((x, y)) + 1
        assert found.distance[0, k] == pytest.approx(length, rel=1e-12)
        normal = (length * unit - [0, 0, 2.0]) / 0.5
        np.testing.assert_allclose(found.normals[0, k], normal, atol=1e-12)
        assert found.cos_incidence[0, k] == pytest.approx(-unit @ normal, rel=1e-12)
    assert not seen(ball(0.3), [0, 0, 1]).hit.any()
    assert not seen(ball(-2.0), [0, 0, 1]).hit.any()


@settings(derandomize=True, max_examples=50, deadline=None)
@given(
    linear=st.tuples(*[st.floats(-2, 2)] * 3),
    angular=st.tuples(*[st.floats(-2, 2)] * 3),
    a=st.floats(-0.5, 1),
    b=st.floats(-0.5, 1),
)
def test_motion_of_a_constant_twist_adds_up(
    linear: tuple[float, ...], angular: tuple[float, ...], a: float, b: float
) -> None:
    motion = CameraMotion(linear, angular)  # type: ignore[arg-type]
    pose = Pose((0.3, -0.4, 2.0), quat("xyz", [0.3, 0.1, -0.7]))
    one, two = motion.carry(motion.carry(pose, a), b), motion.carry(pose, a + b)
    np.testing.assert_allclose(one.position, two.position, atol=1e-9)
    turned = Rotation.from_quat(one.orientation) * Rotation.from_quat(two.orientation).inv()
    assert turned.magnitude() < 1e-7


def test_directions_of_motion() -> None:
    """Forward brings a wall nearer; a turn of the camera to the right moves things to the left."""
    pose = Pose((0.0, 0.0, 2.0))
    assert CameraMotion((0.0, 0.0, 0.5), (0.0, 0.0, 0.0)).carry(pose, 2.0).position == (0.0, 0.0, 1.0)
    # positive about y (down) carries z towards x: the camera looks to its right
    moved = CameraMotion((0.0, 0.0, 0.0), (0.0, 0.1, 0.0)).carry(pose, 1.0)
    assert moved.position == pytest.approx((-2 * math.sin(0.1), 0.0, 2 * math.cos(0.1)))
    assert CameraMotion().carry(pose, 5.0) is pose


# --- simulation -----------------------------------------------------------------------------------


def walls() -> Scene:
    left = Surface(name="left", type="plane", pose=ScenePose((0, 0, 2.0), quat("y", -0.7)), reflectivity=0.9)
    right = Surface(name="right", type="plane", pose=ScenePose((0, 0, 2.0), quat("y", 0.8)), reflectivity=0.4)
    return Scene(surfaces=(left, right))


def exposure(scene: Scene, station: int = 0, stamp: int = 10**9, **change: Any) -> Exposure:
    return Exposure(
        stamp=stamp, settings=replace(SETTINGS, **change), poses=scene.fixed_poses(), station=station
    )


def test_no_surface_no_measurement() -> None:
    """A ray that meets none delivers 0 and 0."""
    board = Surface(name="a", type="rectangle", size=(0.5, 0.4), pose=ScenePose((0.1, 0, 1.5)))
    scene = Scene(surfaces=(board,))
    frame = Simulation(CAMERA, scene).frame(exposure(scene))
    hit = see(scene, scene.fixed_poses(), CAMERA.rays).hit
    assert 0.02 < hit.mean() < 0.9
    np.testing.assert_array_equal(frame.distance > 0, hit)
    assert (frame.amplitude[~hit] == 0).all()
    assert (frame.distance.dtype, frame.amplitude.dtype) == (np.uint16, np.uint16)
    away = Scene(surfaces=(replace(board, pose=ScenePose((0, 0, -1.5))),))
    simulation = Simulation(CAMERA, away)
    with pytest.raises(InputError, match="no ray of the camera meets a surface"):
        simulation.frame(exposure(away))


def test_a_black_surface_is_no_measurement() -> None:
    black = Scene(surfaces=(Surface(name="a", type="plane", pose=ScenePose((0, 0, 2.0)), reflectivity=0.0),))
    frame = Simulation(CAMERA, black).frame(exposure(black))
    assert not frame.distance.any()
    assert not frame.amplitude.any()


@pytest.mark.filterwarnings("error")
def test_hardly_any_light_is_noise_within_the_range() -> None:
    dark = Scene(surfaces=(Surface(name="a", type="plane", pose=ScenePose((0, 0, 3.0)), reflectivity=1e-6),))
    frame = Simulation(CAMERA, dark, seed=1).frame(exposure(dark))
    assert (frame.distance >= 1).all()
    assert frame.distance.std() == pytest.approx(65536 / math.sqrt(12), rel=0.1)


def test_power_is_of_the_station_and_of_all_light() -> None:
    """gain_sigma scales direct and bounced light alike, whatever was simulated before."""
    cam = replace(CAMERA, radiometry=Radiometry(gain=400.0, gain_sigma=0.2))
    cam = with_effects(cam, {"multipath": Multipath(1.0)})
    options: dict[str, Any] = {"seed": 5, "noise": False, "quantised": False}
    running = Simulation(cam, walls(), **options)
    base = Simulation(replace(cam, radiometry=Radiometry(gain=400.0)), walls(), **options).frame(
        exposure(walls())
    )
    powers = []
    for station in (0, 3, 3, 1, 0):
        frame = running.frame(exposure(walls(), station))
        alone = Simulation(cam, walls(), **options).frame(exposure(walls(), station))
        np.testing.assert_allclose(frame.amplitude, alone.amplitude, rtol=1e-6)
        np.testing.assert_allclose(frame.distance, base.distance, atol=1e-6)
        ratio = frame.amplitude / base.amplitude
        assert np.ptp(ratio) < 1e-6
        powers.append(float(ratio.mean()))
    assert powers[0] == pytest.approx(powers[4])
    assert powers[1] == pytest.approx(powers[2])
    assert len({round(p, 6) for p in powers}) == 3


def test_bounced_light_follows_what_lights_it() -> None:
    """The light is kept for a scene at rest, but not where amplitudes change otherwise."""
    scene = walls()
    simulation = Simulation(with_effects(CAMERA, {"multipath": Multipath(1.0)}), scene, noise=False)
    context = simulation.context(exposure(scene))
    assert context.geometry_at is not None
    signal = simulation.signal(context)
    geometry, amplitude = context.geometry_at(0.0)
    plain = replace(signal, distance=geometry.distance, amplitude=amplitude, offset=0.0)
    whole = Multipath(1.0).bounced(plain, context)
    half = np.where(geometry.surface == 0, amplitude, 0.0)
    part = Multipath(1.0).bounced(replace(plain, amplitude=half), context)
    rest = Multipath(1.0).bounced(replace(plain, amplitude=amplitude - half), context)
    # the bounce is linear in the light
    np.testing.assert_allclose(part + rest, whole, atol=1e-5 * np.abs(whole).max())
    assert np.abs(part - whole).max() > 0.1 * np.abs(whole).max()


def test_saturation_clips_after_compression_and_noise() -> None:
    cam = replace(CAMERA, sensor=replace(CAMERA.sensor, saturation=4400.0))
    cam = with_effects(cam, {"amplitude_nonlinearity": AmplitudeNonlinearity(5e-5)})
    scene = Scene(surfaces=(Surface(name="a", type="plane", pose=ScenePose((0, 0, 2.0)), reflectivity=0.8),))
    cosine = CAMERA.rays[..., 2]
    a = 500 * 60 * 0.8 * cosine / (2 / cosine) ** 2
    published = a / (1 + 5e-5 * a)
    frame = Simulation(cam, scene, noise=False).frame(exposure(scene))
    np.testing.assert_array_equal(frame.amplitude, np.rint(np.minimum(published, 4400)))
    assert (frame.amplitude == 4400).any()
    assert (frame.amplitude < 4400).any()
    noisy = Simulation(cam, scene, seed=3).frame(exposure(scene))
    assert noisy.amplitude.max() == 4400
    assert ((noisy.amplitude == 4400) & (published < 4400)).any()


def test_square_wave_is_the_cyclic_error_of_its_harmonics() -> None:
    """To second order: sin(4 phi) by a5 - a3 + a5 a7 - a3 a9, sin(8 phi) by a9 - a7 + (a3^2 - a5^2) / 2, and so on."""
    wave = Waveform.square(0.36, integration_share=0.52, orders=9)
    a = {order: strength.real for order, strength in wave.harmonics}
    by_order = {
        4: a[5] - a[3] + a[5] * a[7] - a[3] * a[9],
        8: a[9] - a[7] + (a[3] ** 2 - a[5] ** 2) / 2,
        12: a[3] * a[7] - a[5] * a[9],
        16: (a[7] ** 2 - a[9] ** 2) / 2,
    }
    turn = L / (2 * math.pi)
    # a negative amplitude is a phase of pi
    closed = CyclicError(
        tuple(Harmonic(n, abs(x) * turn, 0.0 if x > 0 else math.pi) for n, x in by_order.items())
    )
    tilted = Surface(name="a", type="plane", pose=ScenePose((0, 0, 2.4), quat("y", 1.1)))
    scene = Scene(surfaces=(tilted,))
    options: dict[str, Any] = {"noise": False, "quantised": False}
    sampled = Simulation(CAMERA, scene, waveform=wave, **options).frame(exposure(scene)).distance
    plain = Simulation(CAMERA, scene, **options).frame(exposure(scene)).distance
    formula = Simulation(with_effects(CAMERA, {"cyclic_error": closed}), scene, **options)
    expected = formula.frame(exposure(scene)).distance
    assert np.nanmax(np.abs(sampled - plain)) > 0.05
    assert max(abs(x) for x in a.values()) < 0.2
    # the third-order term of the logarithm of 1 + z, |z| at most the sum of the odd harmonics
    largest = sum(abs(a[h]) for h in (3, 5, 7, 9))
    assert np.nanmax(np.abs(sampled - expected)) < largest**3 / 3 * 1.1 * turn < 2e-3


def test_effects_see_the_time_since_the_first_frame() -> None:
    scene = walls()
    simulation = Simulation(CAMERA, scene)
    stamps = [5 * 10**9, 6 * 10**9, 9 * 10**9]
    assert [simulation.context(exposure(scene, stamp=s)).time for s in stamps] == [0.0, 1.0, 4.0]


def test_a_frame_says_what_was_set_and_where_things_are() -> None:
    scene = walls()
    frame = Simulation(CAMERA, scene).frame(
        exposure(scene, stamp=77, uptime=3.5, ambient_temperature=21.0, extra=MappingProxyType({"a": "b"}))
    )
    assert frame.stamp == 77
    assert (frame.settings.integration_time, frame.settings.uptime) == (60.0, 3.5)
    assert frame.settings.extra == {"a": "b"}
    assert frame.truth == scene.fixed_poses()
    assert frame.pose_stamps == {"left": 77, "right": 77}
    assert frame.intrinsics == CAMERA.intrinsics
    assert frame.shape == (23, 31)
