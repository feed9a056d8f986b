"""What the report says is what the improved camera file holds, for every kind of finding."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import added, camera_numbers, load_camera
from rim_camera_ros.diagnose import formula as formulas
from rim_camera_ros.diagnose import full_grid
from rim_camera_ros.diagnose.noise_verdict import with_variance
from rim_camera_ros.diagnose.report import _nested
from rim_camera_ros.diagnose.result import Missing
from rim_camera_ros.diagnose.variance import Variance
from rim_camera_ros.effects.empirical import Empirical
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit import decimation
from rim_camera_ros.parameters import NestedList

from .helpers import CAMERA, CYCLIC, run, scene_text


@dataclass(frozen=True)
class Files:
    """A diagnosis: its report, the camera file before and after, and the one that recorded."""

    report: dict[str, Any]
    known: Camera
    true: Camera
    improved: Camera

    @property
    def missing(self) -> list[str]:
        return [one["effect"] for one in self.report["missing"]]


def diagnosed(
    folder: Path,
    known: str,
    true: str,
    *,
    scene: str | None = None,
    changed: Callable[[np.ndarray], np.ndarray] | None = None,
    **options: Any,
) -> Files:
    """Record with one camera file, the counts changed if need be, and diagnose with another."""
    (folder / "known.yaml").write_text(known)
    (folder / "true.yaml").write_text(true)
    (folder / "scene.yaml").write_text(scene_text() if scene is None else scene)
    bag = folder / "bag"
    run("simulate", folder / "scene.yaml", camera=folder / "true.yaml", out=bag)
    if changed is not None:
        with Recording(bag) as old, RecordingWriter(folder / "changed") as new:
            for one in old.frames():
                new.write_raw(replace(one, distance=changed(one.distance)))
        bag = folder / "changed"
    out = folder / "out"
    run("diagnose", bag, camera=folder / "known.yaml", scene=folder / "scene.yaml", out=out, **options)
    report = json.loads((out / "report.json").read_text())
    cameras = [load_camera(one) for one in (folder / "known.yaml", folder / "true.yaml", out / "camera.yaml")]
    found = Files(report, *cameras)
    agrees(found)
    return found


def agrees(found: Files) -> None:
    """Every number of the report that a camera file has is that of the improved one."""
    numbers = camera_numbers(found.improved)
    for one in found.report["adjusted"]:
        section = one["effect"] in ("radiometry", "noise")
        prefix = f"{one['effect']}." if section else f"effects.{one['effect']}."
        for path, value in one["to"].items():
            assert numbers[prefix + path] == pytest.approx(value, rel=1e-9), path
    for one in found.report["missing"]:
        effect = found.improved.effects.get(one["effect"])
        prefix = f"effects.{one['effect']}." if effect is not None else "optics."
        possible = {} if effect is None else effect.bounds()
        for path, (low, high) in one["interval"].items():
            assert low <= numbers[prefix + path] <= high, path
            least, most = possible.get(path, (-np.inf, np.inf))
            assert least <= low, path
            assert high <= most, path


@pytest.mark.long
def test_a_wrong_focal_length_is_reported_as_what_it_is(tmp_path: Path) -> None:
    """The first that is found stands in for it, and is dropped: what is left has gained it all."""
    found = diagnosed(tmp_path, CAMERA, CAMERA.replace("fx: 30.0, fy: 30.0", "fx: 31.0, fy: 31.0"))
    assert found.missing == ["camera_constant"]
    assert found.improved.optics.fx == pytest.approx(31.0, abs=0.1)
    (one,) = found.report["missing"]
    assert one["probability"] > 0.99
    assert found.report["ranking"][0]["effect"] == "camera_constant"
    # the rays at the corner of 24 x 20 pixels move by a thirtieth of 0.40 rad: by centimetres on a wall
    assert 0.01 < one["magnitude"] < 0.06


@pytest.mark.long
def test_a_wrong_gain_is_a_wrong_parameter(tmp_path: Path) -> None:
    found = diagnosed(tmp_path, CAMERA, CAMERA.replace("gain: 200.0", "gain: 400.0"))
    assert found.report["verdict"] == "wrong_parameters"
    # as well as the reflectivities of the scene file are known
    assert found.improved.radiometry.gain == pytest.approx(400.0, rel=0.15)


def test_a_gain_within_what_reflectivities_allow_is_no_fault(tmp_path: Path) -> None:
    found = diagnosed(tmp_path, CAMERA, CAMERA.replace("gain: 200.0", "gain: 210.0"))
    assert found.report["verdict"] == "consistent"


@pytest.mark.long
def test_another_noise_given_known_unmodulated_light(tmp_path: Path) -> None:
    """What the light adds is not the noise section's: of one frame 0.3^2 (A + 3000) / A^2 and a floor."""
    known = CAMERA.replace("shot: 0.0, amplitude: 4.0", "shot: 0.3, amplitude: 0.0")
    known += "effects: {background_light: {level: 3000.0, offset: 0.0}}\n"
    found = diagnosed(tmp_path, known, known.replace("floor: 0.003", "floor: 0.006"))
    assert found.missing == ["noise"]
    assert found.report["adjusted"] == []
    at = np.array([200.0, 500.0, 1000.0, 3000.0])
    sigma = found.improved.noise.sigma_distance(at, background=found.improved.background)
    assert sigma == pytest.approx(np.sqrt(0.006**2 + 0.3**2 * (at + 3000.0) / at**2), rel=0.04)
    assert found.report["fit"]["chi2_after"] == pytest.approx(1.0, abs=0.06)


@pytest.mark.long
def test_a_second_table_is_not_reported_as_the_first(tmp_path: Path) -> None:
    table = (
        "effects: {empirical: {covariates: [amplitude], knots: [[100, 1000, 5000]], "
        "values: [0, 1.0e-4, 0]}}\n"
    )
    true = (
        "effects: {empirical: {covariates: [height], knots: [[-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5]], "
        "values: [0.03, 0.0, -0.012, 0.0, 0.012, 0.0, -0.03]}}\n"
    )
    found = diagnosed(tmp_path, CAMERA + table, CAMERA + true)
    assert found.missing == ["unknown"]
    (one,) = found.report["missing"]
    assert one["covariates"] == ["height"]
    assert one["parameters"] == {}
    assert found.improved.effects["empirical"].covariates == ("amplitude",)  # type: ignore[attr-defined]
    text = (tmp_path / "out" / "report.html").read_text()
    assert "a camera file has one table, and this one&#39;s is of amplitude" in text


def test_another_noise_with_unknown_physics_is_adjusted(tmp_path: Path) -> None:
    """With the verdict unknown_physics the report names one thing as missing."""
    true = (
        "effects: {empirical: {covariates: [height], knots: [[-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5]], "
        "values: [0.03, 0.0, -0.012, 0.0, 0.012, 0.0, -0.03]}}\n"
    )
    found = diagnosed(tmp_path, CAMERA, CAMERA.replace("floor: 0.003", "floor: 0.009") + true)
    assert (found.report["verdict"], found.missing) == ("unknown_physics", ["unknown"])
    (noise,) = [one for one in found.report["adjusted"] if one["effect"] == "noise"]
    assert noise["from"] == {"floor": 0.003, "shot": 0.0, "amplitude": 4.0}
    assert noise["to"]["floor"] == pytest.approx(0.009, rel=0.05)
    assert found.improved.noise.floor == noise["to"]["floor"]
    assert any(one.startswith("in addition to it, and in camera") for one in found.report["notes"])


@pytest.mark.long
def test_missing_counts_hide_what_else_is_missing(tmp_path: Path) -> None:
    found = diagnosed(
        tmp_path,
        CAMERA,
        CAMERA + CYCLIC,
        scene=scene_text().replace("frames: 4", "frames: 60"),
        changed=lambda counts: counts & 0xFFE0,
    )
    assert found.report["verdict"] == "unknown_physics"
    assert found.missing == ["unknown"]
    assert found.improved.effects == {}
    assert found.report["fit"]["rms_after"] == found.report["fit"]["rms_before"]
    assert any("not named, as missing counts may look like it" in one for one in found.report["notes"])


@pytest.mark.long
def test_a_large_sensor_is_reported_in_its_own_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decimation, "MANY_PIXELS", 1000)
    monkeypatch.setattr(decimation, "_COARSE_PIXELS", 600)
    known = CAMERA.replace("width: 24, height: 20", "width: 48, height: 40")
    known = known.replace("fx: 30.0, fy: 30.0, cx: 11.7, cy: 9.2", "fx: 60.0, fy: 60.0, cx: 23.9, cy: 18.9")
    found = diagnosed(tmp_path, known, known.replace("fx: 60.0, fy: 60.0", "fx: 62.0, fy: 62.0"))
    assert any("of every 2 x 2 pixels one was looked at" in note for note in found.report["notes"])
    assert found.missing == ["camera_constant"]
    (one,) = found.report["missing"]
    assert one["parameters"]["fx"] == pytest.approx(62.0, abs=0.2)
    assert found.improved.optics.fx == pytest.approx(one["parameters"]["fx"], rel=1e-9)


def test_curves_over_angles_are_no_lists() -> None:
    values = {"diffuse.10": 0.1, "diffuse.20": 0.2, "d.1": -0.3, "d.0": 0.2, "fx": 50.0}
    expected = {"diffuse": {"10": 0.1, "20": 0.2}, "d": [0.2, -0.3], "fx": 50.0}
    assert _nested(values) == expected


def test_numbers_in_pixels_of_both_grids() -> None:
    assert decimation.full_number("optics.cx", 11.0, 4) == 46.0
    assert decimation.full_number("optics.fx", 31.0, 2) == 62.0
    assert decimation.full_number("optics.distortion.0", 31.0, 2) == 31.0
    assert decimation.full_number("effects.scattering.kernels.0.sigma.1", 3.0, 2) == 6.0
    assert decimation.full_number("effects.scattering.kernels.0.weight", 0.03, 2) == 0.03
    assert decimation.full_number("effects.mixed_pixels.blur", 0.5, 3) == 1.5
    assert decimation.full_number("effects.mixed_pixels.footprint", 0.3, 3) == pytest.approx(0.9)
    assert decimation.full_number("effects.mixed_pixels.share", 0.3, 3) == 0.3
    assert decimation.full_number("effects.cyclic_error.gradient.0", 0.004, 2) == 0.002


def test_a_formula_describes_all_of_its_curve() -> None:
    """Where the middle is known 30 times better than the ends it must not miss these."""
    x = np.linspace(-1.0, 1.0, 18)
    y = 0.01 * np.exp(-1.7 * x) - 0.01
    sigma = np.where(np.abs(x) < 0.5, 2e-5, 6e-4)
    formula, missed = formulas.closed_form("height", x, y, sigma)
    assert formula.endswith(" [m], x = height")
    assert missed < 0.02 * np.ptp(y)
    shown = formulas.formula_curve(formula, x)
    assert shown is not None
    assert np.sqrt(np.mean((shown - y) ** 2)) == pytest.approx(missed, rel=0.05)


def test_without_the_library_of_formulas_it_is_said_before_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    formulas.require_formulas()
    monkeypatch.setattr(formulas, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"scikit-learn is not installed.*python3-sklearn"):
        formulas.require_formulas()


def test_a_footprint_is_the_same_on_both_grids(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA.replace("width: 24, height: 20", "width: 640, height: 480"))
    camera = load_camera(tmp_path / "camera.yaml")
    small = added(decimation.decimated_camera(camera, 4), MixedPixels(0.0, 0.2, 0.3))
    full = decimation.full_camera(small, camera, 4)
    assert full.effects["mixed_pixels"] == MixedPixels(0.0, 0.8, 0.3)
    assert decimation.decimated_camera(full, 4).effects == small.effects


def test_a_table_over_rows_is_one_of_the_whole_sensor(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA.replace("width: 24, height: 20", "width: 640, height: 480"))
    camera = load_camera(tmp_path / "camera.yaml")
    values = NestedList(np.array([[0.0, 0.0], [0.01, 0.02], [0.0, 0.0]]))
    table = Empirical(("row", "edge"), ((0.0, 60.0, 119.0), (1.0, 4.0)), values)
    small = added(decimation.decimated_camera(camera, 4), table)
    full = decimation.full_camera(small, camera, 4)
    # every fourth row from the third on
    assert full.effects["empirical"].knots == ((2.0, 242.0, 478.0), (4.0, 16.0))  # type: ignore[attr-defined]
    again = decimation.decimated_camera(full, 4)
    assert again.effects["empirical"] == table


def test_a_formula_over_rows_is_one_of_the_whole_sensor(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA.replace("width: 24, height: 20", "width: 640, height: 480"))
    camera = load_camera(tmp_path / "camera.yaml")
    table = Empirical(("row",), ((0.0, 60.0, 119.0),), NestedList(np.array([0.002, 0.02, 0.03])))
    small = added(decimation.decimated_camera(camera, 4), table)
    full = decimation.full_camera(small, camera, 4)
    said = "0.002 +0.0004 x -1e-06 x^2 [m], x = row"
    restated = full_grid.restated(Missing("unknown", 1.0, {}, {}, f"by {said}", formula=said), small, full, 4)
    assert restated.formula is not None
    assert restated.sentence == f"by {restated.formula}"
    x = np.arange(0.0, 120.0, 7.0)
    # every fourth row from the third on
    shown = formulas.formula_curve(restated.formula, 4 * x + 2)
    wanted = 0.002 + 0.0004 * x - 1e-6 * x**2
    assert shown == pytest.approx(wanted, abs=0.015 * np.ptp(wanted))
    of_light = replace(table, covariates=("amplitude",))
    small, full = (added(decimation.decimated_camera(camera, 4), of_light) for _ in range(2))
    said = said.replace("row", "amplitude")
    same = full_grid.restated(Missing("unknown", 1.0, {}, {}, said, formula=said), small, full, 4)
    assert same.formula == said


def test_the_table_goes_where_unmodulated_light_takes_its_place(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    camera = load_camera(tmp_path / "camera.yaml")
    table = Empirical(("amplitude",), ((100.0, 1000.0),), NestedList(np.array([0.01, -0.01])))
    variance = Variance(1.8, 0.01, (), camera.noise, 1.0, 0.1, 0.003, True, background=500.0)
    unknown = Missing("unknown", 1.0, {}, {}, "unknown physics", ("amplitude",), 0.01, "f")
    verdict, missing, model = with_variance(
        "unknown_physics", [unknown], added(camera, table), variance, [], True
    )
    assert (verdict, [one.effect for one in missing]) == ("missing_physics", ["background_light"])
    assert list(model.effects) == ["background_light"]
    # a table that the camera file had stays
    _, _, model = with_variance(
        "unknown_physics", [unknown], added(camera, table), variance, [], True, {"empirical"}
    )
    assert set(model.effects) == {"background_light", "empirical"}
