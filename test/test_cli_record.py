"""``rim record`` of a running driver."""

from __future__ import annotations

import json
import re
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("rclpy")

import numpy as np
import psutil

from rim_camera_ros.bags import Recording, Topics
from rim_camera_ros.frame import Settings
from rim_camera_ros.nodes.common import messages

from .helpers_cli import nothing_left, process, run
from .ros.conftest import world  # noqa: F401 -- a fixture
from .ros.harness import LATCHED

if TYPE_CHECKING:
    from collections.abc import Callable

    from .ros.harness import World

pytestmark = pytest.mark.ros

#: A small simulated camera whose frames are the same in every run.
DRIVER = {
    "camera": "pmd3ks",
    "scene": "wall",
    "seed": 5,
    "frame_rate": 50.0,
    "integration_time": 17.0,
    "qos.images": "reliable",
    "qos.info": "reliable",
}


def test_a_number_of_frames_is_recorded_without_loss(world: World, tmp_path: Path) -> None:  # noqa: F811
    out = tmp_path / "bag"
    running = process("record", "--out", out, "--frames", "12", env=world.environment)
    driver = world.start("driver_node", frames=12, wait_for_subscribers=1, **DRIVER)
    text, err = running.communicate(timeout=60)
    assert (running.returncode, text) == (0, f"12 frames recorded: {out}\n"), err + driver.text
    assert "Ctrl-C ends it" in err
    with Recording(out) as recording:
        frames = list(recording.frames())
        assert recording.truth_surfaces == ("wall",)
    assert len(frames) == 12
    assert {one.settings.integration_time for one in frames} == {17.0}
    assert all(one.intrinsics is not None and one.intrinsics.width == 64 for one in frames)
    assert len({one.distance.tobytes() for one in frames}) == 12
    assert frames[0].truth["wall"].position == (0.0, 0.0, 2.463)
    assert np.median(frames[0].amplitude) > 100


def test_an_interrupted_recording_is_complete(
    world: World,  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Ctrl-C twice: status 0, the file is whole, in another namespace too."""
    out = tmp_path / "bag"
    arguments = ("--out", out, "--namespace", "/left")
    running = process("record", *arguments, env=world.environment)
    world.start("driver_node", "-r", "__ns:=/left", wait_for_subscribers=1, **DRIVER)
    end = world.until(lambda: any(one.stat().st_size > 50_000 for one in tmp_path.rglob("*.mcap")))
    assert end, world.output()
    running.send_signal(signal.SIGINT)
    running.send_signal(signal.SIGINT)
    text, err = running.communicate(timeout=30)
    assert running.returncode == 0, err
    assert "Traceback" not in err
    with Recording(out, topics=Topics("/left")) as recording:
        count = len(list(recording.frames()))
        assert recording.summary().damage is None
    assert count >= 3
    assert text.endswith(f" frames recorded: {out}\n")
    assert [one.name for one in tmp_path.iterdir() if one.name.startswith(".")] == []
    status, text, _ = run(capsys, "info", out, "--json", "--namespace", "/left")
    assert status == 0
    assert json.loads(text)["frames"] == count


def test_nothing_to_record(world: World, tmp_path: Path) -> None:  # noqa: F811
    (tmp_path / "out").mkdir()
    with nothing_left(tmp_path / "out"):
        running = process(
            "record", "--out", tmp_path / "out" / "bag", "--duration", "0.3", "--quiet", env=world.environment
        )
        text, err = running.communicate(timeout=30)
        assert (running.returncode, text) == (1, "")
        assert err.startswith("rim: no frame came on /camera/distance/image_raw (is a driver running")


def test_the_output_is_checked_before(world: World, tmp_path: Path) -> None:  # noqa: F811
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "notes.txt").write_text("mine")
    for more in ([], ["--force"]):
        running = process(
            "record", "--out", tmp_path / "bag", "--duration", "0.1", *more, env=world.environment
        )
        _, err = running.communicate(timeout=30)
        assert running.returncode == 2
        assert len(err.splitlines()) == 1
        assert "bag: " in err
        assert (tmp_path / "bag" / "notes.txt").read_text() == "mine"


def test_a_recording_begins_with_the_first_frame_that_has_its_settings(
    world: World,  # noqa: F811
    tmp_path: Path,
) -> None:
    """Topics are found one by one; images whose settings nobody has heard are of no use."""
    out = tmp_path / "bag"
    running = process("record", "--out", out, "--frames", "4", env=world.environment)
    camera = Driver(world)
    camera.publish_until(lambda: running.poll() is not None, with_settings_from=5)
    text, err = running.communicate(timeout=30)
    assert (running.returncode, text) == (0, f"4 frames recorded: {out}\n"), err
    with Recording(out) as recording:
        frames = list(recording.frames())
        assert not any(recording.skipped.values())
    first = frames[0].stamp // Driver.PERIOD
    assert first >= 5
    assert [one.stamp for one in frames] == [(first + k) * Driver.PERIOD for k in range(4)]
    assert [one.settings.integration_time for one in frames] == [17.0] * 4


def test_a_driver_without_settings_is_recorded_as_it_is(world: World, tmp_path: Path) -> None:  # noqa: F811
    out = tmp_path / "bag"
    running = process("record", "--out", out, "--frames", "4", env=world.environment)
    camera = Driver(world)
    camera.publish_until(lambda: running.poll() is not None, with_settings_from=None)
    text, err = running.communicate(timeout=30)
    assert (running.returncode, text) == (0, f"4 frames recorded: {out}\n"), err
    with Recording(out) as recording:
        assert {one.settings.integration_time for one in recording.frames()} == {None}


@pytest.mark.slow
def test_what_is_covered_is_said_and_published(world: World, tmp_path: Path) -> None:  # noqa: F811
    """On the terminal, as a topic and as a picture; the recording is the same as without."""
    from diagnostic_msgs.msg import DiagnosticArray
    from sensor_msgs.msg import Image

    out = tmp_path / "bag"
    states = world.collect(DiagnosticArray, "coverage", LATCHED)
    pictures = world.collect(Image, "coverage/image", LATCHED)
    coverage = ("--scene", "wall", "--camera", "pmd3ks")
    running = process("record", "--out", out, *coverage, env=world.environment)
    world.start("driver_node", wait_for_subscribers=1, **(DRIVER | {"frame_rate": 10.0}))
    assert world.until(lambda: len(states) > 0 and len(pictures) > 0, 240.0), world.output()
    running.send_signal(signal.SIGINT)
    text, err = running.communicate(timeout=60)
    assert running.returncode == 0, err
    assert "Traceback" not in err
    assert text.endswith(f" frames recorded: {out}\n")
    (status,) = states.messages[0].status
    values = {one.key: one.value for one in status.values}
    # a wall at one place, seen once: no sinusoid over the distance, nor a warm-up
    assert float(values["factor.cyclic_error"]) < 5
    assert "cyclic_error" in values["open"].split(",")
    assert values["at_rest"] == "true"
    assert values["next"] in err
    assert re.search(r"^station 1: 2\.\d\d m, .* frames, at rest$", err, flags=re.MULTILINE)
    assert (pictures.last.encoding, pictures.last.step) == ("rgb8", 3 * pictures.last.width)
    with Recording(out) as recording:
        assert len(list(recording.frames())) > 10
        assert not any(recording.skipped.values())


def test_a_recording_goes_on_where_its_coverage_ends(world: World, tmp_path: Path) -> None:  # noqa: F811
    """One line on the terminal and one error on the topic say that the process was killed."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    out = tmp_path / "bag"
    states = world.collect(DiagnosticArray, "coverage", LATCHED)
    coverage = ("--scene", "wall", "--camera", "pmd3ks")
    running = process("record", "--out", out, "--frames", "12", *coverage, env=world.environment)
    recording = psutil.Process(running.pid)
    assert world.until(recording.children, 30.0)
    for evaluation in recording.children():
        evaluation.kill()
    assert world.until(lambda: len(states) > 0, 30.0)
    world.start("driver_node", frames=12, wait_for_subscribers=1, **DRIVER)
    text, err = running.communicate(timeout=60)
    assert (running.returncode, text) == (0, f"12 frames recorded: {out}\n"), err
    (status,) = states.last.status
    assert (len(states), status.level) == (1, DiagnosticStatus.ERROR)
    assert status.message.startswith("its process was ended by SIGKILL (see")
    assert err.count(f"coverage: {status.message}\n") == err.count("coverage:") == 1


def test_coverage_needs_scene_and_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = ("record", "--out", tmp_path / "bag")
    for given, missing in (("--scene", "--camera"), ("--camera", "--scene")):
        status, _, err = run(capsys, *bag, given, "wall")
        assert (status, len(err.splitlines())) == (2, 1)
        assert f"{missing} is missing" in err
    status, _, err = run(capsys, *bag, "--scene", "wal", "--camera", "sr3000")
    assert (status, len(err.splitlines())) == (2, 1)
    assert "wal" in err


class Driver:
    """Publishes small frames once the images have a subscriber; settings may begin later."""

    PERIOD = 20_000_000

    def __init__(self, world: World) -> None:  # noqa: F811
        from diagnostic_msgs.msg import DiagnosticArray
        from sensor_msgs.msg import Image

        self._world = world
        self._info = DiagnosticArray
        self._images = {
            name: world.publisher(Image, f"{name}/image_raw") for name in ("distance", "amplitude")
        }

    def publish_until(self, done: Callable[[], bool], *, with_settings_from: int | None) -> None:
        assert self._world.until(
            lambda: all(one.get_subscription_count() for one in self._images.values()), 30.0
        )
        settings, info = Settings(integration_time=17.0, modulation_frequency=20e6), None
        for k in range(1, 1000):
            stamp = k * self.PERIOD
            if k == with_settings_from:
                info = self._world.publisher(self._info, "frame_info")
            if info is not None:
                info.publish(messages.frame_info(settings, stamp, "small", "camera"))
            for value, one in enumerate(self._images.values(), start=1):
                pixels = np.full((3, 5), 1000 * value + k, np.uint16)
                one.publish(messages.image(pixels, messages.header(stamp, "camera")))
            self._world.until(done, 0.02)
            if done():
                return
        raise AssertionError("the recording did not end")
