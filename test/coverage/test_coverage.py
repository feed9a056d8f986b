"""What stations determine so far, what to record next, and whether they were at rest."""

from __future__ import annotations

import io
import math
import pickle
import queue
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.bags import Topics, messages
from rim_camera_ros.bags.topics import CAMERA_INFO, DIAGNOSTICS, IMAGE, POSE
from rim_camera_ros.calibrate.plan import NARROWED, plan
from rim_camera_ros.camera import Camera
from rim_camera_ros.coverage.evaluate import Coverage, Evaluator
from rim_camera_ros.coverage.frames import Message, live_frames
from rim_camera_ros.coverage.live import LiveCoverage
from rim_camera_ros.coverage.picture import HEIGHT, WIDTH, Report, coverage_picture, print_report
from rim_camera_ros.coverage.proposals import proposals
from rim_camera_ros.coverage.worker import serve
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.diagnose.variance import movement_of
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.fit.data import Station
from rim_camera_ros.fit.reduction import reduce_frames
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene, ScenePose
from rim_camera_ros.scene import Station as Scheduled
from test.calibrate import helpers

CYCLIC = CyclicError(harmonics=(Harmonic(order=4, amplitude=0.008, phase=0.6),))
SETTINGS = Settings(integration_time=60.0, modulation_frequency=20e6)
#: Seconds between two poses.
PAUSE = 20


def recorded(
    tmp_path: Path,
    poses: Sequence[Pose],
    *,
    scene: Scene | None = None,
    frames: int = 4,
    drift: float = 0.0,
) -> list[RawFrame]:
    """Frames of the board at poses; it moves away by ``drift`` [m] from frame to frame and turns with it."""
    truth, board = helpers.camera(tmp_path, CYCLIC), scene or helpers.scene(tmp_path)
    simulation = Simulation(truth, board, seed=7)
    result = []
    for number, pose in enumerate(poses):
        stamp = (1 + PAUSE * number) * 1_000_000_000
        for k in range(frames):
            x, y, z = pose.position
            turned = (0.0, math.sin(k * drift), 0.0, math.cos(k * drift))
            true = Pose((x, y, z + k * drift), turned if drift else pose.orientation)
            exposure = Exposure(stamp + k * 40_000_000, SETTINGS, {"board": true}, number, stamp)
            result.append(replace(simulation.frame(exposure), truth={"board": pose}))
    return result


def at(*distances: float) -> list[Pose]:
    return [Pose((0.07, -0.04, one)) for one in distances]


def stations(tmp_path: Path, *distances: float) -> list[Station]:
    return list(reduce_frames(recorded(tmp_path, at(*distances)), helpers.camera(tmp_path)))


def evaluated(tmp_path: Path, found: Sequence[Station], scene: Scene | None = None) -> Coverage:
    evaluator = Evaluator(scene or helpers.scene(tmp_path), helpers.camera(tmp_path, CYCLIC))
    for one in found:
        assert evaluator.add(one)
    return evaluator.evaluate()


def test_factors_are_those_of_a_plan(tmp_path: Path) -> None:
    """A plan expects the light that the recorded stations then have."""
    camera = helpers.camera(tmp_path, CYCLIC)
    poses = [
        ScenePose((0.07, -0.04, z), (0.0, s, 0.0, (1 - s * s) ** 0.5))
        for z, s in ((0.7, 0.0), (1.9, 0.2), (3.1, 0.1))
    ]
    schedule = tuple(Scheduled(frames=4, integration_time=60.0, poses={"board": one}) for one in poses)
    scene = replace(helpers.scene(tmp_path), schedule=schedule)
    simulation = Simulation(camera, scene, seed=3)
    evaluator = Evaluator(scene, camera)
    for station in reduce_frames(map(simulation.frame, Timeline(scene, camera)), camera):
        evaluator.add(station)
    found = evaluator.evaluate().factors
    planned = plan(camera, {"board_experiment": scene}).alone["board_experiment"]
    for name in ("cyclic_error", "amplitude_offset", "emitter_offset", "scattering", "incidence_angle"):
        assert found[name] == pytest.approx(planned[name], rel=0.15), name


def test_more_stations_tell_more(tmp_path: Path) -> None:
    """One distance does not determine a sinusoid over the distance, five in half a period of it do."""
    found = stations(tmp_path, 0.8, 1.2, 1.6, 2.0, 2.4)
    before: dict[str, float] = {}
    for number in (1, 3, 5):
        now = evaluated(tmp_path, found[:number])
        assert now.stations == number
        assert all(now.factors[name] >= 0.999 * one for name, one in before.items())
        assert ("cyclic_error" in now.determined) == (number == 5), now.factors
        before = {name: one for name, one in now.factors.items() if name != "amplitude_nonlinearity"}


@pytest.mark.parametrize("size", [None, (0.6, 0.5)], ids=["plane", "rectangle"])
def test_what_is_to_be_recorded_next_brings_what_it_says(
    tmp_path: Path, size: tuple[float, float] | None
) -> None:
    """Also of a board that takes up a third of the image: other pixels see it where it is recorded next."""
    camera, scene = helpers.camera(tmp_path, CYCLIC), helpers.scene(tmp_path)
    if size is not None:
        scene = replace(scene, surfaces=(replace(scene.surfaces[0], type="rectangle", size=size),))
    found = list(reduce_frames(recorded(tmp_path, at(1.1), scene=scene), camera))
    now = evaluated(tmp_path, found, scene)
    assert (now.seen == 0).mean() > 0.5 or size is None
    assert now.next is not None
    assert now.lines()[-1].startswith(f"  next: {now.next.words} (")
    chosen = next(one for one in proposals(scene, camera, found[0]) if one.words == now.next.words)
    pose = chosen.truth["board"]
    more = list(reduce_frames(recorded(tmp_path, [*at(1.1), pose], scene=scene), camera))
    after = evaluated(tmp_path, more, scene)
    for name, (before, promised) in now.next.raised.items():
        if name == "amplitude_offset":  # the pole of its form follows from the light that there was
            continue
        assert now.factors[name] == before < NARROWED
        assert after.factors[name] == pytest.approx(promised, rel=0.3), name


def test_what_no_pose_tells_is_said(tmp_path: Path) -> None:
    """Rows for two settings in the camera file: the other one is offered; uptime is not stated."""
    camera = helpers.camera(tmp_path)
    rows = helpers.camera(tmp_path).effects  # none
    assert rows == {}
    offered = proposals(helpers.scene(tmp_path), camera, stations(tmp_path, 1.3)[0])
    assert {one.words.partition(" at ")[0] for one in offered} == {"board"}
    warm = replace(stations(tmp_path, 1.3)[0], settings=replace(SETTINGS, uptime=4000.0))
    words = [one.words for one in proposals(helpers.scene(tmp_path), camera, warm)]
    assert "the present pose after 30 min more of running" in words
    assert "the present pose within 10 s of switching the camera on, cold" in words


def test_a_station_without_a_pose_counts_for_nothing(tmp_path: Path) -> None:
    evaluator = Evaluator(helpers.scene(tmp_path), helpers.camera(tmp_path))
    assert not evaluator.add(replace(stations(tmp_path, 1.3)[0], truth={}))


@pytest.mark.parametrize(("drift", "rests"), [(0.0, True), (0.004, False)])
def test_rest(tmp_path: Path, drift: float, rests: bool) -> None:
    """4 mrad from frame to frame are 10 to 20 mm at the rim of the array, over eight frames."""
    frames = recorded(tmp_path, at(1.5), frames=8, drift=drift)
    (station,) = reduce_frames(frames, helpers.camera(tmp_path))
    moved = movement_of(station)
    if rests:
        assert moved is None
    else:
        assert moved is not None
        assert 0.003 < moved < 0.1


def test_the_picture(tmp_path: Path) -> None:
    coverage = evaluated(tmp_path, stations(tmp_path, 0.9, 1.4))
    assert coverage.seen.max() == 2
    assert coverage.readings.sum() == coverage.seen.sum()
    # 0.9 m in the middle to 1.4 m / cos(30 deg) at the rim, of 7.49 m in 24 classes
    distances = np.flatnonzero(coverage.readings.sum(axis=1))
    assert (distances.min(), distances.max()) == (2, 5)
    plain = coverage_picture(coverage, ambiguity=7.49)
    moved = coverage_picture(replace(coverage, moved=0.012), ambiguity=7.49)
    assert plain.shape == (HEIGHT, WIDTH, 3)
    assert (plain != moved).any()
    assert "NOT at rest: 12 mm" in replace(coverage, moved=0.012).lines()[0]


def published(frames: Sequence[RawFrame], camera: Camera) -> list[Message]:
    """The messages of frames as a driver sends them, poses first."""
    result = []
    for frame in frames:
        made = [
            (
                "truth",
                "board",
                POSE,
                messages.pose_message(frame.truth["board"], frame.pose_stamps["board"], "o"),
            ),
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
        result += [
            Message(role, name, kind, bytes(messages.encode(one, kind))) for role, name, kind, one in made
        ]
    return result


def test_frames_out_of_messages(tmp_path: Path) -> None:
    """Each is there with its pose and settings; what is damaged is passed over."""
    frames = recorded(tmp_path, at(0.9, 1.4), frames=3)
    sent = published(frames, helpers.camera(tmp_path))
    sent.insert(7, Message("distance", "", IMAGE, b"\0\1\0\0damaged"))
    found = list(live_frames(sent))
    assert [one.stamp for one in found] == [one.stamp for one in frames]
    assert all(np.array_equal(a.distance, b.distance) for a, b in zip(found, frames, strict=True))
    assert [one.truth["board"].position[2] for one in found] == [0.9] * 3 + [1.4] * 3
    # of the first frame nobody knows yet that settings come with frames
    assert [one.settings.integration_time for one in found[1:]] == [60.0] * 5


@pytest.mark.slow
def test_a_process_of_its_own_reports(tmp_path: Path) -> None:
    """To the last station, though more messages came than it evaluates at once; then it is gone."""
    camera = helpers.camera(tmp_path)
    helpers.scene(tmp_path)
    reports: list[Report] = []
    live = LiveCoverage(tmp_path / "scene.yaml", tmp_path / "camera.yaml", reports.append)
    for one in published(recorded(tmp_path, at(0.9, 1.4, 2.2), frames=3), camera):
        live.take(one)
    live.close(patience=100.0)
    assert [one.problem for one in reports] == [""] * len(reports)
    last = reports[-1].coverage
    assert last is not None
    assert (last.stations, last.frames) == (3, 8)  # see above
    assert reports[-1].picture is not None
    assert Topics().namespace == "/camera"


@pytest.mark.slow
def test_another_camera_s_images_are_a_problem_in_words(tmp_path: Path) -> None:
    reports: list[Report] = []
    helpers.scene(tmp_path)
    camera = helpers.camera(tmp_path)
    sent = published(recorded(tmp_path, at(0.9), frames=2), camera)
    (tmp_path / "camera.yaml").write_text(helpers.CAMERA.replace("width: 44", "width: 88"))
    live = LiveCoverage(tmp_path / "scene.yaml", tmp_path / "camera.yaml", reports.append)
    for one in sent:
        live.take(one)
    live.close(patience=100.0)
    assert [one.ended for one in reports] == [True]
    assert [one.problem for one in reports] == [
        "its images have 44 x 36 px, the camera file 88 x 36 "
        "(give the camera file of the camera that recorded it)"
    ]


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
    for one in published(recorded(tmp_path, at(0.9), frames=2), camera):
        live.take(one)
    live.close(patience=20.0)
    assert reports.empty()
    print_report(report)
    assert capsys.readouterr().err == (
        "coverage: its process was ended by SIGKILL (see what it wrote to standard error, and the memory); "
        "no more is said of the coverage, and the recording is not affected\n"
    )
