"""The commands from end to end."""

from __future__ import annotations

import json
import os
import signal
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.bags import Recording

from .helpers_cli import CAMERA, SCENE, nothing_left, process, raw_frame, run, write_bag, write_text

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
    ratios = [row["sigma_m"] / row["model_m"] for row in facts["noise"]]
    assert ratios
    assert all(0.85 < one < 1.15 for one in ratios)


def test_simulating_the_poses_of_a_recording(capsys: Capture, tmp_path: Path, camera: Path) -> None:
    from dataclasses import replace

    from rim_camera_ros.frame import Pose

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


@pytest.mark.parametrize("name", ["sr3000", "sr2", "pmd3ks", "sr3000_every_effect"])
def test_info_on_shipped_cameras(capsys: Capture, name: str) -> None:
    status, out, err = run(capsys, "info", name)
    assert (status, err) == (0, "")
    assert "field of view" in out
    facts = json.loads(run(capsys, "info", name, "--json")[1])
    assert facts["kind"] == "camera"
    if name == "sr3000":
        assert facts["ambiguity_range_m"] == pytest.approx(7.49481, abs=1e-5)
        assert facts["distance_lsb_m"] * 1e3 == pytest.approx(0.114, abs=5e-4)


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


def test_interrupted_twice(tmp_path: Path, camera: Path, scene: Path) -> None:
    """Ctrl-C twice: 130, one line, nothing left."""
    work = tmp_path / "work"
    work.mkdir()
    with nothing_left(work):
        running = process(
            "simulate", scene, "--camera", camera, "--frames", "100000000", "--out", work / "bag"
        )
        while not any(work.iterdir()):
            assert running.poll() is None, running.stderr
        running.send_signal(signal.SIGINT)
        with suppress(ProcessLookupError):
            running.send_signal(signal.SIGINT)
        _, err = running.communicate(timeout=30)
        assert running.returncode == 130
        assert err.strip() == "rim: interrupted"


def test_a_reader_that_goes_away(camera: Path) -> None:
    running = process("info", "sr3000")
    assert running.stdout is not None
    running.stdout.close()
    assert running.stderr is not None
    err = running.stderr.read()
    running.wait(30)
    assert "Traceback" not in err
    assert "Exception" not in err
    assert running.returncode in (0, 1, -signal.SIGPIPE)


def test_recording_without_ros_says_what_to_do(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['rclpy'] = None\n"
        "from rim_camera_ros.cli import main\n"
        f"sys.exit(main(['record', '--out', {str(tmp_path / 'bag')!r}]))\n"
    )
    import subprocess
    import sys

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
