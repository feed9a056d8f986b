"""Outputs that would do harm, and usage: one line, nothing changed, nothing left behind."""

from __future__ import annotations

# ruff: noqa: E501 -- one fault a line
import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.bags.messages import image_message, temperature_message
from rim_camera_ros.frame import Pose

from .helpers_cli import CAMERA, SCENE, nothing_left, raw_frame, run, write_bag, write_text

Capture = pytest.CaptureFixture[str]


def contents(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder."""
    return {str(one): one.read_bytes() for one in folder.rglob("*") if one.is_file() and not one.is_symlink()}


@pytest.fixture
def refused(capsys: Capture, tmp_path: Path) -> Callable[..., None]:
    """Hold the error of ``rim`` against a pattern; no file may have changed."""

    def check(match: str, *arguments: str | Path, status: int = 2) -> None:
        before = contents(tmp_path)
        with nothing_left(tmp_path):
            found, out, err = run(capsys, *arguments)
        assert (found, out) == (status, ""), err
        assert len(err.splitlines()) == 1, err
        assert err.startswith("rim: ")
        assert re.search(match, err), err
        assert contents(tmp_path) == before

    return check


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    return write_text(tmp_path / "camera.yaml", CAMERA)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "bag", [raw_frame(10**9), raw_frame(2 * 10**9)])


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_no_input_is_overwritten(
    refused: Callable[..., None], tmp_path: Path, camera: Path, bag: Path, force: list[str]
) -> None:
    """Not even with --force: a raw recording cannot be had again."""
    start = ("correct", bag, "--camera", camera, *force)
    file = next(bag.glob("*.mcap"))
    refused(r"bag: --out would overwrite the input bag \(give another name\)", *start, "--out", bag)
    refused(r"bag: --out would overwrite the input bag", *start, "--out", tmp_path / "x" / ".." / "bag")
    refused(
        r"bag: --out would overwrite the input bag\.mcap",
        "correct", file, "--camera", camera, *force, "--out", bag,
    )  # fmt: skip
    refused(r"x\.ply: --ply lies in the input bag", *start, "--ply", bag / "x.ply")
    refused(r"bag\.mcap: --ply lies in the input bag", *start, "--ply", file)
    refused(r"camera\.yaml: --npz would overwrite the input camera\.yaml", *start, "--npz", camera)
    link = tmp_path / "link"
    link.symlink_to(bag)
    refused(r"link: --out would overwrite the input bag", *start, "--out", link)
    scene = write_text(tmp_path / "scene.yaml", SCENE)
    start = ("simulate", scene, "--camera", camera, "--poses", bag, *force)
    refused(r"bag: --out would overwrite the input bag", *start, "--out", bag)
    refused(r"scene\.yaml: --out would overwrite the input scene\.yaml", *start, "--out", scene)


def test_two_outputs_of_one_name(
    refused: Callable[..., None], tmp_path: Path, camera: Path, bag: Path
) -> None:
    out = tmp_path / "out"
    refused(
        r"out: is both --ply and --npz \(give two names\)",
        "correct", bag, "--camera", camera, "--ply", out, "--npz", out,
    )  # fmt: skip


def test_a_folder_that_may_not_be_written_to_is_reported_before_the_work(
    refused: Callable[..., None], tmp_path: Path, camera: Path, bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.open

    def denied(path: str | Path, flags: int, *mode: int, **options: int) -> int:
        if flags & os.O_CREAT:
            raise PermissionError(13, "Permission denied")
        return real(path, flags, *mode, **options)

    monkeypatch.setattr(os, "open", denied)
    out = tmp_path / "out"
    refused(r"out: cannot be written: Permission denied \(give a folder", "correct", bag, "--camera", camera, "--out", out)  # fmt: skip
    assert not out.exists()


def test_outputs_are_checked_before_the_work(
    refused: Callable[..., None], tmp_path: Path, camera: Path, bag: Path
) -> None:
    """One bad output among several: none is written."""
    out = ("--out", tmp_path / "out")
    start = ("correct", bag, "--camera", camera, *out)
    refused(
        r"no/x\.ply: its folder does not exist \(make it: mkdir -p .*no\)",
        *start,
        "--ply",
        tmp_path / "no/x.ply",
    )
    (tmp_path / "folder").mkdir()
    refused(r"folder: is a folder, not a file", *start, "--npz", tmp_path / "folder", "--force")
    old = write_text(tmp_path / "old.npz", "old")
    refused(r"old\.npz: exists already \(--force replaces it\)", *start, "--npz", old)
    refused(
        r"--frame: there is no frame 2: it has 2 frames \(0 to 1",
        *start,
        "--ply",
        tmp_path / "x",
        "--frame",
        "2",
    )
    refused(r"--frame: there is no frame -3", *start, "--ply", tmp_path / "x", "--frame", "-3")
    refused(r"--frame: is the frame of --ply or --npz, and neither is given", *start, "--frame", "1")


def test_only_a_recording_is_replaced(
    refused: Callable[..., None], capsys: Capture, tmp_path: Path, camera: Path, bag: Path
) -> None:
    start = ("correct", bag, "--camera", camera, "--force", "--out")
    (tmp_path / "empty").mkdir()
    refused(r"empty: is not replaced: it is an empty folder", *start, tmp_path / "empty")
    mixed = write_bag(tmp_path / "mixed", [raw_frame(10**9)])
    write_text(mixed / "notes.txt", "mine")
    refused(r"mixed: is not replaced: it holds notes\.txt", *start, mixed)
    refused(r"text: is not replaced: it is not a recording", *start, write_text(tmp_path / "text", "mine"))
    other = write_bag(tmp_path / "other", [raw_frame(10**9)])
    link = tmp_path / "link"
    link.symlink_to(other)
    refused(r"link: is not replaced: it is a link", *start, link)
    assert run(capsys, *start, other)[0] == 0


def test_a_full_disk_while_one_frame_is_written(tmp_path: Path, camera: Path, bag: Path) -> None:
    """A limit of the file size stands in for the full disk; the old file stays."""
    old = write_text(tmp_path / "frame.npz", "old")

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    command = [sys.executable, "-m", "rim_camera_ros.cli", "correct", bag, "--camera", camera, "--npz", old]
    with nothing_left(tmp_path):
        done = subprocess.run(
            [*map(str, command), "--force"],
            capture_output=True, text=True, timeout=60, check=False, preexec_fn=limit, env=dict(os.environ),
        )  # fmt: skip
    assert done.returncode == 1
    assert re.fullmatch(r"rim: .*frame\.npz: cannot be written: .*nothing was left behind\)\n", done.stderr)
    assert old.read_text() == "old"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_output_to_a_full_device() -> None:
    command = [sys.executable, "-m", "rim_camera_ros.cli", "info", "sr2"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            command,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            check=False,
            env=dict(os.environ),
        )
    assert done.returncode == 1
    assert re.fullmatch(r"rim: reading or writing failed: No space left on device .*\n", done.stderr)


USAGE = {
    "misspelt command": (["simulte", "wall"], r"no command 'simulte' \(did you mean 'simulate'\?\)"),
    "no command": ([], r"the following arguments are required: COMMAND \(see rim --help\)"),
    "missing option": (["simulate", "wall", "--out", "x"], r"simulate: .*required: --camera \(see rim simulate --help\)"),
    "unknown option": (["info", "wall", "--camrea", "sr2"], r"unrecognized arguments: --camrea sr2"),
    "abbreviated option": (["info", "wall", "--cam", "sr2"], r"unrecognized arguments: --cam sr2"),
    "no number": (["simulate", "wall", "--camera", "sr2", "--out", "x", "--frames", "ten"], r"argument --frames: invalid whole number value: 'ten'"),
    "half a frame": (["simulate", "wall", "--camera", "sr2", "--out", "x", "--frames", "1.5"], r"argument --frames: invalid whole number value: '1\.5'"),
    "negative rate": (["simulate", "wall", "--camera", "sr2", "--out", "x", "--rate", "-5"], r"argument --rate: must be positive, found -5"),
    "rate NaN": (["simulate", "wall", "--camera", "sr2", "--out", "x", "--rate", "nan"], r"argument --rate: must be positive, found nan"),
    "rate without end": (["simulate", "wall", "--camera", "sr2", "--out", "x", "--rate", "inf"], r"argument --rate: must be positive, found inf"),
    "integration time 0": (["simulate", "wall", "--camera", "sr2", "--out", "x", "--integration-time", "0"], r"argument --integration-time: must be positive, found 0"),
    "negative seed": (["simulate", "wall", "--camera", "sr2", "--out", "x", "--seed", "-1"], r"--seed -1 is not a number from 0 to"),
    "topic without =": (["correct", "@bag", "--camera", "@camera", "--out", "x", "--topic", "distance"], r"--topic distance: no '=' in it \(--topic role=name\)"),
    "topic twice": (["correct", "@bag", "--camera", "@camera", "--out", "x", "--topic", "flags=/a", "--topic", "flags=/b"], r"the role flags is given twice"),
    "namespace": (["correct", "@bag", "--camera", "@camera", "--out", "x", "--namespace", "my camera"], r"namespace: 'my camera' is not a topic name"),
    "minimum amplitude": (["correct", "@bag", "--camera", "@camera", "--ply", "x", "--minimum-amplitude", "nan"], r"--minimum-amplitude must be 0 or more counts, found nan"),
    "rate with poses": (["simulate", "wall", "--camera", "@camera", "--poses", "@bag", "--out", "x", "--rate", "5"], r"--rate and --integration-time come from the recording"),
    "camera of a camera": (["info", "sr2", "--camera", "sr2"], r"sr2: is a camera file itself \(leave --camera out\)"),
    "camera of another sensor": (["info", "@bag", "--camera", "sr2"], r"bag: images of 12 x 9 px, but the camera file is for 160 x 124 \(give the camera file of this sensor\)"),
    "nearest shipped name": (["info", "sr300"], r"sr300: neither a file nor .* shipped .*\(did you mean 'sr3000'\?"),
    "nearest shipped scene": (["simulate", "rom", "--camera", "sr2", "--out", "x"], r"rom: no scene file of this name \(did you mean 'room'\?"),
    "absent": (["info", "no/such.yaml"], r"no/such\.yaml: no such file"),
    "other YAML": (["info", "@yaml"], r"other\.yaml: neither a camera file nor a scene file: it states no format"),
}  # fmt: skip


@pytest.mark.parametrize("fault", USAGE)
def test_usage(
    refused: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    camera: Path,
    bag: Path,
    fault: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    other = write_text(tmp_path / "other.yaml", "a: 1\n")
    files = {"@bag": bag, "@camera": camera, "@yaml": other}
    arguments, match = USAGE[fault]
    refused(match, *[files.get(one, one) for one in arguments])


def test_a_shipped_name_that_is_also_a_folder(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, camera: Path
) -> None:
    """As after ``rim simulate wall --out wall``."""
    monkeypatch.chdir(tmp_path)
    for more in ((), ("--force",)):
        arguments = ("simulate", "wall", "--camera", camera, "--frames", "2", "--out", "wall", *more)
        assert run(capsys, *arguments) == (0, "2 frames simulated: wall\n", "")


@pytest.mark.parametrize("encoding", ["rgb8", "mono8", "64FC1"])
def test_a_wrong_encoding(refused: Callable[..., None], tmp_path: Path, camera: Path, encoding: str) -> None:
    """The second frame is wrong: what came before it must not be left."""
    with RecordingWriter(tmp_path / "coded") as writer:
        for i in (1, 2):
            for topic in ("distance", "amplitude"):
                image = image_message(raw_frame(1).distance, 10**9 * i)
                if i == 2 and topic == "distance":
                    image.encoding = encoding
                writer.write_message(f"/camera/{topic}/image_raw", "sensor_msgs/msg/Image", 10**9 * i, image)
    refused(
        rf"coded: topic /camera/distance/image_raw at 2\.0+ s: encoding '{encoding}' .*accepted: 16UC1",
        "correct", tmp_path / "coded", "--camera", camera, "--out", tmp_path / "out",
    )  # fmt: skip


def test_recordings_of_something_else(refused: Callable[..., None], tmp_path: Path, camera: Path) -> None:
    with RecordingWriter(tmp_path / "weather") as writer:
        message = temperature_message(21.5, 10**9)
        writer.write_message("/weather", "sensor_msgs/msg/Temperature", 10**9, message)
    out = ("--camera", camera, "--out", tmp_path / "out")
    refused(
        r"weather: no topic /camera/distance/image_raw; .*topics: /weather \(name it with --topic distance=name\)",
        "correct", tmp_path / "weather", *out,
    )  # fmt: skip
    with RecordingWriter(tmp_path / "typed") as writer:
        for topic in ("distance", "amplitude"):
            message = temperature_message(21.5, 10**9)
            name = f"/camera/{topic}/image_raw"
            writer.write_message(name, "sensor_msgs/msg/Temperature", 10**9, message)
    refused(
        r"typed: topic /camera/distance/image_raw: its type is sensor_msgs/msg/Temperature",
        "correct", tmp_path / "typed", *out,
    )  # fmt: skip
    binary = tmp_path / "noise.mcap"
    binary.write_bytes(np.random.default_rng(1).bytes(5000))
    refused(r"noise\.mcap: is not a recording", "correct", binary, *out)


def test_a_truncated_recording_and_a_frame_beyond_the_cut(
    refused: Callable[..., None], tmp_path: Path, camera: Path
) -> None:
    whole = write_bag(tmp_path / "whole", [raw_frame(10**9 + i * 10**8) for i in range(40)])
    data = next(whole.glob("*.mcap")).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 3])
    refused(
        r"cut\.mcap: --frame: there is no frame 35: it has \d+ frames",
        "correct", cut, "--camera", camera, "--frame", "35", "--ply", tmp_path / "x.ply",
    )  # fmt: skip


def test_the_place_of_a_frame_before_its_pose(
    refused: Callable[..., None], tmp_path: Path, camera: Path
) -> None:
    scene = write_text(tmp_path / "scene.yaml", SCENE.replace("{position: [0, 0, 2.5]}", "truth"))
    late = replace(
        raw_frame(3 * 10**9), truth={"wall": Pose((0.0, 0.0, 2.0))}, pose_stamps={"wall": 3 * 10**9}
    )
    poses = write_bag(tmp_path / "poses", [raw_frame(2 * 10**9), late])
    refused(
        r"poses: frame at 2\.0+ s: surface 'wall' has pose: truth, but no pose is known .*/ground_truth/wall/pose",
        "simulate", scene, "--camera", camera, "--poses", poses, "--out", tmp_path / "out",
    )  # fmt: skip


def test_a_scene_that_the_camera_does_not_see_at_all(
    refused: Callable[..., None], tmp_path: Path, camera: Path
) -> None:
    scene = write_text(tmp_path / "scene.yaml", SCENE.replace("2.5", "-2.5"))
    refused(r"scene\.yaml: no ray of the camera meets a surface \(surfaces must lie", "info", scene, "--camera", camera)  # fmt: skip
