"""Nodes as processes: start, end, signals, exit status, what is said."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import Image, PointCloud2

from rim_camera_ros.pipeline import kernels
from test.ros.harness import BEST_EFFORT, RELIABLE, World

NODES = ("driver_node", "correction_node")


def test_the_nodes_start_without_scipy() -> None:
    # half of the time that a node takes to come back was the import of scipy's statistics and filters
    code = (
        "import sys\n"
        "import rim_camera_ros.nodes.camera_node\n"
        "print(sorted({'scipy', 'matplotlib', 'sklearn'} & set(sys.modules)))\n"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("node", "parameters", "message"),
    [
        (
            "driver_node",
            {"camera": "sr30000"},
            r"sr30000: no camera file of this name \(did you mean 'sr3000'\?; .*\)",
        ),
        (
            "driver_node",
            {"scene": "no/such.yaml"},
            r"no/such\.yaml: no such file \(give a scene file or one of: .*\)",
        ),
        (
            "driver_node",
            {"integration_time": "long"},
            r"integration_time: has the wrong type \(expected a number\)",
        ),
        ("driver_node", {"frame_rate": -1.0}, r"frame_rate: Parameter frame_rate out of range .*"),
        (
            "driver_node",
            {"source": "webcam"},
            r"source: 'webcam' is not a choice \(one of: simulator, playback, sr3000\)",
        ),
        ("driver_node", {"source": "playback"}, r"recording: source playback needs a recording \(.*\)"),
        ("driver_node", {"source": "playback", "recording": "no/bag"}, r"no/bag: .*"),
        ("correction_node", {"camera": "broken.yaml"}, r".*broken\.yaml: optics\.fx \(line 4\): .*"),
        (
            "correction_node",
            {"effects.motion": "x"},
            r"effects\.motion: has the wrong type \(expected true or false\)",
        ),
        (
            "correction_node",
            {"effects.multipath": True},
            r"effects\.multipath: the camera file sr3000 has no .*",
        ),
    ],
)
def test_errors_at_the_start(
    world: World, tmp_path: Path, node: str, parameters: dict[str, Any], message: str
) -> None:
    (tmp_path / "broken.yaml").write_text(
        "format: rim_camera/1\n"
        "sensor: {width: 4, height: 3, pixel_pitch: [40.0e-6, 40.0e-6], modulation_frequency: 20.0e6}\n"
        "optics:\n  fx: wide\n  fy: 2.0\n  cx: 1.0\n  cy: 1.0\n"
    )
    if parameters.get("camera") == "broken.yaml":
        parameters = {"camera": str(tmp_path / "broken.yaml")}
    process = world.start(node, **parameters)
    assert process.wait() == 2, process.text
    assert re.fullmatch(rf"{node}: {message}\n", process.text), process.text


def test_unknown_argument_and_unknown_parameter(world: World) -> None:
    process = world.start("driver_node", "--", "sr3000")
    assert process.wait() == 2
    assert re.fullmatch(r"driver_node: unknown argument sr3000 \(.*\)\n", process.text)
    process = world.start("driver_node", frame=3, frames=1, exit_at_end=True)
    assert process.wait() == 0
    assert "no parameter 'frame', it is ignored (did you mean 'frame" in process.text


@pytest.mark.parametrize("node", NODES)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_node_without_a_trace(world: World, node: str, number: signal.Signals) -> None:
    process = world.start(node)
    assert world.until(lambda: "camera" in process.text and "INFO" in process.text), process.text
    process.send(number)
    process.send(number)  # a terminal and a launcher both send one
    assert process.wait() == 0
    assert "Traceback" not in process.text
    assert "Error" not in process.text


def test_the_correction_says_once_whether_it_has_compiled_kernels(world: World) -> None:
    process = world.start("correction_node")
    assert world.until(lambda: "correcting /camera" in process.text), process.text
    assert world.until(lambda: world.state("correction") == "active"), process.text
    for label in ("deactivate", "cleanup", "configure", "activate"):
        assert world.transition("correction", label), process.text
    process.send(signal.SIGINT)
    assert process.wait() == 0, process.text
    assert process.text.count("correcting /camera") == 2, process.text
    said = re.findall(r"\[INFO\] .*\[camera\.correction\]: (compiled kernels .*)", process.text)
    assert said == [kernels.in_words()]


def test_a_signal_during_shutdown(world: World) -> None:
    process = world.start("driver_node", frame_rate=100.0)
    images = world.collect(Image, "distance/image_raw", BEST_EFFORT)
    assert world.until(lambda: len(images) > 5), process.text
    process.send(signal.SIGINT)
    while process.running:
        process.send(signal.SIGINT)
        world.until(lambda: not process.running, 0.01)
    assert process.wait() == 0
    assert "Traceback" not in process.text


def test_frames_and_end(world: World) -> None:
    images = world.collect(Image, "distance/image_raw", RELIABLE)
    endless = world.start(
        "driver_node", frames=7, frame_rate=50.0, wait_for_subscribers=0, **{"qos.images": "reliable"}
    )
    assert world.until(lambda: "7 frames published" in endless.text), endless.text
    assert endless.running  # parameters can still be looked at
    assert world.get("driver", "frames") == [7]
    count = len(images)
    assert count <= 7
    endless.send(signal.SIGINT)
    assert endless.wait() == 0, endless.text


def test_end_of_a_schedule_that_does_not_loop(world: World, tmp_path: Path) -> None:
    scene = tmp_path / "short.yaml"
    scene.write_text(
        "format: rim_scene/1\n"
        "surfaces:\n- {name: wall, type: plane, pose: {position: [0, 0, 2]}}\n"
        "schedule:\n- {frames: 3, rate: 50}\n- {frames: 4, rate: 100, uptime: 3600}\n"
    )
    process = world.start("driver_node", scene=str(scene), loop=False, exit_at_end=True)
    assert process.wait() == 0  # without waiting an hour for the second station
    assert "is at its end, 7 frames published" in process.text


def test_hostile_messages_are_refused_and_the_next_good_frame_is_corrected(world: World) -> None:
    from builtin_interfaces.msg import Time
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from std_msgs.msg import Header

    correction = world.start("correction_node", **{"qos.input": "reliable"})
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    publishers = {
        role: world.publisher(kind, topic)
        for role, kind, topic in (
            ("frame_info", DiagnosticArray, "frame_info"),
            ("amplitude", Image, "amplitude/image_raw"),
            ("distance", Image, "distance/image_raw"),
        )
    }
    assert world.until(
        lambda: points.matched and all(one.get_subscription_count() for one in publishers.values())
    ), world.output()
    seconds = iter(range(100, 1000))

    def send(*, integration_time: str = "100", amplitude: Any = None, **changes: Any) -> int:
        head = Header(stamp=Time(sec=next(seconds)), frame_id="optical")
        fields = {
            "height": 144,
            "width": 176,
            "encoding": "16UC1",
            "step": 352,
            "data": bytes([0, 40]) * (144 * 176),
        }
        status = DiagnosticStatus(values=[KeyValue(key="integration_time", value=integration_time)])
        publishers["frame_info"].publish(DiagnosticArray(header=head, status=[status]))
        publishers["amplitude"].publish(Image(header=head, **{**fields, **(amplitude or {})}))
        publishers["distance"].publish(Image(header=head, **{**fields, **changes}))
        return int(head.stamp.sec)

    def arrives(second: int) -> bool:
        return world.until(lambda: any(one.header.stamp.sec == second for one in points))

    assert arrives(send()), world.output()
    hostile: list[tuple[dict[str, Any], str]] = [
        ({"encoding": "rgb8"}, "distance/image_raw: message refused: encoding 'rgb8'"),
        ({"step": 351}, "step 351 is shorter than a row"),
        ({"height": 2**31, "width": 2**31, "step": 2**32 - 1}, "distance/image_raw: message refused"),
        ({"data": b""}, "0 bytes of image data"),
        ({"height": 0, "data": b""}, "an image of 176 x 0 pixels"),
        (
            {"height": 2, "width": 2, "step": 4, "data": bytes(8)},
            "an image of 2 x 2 px, but the camera file is for 176 x 144",
        ),
        (
            {"amplitude": {"encoding": "mono8", "step": 176, "data": bytes(176 * 144)}},
            "amplitude/image_raw: message",
        ),
        (
            {"integration_time": "soon"},
            "frame_info: message refused: integration_time: 'soon' is not a number",
        ),
        ({"integration_time": "0"}, "frame_info: message refused: integration_time"),
    ]
    for changes, _ in hostile:
        send(**changes)
        good = send()
        assert arrives(good), f"{changes}\n{world.output()}"
    # of one kind of warning there is one in five seconds, so not every text is there
    for text in (hostile[0][1], hostile[6][1], hostile[7][1], "distance refused: 1 dropped"):
        assert world.until(lambda text=text: text in correction.text), world.output()
    assert correction.text.count("message refused") <= 6
    assert {one.header.stamp.sec for one in points}.isdisjoint(range(101, 101 + 2 * len(hostile), 2))
    odd = send(encoding="32FC1", step=704, data=bytes([0, 0, 0xC0, 0x7F]) * (144 * 176))  # metres, all NaN
    assert arrives(odd), world.output()
    assert "Traceback" not in correction.text
    assert correction.running


def test_frames_without_frame_info_use_the_camera_file(world: World, tmp_path: Path) -> None:
    from rim_camera_ros.files import find_camera

    text = find_camera("sr3000").read_text()
    path = tmp_path / "camera.yaml"
    path.write_text(re.sub(r"\n  integration_time: 100 .*", "", text))
    for one in find_camera("sr3000").parent.glob("sr3000*.npy"):
        (tmp_path / one.name).write_bytes(one.read_bytes())
    correction = world.start("correction_node", camera=str(path), **{"qos.input": "reliable"})
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    amplitude, distance = (world.publisher(Image, f"{one}/image_raw") for one in ("amplitude", "distance"))
    assert world.until(lambda: points.matched and distance.get_subscription_count()), world.output()

    def send(second: int) -> None:
        message = Image(height=144, width=176, encoding="16UC1", step=352, data=bytes([0, 40]) * (144 * 176))
        message.header.stamp.sec = second
        amplitude.publish(message)
        distance.publish(message)

    send(1)
    assert world.until(lambda: "frame not corrected" in correction.text), world.output()
    assert "give sensor.integration_time in the camera file" in correction.text
    assert world.set("correction", camera="sr3000") == ""
    send(2)
    assert world.until(lambda: len(points) == 1), world.output()
