"""Bad input: one line that names file, place and remedy; the exit status; nothing left behind."""

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
from rim_camera_ros.bags.messages import image_message

from .helpers_cli import CAMERA, SCENE, nothing_left, raw_frame, run, write_bag, write_text

Capture = pytest.CaptureFixture[str]


def refused(capsys: Capture, match: str, *arguments: str | Path, status: int = 2) -> str:
    """Run ``rim`` and hold its error against a pattern."""
    found, out, err = run(capsys, *arguments)
    assert found == status, err
    assert out == ""
    assert len(err.splitlines()) == 1, err
    assert "Traceback" not in err
    assert err.startswith("rim: ")
    assert re.search(match, err), err
    return err


CAMERA_FAULTS = {
    "unknown key": (lambda t: t.replace("device:", "devise:"), r"camera\.yaml: devise \(line 3\): unknown key \(did you mean 'device'\?\)"),
    "misspelt effect": (lambda t: t + "effects: {cyclic_eror: {}}\n", r"effects\.cyclic_eror \(line \d+\): unknown effect \(did you mean 'cyclic_error'\?\)"),
    "effect that is a section": (lambda t: t + "effects: {lens_distortion: {}}\n", r"effects\.lens_distortion .*section 'optics'"),
    "unit in the value": (lambda t: t.replace("20.0e6", "20 MHz"), r"sensor\.modulation_frequency \(line \d+\): expected a number in Hz, found the text '20 MHz'"),
    "wrong type": (lambda t: t.replace("width: 12", "width: [12]"), r"sensor\.width \(line \d+\): expected a number in px, found a list"),
    "not whole": (lambda t: t.replace("width: 12", "width: 12.5"), r"sensor\.width .*whole number"),
    "NaN": (lambda t: t.replace("floor: 0.004", "floor: .nan"), r"noise\.floor \(line \d+\): must be finite, found nan"),
    "negative size": (lambda t: t.replace("height: 9", "height: -9"), r"sensor\.height \(line \d+\): must be at least 1 px, found -9"),
    "negative noise": (lambda t: t.replace("amplitude: 20.0", "amplitude: -20.0"), r"noise\.amplitude .*at least 0 m\*counts, found -20"),
    "missing key": (lambda t: t.replace("fx: 14.0, ", ""), r"optics \(line \d+\): key 'fx' is missing \[px\]"),
    "key twice": (lambda t: t + "device: other\n", r"device \(line \d+\): key given twice"),
    "alias of nothing": (lambda t: t + "provenance: {a: &x 1, b: *y}\n", r"line \d+: not valid YAML: found undefined alias 'y'"),
    "unsafe tag": (lambda t: t + "provenance: !!python/object/apply:os.system ['true']\n", r"not valid YAML: could not determine a constructor"),
    "not YAML": (lambda t: t + "optics: {fx: [\n", r"camera\.yaml: line \d+: not valid YAML"),
    "nested too deeply": (lambda t: t + "provenance: " + "[" * 3000 + "]" * 3000 + "\n", r"camera\.yaml: nested too deeply"),
    "another format": (lambda t: t.replace("rim_camera/1", "rim_camera/2"), r"format \(line \d+\): not a camera file: format is 'rim_camera/2' \(expected format: rim_camera/1\)"),
    "a scene": (lambda t: SCENE, r"not a camera file: format is 'rim_scene/1'"),
    "integration time 0": (lambda t: t.replace("modulation_frequency: 20.0e6", "modulation_frequency: 20.0e6, integration_time: 0"), r"sensor\.integration_time .*greater than 0"),
    "map is not there": (lambda t: t + "effects: {fixed_pattern_offset: {map: absent.npy}}\n", r"effects\.fixed_pattern_offset\.map \(line \d+\): no such file 'absent\.npy' \(it must lie beside this file\)"),
    "map of the wrong shape": (lambda t: t + "effects: {fixed_pattern_offset: {map: small.npy}}\n", r"effects\.fixed_pattern_offset .*shape \(3, 4\), expected \(9, 12\)"),
    "map outside the folder": (lambda t: t + "effects: {fixed_pattern_offset: {map: ../map.npy}}\n", r"'\.\./map\.npy' is not a \.npy file in the folder of this file"),
    "map by a link outside": (lambda t: t + "effects: {fixed_pattern_offset: {map: link.npy}}\n", r"'link\.npy' is not a \.npy file in the folder"),
    "map with pickles": (lambda t: t + "effects: {fixed_pattern_offset: {map: pickled.npy}}\n", r"'pickled\.npy' (cannot be read|holds no real numbers)"),
    "map with NaN": (lambda t: t + "effects: {fixed_pattern_offset: {map: nan.npy}}\n", r"'nan\.npy' holds values that are not finite"),
    "dark corners": (lambda t: t + "effects: {emission_pattern: {falloff: [-9.0, 0.0]}}\n", r"effects\.emission_pattern .*positive over the whole array"),
    "weights": (lambda t: t + "effects: {scattering: {kernels: [{weight: 0.6, sigma: [3, 3]}, {weight: 0.5, sigma: [9, 9]}]}}\n", r"effects\.scattering .*weights add up to 1\.1"),
    "folding lens": (lambda t: t.replace("cy: 4.1", "cy: 4.1, d: [-9.0, 0, 0, 0, 0]"), r"optics\.d .*folds back"),
}  # fmt: skip


@pytest.mark.parametrize("fault", CAMERA_FAULTS)
def test_camera_files(capsys: Capture, tmp_path: Path, fault: str) -> None:
    change, match = CAMERA_FAULTS[fault]
    folder = tmp_path / "files"
    folder.mkdir()
    np.save(folder / "small.npy", np.zeros((3, 4), np.float32))
    np.save(folder / "pickled.npy", np.array([{}], dtype=object), allow_pickle=True)
    np.save(folder / "nan.npy", np.full((9, 12), np.nan, np.float32))
    np.save(tmp_path / "map.npy", np.zeros((9, 12), np.float32))
    (folder / "link.npy").symlink_to(tmp_path / "map.npy")
    camera = write_text(folder / "camera.yaml", change(CAMERA))
    scene = write_text(tmp_path / "scene.yaml", SCENE)
    with nothing_left(tmp_path):
        refused(capsys, match, "simulate", scene, "--camera", camera, "--out", tmp_path / "bag")


SCENE_FAULTS = {
    "unknown key": (lambda t: t.replace("reflectivity", "reflectivty"), r"scene\.yaml: surfaces\.0\.reflectivty \(line \d+\): unknown key \(did you mean 'reflectivity'\?\)"),
    "unknown type": (lambda t: t.replace("type: plane", "type: plain"), r"surfaces\.0\.type .*unknown value 'plain' \(did you mean 'plane'\?\)"),
    "reflectivity": (lambda t: t.replace("0.7", "1.7"), r"surfaces\.0\.reflectivity .*at most 1, found 1\.7"),
    "rectangle without size": (lambda t: t.replace("type: plane", "type: rectangle"), r"surfaces\.0 .*a rectangle needs 'size"),
    "no unit quaternion": (lambda t: t.replace("[0, 0, 2.5]", "[0, 0, 2.5], orientation: [0, 0, 0, 2]"), r"surfaces\.0\.pose .*not a unit quaternion x y z w \(its norm is 2\)"),
    "two numbers": (lambda t: t.replace("[0, 0, 2.5]", "[0, 2.5]"), r"surfaces\.0\.pose\.position .*expected 3 values, found 2"),
    "no surfaces": (lambda t: "format: rim_scene/1\nsurfaces: []\n", r"scene\.yaml: .*surfaces is empty"),
    "behind the camera": (lambda t: t.replace("2.5", "-2.5"), r"scene\.yaml: no ray of the camera meets a surface \(surfaces must lie before the camera, at positive z\)"),
    "name twice": (lambda t: t + "- {name: wall, type: plane, pose: {position: [0, 0, 3]}}\n", r"surface name 'wall' is given twice"),
    "pose from nowhere": (lambda t: t.replace("{position: [0, 0, 2.5]}", "truth"), r"surface 'wall' has pose: truth.*--poses BAG"),
    "schedule of another": (lambda t: t + "schedule:\n- {frames: 2, poses: {wal: {position: [0, 0, 1]}}}\n", r"schedule\.0\.poses names 'wal'"),
    "a camera": (lambda t: CAMERA, r"not a scene file: format is 'rim_camera/1'"),
}  # fmt: skip


@pytest.mark.parametrize("fault", SCENE_FAULTS)
def test_scene_files(capsys: Capture, tmp_path: Path, fault: str) -> None:
    change, match = SCENE_FAULTS[fault]
    camera = write_text(tmp_path / "camera.yaml", CAMERA)
    scene = write_text(tmp_path / "scene.yaml", change(SCENE))
    with nothing_left(tmp_path):
        refused(capsys, match, "simulate", scene, "--camera", camera, "--out", tmp_path / "bag")


def test_names(capsys: Capture, tmp_path: Path) -> None:
    scene = write_text(tmp_path / "scene.yaml", SCENE)
    out = tmp_path / "bag"
    refused(capsys, r"sr300: no camera file of this name \(did you mean 'sr3000'\?", "simulate", scene, "--camera", "sr300", "--out", out)  # fmt: skip
    refused(capsys, r"absent\.yaml: no such file", "simulate", scene, "--camera", tmp_path / "absent.yaml", "--out", out)  # fmt: skip
    refused(capsys, r"neither a file nor the name of a shipped camera or scene", "info", "rom")


def test_usage(capsys: Capture, tmp_path: Path) -> None:
    assert run(capsys, "simulate", "wall", "--out", tmp_path / "bag")[0] == 2
    assert (
        run(capsys, "simulate", "wall", "--camera", "sr3000", "--frames", "0", "--out", tmp_path / "bag")[0]
        == 2
    )
    assert run(capsys)[0] == 2
    bag = write_bag(tmp_path / "bag", [raw_frame(10**9)])
    camera = write_text(tmp_path / "camera.yaml", CAMERA)
    refused(capsys, r"nothing to write \(give --out BAG", "correct", bag, "--camera", camera)
    refused(capsys, r"effect 'scatering' is not in the camera file", "correct", bag, "--camera", camera, "--without", "scatering", "--ply", tmp_path / "x.ply")  # fmt: skip
    refused(capsys, r"bag: --frame: there is no frame 3: it has 1 frame \(0 to 0, or -1 for the last\)", "correct", bag, "--camera", camera, "--frame", "3", "--ply", tmp_path / "x.ply")  # fmt: skip
    refused(capsys, r"no role 'distnce' \(did you mean 'distance'\?\)", "correct", bag, "--camera", camera, "--topic", "distnce=/x", "--out", tmp_path / "o")  # fmt: skip
    refused(capsys, r"--waveform: unknown waveform 'triangle'", "simulate", "wall", "--camera", camera, "--waveform", "triangle", "--out", tmp_path / "o")  # fmt: skip


@pytest.fixture
def correct(capsys: Capture, tmp_path: Path) -> Callable[..., str]:
    """Hold the error of ``rim correct`` on a recording against a pattern; nothing may be left."""
    camera = write_text(tmp_path / "camera.yaml", CAMERA)

    def check(bag: Path, match: str, status: int = 2) -> str:
        with nothing_left(tmp_path):
            return refused(
                capsys,
                match,
                "correct",
                bag,
                "--camera",
                camera,
                "--out",
                tmp_path / "out",
                "--quiet",
                status=status,
            )

    return check


def test_recordings(correct: Callable[..., str], tmp_path: Path) -> None:
    correct(tmp_path / "absent", r"absent: .*(no such|does not exist)")
    empty = tmp_path / "empty"
    empty.mkdir()
    correct(empty, r"empty: ")
    correct(write_text(tmp_path / "notes.txt", "not a bag at all\n"), r"notes\.txt: ")
    correct(write_text(tmp_path / "empty.mcap", ""), r"empty\.mcap: ")


def test_a_truncated_recording_gives_nothing(correct: Callable[..., str], tmp_path: Path) -> None:
    whole = write_bag(tmp_path / "bag", [raw_frame(10**9 + i * 10**8) for i in range(40)])
    file = next(whole.glob("*.mcap"))
    data = file.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 2])
    correct(cut, r"cut\.mcap: .*frames read before it: \d+")


def test_another_sensor(correct: Callable[..., str], tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", [raw_frame(10**9, (10, 12))])
    correct(
        bag,
        r"bag: images of 12 x 10 px, but the camera file is for 12 x 9 \(give the camera file of this sensor\)",
    )


def test_images_of_changing_size(correct: Callable[..., str], tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", [raw_frame(10**9), raw_frame(2 * 10**9, (8, 12))])
    correct(bag, r"bag: .*12 x 8")


def test_stamps_that_run_backwards(correct: Callable[..., str], tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for stamp in (3 * 10**9, 2 * 10**9):
            frame = raw_frame(stamp)
            for topic, image in (("distance", frame.distance), ("amplitude", frame.amplitude)):
                writer.write_message(
                    f"/camera/{topic}/image_raw", "sensor_msgs/msg/Image", 10**10, image_message(image, stamp)
                )
    correct(
        tmp_path / "bag",
        r"bag: topic /camera/distance/image_raw at 2\.0+ s: the stamp is not after the one before, 3\.0+ s",
    )


@pytest.mark.parametrize(
    ("topic", "match"),
    [
        ("/camera/distance/image_raw", r"amplitude.*--topic amplitude=name"),
        ("/camera/amplitude/image_raw", r"distance.*--topic distance=name"),
    ],
)
def test_one_image_without_the_other(
    correct: Callable[..., str], tmp_path: Path, topic: str, match: str
) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        writer.write_message(
            topic, "sensor_msgs/msg/Image", 10**9, image_message(raw_frame(10**9).distance, 10**9)
        )
    correct(tmp_path / "bag", match)


def test_a_distance_of_eight_bits(correct: Callable[..., str], tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for topic in ("distance", "amplitude"):
            image = image_message(np.ones((9, 12), np.uint8), 10**9)
            image.encoding = "mono8"
            writer.write_message(f"/camera/{topic}/image_raw", "sensor_msgs/msg/Image", 10**9, image)
    correct(tmp_path / "bag", r"mono8")


def test_settings_that_are_missing(capsys: Capture, tmp_path: Path) -> None:
    rows = "effects: {integration_time_offset: {offset: {16: 0.1, 60: 0.2}}}\n"
    camera = write_text(tmp_path / "camera.yaml", CAMERA + rows)
    bag = write_bag(tmp_path / "bag", [raw_frame(10**9, integration_time=None)])
    with nothing_left(tmp_path):
        refused(
            capsys, r"sensor\.integration_time: .*no integration_time.*give sensor\.integration_time",
            "correct", bag, "--camera", camera, "--out", tmp_path / "out", "--quiet",
        )  # fmt: skip


def test_an_output_that_exists(capsys: Capture, tmp_path: Path) -> None:
    camera = write_text(tmp_path / "camera.yaml", CAMERA)
    scene = write_text(tmp_path / "scene.yaml", SCENE)
    out = write_bag(tmp_path / "out", [raw_frame(10**9)])
    arguments = ("simulate", scene, "--camera", camera, "--frames", "2", "--out")
    with nothing_left(tmp_path):
        refused(capsys, r"out: exists already \(--force replaces it\)", *arguments, out)
    assert run(capsys, *arguments, out, "--force")[0] == 0
    foreign = tmp_path / "thesis"
    foreign.mkdir()
    write_text(foreign / "chapter.txt", "years of work")
    with nothing_left(tmp_path):
        refused(capsys, r"thesis: ", *arguments, foreign, "--force")
    assert (foreign / "chapter.txt").read_text() == "years of work"
    ply = write_text(tmp_path / "cloud.ply", "old")
    refused(capsys, r"cloud\.ply: exists already", "correct", out, "--camera", camera, "--ply", ply)
    assert ply.read_text() == "old"


def test_a_folder_that_is_not_there(capsys: Capture, tmp_path: Path) -> None:
    refused(capsys, r"absent/bag: its folder does not exist", "simulate", "wall", "--camera", "sr3000", "--out", tmp_path / "absent" / "bag")  # fmt: skip


def test_a_full_disk(tmp_path: Path) -> None:
    """A file-size limit stands in for a full disk: writing fails half-way."""
    scene = write_text(tmp_path / "scene.yaml", SCENE)
    camera = write_text(tmp_path / "camera.yaml", CAMERA)

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))

    with nothing_left(tmp_path):
        done = subprocess.run(
            [
                sys.executable, "-m", "rim_camera_ros.cli", "simulate", str(scene), "--camera", str(camera),
                "--frames", "2000", "--out", str(tmp_path / "bag"),
            ],
            capture_output=True, text=True, timeout=120, check=False, preexec_fn=limit, env=dict(os.environ),
        )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert re.search(r"rim: .*bag: .*(large|space|full).*", done.stderr), done.stderr


def test_a_frame_before_the_first_pose(capsys: Capture, tmp_path: Path) -> None:
    from rim_camera_ros.frame import Pose

    truth = write_text(tmp_path / "scene.yaml", SCENE.replace("{position: [0, 0, 2.5]}", "truth"))
    camera = write_text(tmp_path / "camera.yaml", CAMERA)
    late = replace(
        raw_frame(2 * 10**9), truth={"wall": Pose((0.0, 0.0, 2.0))}, pose_stamps={"wall": 2 * 10**9}
    )
    bag = write_bag(tmp_path / "bag", [raw_frame(10**9), late])
    with nothing_left(tmp_path):
        refused(
            capsys, r"surface 'wall' has pose: truth, but no pose is known for this frame",
            "simulate", truth, "--camera", camera, "--poses", bag, "--out", tmp_path / "out",
        )  # fmt: skip
