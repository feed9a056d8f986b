"""The report of a diagnosis: its numbers against formulae and against report.json, its form as a file."""

from __future__ import annotations

import base64
import json
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.cli import main
from rim_camera_ros.diagnose.adjusted import Adjusted
from rim_camera_ros.diagnose.formula import formula_curve
from rim_camera_ros.diagnose.naming import first_frames
from rim_camera_ros.diagnose.report import as_json
from rim_camera_ros.diagnose.result import Diagnosis, Missing
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.effects.scattering import Ghost, Kernel, Scattering
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.reports.diagnosis import figures as page_figures
from rim_camera_ros.reports.diagnosis import maps as page_maps
from rim_camera_ros.reports.diagnosis import words
from rim_camera_ros.reports.diagnosis.classes import binned, region
from rim_camera_ros.reports.diagnosis.curves import curves_of
from rim_camera_ros.reports.diagnosis.evidence import evidence
from rim_camera_ros.reports.diagnosis.page import page, write_page
from rim_camera_ros.reports.words import millimetres
from rim_camera_ros.scene import load_scene
from test.diagnose.helpers import AMBIGUITY, CAMERA, CYCLIC, DISTANCES, scene_text


@dataclass(frozen=True)
class Case:
    camera: Camera
    missing: Diagnosis
    consistent: Diagnosis
    page: str


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("page")
    (folder / "known.yaml").write_text(CAMERA)
    (folder / "true.yaml").write_text(CAMERA + CYCLIC)
    (folder / "scene.yaml").write_text(scene_text())
    bag = folder / "bag"
    arguments = [folder / "scene.yaml", "--camera", folder / "true.yaml", "--out", bag, "--quiet"]
    assert main(["simulate", *map(str, arguments)]) == 0
    scene = load_scene(folder / "scene.yaml")
    results = {}
    for name in ("known", "true"):
        camera = load_camera(folder / f"{name}.yaml")
        dataset = reduce_recording(bag, camera)
        dataset.with_poses(scene, bag)
        results[name] = diagnose(dataset, scene, camera)
    return Case(
        load_camera(folder / "known.yaml"), results["known"], results["true"], rendered(results["known"])
    )


def text_of(content: str) -> str:
    """The text of a page, tags removed."""
    body = content.split("</style>", 1)[1]
    return " ".join(re.sub(r"<[^>]*>", " ", body).split())


def rendered(result: Diagnosis) -> str:
    return page(result, recording="a/bag", camera="b.yaml", scene="c.yaml")


# --- the whole page ---------------------------------------------------------------------------------


def test_what_a_smooth_function_still_gains_is_reported_with_what_is_named(case: Case) -> None:
    """41 nats compared with 1,640 are 2.5 %; 900 would be 55 %, which nobody should call small."""
    for gain, share in ((41.0, "2.5 %"), (900.0, "55 %")):
        result = replace(case.missing, smooth_rest=("column_row", gain), gained=1640.0)
        sentence = f"a smooth function of column row still gains {gain:.0f} nats, {share} of what the effects"
        assert sentence in text_of(rendered(result))
    assert "still gains" not in text_of(rendered(replace(case.missing, smooth_rest=None)))


def test_what_stays_unexplained_comes_first(case: Case) -> None:
    """More than half as much again as noise: whatever is named, that is not all."""
    for chi, said in ((4.2, True), (1.2, False)):
        accuracy = replace(case.missing.accuracy, chi2_after=chi, chi2_before=9.0)
        shown = text_of(rendered(replace(case.missing, accuracy=accuracy)))
        lead = "Unsure, as much of the difference stays unexplained (chi-square per value 4.200 after naming"
        assert (lead in shown) == said
        if said:
            assert shown.index(lead) < shown.index("The simulation lacks odd harmonics")


def test_page_tells_the_numbers_of_the_report(case: Case) -> None:
    content = case.page
    shown = text_of(content)
    report = as_json(case.missing)
    assert report["verdict"] == "missing_physics"
    assert "The simulation lacks odd harmonics of the modulation (cyclic_error)." in shown
    fit = report["fit"]
    assert f"{fit['rms_before'] * 1e3:.2f} → {fit['rms_after'] * 1e3:.2f} mm" in shown
    assert f"{fit['chi2_before']:.3f} → {fit['chi2_after']:.3f}" in shown
    assert f"noise alone: {fit['noise_floor'] * 1e3:.2f} mm" in shown
    assert "18 poses" in shown
    assert "72 frames" in shown
    assert "a/bag" in shown
    for name in report["not_visible_here"]:
        assert f"({name})" in shown


def test_page_shows_the_true_amplitude_in_millimetres_inside_its_interval(case: Case) -> None:
    shown = text_of(case.page)
    found = re.search(r"harmonics\.0\.amplitude ([\d.]+) ([\d.]+) ([\d.]+) mm", shown)
    assert found is not None
    value, low, high = (float(x) for x in found.groups())
    assert abs(value - 9.0) < 0.75 * (high - low)  # three sigma
    assert low < value < high
    assert high - low < 1.0


def test_page_is_one_file_without_scripts(case: Case, tmp_path: Path) -> None:
    write_page(case.missing, tmp_path, recording="bag", camera="<camera>", scene="scene")
    content = (tmp_path / "report.html").read_text()
    assert "<script" not in content
    assert "http://" not in re.sub(r"base64,[^\"]*", "", content)
    assert "https://" not in re.sub(r"base64,[^\"]*", "", content)
    assert "<camera>" not in content
    assert "&lt;camera&gt;" in content
    sources = re.findall(r'src="([^"]*)"', content)
    assert len(sources) >= 7
    for one in sources:
        assert one.startswith("data:image/svg+xml;base64,")
        root = ElementTree.fromstring(base64.b64decode(one.split(",", 1)[1]))
        assert root.tag.endswith("svg")
    assert re.search(r"\bnan\b", text_of(content)) is None


def test_page_is_the_same_for_the_same_result(case: Case) -> None:
    assert rendered(case.missing) == case.page


def test_every_picture_is_explained(case: Case) -> None:
    content = case.page
    figures = re.findall(r"<figure>.*?</figure>", content, flags=re.S)
    assert len(figures) >= 7
    for one in figures:
        caption = re.search(r"<figcaption>(.*?)</figcaption>", one, flags=re.S)
        assert caption is not None
        assert len(caption[1]) > 30


def test_page_of_a_consistent_recording_names_nothing(case: Case) -> None:
    assert case.consistent.verdict == "consistent"
    shown = text_of(rendered(case.consistent))
    assert "The simulation explains this recording" in shown
    assert "Missing physics" not in shown
    assert "→" not in shown
    assert "The curve that gave it away" not in shown
    assert "No effect is named." in shown


def test_page_of_wrong_parameters_shows_before_and_after(case: Case) -> None:
    moved = Adjusted("radiometry", {"gain": 200.0}, {"gain": 231.5})
    result = replace(case.consistent, verdict="wrong_parameters", adjusted=[moved])
    shown = text_of(rendered(result))
    assert "No physics is missing, but the camera file has wrong parameters" in shown
    assert "gain 200 231.5" in shown


def test_page_of_an_inconsistent_setup_gives_the_reason(case: Case) -> None:
    result = replace(case.consistent, verdict="inconsistent_setup", reason="2 of 18 poses do not agree <b>")
    content = rendered(result)
    assert "2 of 18 poses do not agree &lt;b&gt;." in content
    assert "do not belong together" in content


def test_set_ups_come_before_the_proof_where_one_is_to_blame(case: Case) -> None:
    proof, setups = "The proof: poses that the model was not fitted to", "What else the scene could be"
    for result, first in (
        (case.missing, proof),
        (replace(case.consistent, verdict="inconsistent_setup", reason="another board"), setups),
    ):
        shown = text_of(rendered(result))
        assert shown.count(setups) == 1
        assert proof not in shown or (shown.index(setups) < shown.index(proof)) == (first == setups)


def test_page_tells_rivals_and_what_to_record(case: Case) -> None:
    result = replace(
        case.missing,
        indistinguishable=[["cyclic_error", "distance_scale"]],
        next_recording="for cyclic_error: a sweep; for distance_scale: a wall",
    )
    content = rendered(result)
    assert "indistinguishable by this recording" in content
    assert "<li>for cyclic_error: a sweep</li>" in content
    assert "<li>for distance_scale: a wall</li>" in content


def test_page_says_that_mixed_pixels_count_as_they_measure(case: Case) -> None:
    first = case.missing.missing[0]
    mixed = replace(case.missing, missing=[first, replace(first, effect="mixed_pixels")])
    sentence = "Mixed pixels count as they measure"
    assert sentence in rendered(mixed)
    assert sentence not in rendered(case.missing)


@pytest.mark.parametrize(("left", "expected"), [(1.02, "with it nothing is left but noise"), (1.67, "1.67)")])
def test_page_says_what_is_left_given_the_curve(case: Case, left: float, expected: str) -> None:
    result = replace(case.missing, accuracy=replace(case.missing.accuracy, chi2_after=left))
    shown = text_of(rendered(result))
    assert expected in shown
    assert ("that its form does not explain (chi-square per value" in shown) is (left > 1.1)


def test_page_without_repeated_frames_says_so(case: Case) -> None:
    variance = replace(case.consistent.variance, repeated=False, bins=())
    shown = text_of(rendered(replace(case.consistent, variance=variance)))
    assert "noise cannot be measured" in shown
    assert "measured variance of repeated frames" not in shown


def test_page_that_cannot_be_written_is_an_error(case: Case, tmp_path: Path) -> None:
    with pytest.raises(RimError, match="absent"):
        write_page(case.consistent, tmp_path / "absent", recording="r", camera="c", scene="s")


def test_report_holds_the_probability_that_the_page_tells(case: Case) -> None:
    report = json.loads(json.dumps(as_json(case.missing)))
    assert report["missing"][0]["probability"] > 0.999
    assert "Probability above 0.999" in text_of(case.page)


# --- the numbers behind the pictures ----------------------------------------------------------------


def test_curve_follows_the_sinusoid_that_is_missing(case: Case) -> None:
    found = evidence(case.missing)
    (curve,) = [one for one in curves_of(case.missing, found) if "harmonics" in one.title]
    without, after, _ = curve.bins.means
    truth = 9.0 * np.sin(4 * 2 * np.pi * curve.bins.x / AMBIGUITY + 0.7)
    # a constant belongs to the fixed pattern
    error = without - truth
    assert np.std(error) < 0.5
    assert np.ptp(without) > 12.0
    assert np.max(np.abs(after)) < 1.0
    assert np.std(after) < 0.5


def test_residuals_fall_to_the_noise(case: Case) -> None:
    found = evidence(case.missing)
    assert found.chi_before is not None
    assert found.rms_before is not None
    assert len(found.times) == len(DISTANCES)
    assert np.mean(found.chi_before) > 2.0
    assert 0.85 < np.mean(found.chi_after) < 1.05
    assert np.nanmedian(found.rms_before) > 1.3
    assert 0.85 < np.nanmedian(found.rms_after) < 1.05
    assert found.changed == ("cyclic_error",)
    assert found.strength is not None
    # RMS of a sinusoid of 9 mm over 1.8 periods, each pixel's mean removed
    assert np.sqrt(np.mean(found.strength**2)) == pytest.approx(9.0e-3 / np.sqrt(2), rel=0.12)


def test_a_model_that_chi_square_speaks_against_is_not_called_better(case: Case) -> None:
    assert "is the better simulation" in text_of(case.page)
    worse = replace(case.missing, accuracy=replace(case.missing.accuracy, chi2_before=1.03, chi2_after=1.36))
    found = text_of(rendered(worse))
    assert "Chi-square per value of held-out poses rose from 1.03 to 1.36" in found
    assert "is the better simulation" not in found


def test_nothing_is_compared_where_nothing_changed(case: Case) -> None:
    found = evidence(case.consistent)
    assert found.chi_before is None
    assert found.image is None
    assert 0.85 < np.mean(found.chi_after) < 1.05


def test_classes_have_weighted_means_and_errors_between_stations() -> None:
    x = np.repeat([1.0, 5.0], 120)
    station = np.tile(np.repeat([0, 1, 2], 40), 2)
    # the stations' means are 1, 2, 6 in the first class, all 4 in the second
    values = np.concatenate([np.repeat([1.0, 2.0, 6.0], 40), np.full(120, 4.0)])
    bins = binned(x, (values,), weight=np.ones(240), station=station)
    assert bins.x == pytest.approx([1.0, 5.0])
    assert bins.means[0] == pytest.approx([3.0, 4.0])
    # standard error of the mean of 1, 2, 6: sqrt(7) / sqrt(3); none where all agree
    assert bins.errors[0] == pytest.approx([np.sqrt(7 / 3), 0.0])


def test_classes_weigh_values() -> None:
    x = np.full(90, 2.0)
    x[45:] = 3.0
    values = np.tile([1.0, 5.0, 9.0], 30)
    weight = np.tile([4.0, 1.0, 1.0], 30)
    bins = binned(x, (values,), weight=weight, station=np.zeros(90, int))
    assert bins.means[0] == pytest.approx([3.0, 3.0])


def test_region_is_the_smallest_that_holds_the_share() -> None:
    pixels = np.array([[50.0, 1.0, 30.0], [4.0, 15.0, 0.0]])
    # 50 + 30 = 80 of 100 are too few, with 15 it is 95
    assert region(pixels).tolist() == [[True, False, True], [False, True, False]]
    assert region(pixels, 0.5).sum() == 1
    assert not region(np.zeros((3, 2))).any()


# --- words ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "low", "high", "expected"),
    [
        (9.0312, 8.7, 9.36, ["9.03", "8.70", "9.36"]),
        (0.0014584, 0.00143553, 0.0014813, ["0.001458", "0.001436", "0.001481"]),
        (1234.56, 1100.0, 1369.0, ["1235", "1100", "1369"]),
        (2.9e-10, 1.9e-10, 4.0e-10, ["2.9·10⁻¹⁰", "1.9·10⁻¹⁰", "4.0·10⁻¹⁰"]),
    ],
)
def test_numbers_have_the_digits_of_their_interval(
    value: float, low: float, high: float, expected: list[str]
) -> None:
    assert words.with_width(value, low, high) == expected


def test_lengths_are_in_millimetres() -> None:
    assert millimetres(0.0312) == "31 mm"
    assert millimetres(0.2587) == "260 mm"
    assert millimetres(0.00083) == "0.83 mm"
    assert millimetres(2.4537) == "2,500 mm"


def test_probability_is_never_certain() -> None:
    assert words.probability(1.0) == "above 0.999"
    assert words.probability(0.0) == "below 0.001"
    assert words.probability(0.734) == "0.734"


def test_closed_form_is_evaluated_as_it_is_written() -> None:
    formula = "0.0035 -0.002 x^2 +0.01 1/x [m], x = distance"
    x = np.array([0.5, 2.0])
    assert formula_curve(formula, x) == pytest.approx([0.0035 - 0.0005 + 0.02, 0.0035 - 0.008 + 0.005])
    assert words.formula_words(formula) == "3.5 − 2 x² + 10 / x mm, x = distance in m"
    assert formula_curve("staircase of the distance", x) is None
    assert words.formula_words("staircase of the distance") == "staircase of the distance"


def test_parameters_have_units_and_meanings_of_their_own(case: Case) -> None:
    light = Scattering(
        kernels=(Kernel(weight=0.02, sigma=(4.0, 7.0)),), ghost=Ghost(weight=0.01, shift=(2.0, -3.0))
    )
    camera = replace(case.camera, effects={"scattering": light})
    assert words.described(camera, "scattering", "kernels.0.sigma.0") == ("px", "along row")
    assert words.described(camera, "scattering", "kernels.0.sigma.1") == ("px", "along column")
    assert words.described(camera, "scattering", "kernels.0.weight") == ("", "share of each pixel's light")
    assert words.described(camera, "camera_constant", "fx") == ("px", "focal length along the row")


def test_parameter_without_interval_is_said_to_be_not_fitted(case: Case) -> None:
    one = Missing(
        "cyclic_error",
        1.0,
        {"harmonics.0.amplitude": 0.009, "harmonics.0.order": 4.0},
        {"harmonics.0.amplitude": (0.0087, 0.0093)},
        "cyclic error",
    )
    rows = words.parameter_rows(one, case.missing.camera)
    assert rows[0][:5] == ["harmonics.0.amplitude", "9.00", "8.70", "9.30", "mm"]
    assert rows[1][:4] == ["harmonics.0.order", "4", "-", "-"]
    assert rows[1][5].endswith("not fitted")


def test_verdict_of_unknown_physics_names_its_covariates(case: Case) -> None:
    one = Missing("unknown", 1.0, {}, {}, "unknown physics", ("height", "row_amplitude"), formula="h a")
    sentence = words.verdict(replace(case.missing, verdict="unknown_physics", missing=[one]))
    expected = "height above the camera and mean amplitude of the row"
    assert sentence == f"Distances depend on {expected} in a way that no known effect explains."


def test_verdict_of_first_frames_says_what_they_are(case: Case) -> None:
    sentence = words.verdict(replace(case.missing, verdict="unknown_physics", missing=[first_frames()]))
    assert sentence.startswith("The first frame of each pose differs from those after it, which are alike")
    assert sentence.endswith("in what all pixels share.")


# --- pictures of their own --------------------------------------------------------------------------


def test_histogram_of_nulls_takes_any_score() -> None:
    maxima = np.linspace(-1.5, 6.0, 200)
    for score in (-3.0, 2.0, 30.0, 2.0e6):
        picture = page_figures.nulls([("", maxima, (8.0, "its threshold"), (score, "best effect"), 6.2)])
        assert ElementTree.fromstring(picture).tag.endswith("svg")


def test_ranking_takes_gains_of_all_sizes() -> None:
    rows: list[tuple[str, float, float | None, str]] = [
        ("a", 3.0e6, 9.0, "named"),
        ("b", 0.4, None, "other"),
        ("c", -50.0, 8.0, "smooth"),
    ]
    assert ElementTree.fromstring(page_figures.ranking(rows, threshold=8.0)).tag.endswith("svg")


def test_surface_of_a_table_over_column_and_amplitude() -> None:
    knots = [list(range(24)), [50.0, 400.0, 3000.0]]
    values = np.outer(np.sin(np.arange(24.0)), [0.001, 0.0, -0.002])
    picture = page_maps.surface(
        knots, values, ["column [px]", "amplitude [counts]"], log=[False, True], unit="mm"
    )
    assert ElementTree.fromstring(picture).tag.endswith("svg")


def test_outline_keeps_small_regions_and_smooths_large_ones() -> None:
    inside = np.zeros((40, 50), bool)
    inside[3, 7:12] = True
    assert np.array_equal(page_maps.simplified(inside) > 0.5, inside)
    inside = np.zeros((40, 50), bool)
    inside[5:35, 10:40] = True
    inside[20, 20] = False
    inside[2, 2] = True
    outline = page_maps.simplified(inside) > 0.5
    assert outline[20, 20]
    assert not outline[2, 2]
    assert outline[10:30, 15:35].all()


def test_every_key_of_the_report_is_explained(case: Case) -> None:
    """docs/diagnosis_report.md has a row for each key, of which some are in the row they belong to."""
    documented = (Path(__file__).resolve().parents[2] / "docs" / "diagnosis_report.md").read_text()
    report = as_json(case.missing)
    keys = [*report, *(f"where.{one}" for one in report["where"]), *report["fit"], *report["ranking"][0]]
    keys += [*report["missing"][0], "covariates", "closed_form", "reason"]
    absent = [one for one in keys if f"`{one}`" not in documented and one != "where"]
    assert absent == []


def test_poses_of_another_scene_are_not_said_to_agree(case: Case) -> None:
    assert "All poses agree" in text_of(case.page)
    wrong = replace(case.missing, verdict="inconsistent_setup", reason="another scene", missing=[])
    assert "All poses agree" not in text_of(rendered(wrong))


def test_what_was_excluded_stands_with_the_verdict_alone(case: Case) -> None:
    notes = ["excluded: 3 % of the values, as a hand before them", "a detail of a fit"]
    text = text_of(rendered(replace(case.consistent, notes=notes)))
    assert text.count("3 % of the values, as a hand before them") == 1
    before, after = text.split("Excluded: 3 % of the values, as a hand before them.")
    assert "What this means" in before
    assert "Differences over the array" in after
    assert "a detail of a fit" in after
