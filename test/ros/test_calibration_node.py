"""The calibration node: recordings and live topics become a camera file while frames flow."""

from __future__ import annotations

import json
import re
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import SetBool, Trigger

from rim_camera_ros.camera_file import load_camera, save_camera
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.nodes.calibration.supervision import WorkProcess
from rim_camera_ros.pipeline.correct import Correction
from test.calibrate.bags import frames, write
from test.calibrate.helpers import SCENE, camera, scene
from test.helpers_cli import nothing_left, run
from test.ros.harness import LATCHED, Chain, Diagnosed, World

TRUE = CyclicError((Harmonic(4, 0.012, 0.8),))
STATED = CyclicError((Harmonic(4, 0.008, 0.5),))
AMPLITUDE = "effects.cyclic_error.harmonics.0.amplitude"
WORK = "/camera/calibration: work"
RESULT = "/camera/calibration: result"
PROGRESS = "/camera/calibration: progress"


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, the scene of it, the true camera and the camera file to start from."""
    folder = tmp_path_factory.mktemp("laboratory")
    truth = camera(folder, TRUE)
    (folder / "scene.yaml").write_text(SCENE)
    write(folder / "bag", frames(truth, scene(folder), poses=15, repeats=3, seed=2))
    save_camera(truth, folder / "truth.yaml")
    save_camera(replace(truth, effects={"cyclic_error": STATED}), folder / "start.yaml")
    return folder


def moving_board(path: Path) -> str:
    """Write the scene with a schedule of 16 poses of 3 frames, for a simulated driver; return its name."""
    turns = ("0, 0, 0, 1", "0.28, 0, 0, 0.96", "0, -0.28, 0, 0.96", "-0.096, 0.28, 0, 0.95518794")
    lines = ["schedule:"]
    for k in range(16):
        pose = f"{{position: [0.0{k % 3}, 0.0{k % 2}, {0.7 + 0.23 * k:.2f}], orientation: [{turns[k % 4]}]}}"
        lines.append(
            f"- {{frames: 3, rate: 20, integration_time: {(16, 60, 100)[k % 3]}, uptime: {100 + 50 * k}, "
            f"ambient: 20.0, poses: {{board: {pose}}}}}"
        )
    path.write_text(SCENE + "\n".join(lines) + "\n")
    return str(path)


class Node:
    """A running calibration node, what it tells, and the folder that it writes into."""

    def __init__(self, world: World, folder: Path, laboratory: Path, **parameters: Any) -> None:
        self.world, self.folder = world, folder
        given = {
            "camera": str(laboratory / "start.yaml"),
            "scene": str(laboratory / "scene.yaml"),
            "recordings": str(laboratory / "bag"),
            "effects": "cyclic_error",
            "folders": str(folder),
        }
        self.process = world.start("calibration_node", **(given | parameters))
        self.progress = Diagnosed(world.collect(DiagnosticArray, "calibration/progress"))
        self.result = Diagnosed(world.collect(DiagnosticArray, "calibration/result", LATCHED))
        self.coverage = Diagnosed(world.collect(DiagnosticArray, "coverage", LATCHED))
        self.diagnostics = world.diagnostics()

    def call(self, service: str) -> str:
        """Call ``start`` or ``cancel``; return the reason of a refusal, or ''."""
        response = self.world.call(Trigger, f"calibration/{service}")
        assert response.message
        return "" if response.success else str(response.message)

    def record(self, begin: bool) -> str:
        """Begin or finish a recording; return the reason of a refusal, or ''."""
        response = self.world.call(SetBool, "calibration/record", data=begin)
        assert response.message
        return "" if response.success else str(response.message)

    def wait(self, condition: Callable[[], object], seconds: float = 60.0) -> None:
        assert self.world.until(condition, seconds), (
            f"{self.result.message(RESULT)}\n{self.progress.message(PROGRESS)}\n{self.world.output()}"
        )

    def ended(self, seconds: float = 60.0) -> dict[str, str]:
        """Wait for one more result, and return its values."""
        self.wait(lambda: self.result.of(RESULT), seconds)
        values = self.result.values(RESULT)
        values["message"] = self.result.message(RESULT)
        self.result.clear()
        return values

    def stages(self) -> set[str]:
        """Return the stages of the progress so far."""
        return {
            pair.value for one in self.progress.of(PROGRESS) for pair in one.values if pair.key == "stage"
        }

    def begin_and_adjust(self) -> int:
        """Start, wait until the adjustment has begun, and return the id of the process."""
        self.progress.clear()
        assert self.call("start") == ""
        self.wait(lambda: "held-out poses" in self.stages() or len(self.stages()) > 3)
        return int(self.progress.values(PROGRESS)["pid"])


def test_bad_parameters_are_refused_with_the_remedy(world: World, laboratory: Path, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    (folder / "taken.yaml").write_text("somebody's")
    node = Node(world, folder, laboratory, recordings="", scene="")
    assert re.search(r"^recordings: none is given \(name recordings, joined by ':'", node.call("start"))
    for values, reason in (
        ({"recordings": "/etc"}, r"^/etc: recordings: lies outside of the folders .*folders:=FOLDER"),
        ({"scene": "/etc/passwd"}, r"^/etc/passwd: scene: lies outside of the folders"),
        ({"output": "../start"}, r"^output: '\.\./start' is not a name of a file \(letters, digits"),
        ({"record_as": "a/b"}, r"^record_as: 'a/b' is not a name of a file"),
    ):
        assert re.search(reason, world.set("calibration", **values)), values
    missing = str(folder / "missing")
    assert world.set("calibration", recordings=missing) == ""
    assert node.call("start") == f"{missing}: recordings: no such recording (check its path)"
    bag = folder / "bag"
    bag.symlink_to(folder)  # within the folder, and no recording
    assert world.set("calibration", recordings=f"{bag}:{bag}") == ""
    assert "recordings: is given twice" in node.call("start")
    assert world.set("calibration", recordings=str(bag)) == ""
    assert node.call("start").startswith("scene: is empty (name the scene file")
    assert world.set("calibration", scene="bord") == ""
    assert re.search(r"^bord: scene: no scene file of this name \(did you mean 'board'", node.call("start"))
    assert world.set("calibration", scene="board", output="taken") == ""
    assert re.search(r"taken\.yaml: output: exists already \(give another name\)", node.call("start"))
    assert re.search(r"^nothing is being done", node.call("cancel"))
    assert re.search(r"^nothing is being recorded", node.record(False))
    # what only reading tells comes as the result
    assert world.set("calibration", output="") == ""
    assert node.call("start") == ""
    ended = node.ended()
    assert (ended["state"], ended["work"]) == ("failed", "calibration")
    assert ended["reason"].startswith(f"{bag}: ")
    node.wait(lambda: node.diagnostics.level(WORK) == 2)
    assert f"the calibration failed: {bag}: " in node.diagnostics.message(WORK)
    assert (folder / "taken.yaml").read_text() == "somebody's"
    assert world.transition("calibration", "deactivate")
    assert node.call("start") == "the node is inactive (activate /camera/calibration)"


def test_cancelled_and_killed_work_leaves_nothing(world: World, laboratory: Path, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    node = Node(world, folder, laboratory, output="mine", effects="cyclic_eror")
    with nothing_left(folder), nothing_left(laboratory):
        before = {path: path.read_bytes() for path in laboratory.glob("*.yaml")}
        assert node.call("start") == ""
        reason = node.ended()["reason"]
        assert reason == "effects: unknown effect 'cyclic_eror' (did you mean 'cyclic_error'?)"
        assert world.set("calibration", effects="cyclic_error") == ""

        pid = node.begin_and_adjust()
        assert psutil.Process(pid).nice() == 10
        assert re.search(
            r"^a calibration runs already \(wait for its end, or call cancel\)", node.call("start")
        )
        assert node.record(True).startswith("a calibration runs already")
        begun = time.monotonic()
        assert node.call("cancel") == ""
        ended = node.ended()
        assert time.monotonic() - begun < 10.0
        assert ended["state"] == "cancelled"
        assert ended["message"] == "the calibration was cancelled; nothing was written"
        assert not psutil.pid_exists(pid)

        psutil.Process(node.begin_and_adjust()).kill()
        ended = node.ended()
        assert ended["state"] == "failed"
        assert ended["reason"].startswith("the calibration process was ended by SIGKILL (see what it wrote")
        node.wait(lambda: node.diagnostics.level(WORK) == 2)
        assert "was ended by SIGKILL" in node.diagnostics.message(WORK)

        # it starts again, and ends with the node
        pid = node.begin_and_adjust()
        node.wait(lambda: node.diagnostics.level(WORK) == 0)
        assert node.diagnostics.message(WORK).startswith("calibrating: ")
        node.process.send(signal.SIGINT)
        assert node.process.wait() == 0, node.process.text
        assert not psutil.pid_exists(pid)
        assert node.ended()["state"] == "cancelled"
        assert "Traceback" not in node.process.text
        assert {path: path.read_bytes() for path in before} == before


def test_from_live_frames_to_a_corrected_camera(
    world: World, laboratory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, start = tmp_path / "files", laboratory / "start.yaml"
    before = start.read_bytes()
    chain = Chain(
        world,
        driver={
            "camera": str(laboratory / "truth.yaml"),
            "scene": moving_board(tmp_path / "moving.yaml"),
            "exit_at_end": False,
        },
        correction={"camera": str(start), "folders": str(folder)},
    )
    node = Node(world, folder, laboratory, recordings="", record_frames=48)
    assert node.record(True) == ""
    recorded = node.ended()
    bag = folder / "recording_1"
    assert (recorded["state"], recorded["file"], recorded["frames"]) == ("recorded", str(bag), "48")
    node.wait(lambda: world.get("calibration", "recordings") == [str(bag)])
    status, out, error = run(capsys, "info", bag, "--json")
    assert (status, error) == (0, "")
    assert json.loads(out)["frames"] == 48

    node.progress.clear()
    assert node.call("start") == ""
    node.wait(lambda: "reading frames" in node.stages())
    assert node.progress.values(PROGRESS)["state"] == "calibrating"
    # it answers meanwhile
    assert world.get("calibration", "output") == [""]
    ended = node.ended()
    out_file = folder / "calibrated_1.yaml"
    assert (ended["state"], ended["file"], ended["effects"]) == ("done", str(out_file), "cyclic_error")
    found = load_camera(out_file)
    assert found.covariance is not None
    where = list(found.covariance.parameters).index(AMPLITUDE)
    sigma = float(found.covariance.matrix.values[where, where]) ** 0.5
    assert 0 < sigma < 0.001
    fitted = found.effects["cyclic_error"]
    assert isinstance(fitted, CyclicError)
    assert fitted.harmonics[0].amplitude == pytest.approx(0.012, abs=4 * sigma)
    said = found.provenance["accuracy"]
    assert float(ended["systematic_mm"]) == pytest.approx(1e3 * said["systematic_m"], abs=2e-3)
    assert float(ended["chi_square"]) == pytest.approx(said["chi_square_per_value"], abs=1e-4)
    assert 0.8 < float(ended["chi_square"]) < 1.2
    assert Path(ended["report"]).read_text().startswith("<!DOCTYPE html>")
    assert found.provenance["recordings"][0]["path"] == str(bag)
    assert {"reading files", "reading frames", "noise", "held-out poses", "report"} <= node.stages()
    node.wait(lambda: node.diagnostics.message(WORK).startswith(f"done: {out_file}, systematic error "))
    assert node.diagnostics.level(WORK) == 0
    # who comes later receives it, too
    late = Diagnosed(world.collect(DiagnosticArray, "calibration/result", LATCHED))
    node.wait(lambda: late.of(RESULT))
    assert late.values(RESULT)["file"] == str(out_file)

    # the correction takes the new file between two frames
    assert world.set("correction", camera=str(out_file)) == ""
    count = len(chain.points)
    node.wait(lambda: len(chain.points) > count + 5)
    chain.driver.send(signal.SIGINT)
    chain.finish()
    clouds, raw = chain.clouds(), chain.raw_frames()
    assert [one.stamp for one in raw] == sorted(clouds)
    corrections = [Correction(load_camera(path)) for path in (start, out_file)]
    by_new = []
    for frame in raw:
        expected = [one.cloud(one.correct(frame)).tobytes() for one in corrections]
        by_new.append(expected.index(clouds[frame.stamp].tobytes()))
    assert by_new == sorted(by_new)
    assert 5 < sum(by_new) < len(by_new)
    assert start.read_bytes() == before


def test_a_recording_is_finished_or_cancelled(world: World, laboratory: Path, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    node = Node(world, folder, laboratory, record_as="desk")
    with nothing_left(folder):
        assert node.record(True) == ""
        node.wait(lambda: node.progress.values(PROGRESS).get("stage") == "frames")
        assert node.record(False) == ""
        ended = node.ended()
        assert ended["state"] == "failed"
        assert "no frame came on /camera/distance/image_raw (is a driver running" in ended["reason"]
    world.start("driver_node", camera=str(laboratory / "truth.yaml"), scene="wall")
    with nothing_left(folder):
        assert node.record(True) == ""
        node.wait(lambda: int(node.progress.values(PROGRESS).get("done", "0")) > 3)
        before = node.progress.values(PROGRESS)["pid"]
        assert node.call("cancel") == ""
        assert node.ended()["state"] == "cancelled"
    assert node.record(True) == ""
    # what the first one published may still be on its way
    node.wait(lambda: node.progress.values(PROGRESS)["pid"] != before)
    node.wait(lambda: int(node.progress.values(PROGRESS).get("done", "0")) > 3)
    # the driver shows a wall, the scene is of a board
    node.wait(lambda: node.coverage.level("coverage") == 2)
    assert "no frame has the pose of 'board' so far" in node.coverage.message("coverage")
    # where the process of the coverage ends, that is said, and the recording goes on
    (evaluation,) = psutil.Process(int(node.progress.values(PROGRESS)["pid"])).children()
    evaluation.kill()
    node.wait(lambda: "was ended by SIGKILL" in node.coverage.message("coverage"))
    reached = int(node.progress.values(PROGRESS)["done"])
    node.wait(lambda: int(node.progress.values(PROGRESS)["done"]) > reached)
    # with the node ends the recording, which keeps what has come
    node.process.send(signal.SIGINT)
    assert node.process.wait() == 0, node.process.text
    ended = node.ended()
    assert (ended["state"], ended["file"]) == ("recorded", str(folder / "desk"))
    assert int(ended["frames"]) > 3
    assert [one.name for one in folder.iterdir()] == ["desk"]


def test_work_ends_with_a_node_that_was_killed(laboratory: Path, tmp_path: Path) -> None:
    request = {
        "recordings": [str(laboratory / "bag")],
        "camera": str(laboratory / "start.yaml"),
        "scene": [str(laboratory / "scene.yaml")],
        "effects": ["cyclic_error"],
        "geometry": False,
        "output": str(tmp_path / "never.yaml"),
        "niceness": 3,
        "command": "test",
    }
    work = WorkProcess("calibration", request)
    progress, end = work.poll()
    while not progress and end is None:
        threading.Event().wait(0.02)
        progress, end = work.poll()
    assert end is None
    assert progress[0]["stage"] == "reading files"
    assert psutil.Process(work.pid).nice() == 3
    process = work._process
    assert process.stdin is not None
    process.stdin.close()  # as the end of the node does
    assert process.wait(20.0) in (0, 1)
    assert work.poll()[1] == {"cancelled": True}
    assert not list(tmp_path.iterdir())
