"""`rim reproduce`: what it prints and writes; the numbers that must come out."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.cli import main
from rim_camera_ros.reproduce.laboratory import Laboratory, across, around, plate, stations
from rim_camera_ros.reproduce.report import explanations
from rim_camera_ros.reproduce.results import Printed, Row
from rim_camera_ros.reproduce.run import EXPERIMENTS, chosen, reproduce

ROOT = Path(__file__).resolve().parents[2]
FAST = ("ambiguity", "two_cameras", "dynamic_range", "coordinates")
#: Chapter and numbers of the figures that the page shows.
FIGURES = {3: (10, 17, 19, 24, 25, 26, 32, 33, *range(45, 52), 57), 4: range(4, 14)}
PICTURES = [f"fig_{chapter}_{one}.png" for chapter, numbers in FIGURES.items() for one in numbers]


def rows_of(*names: str) -> dict[str, Row]:
    done = reproduce(chosen(names))
    return {row.quantity: row for one in done for row in one.outcome.rows}


# --- numbers ---------------------------------------------------------------------------------------


def test_ambiguity_and_count_are_those_of_20_mhz() -> None:
    """Eq. 2.4: c / (2 f) = 7.49481145 m and that over 65536."""
    rows = rows_of("ambiguity")
    assert rows["ambiguity range"].ours == pytest.approx(7.49481145, abs=0.005)
    assert rows["size of a count, 16 bit"].ours == pytest.approx(0.11436174, rel=1e-3)


def test_dynamic_range_of_eq_2_13() -> None:
    """(7.5 / 0.2)^2 / 0.05 = 28125, 88.98 dB."""
    rows = rows_of("dynamic_range")
    assert rows["the same as a ratio"].ours == pytest.approx(28125.0, rel=1e-3)
    assert rows["dynamic range"].ours == pytest.approx(88.98, abs=0.01)


@pytest.mark.long
def test_pmd_sensors_of_table_2_3() -> None:
    """Dynamic ranges by light and noise, and by area: 3.27 times that of the 3k-S is 5.15 dB more."""
    rows = rows_of("pmd_sensors")
    ranges = {"PMD 768-S 3D": 78.0, "PMD 1k-S 2 3D": 78.0, "PMD 3k-S": 74.0, "PMD 19k": 65.0}
    for device, printed in ranges.items():
        assert rows[f"dynamic range {device}"].ours == pytest.approx(printed, abs=0.3)
    reference = rows["dynamic range PMD 3k-S"].ours
    assert reference is not None
    for device, area in (("PMD 768-S 3D", 210.8 * 155.3), ("PMD 19k", 1600.0)):
        ours = rows[f"dynamic range {device} by its pixel's area"].ours
        assert ours == pytest.approx(reference + 10 * math.log10(area / 1e4), abs=1e-6)
    for device in ("PMD 768-S 3D", "PMD 1k-S 2 3D", "PMD 3k-S"):
        assert rows[f"more light by SBI, {device}"].ours == pytest.approx(50.0, abs=0.01)
    assert rows["PMD 1k-S 2 3D image area, width"].ours == pytest.approx(9.94, abs=0.005)
    assert rows["PMD 1k-S 2 3D image area, height"].ours == pytest.approx(3.37, abs=0.005)
    noise = rows["sigma under background 100 : 1, PMD 3k-S"]
    assert noise.sigma is not None
    assert noise.ours == pytest.approx(math.sqrt(101.0), abs=4 * noise.sigma)


def test_suppression_agrees_with_a_lock_in_pixel_integrated_by_hand() -> None:
    """The mean of a sinusoid 0.1 MHz off the reference over windows near 1 ms, the largest of them."""
    left = []
    for window in np.linspace(0.990e-3, 1.010e-3, 41):
        time = (np.arange(4000) + 0.5) / 4000 * window
        left.append(abs(np.mean(np.exp(2j * np.pi * 1e5 * time))))
    by_hand = -20 * np.log10(max(left))
    ours = rows_of("two_cameras")["suppression of a second camera, 0.1 MHz apart"].ours
    assert ours == pytest.approx(by_hand, abs=0.5)
    assert ours > 40


def test_table_2_4_to_its_last_digit() -> None:
    for name, row in rows_of("coordinates").items():
        limit = 7e-4 if name.startswith("Y") else 5.05e-4
        assert row.deviation is not None
        assert abs(row.deviation) < limit, name


def test_a_plate_across_a_ray_is_met_perpendicularly_at_its_distance() -> None:
    laboratory = Laboratory()
    camera = laboratory.camera("sr3000")
    scene = stations(plate(), [(100, across(camera.rays[130, 15], 2.25))], frames=2, uptime=360.0)
    (seen,) = laboratory.record(camera, scene, around((130, 15), 1), seed=1, words="")
    assert seen.nominal[1, 1] == pytest.approx(2.25, abs=1e-9)
    assert seen.incidence[1, 1] == pytest.approx(0.0, abs=1e-6)
    assert seen.error.shape == (2, 3, 3)


# --- words -----------------------------------------------------------------------------------------


def test_explanations_name_their_rows_once() -> None:
    def row(how: str, why: str = "") -> Row:
        return Row("q", "s", Printed.number(1.0), 1.0, "m", how, why=why)

    rows = {4: row("wall"), 5: row("wall", "noise"), 6: row("plate"), 7: row("wall")}
    assert explanations(rows) == ["4-5, 7: wall.", "6: plate.", "5: deviation: noise."]


# --- command ---------------------------------------------------------------------------------------


def test_json_has_printed_ours_and_deviation(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "--only", "two_cameras", "--json", "--quiet"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["format"] == "rim_reproduction/1"
    (row,) = report["rows"]
    assert row["thesis"] == {"text": "better than 40", "low": 40.0, "high": None}
    assert row["ours"] == pytest.approx(49.9, abs=0.5)
    assert (row["deviation"], row["unit"], row["source"]) == (0.0, "dB", "eq. 2.11")
    assert "RMS over the frames" in row["how"]


@pytest.mark.long
def test_folder_page_and_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, page = tmp_path / "pictures", tmp_path / "page.md"
    arguments = ["reproduce", "--only", *FAST, "--out", str(out), "--page", str(page)]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert re.search(r"dynamic range +89 +89\.0 +\+0\.0 +dB +eq\. 2\.13", text)
    assert sorted(one.name for one in out.iterdir()) == ["eq_2_11.png", "index.html", "reproduction.json"]
    assert (out / "eq_2_11.png").read_bytes().startswith(b"\x89PNG")
    assert 'src="eq_2_11.png"' in (out / "index.html").read_text()
    markdown = page.read_text()
    assert "![Eq. 2.11](pictures/eq_2_11.png)" in markdown
    assert "| 3 | suppression of a second camera" in markdown
    assert main(arguments) == 2
    assert "exists already (--force replaces it)" in capsys.readouterr().err
    assert main([*arguments, "--force", "--quiet"]) == 0
    assert page.read_text() == markdown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--only", "grey_wege"],
            r"--only: no experiment 'grey_wege' \(did you mean 'grey_wedge'\?\)",
        ),
        (["--page", "a.md"], r"--page needs --out, the folder of its pictures"),
        (["--out", "o", "--page", "a.txt"], r"a\.txt: --page: a Markdown page ends in \.md"),
        (["--out", "none/o"], r"none/o: its folder does not exist \(make it: mkdir -p none\)"),
    ],
)
def test_bad_usage_is_one_line(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", *arguments]) == 2
    error = capsys.readouterr().err
    assert re.search(message, error)
    assert error.count("\n") == 1


def test_a_folder_of_something_else_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "precious.txt").write_text("x")
    assert main(["reproduce", "--only", "coordinates", "--out", str(tmp_path), "--force"]) == 2
    assert "holds something else than a reproduction" in capsys.readouterr().err
    assert (tmp_path / "precious.txt").read_text() == "x"


# --- documentation ---------------------------------------------------------------------------------


def test_the_page_has_every_experiment_and_picture() -> None:
    page = (ROOT / "docs" / "reproduction.md").read_text()
    for one in EXPERIMENTS:
        assert f"`--only {one.name}`" in page
    shown = re.findall(r"\]\((reproduction/[^)]+)\)", page)
    assert {f"reproduction/{one}" for one in PICTURES} <= set(shown)
    sizes = [(ROOT / "docs" / one).stat().st_size for one in shown]
    assert sum(sizes) < 2_000_000


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_whole_reproduces_the_page(tmp_path: Path) -> None:
    """All rows anew: those that the shipped cameras hold must come out, and be those of the page."""
    out = tmp_path / "all"
    assert main(["reproduce", "--out", str(out), "--quiet"]) == 0
    rows = json.loads((out / "reproduction.json").read_text())["rows"]
    stored = json.loads((ROOT / "docs" / "reproduction" / "reproduction.json").read_text())["rows"]
    assert [one["quantity"] for one in rows] == [one["quantity"] for one in stored]
    for one, before in zip(rows, stored, strict=True):
        if before["ours"] is not None:
            # libraries of other versions round otherwise: the same within a hundredth
            assert one["ours"] == pytest.approx(before["ours"], rel=0.01, abs=0.02), one["quantity"]
    ours = {one["quantity"]: one["ours"] for one in rows}
    sigma = {one["quantity"]: one["sigma"] for one in rows}
    for setting, (a, b) in {16: (85.71, 0.995), 60: (237.0, 15.71), 100: (383.3, 4.036)}.items():
        for name, printed in ((f"hyperbola a, setting {setting}", a), (f"hyperbola b, setting {setting}", b)):
            assert abs(ours[name] - printed) < 3 * sigma[name], name
    assert ours["SR-2 cyclic error, +-"] == pytest.approx(80.0, abs=1.0)
    assert ours["SR-2, external temperature"] == pytest.approx(8.0, abs=0.1)
    assert ours["SR-3000 camera constant c"] == pytest.approx(7.9955, abs=0.03)
    assert ours["phase over distance from pixel 0/0, rank correlation"] > 0.9
    assert 10 < ours["residual drift after eq. 4.4, first 30 s"] < 35
