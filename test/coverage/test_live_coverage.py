"""Coverage out of messages, evaluated in a process of its own; what becomes of it."""

from __future__ import annotations

import io
import itertools
import pickle
import queue
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from rim_camera_ros.bags import Topics, messages
from rim_camera_ros.bags.topics import CAMERA_INFO, DIAGNOSTICS, IMAGE, POSE
from rim_camera_ros.calibrate.plan import planning_camera
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.coverage.evaluate import Evaluator
from rim_camera_ros.coverage.frames import Message, live_frames
from rim_camera_ros.coverage.live import LiveCoverage
from rim_camera_ros.coverage.picture import Report, print_report
from rim_camera_ros.coverage.worker import serve
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.optics import project
from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import load_scene
from test.calibrate import helpers
from test.coverage.recordings import at, recorded
from test.helpers_cli import run


def published(frames: Sequence[RawFrame], camera: Camera, *, poses: bool = True) -> list[Message]:
    """The messages of frames as a driver sends them, those of a board's ``poses`` first."""
    result = []
    for frame in frames:
        made = [
            ("distance", "", IMAGE, messages.image_message(frame.distance, frame.stamp, "o")),
            ("amplitude", "", IMAGE, messages.image_message(frame.amplitude, frame.stamp, "o")),
            (
                "camera_info",
                "",
                CAMERA_INFO,
                messages.camera_info_message(camera.intrinsics, frame.stamp, "o"),
            ),
            (
                "frame_info",
                "",
                DIAGNOSTICS,
                messages.frame_info_message(frame.settings, frame.stamp, "t", "o"),
            ),
        ]
        if poses:
            pose = messages.pose_message(frame.truth["board"], frame.pose_stamps["board"], "o")
            made.insert(0, ("truth", "board", POSE, pose))
        result += [
            Message(role, name, kind, bytes(messages.encode(message, kind)))
            for role, name, kind, message in made
        ]
    return result


def reported(scene: Path, camera: Path, sent: Sequence[Message]) -> list[Report]:
    """What is reported of messages, until their end."""
    reports: list[Report] = []
    live = LiveCoverage(scene, camera, reports.append)
    for message in sent:
        live.take(message)
    live.close(patience=100.0)
    return reports


def test_frames_out_of_messages(tmp_path: Path) -> None:
    """Each is there with its pose and settings; what is damaged is passed over."""
    frames = recorded(tmp_path, at(0.9, 1.4), frames=3)
    sent = published(frames, helpers.camera(tmp_path))
    sent.insert(7, Message("distance", "", IMAGE, b"\0\1\0\0damaged"))
    found = list(live_frames(sent))
    assert [frame.stamp for frame in found] == [frame.stamp for frame in frames]
    assert all(np.array_equal(a.distance, b.distance) for a, b in zip(found, frames, strict=True))
    assert [frame.truth["board"].position[2] for frame in found] == [0.9] * 3 + [1.4] * 3
    # of the first frame nobody knows yet that settings come with frames
    assert [frame.settings.integration_time for frame in found[1:]] == [60.0] * 5


def test_a_board_that_is_found_in_the_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As ``rim board`` writes it, at two stations of its schedule; a third of the image at most."""
    run(capsys, "board", "checkerboard", "--out", tmp_path / "board", "--quiet")
    scene, camera = load_scene(tmp_path / "board.yaml"), load_camera(find_camera("sr3000"))
    simulation = Simulation(camera, scene, seed=3)
    exposures = list(itertools.islice(Timeline(scene, camera), 10))
    sent = published(list(map(simulation.frame, exposures)), camera, poses=False)
    reports = reported(tmp_path / "board.yaml", find_camera("sr3000"), sent)
    assert {report.problem for report in reports} == {""}
    last = reports[-1]
    assert last.picture is not None
    coverage = last.coverage
    assert coverage is not None
    assert (coverage.stations, coverage.frames) == (2, 9)  # of the first frame nobody knows the settings yet
    # the board is in the pixels to which its corners are projected
    coarse, _ = planning_camera(camera)
    width, height = scene.surfaces[0].size or (0.0, 0.0)
    corners = np.array([(x * width / 2, y * height / 2, 0.0) for x in (-1, 1) for y in (-1, 1)])
    around = np.zeros(coarse.shape, np.uint8)
    for pose in (exposures[0].poses["board"], exposures[5].poses["board"]):
        turned = corners @ rotation_matrix(pose.orientation).T + np.array(pose.position)
        hull = cv2.convexHull(project(coarse.optics, turned).round().astype(np.int32))
        cv2.fillConvexPoly(around, hull, 1)
    assert not coverage.seen[cv2.dilate(around, np.ones((3, 3), np.uint8)) == 0].any()
    assert (coverage.seen > 0).sum() > around.sum() / 4  # without those beside edges of squares
    # one distance: light from the side and its fall to the rim are seen, what follows distance or time is not
    assert coverage.determined.keys() >= {"emission_pattern", "amplitude_nonlinearity"}
    assert coverage.open.keys() >= {"cyclic_error", "distance_scale", "warm_up_drift"}
    assert coverage.next is not None
    assert coverage.next.raised["cyclic_error"][1] > 2 * coverage.factors["cyclic_error"]


@pytest.mark.slow
def test_a_process_of_its_own_reports(tmp_path: Path) -> None:
    """To the last station, though more messages came than it evaluates at once; then it is gone."""
    camera = helpers.camera(tmp_path)
    helpers.scene(tmp_path)
    sent = published(recorded(tmp_path, at(0.9, 1.4, 2.2), frames=3), camera)
    reports = reported(tmp_path / "scene.yaml", tmp_path / "camera.yaml", sent)
    assert [report.problem for report in reports] == [""] * len(reports)
    last = reports[-1].coverage
    assert last is not None
    assert (last.stations, last.frames) == (3, 8)  # see above
    assert reports[-1].picture is not None
    assert Topics().namespace == "/camera"


@pytest.mark.slow
def test_another_camera_s_images_are_a_problem_in_words(tmp_path: Path) -> None:
    helpers.scene(tmp_path)
    camera = helpers.camera(tmp_path)
    sent = published(recorded(tmp_path, at(0.9), frames=2), camera)
    (tmp_path / "camera.yaml").write_text(helpers.CAMERA.replace("width: 44", "width: 88"))
    (report,) = reported(tmp_path / "scene.yaml", tmp_path / "camera.yaml", sent)
    assert report.ended
    assert report.problem == (
        "its images have 44 x 36 px, the camera file 88 x 36 "
        "(give the camera file of the camera that recorded it)"
    )


@pytest.mark.parametrize("place", ["add", "evaluate"])
def test_an_error_of_the_evaluation_is_its_last_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: str
) -> None:
    """In either of its threads; the traceback goes to the terminal, as it is to be reported."""

    def fail(*_: object, **__: object) -> None:
        raise ValueError("inhomogeneous shape")

    monkeypatch.setattr(Evaluator, place, fail)
    camera = helpers.camera(tmp_path)
    helpers.scene(tmp_path)
    sent = published(recorded(tmp_path, at(0.9), frames=3), camera)
    files = (str(tmp_path / "scene.yaml"), str(tmp_path / "camera.yaml"))
    source, sink = io.BytesIO(b"".join(map(pickle.dumps, [files, *sent]))), io.BytesIO()
    serve(source, sink)
    sink.seek(0)
    report = pickle.load(sink)
    assert report == Report(
        None, problem="unexpected ValueError: inhomogeneous shape (please report this)", ended=True
    )
    assert sink.read() == b""
    assert "in fail" in capsys.readouterr().err


def test_a_process_that_is_killed_is_missed_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Messages go on being taken; one report says what became of the process."""
    camera = helpers.camera(tmp_path)
    helpers.scene(tmp_path)
    reports: queue.SimpleQueue[Report] = queue.SimpleQueue()
    live = LiveCoverage(tmp_path / "scene.yaml", tmp_path / "camera.yaml", reports.put)
    live._process.kill()
    report = reports.get(timeout=20.0)
    assert report.coverage is None
    assert report.ended
    for message in published(recorded(tmp_path, at(0.9), frames=2), camera):
        live.take(message)
    live.close(patience=20.0)
    assert reports.empty()
    print_report(report)
    assert capsys.readouterr().err == (
        "coverage: its process was ended by SIGKILL (see what it wrote to standard error, and the memory); "
        "no more is said of the coverage, and the recording is not affected\n"
    )
