"""Parameters that are changed while nodes run: what takes effect, what is rejected and why."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects import registry
from rim_camera_ros.files import find_camera
from rim_camera_ros.pipeline.correct import Correction
from test.ros.harness import BEST_EFFORT, Collected, World, stamp_of


def fresh(world: World, collected: Collected, count: int = 3) -> Any:
    """Return the last of so many messages of frames that were taken from now on.

    By their stamps: on a busy machine frames from before a change may still be on their way when the service
    has answered. The simulator makes the next frame ahead of its time: the first may be of the old settings.
    """
    now = time.time_ns()

    def since() -> list[Any]:
        return [one for one in collected.messages[-100:] if stamp_of(one) >= now]

    assert world.until(lambda: len(since()) >= count), world.output()
    return since()[-1]


def info_of(message: Any) -> dict[str, str]:
    return {one.key: one.value for one in message.status[0].values}


def valid_pixels(message: Any) -> int:
    return int(np.isfinite(np.frombuffer(message.data, np.float32).reshape(-1, 4)[:, 2]).sum())


# --- driver -------------------------------------------------------------------------------------


def started_driver(world: World) -> tuple[World, Collected]:
    infos = world.collect(DiagnosticArray, "frame_info", BEST_EFFORT)
    world.start("driver_node", scene="wall", frame_rate=50)
    assert world.until(lambda: len(infos) > 2), world.output()
    return world, infos


@pytest.fixture
def driver(world: World) -> tuple[World, Collected]:
    return started_driver(world)


@pytest.fixture(scope="module")
def undisturbed_driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[World, Collected]]:
    """A driver for all tests that leave it as it is."""
    with World(tmp_path_factory.mktemp("driver")) as world:
        yield started_driver(world)


def test_integration_time_and_rate_take_effect(driver: tuple[World, Collected]) -> None:
    world, infos = driver
    assert info_of(infos.last)["integration_time"] == "100"
    uptime = float(info_of(infos.last)["uptime"])
    assert world.set("driver", integration_time=60, frame_rate=20.0) == ""  # a whole number will do
    assert info_of(fresh(world, infos))["integration_time"] == "60"
    assert float(info_of(infos.last)["uptime"]) > uptime  # the same camera goes on
    before = stamp_of(infos.last)
    assert (stamp_of(fresh(world, infos, 1)) - before) % 50_000_000 in (0, 1, 49_999_999)
    assert world.get("driver", "integration_time", "frame_rate") == [60.0, 20.0]
    assert world.set("driver", integration_time=0.0) == ""
    assert info_of(fresh(world, infos))["integration_time"] == "100"


def test_another_scene_and_camera(driver: tuple[World, Collected]) -> None:
    world, infos = driver
    images = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    assert fresh(world, images).width == 176
    assert world.set("driver", camera="pmd3ks", scene="board", frame_rate=10.0) == ""
    camera = load_camera(find_camera("pmd3ks"))
    assert (fresh(world, images).height, images.last.width) == camera.shape
    assert fresh(world, infos).status[0].hardware_id == camera.device


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"camera": "sr30000"}, r"sr30000: no camera file of this name \(did you mean 'sr3000'\?"),
        ({"scene": "nowhere"}, r"nowhere: no scene file of this name"),
        (
            {"scene": "nowhere/scene.yaml"},
            r"scene\.yaml: scene: lies outside of the folders that may be read",
        ),
        ({"camera": "/etc/passwd"}, r"/etc/passwd: camera: lies outside of the folders .* folders:=FOLDER"),
        ({"camera_info": "../../secret.yaml"}, r"secret\.yaml: camera_info: lies outside of the folders"),
        ({"recording": "/etc", "source": "playback"}, r"/etc: recording: lies outside of the folders"),
        ({"library": "/tmp/evil.so"}, r"read-only parameter: library"),
        ({"pause": True}, r"pause: only playback can stand still"),
        ({"integration_time": -1.0}, r"integration_time out of range Min: 0\.0"),
        ({"frame_rate": float("nan")}, r"frame_rate"),
        ({"source": "playback"}, r"recording: source playback needs a recording"),
        ({"source": "webcam"}, r"source: 'webcam' is not a choice \(one of: simulator, playback, sr3000\)"),
        ({"waveform": "triangle"}, r"waveform: unknown waveform 'triangle'"),
        ({"frames": 7}, r"read-only parameter: frames"),
        ({"loop": 3}, r"Wrong parameter type"),
        ({"integration_time": 60.0, "camera": "nope"}, r"nope: no camera file"),
        ({"frame_id": "/optical"}, r"frame_id must not begin with /"),
    ],
)
def test_rejected_changes_of_the_driver(
    undisturbed_driver: tuple[World, Collected], values: dict[str, Any], reason: str
) -> None:
    world, infos = undisturbed_driver
    before = world.get("driver", *values)
    assert re.search(reason, world.set("driver", **values)), reason
    assert world.get("driver", *values) == before
    assert info_of(fresh(world, infos))["integration_time"] == "100"


def test_descriptors(undisturbed_driver: tuple[World, Collected]) -> None:
    world, _ = undisturbed_driver
    described = world.describe("driver")
    described = {
        name: one
        for name, one in described.items()
        if name not in ("use_sim_time", "start_type_description_service")
    }
    assert all(one.description for one in described.values())
    assert described["frame_rate"].floating_point_range[0].to_value == 1000.0
    assert described["seed"].integer_range[0].from_value == 0
    assert described["qos.images"].read_only
    assert described["source"].additional_constraints == "one of: simulator, playback, sr3000"


# --- correction ---------------------------------------------------------------------------------


def started_chain(world: World, **correction: Any) -> tuple[World, Collected]:
    world.start("driver_node", scene="room", frame_rate=25.0, integration_time=100.0)
    world.start("correction_node", **correction)
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    assert world.until(lambda: len(points) > 2), world.output()
    return world, points


@pytest.fixture
def chain(world: World, tmp_path: Path) -> tuple[World, Collected]:
    return started_chain(world, folders=str(tmp_path))


@pytest.fixture(scope="module")
def undisturbed_chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[World, Collected]]:
    """Driver and correction for all tests that leave them as they are."""
    with World(tmp_path_factory.mktemp("chain")) as world:
        yield started_chain(world)


def test_minimum_amplitude(chain: tuple[World, Collected]) -> None:
    world, points = chain
    before = valid_pixels(points.last)
    assert world.set("correction", minimum_amplitude=3000.0) == ""
    bright = valid_pixels(fresh(world, points))
    assert 0 < bright < before / 2
    assert world.set("correction", minimum_amplitude=-1) == ""
    assert abs(valid_pixels(fresh(world, points)) - before) < 100
    assert "minimum_amplitude: -0.5 counts" in world.set("correction", minimum_amplitude=-0.5)
    assert world.get("correction", "minimum_amplitude") == [-1.0]


def test_effects_are_those_of_the_camera_file(undisturbed_chain: tuple[World, Collected]) -> None:
    world, _ = undisturbed_chain
    names = list(registry())
    values = world.get("correction", *(f"effects.{name}" for name in names))
    camera = load_camera(find_camera("sr3000"))
    assert dict(zip(names, values, strict=True)) == {name: name in camera.effects for name in names}
    assert all(world.describe("correction")[f"effects.{name}"].description for name in names)


def test_an_effect_is_switched_off_and_on(world: World) -> None:
    distances = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    amplitudes = world.collect(Image, "amplitude/image_raw", BEST_EFFORT)
    infos = world.collect(DiagnosticArray, "frame_info", BEST_EFFORT)
    corrected = world.collect(Image, "distance/image", BEST_EFFORT)
    world.start("driver_node", scene="wall")
    world.start("correction_node", **{"effects.ambient_temperature": False})
    assert world.until(lambda: len(corrected) > 2), world.output()
    camera = load_camera(find_camera("sr3000"))
    for off in (set(), {"cyclic_error"}, {"cyclic_error", "scattering"}):
        changes = {f"effects.{name}": name not in off for name in ("cyclic_error", "scattering")}
        assert world.set("correction", **changes) == ""
        expected = Correction(camera, without={*off, "ambient_temperature"})
        begin = stamp_of(fresh(world, corrected))
        stamps: set[int] = set()

        def paired(begin: int = begin, stamps: set[int] = stamps) -> set[int]:
            everything = (corrected, distances, amplitudes, infos)
            common = set.intersection(*(set(one.by_stamp()) for one in everything))
            stamps.update(stamp for stamp in common if stamp >= begin)
            return stamps

        assert world.until(paired), world.output()
        stamp = max(stamps)
        frame = _frame(distances.by_stamp()[stamp], amplitudes.by_stamp()[stamp], infos.by_stamp()[stamp])
        assert bytes(corrected.by_stamp()[stamp].data) == expected.correct(frame).distance.tobytes()


def _frame(distance: Any, amplitude: Any, info: Any) -> Any:
    from rim_camera_ros.bags.messages import image_array, settings_from
    from rim_camera_ros.frame import RawFrame

    return RawFrame(
        stamp=stamp_of(distance),
        distance=image_array(distance),
        amplitude=image_array(amplitude),
        settings=settings_from(info)[0],
    )


def test_another_camera_file_changes_the_set_of_effects(
    chain: tuple[World, Collected], tmp_path: Path
) -> None:
    world, points = chain
    assert world.set("correction", **{"effects.scattering": False}) == ""
    folder = find_camera("sr3000").parent
    for file in folder.glob("sr3000*.npy"):
        shutil.copy(file, tmp_path)
    path = tmp_path / "mine.yaml"
    shutil.copy(folder / "sr3000_every_effect.yaml", path)
    assert world.set("correction", camera=str(path)) == ""
    assert world.get("correction", "effects.multipath", "effects.scattering") == [True, False]
    assert valid_pixels(fresh(world, points)) > 0
    plain = _without_effects(tmp_path)
    assert world.set("correction", camera=str(plain)) == ""
    assert world.get("correction", "effects.multipath", "effects.cyclic_error") == [False, False]
    reason = world.set("correction", **{"effects.cyclic_error": True})
    assert re.search(
        r"effects\.cyclic_error: the camera file .*plain\.yaml has no effect 'cyclic_error'", reason
    )
    assert valid_pixels(fresh(world, points)) > 0


def _without_effects(folder: Path) -> Path:
    text = find_camera("sr3000").read_text()
    path = folder / "plain.yaml"
    path.write_text(text[: text.index("\neffects:")] + "\n")
    return path


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"camera": "sr300"}, r"sr300: no camera file of this name"),
        ({"camera": "pmd3ks"}, r"pmd3ks: the file is for \d+ x \d+ px, the images are 176 x 144"),
        (
            {"effects.multipath": True},
            r"effects\.multipath: the camera file sr3000 has no effect 'multipath'",
        ),
        ({"minimum_amplitude": 1e9}, r"minimum_amplitude out of range"),
        ({"qos.points": "reliable"}, r"read-only parameter: qos\.points"),
        ({"minimum_amplitude": 3000.0, "effects.multipath": True}, r"has no effect 'multipath'"),
    ],
)
def test_rejected_changes_of_the_correction(
    undisturbed_chain: tuple[World, Collected], values: dict[str, Any], reason: str
) -> None:
    world, points = undisturbed_chain
    before = world.get("correction", *values)
    pixels = valid_pixels(points.last)
    assert re.search(reason, world.set("correction", **values)), reason
    assert world.get("correction", *values) == before
    assert abs(valid_pixels(fresh(world, points)) - pixels) < 200


def test_camera_file_that_breaks_and_vanishes_while_running(world: World, tmp_path: Path) -> None:
    path = _without_effects(tmp_path)
    good = path.read_text()
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    driver = world.start("driver_node", folders=str(tmp_path))
    correction = world.start("correction_node", camera=str(path))
    assert world.until(lambda: len(points) > 2), world.output()
    path.write_text(good.replace("fx: 199.8875", "fx: [oops"))
    fresh(world, points)

    def reasons() -> list[str]:
        answer = world.call(Trigger, "correction/load_camera")
        assert not answer.success
        return [world.set("driver", camera=str(path)), answer.message]

    assert all(re.search(r"plain\.yaml: line \d+: not valid YAML", one) for one in reasons())
    path.unlink()
    fresh(world, points)
    assert all("plain.yaml: no such file" in one for one in reasons())
    fresh(world, points)
    path.write_text(re.sub("minimum_amplitude: null", "minimum_amplitude: 3000", good))
    before = valid_pixels(points.last)
    assert world.set("correction", camera=str(path)) == ""  # the value that it has: nothing is read
    assert abs(valid_pixels(fresh(world, points)) - before) < 200
    assert world.call(Trigger, "correction/load_camera").success
    assert valid_pixels(fresh(world, points)) < 0.75 * before
    assert driver.running
    assert correction.running
    assert "Traceback" not in world.output()
