"""Verdicts: nulls first, then what is wrong with the setup, the parameters, the noise, the physics."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera_file import load_camera, with_numbers
from rim_camera_ros.cli import main
from rim_camera_ros.diagnose.codes import missing_codes
from rim_camera_ros.diagnose.report import as_json
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.frame import Pose
from rim_camera_ros.reports.diagnosis.evidence import evidence
from rim_camera_ros.reports.diagnosis.page import page
from rim_camera_ros.scene import load_scene

from ..calibrate.bags import frames, write
from ..calibrate.helpers import camera, record, scene

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
KNOWN = (EmissionPattern((-1.3, 0.7)), CyclicError((Harmonic(4, 0.011, 0.7),), (0.004, -0.002)))


@pytest.mark.long
def test_consistent(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)
    result = diagnose(record(truth, board, seed=21), board, truth)
    assert result.verdict == "consistent"
    assert result.missing == []
    assert result.adjusted == []
    # amplitudes of a simulation are better than the percent to which any amplitude is predicted
    assert 0.92 < result.accuracy.chi2_before < 1.03
    assert result.camera == truth


@pytest.mark.long
def test_what_nothing_explains_is_not_consistent(tmp_path: Path) -> None:
    """Errors of single pixels that change from pose to pose follow no covariate, and are not in the noise."""
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)
    data = record(truth, board, seed=21)
    rng = np.random.default_rng(8)
    for k, one in enumerate(data.stations):
        sigma = truth.noise.sigma_distance(one.amplitude) / np.sqrt(np.maximum(one.count, 1))
        error = 0.7 * np.where(np.isfinite(sigma), sigma, 0.0) * rng.standard_normal(sigma.shape)
        data.stations[k] = replace(one, distance=one.distance + error)
    result = diagnose(data, board, truth)
    assert result.verdict == "unknown_physics"
    (found,) = result.missing
    assert found.effect == "unknown"
    # of distances 1.49; of amplitudes less than 1, which count little
    assert 1.3 < result.accuracy.chi2_before < 1.5
    report = as_json(result)
    assert report["missing"][0]["effect"] == "unknown"


@pytest.mark.long
def test_wrong_parameters_are_not_called_missing_physics(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)
    stated = with_numbers(truth, {"effects.cyclic_error.harmonics.0.amplitude": 0.025})
    result = diagnose(record(truth, board, seed=22), board, stated)
    assert result.verdict == "wrong_parameters"
    assert [one.effect for one in result.adjusted] == ["cyclic_error"]
    found = result.adjusted[0].after["harmonics.0.amplitude"]
    assert found == pytest.approx(0.011, abs=0.001)
    assert result.accuracy.chi2_after < result.accuracy.chi2_before - 0.1


@pytest.mark.long
def test_a_pose_that_is_off_is_no_physics(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)
    data = record(truth, board, seed=23)
    for k in (4, 9):
        one = data.stations[k]
        x, y, z = one.truth["board"].position
        moved = Pose((x, y, z + 0.05), one.truth["board"].orientation)
        data.stations[k] = replace(one, truth={"board": moved})
    result = diagnose(data, board, truth)
    assert result.verdict == "inconsistent_setup"
    assert result.missing == []
    assert result.reason is not None
    assert "2 of 24 poses" in result.reason
    report = as_json(result)
    assert report["reason"] == result.reason
    # the page shows the worst of them: stated to be 50 mm farther away, and at its place in the image
    worst = evidence(result).worst
    assert worst is not None
    assert worst.pose in (4, 9)
    recorded = data.stations[worst.pose].amplitude
    np.testing.assert_array_equal(worst.recorded[recorded > 0], recorded[recorded > 0])
    assert np.nanmedian(worst.difference) == pytest.approx(-0.05, abs=0.008)
    assert np.corrcoef(recorded.ravel(), worst.simulated.ravel())[0, 1] > 0.9
    html = page(result, recording="bag", camera="camera.yaml", scene="scene.yaml")
    alt = f"Recorded amplitude, simulated amplitude and difference of distances at pose {worst.pose}; median"
    shown = re.search(rf'<img alt="{alt} difference (\d+) mm" src="data:image/svg\+xml;base64,([^"]+)"', html)
    assert shown is not None
    assert int(shown[1]) == pytest.approx(50, abs=8)
    drawn = base64.b64decode(shown[2]).decode()
    for title in ("recorded amplitude", "simulated amplitude", "recorded - simulated distance"):
        assert title in drawn
    assert drawn.count("<image ") >= 3


@pytest.mark.long
def test_one_pose_that_is_off_is_excluded(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)
    data = record(truth, board, seed=26)
    one = data.stations[7]
    x, y, z = one.truth["board"].position
    data.stations[7] = replace(one, truth={"board": Pose((x, y, z + 0.06), one.truth["board"].orientation)})
    result = diagnose(data, board, truth)
    assert result.verdict == "consistent", result.reason
    assert any(re.match(r"1 of 24 poses .* \(7\); .* excluded$", note) for note in result.notes)


def test_of_one_pose_nothing_is_named(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)
    stated = replace(truth, effects={name: truth.effects[name] for name in ("emission_pattern",)})
    data = record(truth, board, seed=24)
    data.stations = [one for one in data.stations if one.pose == 0]
    result = diagnose(data, board, stated)
    assert result.missing == []
    assert not result.accuracy.held_out
    assert any(re.match("only one pose: .* record 20 poses or more", note) for note in result.notes)


@pytest.mark.long
def test_a_small_part_of_the_picture_may_be_described(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)
    small = replace(board, surfaces=(replace(board.surfaces[0], type="rectangle", size=(0.12, 0.1)),))
    data = record(truth, board, seed=25)
    result = diagnose(data, small, truth)
    assert result.verdict == "consistent", result.reason


@pytest.mark.long
def test_noise_is_examined(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)
    stated = replace(truth, noise=replace(truth.noise, amplitude=0.7 * truth.noise.amplitude))
    result = diagnose(record(truth, board, seed=24), board, stated)
    assert [one.effect for one in result.missing] == ["noise"]
    assert result.variance.noise.amplitude == pytest.approx(truth.noise.amplitude, rel=0.05)
    # (6^2 - 4.2^2) / A^2 of variance is more than the file says: most of it where it is dark
    total, count = np.zeros(stated.shape), np.zeros(stated.shape)
    for one in result.final.fit.forward.predictions():
        seen = one.view.geometry.hit & (one.station.count > 0)
        at = one.amplitude[seen]
        file = 0.003**2 + (4.2 / at) ** 2 + (299_792_458.0 / 40e6 / 65536) ** 2 / 12
        total[seen] += (6.0**2 - 4.2**2) / at**2 / file
        count[seen] += 1
    wanted = total[count > 0] / count[count > 0]
    found = result.where.pixels[count > 0]
    assert np.median(found / wanted) == pytest.approx(1.0, abs=0.1)
    assert np.corrcoef(found, wanted)[0, 1] > 0.99
    assert [name for name, _ in result.where.covariates][:1] == ["amplitude"]


def test_missing_codes() -> None:
    """Every code occurs beside frequent ones, where the noise is wide; a staircase omits codes."""
    rng = np.random.default_rng(3)
    values = rng.normal(20_000, 40, 100_000)
    smooth = np.bincount(np.rint(values).astype(int), minlength=65536)
    steps = np.bincount((np.rint(values / 8) * 8).astype(int), minlength=65536)
    assert missing_codes(smooth, noise=40.0) is None
    found = missing_codes(steps, noise=40.0)
    assert found is not None
    assert found.step == 8
    # a recording without noise is no staircase
    assert missing_codes(steps, noise=1.0) is None


@pytest.mark.parametrize("to", [-1, 1])
def test_ranges_of_codes_that_are_missing(to: int) -> None:
    """Two ranges of 600 counts, whose values fall on the code before or after them: 1200 / 16,000 of all."""
    rng = np.random.default_rng(5)
    values = np.rint(rng.uniform(9_000, 25_000, 300_000) + rng.normal(0, 17, 300_000)).astype(int)
    for first in (12_000, 19_000):
        values[(values >= first) & (values < first + 600)] = first - 1 if to < 0 else first + 600
    found = missing_codes(np.bincount(values, minlength=65536), noise=17.0)
    assert found is not None
    assert (found.ranges, found.step) == (2, 601.0)
    assert found.share == pytest.approx(1200 / 16_000, rel=0.15)
    # the same values without the ranges, and what nobody measures between two walls
    plain = rng.normal(0, 17, 300_000) + np.repeat([12_000, 15_000], 150_000)
    slope = rng.normal(0, 17, 300_000) + rng.uniform(9_000, 25_000, 300_000)
    gap = np.abs(slope - 17_000) > 700  # cut before the noise, which rounds its edges
    for one in (plain, slope, (slope + rng.normal(0, 17, 300_000))[gap]):
        counts = np.bincount(np.rint(one).astype(int), minlength=65536)
        assert missing_codes(counts, noise=17.0) is None


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera(tmp_path)
    scene(tmp_path)
    bag = tmp_path / "bag"
    options = ["--camera", str(tmp_path / "camera.yaml"), "--scene", str(tmp_path / "scene.yaml")]
    assert main(["diagnose", str(bag), *options, "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.startswith("rim: ")
    assert "bag" in message
    assert message.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(
    not CASES.is_dir(), reason="the open cases are not beside this checkout (../shared/cases)"
)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("nothing_missing", marks=pytest.mark.long),
        pytest.param("amplitude_offset", marks=pytest.mark.long),
        pytest.param("scattering", marks=pytest.mark.slow),
        pytest.param("cancelled_pair", marks=pytest.mark.slow),
        pytest.param("incidence_angle_concealed", marks=pytest.mark.slow),
        pytest.param("warm_up_in_a_sweep", marks=pytest.mark.slow),
        pytest.param("unknown", marks=pytest.mark.slow),
    ],
)
def test_open_cases(name: str) -> None:
    """Seven recordings of a program that is independent of this one, with functional forms of its own."""
    folder = CASES / name
    stated, setting = load_camera(folder / "camera.yaml"), load_scene(folder / "scene.yaml")
    data = reduce_recording(folder / "recording", stated)
    data.with_poses(setting)
    result = diagnose(data, setting, stated)
    truth = json.loads((folder / "truth.json").read_text())["effects"]
    named = {one.effect for one in result.missing}
    if truth and truth[0].startswith("unknown"):
        assert result.verdict == "unknown_physics"
        assert result.missing[0].covariates == ("height",)
    else:
        assert named == set(truth)
        assert result.verdict == ("missing_physics" if truth else "consistent")
    assert result.accuracy.chi2_after == pytest.approx(1.0, abs=0.04)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("3,x", r"argument --without-poses: '3,x' is no list of numbers of poses, as 3,17"),
        ("-4", r"--without-poses"),
    ],
)
def test_poses_to_exclude_are_numbers(given: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["bag", "--camera", "sr3000", "--scene", "wall", "--out", "never"]
    assert main(["diagnose", *options, f"--without-poses={given}"]) == 2
    assert re.search(message, capsys.readouterr().err)


@pytest.mark.long
def test_stray_light_on_a_board_is_distinguished_from_what_darkens_slopes(tmp_path: Path) -> None:
    """From a linear guess its widths once left for good, and surfaces unlike Lambert's took its place."""
    light = Scattering((Kernel(0.05, (5.0, 4.0)), Kernel(0.04, (17.0, 14.0))))
    truth, board = camera(tmp_path, *KNOWN, light), scene(tmp_path)
    stated = camera(tmp_path, *KNOWN)
    result = diagnose(record(truth, board, seed=27), board, stated)
    assert [one.effect for one in result.missing] == ["scattering"]
    found = result.camera.effects["scattering"]
    assert isinstance(found, Scattering)
    assert sum(one.weight for one in found.kernels) == pytest.approx(0.09, abs=0.02)
    assert result.accuracy.chi2_after == pytest.approx(1.0, abs=0.04)
    assert result.accuracy.chi2_before > 1.3


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("0,1,2", r"bag: --without-poses: all poses are excluded \(name fewer of them\)"),
        ("1,9", r"bag: --without-poses: there is no pose 9 \(the recording's are numbered 0 to 2\)"),
    ],
)
def test_some_poses_must_be_left(
    tmp_path: Path, given: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    camera(tmp_path)
    board = scene(tmp_path)
    write(tmp_path / "bag", frames(camera(tmp_path), board, poses=3, repeats=2, seed=3))
    options = ["--camera", str(tmp_path / "camera.yaml"), "--scene", str(tmp_path / "scene.yaml")]
    out = ["--out", str(tmp_path / "out"), "--quiet"]
    assert main(["diagnose", str(tmp_path / "bag"), *options, *out, "--without-poses", given]) == 2
    assert re.search(message, capsys.readouterr().err)
