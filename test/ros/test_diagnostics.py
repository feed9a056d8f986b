"""Diagnostics of running nodes: what is said in a known situation, and at which level."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import PointCloud2

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects.warm_up_drift import WarmUpDrift
from rim_camera_ros.files import find_camera
from test.ros.harness import BEST_EFFORT, World

OK, WARN, ERROR = 0, 1, 2


def test_a_healthy_chain(world: World, tmp_path: Path) -> None:
    scene = tmp_path / "warm.yaml"
    scene.write_text(
        "format: rim_scene/1\n"
        "surfaces:\n- {name: wall, type: plane, pose: {position: [0, 0, 2.5]}, reflectivity: 0.8}\n"
        "schedule:\n- {frames: 100000, rate: 25, uptime: 7200, ambient: 22}\n"
    )
    world.start("driver_node", scene=str(scene))
    world.start("correction_node")
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    said = world.diagnostics()
    names = [
        *(f"/camera/driver: {one}" for one in ("frames", "device")),
        *(
            f"/camera/correction: {one}"
            for one in ("frames", "pixels", "calibration", "warm-up", "consistency")
        ),
    ]

    def settled() -> bool:
        return "noise_ratio" in said.values(names[-1]) and all(said.level(one) == OK for one in names)

    assert world.until(settled), "\n".join(f"{one}: {said.message(one)}" for one in names)
    assert world.until(lambda: len(points) > 50)
    driver, correction = said.values(names[0]), said.values(names[2])
    assert float(driver["rate_hz"]) == pytest.approx(25.0, rel=0.05)
    assert float(correction["rate_hz"]) == pytest.approx(25.0, rel=0.05)
    assert 0 < float(correction["latency_median_ms"]) < 100
    assert float(correction["latency_p99_ms"]) >= float(correction["latency_median_ms"])
    assert float(said.values(names[3])["valid"]) > 0.9
    device = said.values(names[1])
    assert (device["state"], device["device"], device["integration_time"]) == ("active", "SR-3000", "100")
    assert said.of(names[1])[-1].hardware_id == "SR-3000"
    assert float(said.values(names[5])["drift_mm_per_min"]) == pytest.approx(0.0, abs=1e-3)
    assert float(said.values(names[6])["noise_ratio"]) == pytest.approx(1.0, abs=0.05)
    count = len(said.of(names[0]))
    world.until(lambda: False, 3.0)
    assert 2 <= len(said.of(names[0])) - count <= 4  # once a second


def test_warm_up_is_said_with_its_speed(world: World, tmp_path: Path) -> None:
    scene = tmp_path / "cold.yaml"
    scene.write_text(
        "format: rim_scene/1\nsurfaces:\n- {name: wall, type: plane, pose: {position: [0, 0, 2.5]}}\n"
        "schedule:\n- {frames: 100000, rate: 10, uptime: 60}\n"
    )
    world.start("driver_node", scene=str(scene))
    world.start("correction_node")
    infos = world.collect(DiagnosticArray, "frame_info", BEST_EFFORT)
    said = world.diagnostics()
    name = "/camera/correction: warm-up"
    assert world.until(lambda: infos and "drifting" in said.message(name)), world.output()
    effect = load_camera(find_camera("sr3000")).effects["warm_up_drift"]
    assert isinstance(effect, WarmUpDrift)
    values = said.values(name)
    expected = 6e4 * effect.rate(float(values["uptime_s"]))
    assert float(values["drift_mm_per_min"]) == pytest.approx(expected, rel=0.01)
    found = re.fullmatch(r"still drifting (\d+) mm/min, corrected by its mean law", said.message(name))
    assert found
    assert int(found[1]) == pytest.approx(abs(expected), abs=0.6)
    assert said.level(name) == WARN
    assert world.set("correction", **{"effects.warm_up_drift": False}) == ""
    assert world.until(lambda: "mm/min, not corrected" in said.message(name)), said.message(name)


def test_outside_of_the_calibration(world: World) -> None:
    world.start("driver_node", scene="wall", integration_time=200.0)
    correction = world.start("correction_node")
    said = world.diagnostics()
    name = "/camera/correction: calibration"
    assert world.until(lambda: said.level(name) == WARN), world.output()
    assert said.message(name) == "integration time 200 is outside of the calibrated 16 to 100"
    assert said.values(name)["valid_integration_time"] == "16 to 100"
    assert said.values(name)["file"] == "sr3000"
    assert world.until(lambda: "calibration: integration time 200" in correction.text)
    assert world.set("driver", integration_time=60.0) == ""
    assert world.until(lambda: said.level(name) == OK), said.message(name)


def test_a_camera_that_no_longer_matches_its_calibration(world: World, tmp_path: Path) -> None:
    folder = find_camera("sr3000").parent
    for file in folder.glob("sr3000*.npy"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    text = (folder / "sr3000.yaml").read_text()
    noisy = re.sub(r"\n  floor: 0\.0045 ", "\n  floor: 0.009 ", text)
    noisy = re.sub(r"\n  amplitude: 28\.0 ", "\n  amplitude: 56.0 ", noisy)
    assert noisy != text
    (tmp_path / "noisy.yaml").write_text(noisy)
    world.start("driver_node", scene="room", camera=str(tmp_path / "noisy.yaml"))
    world.start("correction_node")
    said = world.diagnostics()
    name = "/camera/correction: consistency"
    assert world.until(lambda: said.level(name) == WARN), world.output()
    assert float(said.values(name)["noise_ratio"]) == pytest.approx(2.0, rel=0.05)
    assert "the camera no longer matches its calibration" in said.message(name)
    assert "rim diagnose BAG --camera sr3000" in said.message(name)


def test_frames_that_stop_are_an_error_and_come_back(world: World) -> None:
    driver = world.start("driver_node", scene="wall")
    world.start("correction_node")
    said = world.diagnostics()
    name = "/camera/correction: frames"
    assert world.until(lambda: said.level(name) == OK), world.output()
    driver.kill()
    assert world.until(lambda: said.level(name) == ERROR), world.output()
    assert re.match(r"no frame for \d\.\d s", said.message(name))
    world.start("driver_node", scene="wall")
    assert world.until(lambda: said.level(name) == OK), said.message(name)


def test_nothing_to_see(world: World, tmp_path: Path) -> None:
    scene = tmp_path / "far.yaml"
    scene.write_text(
        "format: rim_scene/1\n"
        "surfaces:\n- {name: wall, type: plane, pose: {position: [0, 0, 7]}, reflectivity: 0.01}\n"
    )
    world.start("driver_node", scene=str(scene), integration_time=16.0)
    world.start("correction_node")
    said = world.diagnostics()
    name = "/camera/correction: pixels"
    assert world.until(lambda: said.level(name) == ERROR), world.output()
    assert "the camera sees nothing" in said.message(name)
    assert float(said.values(name)["low_amplitude"]) > 0.99
