"""A gate that opens late: found in a recording that its true gates made, as a wrong parameter."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.camera_file import load_camera, save_camera
from rim_camera_ros.cli import main
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.files import find_camera
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.scene import load_scene


def board(path: Path) -> Path:
    """Write a board at twelve poses over the range of the gates, brighter exposed the farther it is."""
    lines = [
        "format: rim_scene/1",
        "surfaces:",
        "- {name: board, type: rectangle, size: [3.0, 2.4], pose: truth, reflectivity_sigma: 0.02,",
        "   texture: {cell: [0.2, 0.2], values: [[0.3, 0.8], [0.6, 0.45]]}}",
        "schedule:",
    ]
    for i in range(12):
        z, half = 0.5 + 0.19 * i, 0.125 * math.sin(2.1 * i)
        pose = (
            f"{{position: [0, 0, {z:.3f}], orientation: [0, {math.sin(half):.6f}, 0, {math.cos(half):.6f}]}}"
        )
        time = max(2, round(14 * z * z))
        lines.append(f"- {{frames: 10, rate: 10, integration_time: {time}, poses: {{board: {pose}}}}}")
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.slow
@pytest.mark.parametrize(("late", "verdict"), [(2e-10, "wrong_parameters"), (0.0, "consistent")])
def test_a_late_gate_is_a_wrong_parameter(late: float, verdict: str, tmp_path: Path) -> None:
    """The device evaluates what the true gates let through as if they opened when the file says."""
    whole = load_camera(find_camera("gated"))
    stated = replace(
        whole,
        sensor=replace(whole.sensor, width=48, height=36),
        optics=replace(whole.optics, fx=40.0, fy=40.0, cx=23.5, cy=17.5),
        noise=replace(whole.noise, shot=1.32, amplitude=46.0),
    )
    gates = list(stated.measurement.gates)
    gates[1] = replace(gates[1], delay=gates[1].delay + late)
    true = replace(stated, measurement=replace(stated.measurement, gates=tuple(gates)))
    scene = load_scene(board(tmp_path / "board.yaml"))
    simulation = measurement_of(true).simulation(true, scene, seed=21)
    estimator = stated.measurement.estimator(stated)
    with RecordingWriter(tmp_path / "bag") as writer:
        for exposure in Timeline(scene, true, start=10**9):
            frame = simulation.frame(exposure)
            planes = np.moveaxis(frame.images["gates"], -1, 0)
            found = estimator.estimate(planes.reshape(3, -1)).distance.reshape(stated.shape)
            counts = np.rint(np.nan_to_num(found) / stated.sensor.lsb).astype(np.uint16)
            writer.write_raw(replace(frame, distance=counts, images={}))
    save_camera(stated, tmp_path / "camera.yaml")
    given = ["diagnose", "bag", "--camera", "camera.yaml", "--scene", "board.yaml", "--out", "out", "--quiet"]
    given = [str(tmp_path / one) if (tmp_path / one).exists() or one == "out" else one for one in given]
    assert main(given) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == verdict
    assert report["missing"] == []
    assert [one["effect"] for one in report["adjusted"]] == (["gate_timing"] if late else [])
    if late:
        # how the error changes over the range: that of gate 1 alone, against gate 0
        to = report["adjusted"][0]["to"]
        assert to["delay.1"] - to["delay.0"] - to["width.0"] == pytest.approx(late, rel=0.25)
