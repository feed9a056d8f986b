"""``rim calibrate`` as a user meets it: files, table, report, errors in one line, nothing harmed."""

from __future__ import annotations

import hashlib
import os
import re
import signal
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import yaml

from rim_camera_ros.calibrate.effect_status import likelier
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import draw_parameters, load_camera, save_camera
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.noise import Noise

from ..helpers_cli import nothing_left, process, run
from .bags import frames, write
from .helpers import SCENE, camera, scene

TRUE = CyclicError((Harmonic(4, 0.012, 0.8),))
STATED = CyclicError((Harmonic(4, 0.008, 0.5),))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording, camera file and scene file."""
    folder = tmp_path_factory.mktemp("command")
    truth: Camera = camera(folder, TRUE)
    (folder / "scene.yaml").write_text(SCENE)
    write(folder / "bag", frames(truth, scene(folder), poses=15, repeats=3, seed=2))
    save_camera(replace(truth, effects={"cyclic_error": STATED}), folder / "start.yaml")
    return folder


def arguments(folder: Path, *more: str | Path, out: str = "out.yaml") -> list[str | Path]:
    files = ["--camera", folder / "start.yaml", "--scene", folder / "scene.yaml", "--out", folder / out]
    return ["calibrate", folder / "bag", *files, *more]


@pytest.fixture(scope="module")
def written(folder: Path) -> tuple[Path, str]:
    """A calibrated camera file and what the command printed."""
    child = process(*arguments(folder, "--effects", "cyclic_error"))
    out, error = child.communicate(timeout=200)
    assert child.returncode == 0, error
    assert error == ""
    return folder / "out.yaml", out


def test_the_table_names_parameters_with_sigma(written: tuple[Path, str]) -> None:
    text = written[1]
    assert "parameter" in text.splitlines()[0]
    line = next(one for one in text.splitlines() if "harmonics.0.amplitude" in one)
    name, before, after, sigma, unit = line.split()
    assert name == "harmonics.0.amplitude"
    assert float(before) == 0.008
    assert float(after) == pytest.approx(0.012, abs=4 * float(sigma))
    assert float(sigma) < 0.0005
    assert unit == "m"
    assert "distances of 15 held-out poses" in text
    assert "chi-square per value" in text
    assert "not determined by these recordings" in text
    assert text.splitlines()[-1].startswith("written: ")


def test_the_camera_file_states_all(folder: Path, written: tuple[Path, str]) -> None:
    found = load_camera(written[0])
    assert found.covariance is not None
    names = found.covariance.parameters
    assert "effects.cyclic_error.harmonics.0.amplitude" in names
    assert "radiometry.gain" in names
    matrix = found.covariance.matrix.values
    assert np.all(np.linalg.eigvalsh(matrix / np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))) > 0)
    assert found.validity.integration_time == (16.0, 100.0)
    said = found.provenance
    bag = folder / "bag"
    whole = hashlib.sha256()
    for one in sorted(p for p in bag.rglob("*") if p.is_file()):
        digest = hashlib.sha256(one.read_bytes()).hexdigest()
        whole.update(f"{one.relative_to(bag)} {digest}\n".encode())
    assert said["recordings"] == [{"path": str(bag), "sha256": whole.hexdigest(), "frames": 45, "poses": 15}]
    assert said["program"].startswith("rim_camera_ros ")
    assert said["command"].startswith("rim calibrate ")
    assert f"--scene {folder / 'scene.yaml'} --out " in said["command"]
    assert "--effects cyclic_error" in said["command"]
    assert said["fitted"] == ["cyclic_error", "radiometry"]
    assert "no pixel of the recordings is saturated" in said["left_out"]["saturation_bleed"]
    assert said["accuracy"]["held_out_poses"] == 15
    assert (
        0 <= said["accuracy"]["systematic_m"] < said["accuracy"]["rms_m"] < said["accuracy"]["rms_before_m"]
    )
    # what draws cameras from their covariance takes it
    drawn = draw_parameters(found, np.random.default_rng(1))
    assert drawn.effects["cyclic_error"] != found.effects["cyclic_error"]


def test_arrays_are_named_after_the_file(written: tuple[Path, str]) -> None:
    data = yaml.safe_load(written[0].read_text())
    for name in (data["covariance"]["matrix"], data["effects"]["fixed_pattern_offset"]["map"]):
        assert name.startswith("out.")
        assert (written[0].parent / name).is_file()


def test_the_report_stands_alone(written: tuple[Path, str]) -> None:
    page = written[0].with_name("out.report.html").read_text()
    assert page.startswith("<!DOCTYPE html>")
    headings = re.findall("<h2[^>]*>([^<]*)", page)
    assert {"Effects: error before and after", "Errors of held-out poses", "Parameters", "Provenance"} <= {
        *headings
    }
    assert "By a table instead of physics" in page
    assert page.count("data:image/svg+xml;base64,") >= 6
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "<script" not in page


@pytest.mark.long
def test_a_file_beside_another_harms_nothing(
    folder: Path, written: tuple[Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    """A second file made from the first, in the same folder, and the first made anew by --force."""
    first = {one: one.read_bytes() for one in folder.glob("out.*")}
    second = ["calibrate", folder / "bag", "--camera", written[0], "--scene", folder / "scene.yaml"]
    status, _, error = run(capsys, *second, "--out", folder / "second.yaml", "--effects", "cyclic_error")
    assert (status, error) == (0, "")
    assert {one: one.read_bytes() for one in folder.glob("out.*")} == first
    assert load_camera(folder / "second.yaml").covariance is not None
    status, _, error = run(capsys, *second, "--out", written[0], "--effects", "distance_scale")
    assert status == 2
    assert "out.yaml: exists already (--force replaces it)" in error
    assert {one: one.read_bytes() for one in folder.glob("out.*")} == first


@pytest.mark.long
def test_replacing_the_file_that_is_read(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = folder / "own"
    own.mkdir()
    again = ["calibrate", folder / "bag", "--camera", own / "c.yaml", "--scene", folder / "scene.yaml"]
    again += ["--out", own / "c.yaml", "--effects", "cyclic_error", "--no-report", "--quiet", "--force"]
    save_camera(load_camera(folder / "start.yaml"), own / "c.yaml")
    assert run(capsys, *again) == (0, "", "")
    once = load_camera(own / "c.yaml")
    # a copy of it goes on naming its arrays
    (own / "copy.yaml").write_bytes((own / "c.yaml").read_bytes())
    assert run(capsys, *again) == (0, "", "")
    load_camera(own / "copy.yaml")
    twice = load_camera(own / "c.yaml")
    (own / "copy.yaml").unlink()
    assert run(capsys, *again) == (0, "", "")
    assert len(list(own.glob("*.npy"))) == 2
    amplitude = [one.effects["cyclic_error"].harmonics[0].amplitude for one in (once, twice)]
    assert amplitude[0] == pytest.approx(amplitude[1], abs=2e-5)


@pytest.mark.parametrize(
    ("more", "match"),
    [
        (
            ["--effects", "cyclic_eror"],
            "--effects: unknown effect 'cyclic_eror' (did you mean 'cyclic_error'?)",
        ),
        (["--effects", ","], "--effects names none"),
        (["--effects", "ambient_temperature:3"], "unknown effect 'ambient_temperature:3'"),
        (["--seed", "-1"], "--seed -1 is not a number from 0 to 2^64 - 1"),
        (["--effects", "saturation_bleed"], "no pixel of the recordings is saturated"),
    ],
)
def test_bad_usage_is_one_line_and_leaves_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], more: list[str], match: str
) -> None:
    with nothing_left(folder):
        status, out, error = run(capsys, *arguments(folder, *more, out="never.yaml"))
    assert (status, out) == (2, "")
    assert match in error
    assert error.count("\n") == 1


def test_bad_files_are_one_line(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    def fails(*words: str | Path) -> str:
        with nothing_left(folder):
            status, out, error = run(capsys, "calibrate", *words)
        assert (status, out) == (2, "")
        assert error.count("\n") == 1
        return error

    bag, start, board = folder / "bag", folder / "start.yaml", folder / "scene.yaml"
    out = tmp_path / "c.yaml"
    given = ["--camera", start, "--scene", board]
    assert "without a scene nothing says what the camera saw" in fails(bag, "--camera", start, "--out", out)
    assert "a camera file ends in .yaml" in fails(bag, *given, "--out", tmp_path / "c")
    assert "its folder does not exist" in fails(bag, *given, "--out", tmp_path / "none" / "c.yaml")
    assert "is given twice (give each recording once)" in fails(bag, bag, *given, "--out", out)
    assert "would overwrite the input scene.yaml" in fails(bag, *given, "--out", board, "--force")
    assert "start.yaml: exists already" in fails(bag, *given, "--out", start)
    assert "no such file or folder" in fails(folder / "nobag", *given, "--out", out).lower()


def test_an_unfinished_recording_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    whole = next((folder / "bag").glob("*.mcap")).read_bytes()
    given = [
        "--camera",
        folder / "start.yaml",
        "--scene",
        folder / "scene.yaml",
        "--out",
        tmp_path / "c.yaml",
    ]
    for share, match in ((0.8, "the recording ends in the middle"), (0.01, "cut.mcap: ")):
        cut.write_bytes(whole[: int(len(whole) * share)])
        status, out, error = run(capsys, "calibrate", cut, *given)
        assert (status, out) == (2, "")
        assert match in error
        assert error.count("\n") == 1
        assert not (tmp_path / "c.yaml").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_interrupted_nothing_is_written(folder: Path) -> None:
    with nothing_left(folder):
        child = process(*arguments(folder, out="late.yaml"))
        watched = psutil.Process(child.pid)
        # its name is claimed after all imports, and the fit follows
        while child.poll() is None and not list(folder.glob(".late.yaml.*claim")):
            threading.Event().wait(0.02)
        begun = watched.cpu_times().user
        while child.poll() is None and watched.cpu_times().user < begun + 0.5:
            threading.Event().wait(0.02)
        os.kill(child.pid, signal.SIGINT)
        out, error = child.communicate(timeout=60)
    assert child.returncode == 130
    assert error == "rim: interrupted: nothing was written\n"
    assert out == ""


@pytest.mark.long
def test_without_matplotlib_there_is_no_report(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in [one for one in sys.modules if one.startswith(("matplotlib", "rim_camera_ros.reports.fig"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "rim_camera_ros.reports.calibration", raising=False)
    monkeypatch.delitem(sys.modules, "rim_camera_ros.reports.curves", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    given = ["--camera", folder / "start.yaml", "--scene", folder / "scene.yaml", "--effects", "cyclic_error"]
    status, out, error = run(capsys, "calibrate", folder / "bag", *given, "--out", tmp_path / "c.yaml")
    assert status == 0
    assert (
        "no report was written: matplotlib is not installed (pip install 'rim_camera_ros[reports]'" in error
    )
    assert out.splitlines()[-1] == f"written: {tmp_path / 'c.yaml'}"
    assert not list(tmp_path.glob("*.html"))


def test_a_noise_model_is_stated_in_the_file(folder: Path, written: tuple[Path, str]) -> None:
    # confirmed, so that the numbers of the file stay as they are
    assert load_camera(written[0]).noise == Noise(floor=0.003, shot=0.0, amplitude=6.0)
    assert "confirmed: floor 3 mm" in written[1]


@pytest.mark.long
def test_offsets_of_pixels_alone(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Beside a file that other programs keep there and that cannot be read, and without its picture."""
    own = folder / "of pixels"
    own.mkdir()
    (own / ".#scene.yaml").symlink_to("somebody@somewhere.1234")
    status, out, _ = run(
        capsys, *arguments(folder, "--effects", "fixed_pattern_offset", out="of pixels/c.yaml")
    )
    assert status == 0
    assert out.splitlines()[-1].startswith("written: ")
    found = load_camera(own / "c.yaml")
    assert "fixed_pattern_offset" in found.effects
    assert found.effects["cyclic_error"] == STATED


@pytest.mark.long
def test_what_speaks_for_an_effect_that_is_not_fitted_is_said_without_units_of_evidence(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A cyclic error of 12 mm and a scale, which alone was requested; 10 nats are a factor of 22,026."""
    assert likelier(10.0) == "held-out poses are 10^4 times as probable"
    plain = replace(load_camera(folder / "start.yaml"), effects={})
    save_camera(plain, folder / "plain.yaml")
    files = [
        "--camera",
        folder / "plain.yaml",
        "--scene",
        folder / "scene.yaml",
        "--out",
        folder / "scale.yaml",
    ]
    words = ["calibrate", folder / "bag", *files, "--effects", "distance_scale", "--force-result"]
    status, out, error = run(capsys, *words)
    assert status == 0, error
    said = r"not fitted, at most [\d.]+ mm RMS, though with it held-out poses are 10\^(\d+) times as probable"
    page = (folder / "scale.report.html").read_text()
    found = re.search(f"cyclic_error {said}", " ".join(out.split()))
    assert found is not None
    assert int(found[1]) > 30
    assert found[1] in re.findall(said, page)
    assert not re.search(r"\bnats\b", out + page)


@pytest.mark.long
def test_a_picture_that_fails_loses_no_calibration(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object, **__: object) -> str:
        raise ValueError("no such colour")

    monkeypatch.setattr("rim_camera_ros.reports.calibration.calibration_page", broken)
    status, _, error = run(capsys, *arguments(folder, "--effects", "cyclic_error", out="without.yaml"))
    assert status == 0
    assert "no report was written: ValueError: no such colour" in error
    assert load_camera(folder / "without.yaml").covariance is not None


@pytest.mark.long
def test_a_table_alone_states_its_own_errors(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The effects that it replaces are reported as not fitted, and nothing of their fit is in the file."""
    words = arguments(folder, "--effects", "integral_table", out="table.yaml")
    status, _, error = run(capsys, *words)
    # of so few poses it is worse than nothing
    assert status == 1
    assert "does not improve 15 held-out poses" in error
    status, out, error = run(capsys, *words, "--force-result")
    assert status == 0, error
    found = load_camera(folder / "table.yaml")
    assert "cyclic_error" not in found.effects
    accuracy = found.provenance["accuracy"]
    assert not {"chi_square_per_value", "outliers", "values"} & set(accuracy)
    first = (folder / "table.yaml").read_text().splitlines()[1]
    assert f"{accuracy['rms_m'] * 1e3:.2f} mm RMS" in first
    assert "the table stands in the place of all effects" in found.provenance["left_out"]["cyclic_error"]
    assert "chi-square" not in out
    assert "beyond 4 sigma" not in out


@pytest.mark.long
def test_a_curve_that_the_file_has_is_fitted_again(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`empirical` without covariates takes the file's; another one is said to take its place."""
    first = arguments(folder, "--effects", "empirical:distance", out="curve.yaml")
    assert run(capsys, *first)[0] == 0
    files = ["--camera", folder / "curve.yaml", "--scene", folder / "scene.yaml"]
    again = ["calibrate", folder / "bag", *files, "--effects"]
    status, _, error = run(capsys, *again, "empirical", "--out", folder / "again.yaml")
    assert (status, error) == (0, "")
    effect: Any = load_camera(folder / "again.yaml").effects["empirical"]
    assert effect.covariates == ("distance",)
    _, _, error = run(capsys, *again, "empirical:amplitude", "--out", folder / "other.yaml")
    assert "empirical: the file's table of distance gave way to one of amplitude" in error
