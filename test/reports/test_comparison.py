"""Two camera files compared: differences that are known in closed form, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Camera, Covariance, Validity
from rim_camera_ros.camera_file import load_camera, save_camera, with_effects
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.errors import InputError
from rim_camera_ros.parameters import ArrayFile
from rim_camera_ros.reports.comparison import compare, comparison_json, first_sentence
from rim_camera_ros.reports.comparison_page import comparison_page
from rim_camera_ros.reports.walls import (
    Wall,
    corrected_walls,
    distances_of,
    raw_wall,
    setting_of,
    uncertainty,
)
from test.diagnose.helpers import AMBIGUITY, CAMERA

from ..helpers_cli import run
from .pages import faults_of


@pytest.fixture
def plain(tmp_path: Path) -> Camera:
    (tmp_path / "plain.yaml").write_text(CAMERA)
    camera = load_camera(tmp_path / "plain.yaml")
    return replace(camera, validity=Validity(distance=(0.8, 5.2)))


def test_a_wall_is_corrected_to_where_it_stands(plain: Camera) -> None:
    camera = with_effects(plain, {"cyclic_error": CyclicError((Harmonic(4, 0.009, 0.7),))})
    found = corrected_walls(camera, [raw_wall(camera, Wall(z, 60.0)) for z in (0.9, 3.1)])
    np.testing.assert_allclose(found * camera.rays[..., 2], [[[0.9]], [[3.1]]] * np.ones((20, 24)), atol=2e-6)


def test_a_scale_differs_by_its_share_of_the_distance(plain: Camera) -> None:
    """Measured = d (1 + s): the second file takes d s away from what the first leaves."""
    other = with_effects(plain, {"distance_scale": DistanceScale(0.002)})
    found = compare(plain, other)
    for wall, image in zip(found.walls, found.maps, strict=True):
        radial = wall.distance / plain.rays[..., 2]
        np.testing.assert_allclose(image, radial * (1 / 1.002 - 1), atol=2e-6)
    assert [wall.distance for wall in found.walls] == pytest.approx([0.8, 1.9, 3.0, 4.1, 5.2])
    (effect,) = found.effects
    assert (effect.effect, effect.stands) == ("distance_scale", "second")
    assert effect.rms == pytest.approx(found.rms)
    assert [one.path for one in found.numbers] == ["effects.distance_scale.scale"]
    assert "most by distance_scale" in first_sentence(found)


def test_each_effect_has_its_own_share(plain: Camera) -> None:
    one = with_effects(plain, {"cyclic_error": CyclicError((Harmonic(4, 0.009, 0.7),))})
    weaker = CyclicError((Harmonic(4, 0.004, 0.7),))
    other = with_effects(plain, {"cyclic_error": weaker, "distance_scale": DistanceScale(0.0004)})
    found = compare(one, other)
    shares = {effect.effect: (effect.stands, effect.rms) for effect in found.effects}
    d = np.concatenate([wall.distance / one.rays[..., 2].ravel() for wall in found.walls])
    sinusoid = 0.005 * np.sin(4 * 2 * np.pi * d / AMBIGUITY + 0.7)
    assert shares["cyclic_error"][0] == "both"
    # corrected at the distance as measured: to first order
    assert shares["cyclic_error"][1] == pytest.approx(np.sqrt(np.mean(sinusoid**2)), rel=0.02)
    scaled = np.sqrt(np.mean((0.0004 * d) ** 2))
    assert shares["distance_scale"] == ("second", pytest.approx(scaled, rel=0.02))


def test_rays_differ_by_the_focal_length(plain: Camera) -> None:
    other = replace(plain, optics=replace(plain.optics, fx=plain.optics.fx * 1.02, cy=plain.optics.cy + 0.3))
    found = compare(plain, other)
    u = np.arange(24) - plain.optics.cx
    np.testing.assert_allclose(found.rays[..., 0], np.tile(u * (1 / 1.02 - 1), (20, 1)), atol=1e-9)
    np.testing.assert_allclose(found.rays[..., 1], -0.3, atol=1e-9)
    assert found.rms == pytest.approx(0.0, abs=1e-6)
    assert "rays by" in first_sentence(found)


def test_the_same_under_other_names_is_the_same(plain: Camera) -> None:
    values = np.random.default_rng(5).normal(0, 0.01, plain.shape).astype(np.float32)
    one, other = (
        with_effects(plain, {"fixed_pattern_offset": FixedPatternOffset(ArrayFile(name, values))})
        for name in ("a.npy", "b.npy")
    )
    assert first_sentence(compare(one, other)) == "The camera files say the same."
    longer = FixedPatternOffset(ArrayFile("a.npy", values + np.float32(0.003)))
    third = with_effects(plain, {"fixed_pattern_offset": longer})
    found = compare(one, third)
    assert found.rms == pytest.approx(0.003, abs=2e-6)
    assert [effect.effect for effect in found.effects] == ["fixed_pattern_offset"]


def test_differences_are_stated_in_sigmas_of_both(plain: Camera) -> None:
    def stated(scale: float, sigma: float) -> Camera:
        camera = with_effects(plain, {"distance_scale": DistanceScale(scale)})
        matrix = ArrayFile("c.npy", np.array([[sigma**2]]))
        return replace(camera, covariance=Covariance(("effects.distance_scale.scale",), matrix))

    (number,) = compare(stated(0.001, 0.0003), stated(0.003, 0.0004)).numbers
    assert number.sigmas == pytest.approx(0.002 / 0.0005)


def test_cameras_of_other_sizes_are_refused(plain: Camera) -> None:
    other = replace(plain, sensor=replace(plain.sensor, modulation_frequency=30e6))
    with pytest.raises(InputError, match="other sizes or modulation frequencies"):
        compare(plain, other)


def test_uncertainty_is_that_of_the_covariance_and_the_offsets(plain: Camera) -> None:
    """A scale known to s and a pattern known to p: sqrt((d s)^2 + p^2), and what is correlated cancels."""
    camera = with_effects(plain, {"distance_scale": DistanceScale(0.001)})
    pattern = np.linspace(1e-8, 4e-6, 480).reshape(20, 24)
    walls = [Wall(1.0, 60.0), Wall(4.0, 60.0)]
    paths, covariance = ["effects.distance_scale.scale"], np.array([[0.0005**2]])
    found = uncertainty(camera, paths, covariance, walls, pattern=pattern)
    for wall, image in zip(walls, found, strict=True):
        d = wall.distance / plain.rays[..., 2]
        np.testing.assert_allclose(image, np.sqrt((d * 0.0005) ** 2 + pattern), rtol=5e-3)

    both = with_effects(camera, {**camera.effects, "cyclic_error": CyclicError((Harmonic(4, 0.009, 0.0),))})
    paths += ["effects.cyclic_error.harmonics.0.amplitude"]
    wall = Wall(AMBIGUITY * 1.25 / 4, 60.0)  # at its crest it adds what its amplitude does
    single, crossed = np.diag([0.0005**2, 0.001**2]), 0.0005 * 0.001
    apart = uncertainty(both, paths, single, [wall])[0][9, 12]
    tied = uncertainty(both, paths, single + crossed * np.array([[0, -1], [-1, 0]]), [wall])[0][9, 12]
    d = wall.distance / plain.rays[9, 12, 2]
    assert apart == pytest.approx(np.hypot(d * 0.0005, 0.001), rel=0.01)
    assert tied == pytest.approx(abs(d * 0.0005 - 0.001), rel=0.04)


def test_of_many_pixels_some_are_enough(plain: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = with_effects(plain, {"distance_scale": DistanceScale(0.001)})
    given = (["effects.distance_scale.scale"], np.array([[0.0005**2]]), [Wall(2.0, 60.0)])
    full = uncertainty(camera, *given)[0]
    monkeypatch.setattr("rim_camera_ros.reports.walls._ENOUGH", 100)
    few = uncertainty(camera, *given)[0]
    assert few.shape == full.shape
    np.testing.assert_allclose(few, full, rtol=0.05)


def test_distances_and_settings_are_those_of_both(plain: Camera) -> None:
    other = replace(plain, validity=Validity(distance=(2.0, 9.0), integration_time=(16.0, 60.0)))
    assert distances_of(plain, other) == pytest.approx([2.0, 3.6, 5.2])
    assert setting_of(plain, other) == 60.0
    assert setting_of(plain) is None


# --- command ---------------------------------------------------------------------------------------


@pytest.fixture
def files(plain: Camera, tmp_path: Path) -> tuple[Path, Path]:
    save_camera(plain, tmp_path / "a.yaml")
    save_camera(with_effects(plain, {"distance_scale": DistanceScale(0.002)}), tmp_path / "b.yaml")
    return tmp_path / "a.yaml", tmp_path / "b.yaml"


def test_the_command_prints_a_table_and_writes_a_page(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    status, out, error = run(capsys, "compare", *files, "--out", tmp_path / "page.html")
    assert (status, error) == (0, "")
    z = np.linspace(0.8, 5.2, 5)[:, None, None]
    rms = 0.002 / 1.002 * np.sqrt(np.mean((z / load_camera(files[0]).rays[..., 2]) ** 2))
    assert out.startswith(f"Corrected distances differ by {rms * 1e3:.2g} mm (RMS;")
    assert "distance_scale.scale" in out
    page = (tmp_path / "page.html").read_text()
    assert faults_of(page) == []
    assert page == comparison_page(compare(*map(load_camera, files)), names=tuple(map(str, files)))
    status, _, error = run(capsys, "compare", *files, "--out", tmp_path / "page.html")
    assert status == 2
    assert "exists already" in error


def test_the_command_prints_json(files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "compare", *files, "--json")
    assert status == 0
    found = json.loads(out)
    expected = comparison_json(compare(*map(load_camera, files)), list(map(str, files)))
    assert found == json.loads(json.dumps(expected))
    assert found["format"] == "rim_comparison/1"
    assert found["numbers"][0]["other"] == 0.002


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.yaml", "absent.yaml"], "absent.yaml: "),
        (["a.yaml", "b.yaml", "--out", "page.pdf"], "page.pdf: --out: a page ends in .html"),
        (["a.yaml", "b.yaml", "--out", "b.yaml"], "b.yaml: --out"),
        (["a.yaml", "sr3000"], "of other sizes or modulation frequencies"),
    ],
)
def test_bad_usage_is_one_line(
    files: tuple[Path, Path],
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(files[0].parent)
    status, out, error = run(capsys, "compare", *arguments)
    assert (status, out) == (2, "")
    assert message in error
    assert error.count("\n") == 1
