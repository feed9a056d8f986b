"""Every page opened in Chromium, where it is installed; without it `faults_of` judges the same pages."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from rim_camera_ros.calibrate.run import Request, calibrate
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.cli import main
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.files import find_camera
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.reports.calibration import calibration_page
from rim_camera_ros.reports.diagnosis.page import page
from rim_camera_ros.reproduce.report import html_page
from rim_camera_ros.reproduce.run import chosen, reproduce
from rim_camera_ros.scene import load_scene
from test.diagnose.helpers import CAMERA, CYCLIC, scene_text

from .browser import CHROMIUM, open_page
from .pages import faults_of, text_of

VERDICTS = ("consistent", "parameters", "unknown")
NAMES = ("calibration", "diagnosis", "setup", *VERDICTS, "reproduction", "comparison")
LONG = "a_folder_with_a_name_that_has_no_place_to_break/" * 3 + "recording"
#: A calibration and a diagnosis come first, on machines that are busy.
pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]
#: Said where there is no browser.
WITHOUT = "chromium is not installed (Debian: apt install chromium): only the HTML was checked"


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("pages")
    (folder / "known.yaml").write_text(CAMERA)
    (folder / "true.yaml").write_text(CAMERA + CYCLIC)
    (folder / "scene.yaml").write_text(scene_text())
    bag, scene = folder / "bag", load_scene(folder / "scene.yaml")
    words = [folder / "scene.yaml", "--camera", folder / "true.yaml", "--out", bag, "--quiet"]
    assert main(["simulate", *map(str, words)]) == 0
    known = load_camera(folder / "known.yaml")
    dataset = reduce_recording(bag, known)
    dataset.with_poses(scene, bag)
    found = diagnose(dataset, scene, known)
    wrong = replace(
        found, verdict="inconsistent_setup", reason="18 of 18 poses disagree", missing=[], found=[]
    )
    consistent = replace(found, verdict="consistent", missing=[], found=[])
    parameters = replace(found, verdict="wrong_parameters", missing=[])
    other = replace(found.missing[0], effect="unknown", parameters={}, interval={}, covariates=("row",))
    unknown = replace(found, verdict="unknown_physics", missing=[other])
    made = calibrate(Request((bag,), known, scene, effects=("cyclic_error",), camera_name=LONG))
    from rim_camera_ros.reports.comparison import compare
    from rim_camera_ros.reports.comparison_page import comparison_page

    two = compare(load_camera(find_camera("sr3000")), load_camera(find_camera("sr3000_every_effect")))
    named = {"recording": LONG, "camera": "camera.yaml", "scene": "scene.yaml"}
    return {
        "calibration": calibration_page(made, title="camera.yaml"),
        "diagnosis": page(found, **named),
        "setup": page(wrong, **named),
        "consistent": page(consistent, **named),
        "parameters": page(parameters, **named),
        "unknown": page(unknown, **named),
        "reproduction": html_page(reproduce(chosen(["dynamic_range", "ambiguity"]))),
        "comparison": comparison_page(two, names=(LONG, "b.yaml")),
    }


@pytest.mark.parametrize("name", NAMES)
def test_the_html_of_every_page(pages: dict[str, str], name: str) -> None:
    assert faults_of(pages[name]) == []


@pytest.mark.skipif(CHROMIUM is None, reason=WITHOUT)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("width", "dark"),
    [
        (1280, False),
        (390, True),
        pytest.param(1280, True, marks=pytest.mark.slow),
        pytest.param(390, False, marks=pytest.mark.slow),
    ],
)
def test_every_page_in_a_browser(
    pages: dict[str, str], name: str, width: int, dark: bool, tmp_path: Path
) -> None:
    seen = open_page(pages[name], tmp_path, width=width, dark=dark)
    assert seen.width == width
    assert seen.reach == width
    assert seen.wide == []
    assert seen.console == []
    assert seen.broken == 0
    assert seen.unnamed == 0
    assert seen.pictures >= {"reproduction": 0, "comparison": 1}.get(name, 5)
    # light letters on dark paper, or the other way round
    ink, paper = (sum(map(int, re.findall(r"\d+", one)[:3])) for one in (seen.ink, seen.paper))
    assert (ink > paper + 300) if dark else (paper > ink + 300)


@pytest.mark.skipif(CHROMIUM is None, reason=WITHOUT)
def test_the_browser_sees_what_is_wrong(tmp_path: Path) -> None:
    wide = '<!DOCTYPE html><html><body><div style="width:700px">wide</div><img src="none.png">'
    seen = open_page(
        f"{wide}<script>console.error('boo')</script></body></html>", tmp_path, width=390, dark=False
    )
    assert seen.reach > 390
    assert seen.wide == ["DIV wide"]
    assert (seen.broken, seen.unnamed) == (1, 1)
    assert any("boo" in one for one in seen.console)


def test_calibrate_opens_with_a_sentence(pages: dict[str, str]) -> None:
    shown = text_of(pages["calibration"])
    found = re.search(
        r"Good to ([\d.]+) mm between ([\d.]+) and ([\d.]+) m \(file before: ([\d.]+) mm;", shown
    )
    assert found is not None
    after, near, far, before = map(float, found.groups())
    # noise of four frames and reference instrument: 3 mm; a sinusoid of 9 mm in addition to them
    assert after == pytest.approx(3.1, abs=0.3)
    assert before == pytest.approx((after**2 + 9.0**2 / 2) ** 0.5, rel=0.1)
    assert near < 1.1 < 4.2 < far
    assert "1 effect fitted; not determined:" in shown
    assert "record" in shown[: shown.index("RMS error")]


def test_errors_of_effects_before_and_after(pages: dict[str, str]) -> None:
    """A sinusoid of 9 mm was absent before: 9 / sqrt(2) = 6.4 mm, over whole periods."""
    row = re.search(r"\(cyclic_error\) ([\d.]+) ([\d.]+) ± ([\d.]+) mm", text_of(pages["calibration"]))
    assert row is not None
    size, before, after = map(float, row.groups())
    assert before == size
    assert before == pytest.approx(6.4, abs=0.5)
    assert 0.02 < after < 0.3
