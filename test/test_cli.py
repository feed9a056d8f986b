"""The commands from end to end."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from rim_camera_ros.bags import Recording
from rim_camera_ros.bags.messages import pose_from, settings_from, stamp_of, typestore
from rim_camera_ros.frame import Pose

from .helpers_cli import CAMERA, SCENE, process, raw_frame, run, write_bag, write_text

SHARED = Path(__file__).resolve().parents[2] / "shared"
needs_recordings = pytest.mark.skipif(
    not (SHARED / "recordings").is_dir(), reason="the real recordings are not beside this checkout"
)
Capture = pytest.CaptureFixture[str]


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    return write_text(tmp_path / "camera.yaml", CAMERA)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_text(tmp_path / "scene.yaml", SCENE)


def test_help_of_every_command(capsys: Capture) -> None:
    status, out, _ = run(capsys, "--help")
    assert status == 0
    for command in ("simulate", "record", "correct", "info"):
        assert command in out
        status, text, _ = run(capsys, command, "--help")
        assert status == 0
        assert "examples:" in text
    assert run(capsys, "--version")[1].startswith("rim 0.")


def test_simulate_then_correct_then_info(capsys: Capture, tmp_path: Path, camera: Path, scene: Path) -> None:
    bag, corrected = tmp_path / "bag", tmp_path / "corrected"
    arguments = (
        "--camera",
        camera,
        "--frames",
        "7",
        "--integration-time",
        "60",
        "--rate",
        "10",
        "--seed",
        "3",
    )
    status, out, err = run(capsys, "simulate", scene, *arguments, "--out", bag)
    assert (status, err) == (0, "")
    assert "7 frames simulated" in out
    with Recording(bag) as recording:
        frames = list(recording.frames())
        assert recording.truth_surfaces == ("wall",)
    assert len(frames) == 7
    assert np.diff([one.stamp for one in frames]).tolist() == [10**8] * 6
    assert {one.settings.integration_time for one in frames} == {60.0}
    assert all(one.settings.body_temperature is not None for one in frames)
    status, out, err = run(
        capsys, "correct", bag, "--camera", camera, "--out", corrected,
        "--ply", tmp_path / "cloud.ply", "--npz", tmp_path / "frame.npz", "--frame", "-1",
    )  # fmt: skip
    assert (status, err) == (0, "")
    with Recording(corrected) as recording:
        distances = [one.distance for one in recording.corrected_frames()]
        roles = recording.summary().roles
    assert set(roles) >= {"points", "sigma", "flags", "corrected_distance", "depth", "camera_info"}
    arrays = np.load(tmp_path / "frame.npz")
    np.testing.assert_array_equal(arrays["distance"], distances[-1])
    # the wall is a plane at z = 2.5 m
    assert arrays["points"][..., 2].mean() == pytest.approx(2.5, abs=0.01)
    ply = (tmp_path / "cloud.ply").read_bytes()
    header, _, body = ply.partition(b"end_header\n")
    assert b"element vertex 108" in header
    assert len(body) == 108 * 16
    np.testing.assert_array_equal(np.frombuffer(body, "<f4").reshape(-1, 4), arrays["points"].reshape(-1, 4))
    status, out, _ = run(capsys, "info", bag, "--camera", camera, "--json")
    facts = json.loads(out)
    assert status == 0
    assert (facts["kind"], facts["frames"], facts["rate_hz"], facts["gaps"]) == ("recording", 7, 10.0, 0)
    assert facts["settings"]["integration_times"] == {"60": 7}
    ratios = [row["sigma"] / row["model"] for row in facts["noise"]["classes"]]
    assert ratios
    assert all(0.85 < one < 1.15 for one in ratios)


def test_simulating_the_poses_of_a_recording(capsys: Capture, tmp_path: Path, camera: Path) -> None:
    truth = write_text(
        tmp_path / "truth.yaml",
        "format: rim_scene/1\nsurfaces:\n- {name: board, type: plane, pose: truth, reflectivity: 0.6}\n",
    )
    frames = [
        replace(
            raw_frame(10**9 * i, integration_time=20.0 + i),
            truth={"board": Pose((0.0, 0.1, 1.5 + 0.25 * i))},
            pose_stamps={"board": 10**9 * i},
        )
        for i in (1, 2, 5)
    ]
    bag = write_bag(tmp_path / "bag", frames)
    status, _, err = run(
        capsys, "simulate", truth, "--camera", camera, "--poses", bag, "--out", tmp_path / "out", "--quiet"
    )
    assert (status, err) == (0, "")
    with Recording(tmp_path / "out") as recording:
        simulated = list(recording.frames())
    assert [one.stamp for one in simulated] == [10**9, 2 * 10**9, 5 * 10**9]
    assert [one.settings.integration_time for one in simulated] == [21.0, 22.0, 25.0]
    lsb = 299792458.0 / 40e6 / 65536
    assert [one.truth["board"].position[2] for one in simulated] == [1.75, 2.0, 2.75]
    for frame, z in zip(simulated, (1.75, 2.0, 2.75), strict=True):
        middle = float(np.mean(frame.distance[4, 5:7])) * lsb
        assert middle == pytest.approx(z, abs=0.03)


@pytest.mark.parametrize(
    "name", ["sr3000", "sr2", "pmd768s", "pmd1ks2", "pmd3ks", "pmd19k", "sr3000_every_effect"]
)
def test_info_on_shipped_cameras(capsys: Capture, name: str) -> None:
    status, out, err = run(capsys, "info", name)
    assert (status, err) == (0, "")
    assert "field of view" in out
    facts = json.loads(run(capsys, "info", name, "--json")[1])
    assert facts["kind"] == "camera"
    if name == "sr3000":
        assert facts["ambiguity_range_m"] == pytest.approx(7.49481, abs=1e-5)
        assert facts["distance_lsb_m"] * 1e3 == pytest.approx(0.114, abs=5e-4)
        assert facts["background_suppression_db"] is None
        assert "unmodulated light  " not in out
    if name == "pmd3ks":
        assert facts["background_suppression_db"] == 50.0
        assert re.search(
            r"unmodulated light +fills a pixel by itself at 20723987 counts, suppressed by 50 dB", out
        )


@pytest.mark.parametrize("name", ["wall", "corner", "board", "track_line", "room"])
def test_info_on_shipped_scenes(capsys: Capture, name: str) -> None:
    status, out, err = run(capsys, "info", name, "--camera", "sr3000")
    assert (status, err) == (0, "")
    assert "surface" in out
    facts = json.loads(run(capsys, "info", name, "--camera", "sr3000", "--json")[1])
    assert facts["seen"]["distance_m"][0] > 0.2


def test_json_has_no_nan(capsys: Capture, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", [raw_frame(10**9)])
    status, out, _ = run(capsys, "info", bag, "--json")
    assert status == 0

    def refuse(token: str) -> None:
        raise AssertionError(token)

    json.loads(out, parse_constant=refuse)


@needs_recordings
@pytest.mark.parametrize(
    ("folder", "frames", "size"), [("kinect2_checkerboard", 68, (512, 424)), ("o3d303_wall", 3, (176, 132))]
)
def test_real_recordings(
    capsys: Capture, tmp_path: Path, folder: str, frames: int, size: tuple[int, int]
) -> None:
    recording = SHARED / "recordings" / folder
    arguments = (recording / "recording", "--camera", recording / "camera.yaml")
    facts = json.loads(run(capsys, "info", *arguments, "--json")[1])
    assert (facts["frames"], facts["width"], facts["height"]) == (frames, *size)
    status, _, err = run(capsys, "correct", *arguments, "--ply", tmp_path / "cloud.ply")
    assert (status, err) == (0, "")
    assert (tmp_path / "cloud.ply").stat().st_size > 100_000


@needs_recordings
@pytest.mark.parametrize("folder", ["kinect2_checkerboard", "o3d303_wall"])
def test_correcting_a_real_recording(capsys: Capture, tmp_path: Path, folder: str) -> None:
    """All frames; the poses of the truth come along, and what is written can be examined."""
    recording = SHARED / "recordings" / folder
    out = tmp_path / "out"
    arguments = (recording / "recording", "--camera", recording / "camera.yaml", "--out", out)
    status, text, err = run(capsys, "correct", *arguments)
    assert (status, err) == (0, "")
    facts = json.loads(run(capsys, "info", out, "--json")[1])
    assert text == f"{facts['corrected']['frames']} frames corrected: {out}\n"
    before = json.loads(run(capsys, "info", recording / "recording", "--json")[1])
    assert facts["corrected"]["frames"] == before["frames"]
    assert facts["truth_surfaces"] == before["truth_surfaces"]
    with Recording(recording / "recording") as raw, Recording(out) as corrected:
        first, result = next(raw.frames()), next(corrected.corrected_frames())
    lsb = 1e-4 if folder == "kinect2_checkerboard" else 1e-3
    valid = np.isfinite(result.distance)
    assert valid.any()
    # these camera files state no effects: the distance is the measured one
    np.testing.assert_allclose(result.distance[valid], first.distance[valid] * lsb, atol=1e-5)
    assert not (valid & (first.distance == 0)).any()


def test_every_command_as_a_process(tmp_path: Path, camera: Path, scene: Path) -> None:
    """Output goes to standard output, nothing to standard error in a pipe: no progress either."""
    bag, out = tmp_path / "bag", tmp_path / "out"
    for arguments, text in (
        (
            ("simulate", scene, "--camera", camera, "--frames", "1", "--out", bag),
            f"1 frame simulated: {bag}\n",
        ),
        (("correct", bag, "--camera", camera, "--out", out), f"1 frame corrected: {out}\n"),
        (("correct", bag, "--camera", camera, "--out", out, "--force", "--quiet"), ""),
    ):
        running = process(*arguments)
        assert running.communicate(timeout=60) == (text, "")
        assert running.returncode == 0
    running = process("info", bag, "--camera", camera)
    text, err = running.communicate(timeout=60)
    assert (running.returncode, err) == (0, "")
    assert "1 of 12 x 9 px" in text


def test_the_corrected_recording_holds_the_truth_and_the_settings(
    capsys: Capture, tmp_path: Path, camera: Path
) -> None:
    frames = [
        replace(
            raw_frame(10**9 * i, integration_time=40.0 + i),
            truth={"board": Pose((0.25, -0.1, 1.5 + 0.25 * i), (0.0, 0.6, 0.0, 0.8))},
            pose_stamps={"board": 10**9 * i - 5},
        )
        for i in (1, 2)
    ]
    bag, out = write_bag(tmp_path / "bag", frames), tmp_path / "out"
    assert run(capsys, "correct", bag, "--camera", camera, "--out", out, "--quiet") == (0, "", "")
    poses, settings = [], []
    with AnyReader([out], default_typestore=typestore()) as reader:
        for connection, time, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == "/ground_truth/board/pose":
                poses.append((time, stamp_of(message), pose_from(message)))
            elif connection.topic == "/camera/frame_info":
                settings.append(settings_from(message))
    assert poses == [(one.stamp, one.pose_stamps["board"], one.truth["board"]) for one in frames]
    assert [one.integration_time for one, _ in settings] == [41.0, 42.0]
    assert {device for _, device in settings} == {"test"}


def test_one_frame_as_files(capsys: Capture, tmp_path: Path, camera: Path) -> None:
    frames = [raw_frame(10**9 * i) for i in (1, 2, 3)]
    for i, one in enumerate(frames):
        one.distance[...] += np.uint16(1000 * i)
        one.distance[0, i] = 0
    bag = write_bag(tmp_path / "bag", frames)
    ply, npz = tmp_path / "cloud.ply", tmp_path / "frame.npz"
    arguments = ("correct", bag, "--camera", camera, "--ply", ply, "--npz", npz, "--force", "--frame")
    for index in (1, -1):
        status, out, err = run(capsys, *arguments, str(index))
        assert (status, err) == (0, "")
        chosen = index % 3
        assert out == f"frame {chosen} corrected: {ply} (107 points), {npz}\n"
        arrays = np.load(npz)
        assert arrays["stamp"] == 10**9 * (chosen + 1)
        assert {name: str(one.dtype) for name, one in arrays.items()} == {
            "distance": "float32", "sigma": "float32", "flags": "uint8", "amplitude": "float32",
            "points": "float32", "stamp": "int64",
        }  # fmt: skip
        assert np.argwhere(np.isnan(arrays["distance"])).tolist() == [[0, chosen]]
        lsb = 299792458.0 / 40e6 / 65536
        expected = np.float32(frames[chosen].distance[7, 3] * lsb)
        assert arrays["distance"][7, 3] == pytest.approx(expected, abs=1e-5)
        assert np.linalg.norm(arrays["points"][7, 3, :3]) == pytest.approx(expected, abs=1e-5)
        assert arrays["points"][7, 3, 3] == frames[chosen].amplitude[7, 3]
        header = ply.read_bytes().partition(b"end_header\n")[0].decode()
        assert "format binary_little_endian 1.0" in header
        assert "metres, optical frame: x right, y down, z forward" in header
        assert f"frame {chosen} of {bag}" in header


def test_notes_are_said_once(capsys: Capture, tmp_path: Path) -> None:
    text = CAMERA + "effects: {warm_up_drift: {terms: [{amplitude: 0.01, time_constant: 30}]}}\n"
    camera = write_text(tmp_path / "camera.yaml", text)
    bag = write_bag(tmp_path / "bag", [raw_frame(10**9 * i, uptime=None) for i in (1, 2, 3)])
    arguments = ("correct", bag, "--camera", camera, "--out", tmp_path / "out", "--force")
    status, _, err = run(capsys, *arguments)
    assert status == 0
    assert err.startswith("note: ")
    assert len(err.splitlines()) == 1
    assert "uptime" in err
    assert run(capsys, *arguments, "--quiet")[2] == ""


def test_the_waveform_makes_the_cyclic_error(capsys: Capture, tmp_path: Path, camera: Path) -> None:
    scene = write_text(tmp_path / "scene.yaml", SCENE)
    means = []
    for waveform in ("sinusoid", "harmonics:3=0.1"):
        out = tmp_path / waveform.partition(":")[0]
        arguments = ("--camera", camera, "--frames", "40", "--waveform", waveform, "--out", out)
        assert run(capsys, "simulate", scene, *arguments, "--quiet")[0] == 0
        with Recording(out) as recording:
            means.append(np.mean([one.distance[4, 5] for one in recording.frames()]))
    assert abs(means[1] - means[0]) * 299792458.0 / 40e6 / 65536 > 0.02


def test_the_seed_decides_the_noise(capsys: Capture, tmp_path: Path, camera: Path, scene: Path) -> None:
    images = []
    for i, seed in enumerate(("11", "11", "12")):
        out = tmp_path / f"bag{i}"
        arguments = ("--camera", camera, "--frames", "2", "--seed", seed, "--out", out)
        assert run(capsys, "simulate", scene, *arguments)[0] == 0
        with Recording(out) as recording:
            images.append([one.distance.tobytes() for one in recording.frames()])
    assert images[0] == images[1] != images[2]


def test_the_schedule_decides_the_number_of_frames(capsys: Capture, tmp_path: Path, camera: Path) -> None:
    scene = write_text(
        tmp_path / "scene.yaml",
        SCENE + "schedule:\n- {frames: 3, integration_time: 16}\n- {frames: 2, integration_time: 60}\n",
    )
    for more, expected in (((), [16] * 3 + [60] * 2), (("--frames", "7"), [16] * 3 + [60] * 2 + [16] * 2)):
        arguments = ("simulate", scene, "--camera", camera, "--out", tmp_path / "bag", "--force", *more)
        assert run(capsys, *arguments)[0] == 0
        with Recording(tmp_path / "bag") as recording:
            assert [one.settings.integration_time for one in recording.frames()] == expected


def test_progress_on_a_terminal_only(tmp_path: Path, camera: Path, scene: Path) -> None:
    master, slave = pty.openpty()
    arguments = ("simulate", scene, "--camera", camera, "--frames", "1500", "--out", tmp_path / "bag")
    running = process(*arguments, stderr=slave)
    os.close(slave)
    shown = b""
    with suppress(OSError):  # the end of a pseudo terminal
        while part := os.read(master, 4096):
            shown += part
    os.close(master)
    running.communicate(timeout=60)
    assert running.returncode == 0
    assert re.search(rb"\r\x1b\[Ksimulated \d+ of 1500 frames \(\d+/s, \d+ s left\)", shown)
    assert shown.endswith(b"\r\x1b[K")


def test_recording_without_ros_says_what_to_do(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['rclpy'] = None\n"
        "from rim_camera_ros.cli import main\n"
        f"sys.exit(main(['record', '--out', {str(tmp_path / 'bag')!r}]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env=dict(os.environ),
    )
    assert done.returncode == 1
    assert "recording needs ROS 2" in done.stderr
    assert "setup.bash" in done.stderr
    assert not (tmp_path / "bag").exists()


def test_the_desk_commands_load_neither_ros_nor_matplotlib() -> None:
    code = (
        "import sys\n"
        "from rim_camera_ros.cli import main\n"
        "assert main(['info', 'wall', '--camera', 'pmd3ks']) == 0\n"
        "print(sorted({'rclpy', 'matplotlib'} & set(sys.modules)))\n"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
