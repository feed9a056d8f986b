"""The scorer's arithmetic against numbers from outside it, the plan, the page, and runs of the benchmark."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from test.blind import table
from test.blind.__main__ import finished, main
from test.blind.baselines import Sums, by_bic, by_correlation
from test.blind.page import write_page
from test.blind.plan import CI_COUNTS, COUNTS, LARGE, TWICE, plan
from test.blind.run_case import open_again, publish, seal_away
from test.blind.score import (
    Rate,
    confidently_wrong,
    covered,
    explained_share,
    identifiability,
    inside_rivals,
    intersection_over_union,
    median_interval,
    named,
    named_right,
    named_wrongly,
    region,
)
from test.blind.sensitivity import fit_curves


def result(
    truth=("scattering",),
    said=("scattering",),
    *,
    verdict=None,
    tier="plain",
    kind=None,
    name="plain-000",
    ties=(),
    adjusted=(),
    probability=0.9,
    strength=1.0,
    chi2=(1.5, 1.05, 1.0),
    intervals=None,
    parameters=None,
    scene="rich",
    iou=0.8,
    true_region=0.3,
    baselines=None,
    left=None,
    forms="scoring",
    twin_of=None,
):
    """A made-up result with the fields of a real one."""
    if verdict is None:
        verdict = "consistent" if not said else "unknown_physics" if "unknown" in said else "missing_physics"
    return {
        "case": {
            "name": name,
            "kind": kind or tier,
            "forms": forms,
            "seed": 17,
            "master_seed": 20261121,
            "twin_of": twin_of,
        },
        "state": {"commit": "c" * 40, "package": "p" * 64, "generator": "g" * 64},
        "truth": {
            "effects": list(truth),
            "tier": tier,
            "strength": dict.fromkeys(truth, strength),
            "strength_local": strength if truth else None,
            "left_after_masking": left,
            "parameters": parameters or {},
            "forms": forms,
            "scene": scene,
            "masked": left is not None,
            "size": [88, 72],
            "covariates": ["height"] if tier == "unknown" else [],
        },
        "report": {
            "verdict": verdict,
            "missing": [
                {"effect": one, "probability": probability, "interval": (intervals or {}).get(one, {})}
                for one in said
            ],
            "adjusted": [{"effect": one} for one in adjusted],
            "indistinguishable": [list(tie) for tie in ties],
            "ranking": [],
            "fit": {"chi2_before": chi2[0], "chi2_after": chi2[1]},
        },
        "error": None,
        "chi2_of_truth": chi2[2],
        "iou": iou if truth else None,
        "iou_of_root": iou if truth else None,
        "true_region": true_region if truth else None,
        "baselines": baselines or {"bic": "noise", "correlation": "scattering"},
        "cpu_seconds": 9.0,
        "peak_mb": 500.0,
    }


# arithmetic


@pytest.mark.parametrize(("successes", "count"), [(0, 10), (10, 10), (81, 263), (15, 148), (95, 100), (1, 1)])
def test_wilson_interval_is_that_of_scipy(successes, count):
    expected = binomtest(successes, count).proportion_ci(0.95, method="wilson")
    np.testing.assert_allclose(Rate(successes, count).interval, expected, atol=1e-12)


def test_wilson_interval_of_newcombe_1998():
    # Newcombe, Statistics in Medicine 17 (1998), table I, method 3
    np.testing.assert_allclose(Rate(81, 263).interval, [0.2553, 0.3662], atol=5e-5)
    np.testing.assert_allclose(Rate(0, 20).interval, [0.0, 0.1611], atol=5e-5)


def test_a_rate_meets_what_its_interval_contains_or_exceeds():
    assert Rate(95, 100).meets(at_least=0.95) is True
    assert Rate(94, 100).meets(at_least=0.95) is False
    assert Rate(5, 100).meets(at_most=0.05) is True
    assert Rate(6, 100).meets(at_most=0.05) is False
    assert Rate(200, 200).meets(at_least=0.90, at_most=0.98) is False
    assert Rate(0, 0).meets(at_least=0.95) is None


def test_median_with_order_statistics():
    # 20 values: 6th and 15th of them (Conover, Practical Nonparametric Statistics, binomial table)
    middle, low, high = median_interval(list(range(20, 0, -1)))
    assert (middle, low, high) == (10.5, 6.0, 15.0)
    assert np.isnan(median_interval([])).all()


def test_region_is_the_smallest_set_with_90_percent():
    values = np.array([[1.0, 4.0, 0.0], [50.0, 5.0, 40.0]])
    assert region(values).tolist() == [[False, False, False], [True, False, True]]
    assert region(values, 0.901).tolist() == [[False, False, False], [True, True, True]]
    assert not region(np.zeros((2, 3))).any()
    assert region(np.array([np.nan, 3.0])).tolist() == [False, True]


def test_overlap():
    one = np.array([1, 1, 1, 0, 0], bool)
    other = np.array([0, 1, 1, 1, 0], bool)
    assert intersection_over_union(one, other) == pytest.approx(2 / 4)
    assert intersection_over_union(one, ~one) == 0.0


def test_logistic_curves_find_the_points_that_made_the_data():
    rng = np.random.default_rng(3)
    true = {"scattering": 0.08, "noise": 0.4}
    data = {}
    for name, point in true.items():
        strength = np.exp(rng.uniform(np.log(0.01), np.log(3.0), 600))
        seen = rng.uniform(size=600) < 1.0 / (1.0 + (strength / point) ** -2.5)
        data[name] = list(zip(strength.tolist(), seen.tolist(), strict=True))
    curves = fit_curves(data)
    assert curves.slope == pytest.approx(2.5, rel=0.15)
    for name, point in true.items():
        assert curves.points[name] == pytest.approx(point, rel=0.15)
        assert curves.probability(name, curves.points[name]) == pytest.approx(0.5)


def test_logistic_curves_of_separated_and_of_no_data():
    curves = fit_curves({"a": [(0.5, True), (1.0, True)], "b": [(0.5, False), (1.0, False)], "c": []})
    assert curves.points["a"] < 0.5
    assert curves.points["b"] > 1.0
    assert set(curves.points) == {"a", "b"}
    with pytest.raises(ValueError, match="positive"):
        fit_curves({"a": [(0.0, True)]})


# one result


def test_what_counts_as_named():
    assert named_right(result())
    both = result(("scattering", "cyclic_error"), ("cyclic_error", "scattering"), tier="two")
    assert named_right(both)
    extra = result(said=("scattering", "noise"))
    assert not named_right(extra)
    assert named_wrongly(extra)
    missed = result(said=())
    assert not named_right(missed)
    assert not named_wrongly(missed)
    abstained = result(said=("unknown",))
    assert not named_right(abstained)
    assert not named_wrongly(abstained)
    outside = result(("height",), ("unknown",), tier="unknown")
    assert named_right(outside)
    assert named_wrongly(result(("height",), ("scattering",), tier="unknown"))


def test_nulls_are_right_when_consistent_only():
    assert named_right(result((), (), tier="null"))
    assert not named_right(result((), (), tier="null", verdict="wrong_parameters"))
    assert not named_right(result((), (), tier="null", verdict="inconsistent_setup"))


def test_sections_that_are_merely_wrong():
    assert named_right(
        result(("noise",), (), verdict="wrong_parameters", adjusted=("amplitude_offset", "noise"))
    )
    # with another verdict, or for an effect that was omitted, `adjusted` names nothing
    assert not named_right(result(("noise",), (), verdict="consistent", adjusted=("noise",)))
    assert named(result(said=("scattering",), adjusted=("noise",))) == ("scattering",)
    assert not named_right(result(("scattering",), (), verdict="wrong_parameters", adjusted=("scattering",)))


def test_a_failed_run_names_nothing_and_is_no_null_that_was_right():
    failed = result((), (), tier="null") | {"report": None, "error": "exit 2: rim: broken"}
    assert not named_right(failed)
    assert not named_wrongly(failed)
    assert explained_share(failed) is None


def test_rivals_and_confidence():
    wrong = result(said=("multipath",))
    assert not inside_rivals(wrong)
    assert confidently_wrong(wrong)
    tied = result(said=("multipath",), ties=[("multipath", "scattering")])
    assert inside_rivals(tied)
    assert not confidently_wrong(tied)
    assert named_wrongly(tied)
    # a tie of others is no help
    assert not inside_rivals(result(said=("multipath",), ties=[("noise", "scattering")]))
    assert not confidently_wrong(result(said=("multipath",), probability=0.4))
    assert not confidently_wrong(result(said=("unknown",)))
    # what is named in addition to the leader is claimed, whatever its share
    assert confidently_wrong(result(said=("scattering", "multipath"), probability=0.0))


def test_explained_share():
    assert explained_share(result(chi2=(1.5, 1.05, 1.0))) == pytest.approx(0.9)
    assert explained_share(result(chi2=(1.5, 1.5, 1.02))) == pytest.approx(0.0)
    assert explained_share(result(chi2=(1.003, 1.0, 1.0))) is None
    assert explained_share(result(chi2=(1.5, 1.0, None))) is None


def test_identifiability_is_the_reports_before_the_truths():
    assert identifiability(result(left=0.1)) == pytest.approx(0.01)
    stated = result(left=0.1)
    stated["report"]["ranking"] = [
        {"effect": "scattering", "identifiability": 0.3},
        {"effect": "noise", "identifiability": 0.001},
    ]
    assert identifiability(stated) == pytest.approx(0.3)
    assert identifiability(result()) is None


def test_intervals_of_counterparts():
    drawn = {"integration_time_offset": {"amount": 0.02, "sign": -1.0}}
    # -0.02 (exp(-T / 45) - 0.35): -0.00702 at 16, +0.00173 at 60, +0.00483 at 100
    bounds = {"offset.16": [-0.008, -0.006], "offset.60": [0.0018, 0.0025], "offset.100": [0.004, 0.005]}
    one = result(
        ("integration_time_offset",),
        ("integration_time_offset",),
        parameters=drawn,
        intervals={"integration_time_offset": bounds},
    )
    assert dict(covered(one)) == {
        "integration_time_offset.offset.16": True,
        "integration_time_offset.offset.60": False,
        "integration_time_offset.offset.100": True,
    }
    drawn = {"distance_scale": {"amount": 0.004, "sign": -1.0}}
    for bounds, inside in (([-0.0046, -0.0042], True), ([-0.0039, -0.0038], False)):
        one = result(
            ("distance_scale",),
            ("distance_scale",),
            parameters=drawn,
            intervals={"distance_scale": {"scale": bounds}},
        )
        assert covered(one) == [("distance_scale.scale", inside)]
    # no counterpart: the hidden form has other parameters
    assert covered(result(intervals={"scattering": {"kernels.0.weight": [0.0, 1.0]}})) == []


# the table


def made_up():
    nulls = [
        result((), () if i >= 2 else ("noise",), tier="null", name=f"null-{i:03d}", chi2=(1.0, 1.0, None))
        for i in range(20)
    ]
    plain = [result(name=f"plain-{i:03d}", strength=2.0) for i in range(18)]
    plain += [result(said=("multipath",), name=f"plain-{i:03d}", strength=2.0) for i in (18, 19)]
    faint = [result(said=(), kind="faint", name=f"faint-{i:03d}", strength=0.02) for i in range(6)]
    cancelled = result(
        ("incidence_angle", "amplitude_offset"), ("incidence_angle",), tier="cancelled", name="cancelled-000"
    )
    two = result(("scattering", "cyclic_error"), ("scattering",), tier="two", name="two-000")
    outside = result(("height",), ("unknown",), tier="unknown", name="unknown-000", strength=2.0)
    larger = result(said=(), kind=TWICE, name="large-000", twin_of="plain-000")
    larger["truth"]["size"] = list(LARGE)
    return [*nulls, *plain, *faint, cancelled, two, outside, larger]


def row_of(found, start):
    return next(row for row in found.rows if row.measure.startswith(start))


def test_rows_of_the_table():
    found = table.score(made_up())
    assert row_of(found, "missing effect named").value.startswith("18 of 20 = 90.0 %")
    assert row_of(found, "the same, named wrongly").value.startswith("2 of 20 = 10.0 %")
    assert row_of(found, "the same, named wrongly").met is False
    assert row_of(found, "the same, truth inside").value.startswith("18 of 20")
    alarms = row_of(found, "alarm")
    assert alarms.value == "2 of 20 = 10.0 % (2.8 to 30.1)"
    assert alarms.met is False
    assert row_of(found, "*unknown*").value.startswith("1 of 1")
    assert row_of(found, "two effects").value.startswith("0 of 1")
    assert row_of(found, "held-out").value.startswith("90.0 %")
    assert row_of(found, "concealed cases confidently").value.startswith("0 of 1")
    assert row_of(found, "concealed cases named").value.startswith("0 of 1")
    # 2 nulls, 2 plain, 6 faint, cancelled, two, and the larger one
    assert len(found.misses) == 13
    assert [table.same_verdict(*pair) for pair in found.sizes] == [False]
    assert {name: total for name, _, total in found.effects}["scattering"] == Rate(18, 20)


def test_an_effect_that_is_never_seen_counts_where_it_is_strong():
    never = [result(said=(), strength=s, name=f"plain-{i}") for i, s in enumerate((0.3, 1.0, 1.6, 2.5))]
    assert row_of(table.score(never), "missing effect").value.startswith("0 of 2 = 0.0 %")


def test_confusion_by_the_first_name():
    found = table.confusion(made_up(), "rim diagnose")
    assert found["scattering"] == {"scattering": 18, "multipath": 2}
    assert found["null"] == {"consistent": 18, "noise": 2}
    assert found["outside"] == {"unknown": 1}
    assert table.confusion(made_up(), "independent BIC")["scattering"] == {"noise": 20}


def test_page_tells_all_of_it(tmp_path):
    ledger = tmp_path / "ledger.txt"
    ledger.write_text("plain-000 ...\n")
    page = write_page(made_up(), tmp_path / "docs", ledger=ledger, command="make proof").read_text()
    assert "| alarm although nothing is missing | ≤ 5 % | 2 of 20 = 10.0 % (2.8 to 30.1) | **no** |" in page
    assert "| scattering | 18/20 | " in page
    assert "018 scattering: missing_physics: multipath" in page
    assert "prove nothing" not in page
    assert "cccccccccccc" in page
    for name in ("confusion.png", "sensitivity.png", "ledger.txt"):
        assert f"proof/{name}" in page
        assert 0 < (tmp_path / "docs" / "proof" / name).stat().st_size < 300_000


def test_page_keeps_what_people_say_of_the_run(tmp_path):
    (tmp_path / "proof").mkdir()
    said = "Seven cases were seen before.\n\n## After the run\n\nNothing.\n"
    (tmp_path / "proof" / "history.md").write_text(said)
    text = write_page([result()], tmp_path, ledger=tmp_path / "none", command="x").read_text()
    assert "\n\nSeven cases were seen before.\n\n## What was reached" in text
    assert text.endswith("\n\n## After the run\n\nNothing.\n")


def test_page_warns_of_other_forms(tmp_path):
    path = write_page([result(forms="tuning")], tmp_path, ledger=tmp_path / "none", command="x")
    assert "prove nothing" in path.read_text()


# the plan


def test_plan_has_the_numbers_and_no_seed_twice():
    cases = plan()
    assert {kind: sum(case.kind == kind for case in cases) for kind in COUNTS} == COUNTS
    assert len({case.name for case in cases}) == len(cases)
    small = [case for case in cases if case.kind != TWICE]
    assert len({case.seed for case in small}) == len(small)
    assert sum(bool(case.masked) for case in cases if case.kind == "null") == 50
    plain = [case.effect for case in cases if case.kind == "plain"]
    assert {plain.count(effect) for effect in plain} == {5, 6}
    assert sum(CI_COUNTS.values()) == 40


def test_larger_cases_repeat_smaller_ones():
    cases = {case.name: case for case in plan()}
    larger = [case for case in cases.values() if case.kind == TWICE]
    for case in larger:
        twin = cases[case.twin_of]
        assert case.size == (176, 144)
        assert (case.seed, case.tier, case.effect) == (twin.seed, twin.tier, twin.effect)
    assert {case.tier for case in larger} >= {"null", "plain", "masked", "unknown"}


def test_first_cases_do_not_depend_on_how_many_there_are():
    few = plan({"plain": 3, "masked": 2})
    assert few == [case for case in plan() if case.name in {one.name for one in few}]
    tuning = {case.seed for case in plan(forms="tuning")}
    assert not tuning & {case.seed for case in plan()}


def test_plan_names_what_it_does_not_know():
    with pytest.raises(ValueError, match="no such tiers or forms: typo"):
        plan({"typo": 1})


# seals and baselines


def test_seal_is_published_before_and_checked_after(tmp_path):
    given, sealed = tmp_path / "given", tmp_path / "sealed"
    given.mkdir()
    (given / "truth.json").write_text("abc")
    np.save(given / "truth.npy", np.arange(3.0))
    seals = seal_away(given, sealed)
    # sha256("abc") of FIPS 180-2, appendix B.1
    assert seals["truth.json"] == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert list(given.iterdir()) == []
    for name in ("one", "two"):
        publish(tmp_path / "ledger.txt", name, seals, {"generator": "g" * 64, "package": "p" * 64})
    lines = (tmp_path / "ledger.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["one", "two"]
    assert all(seals["truth.json"] in line for line in lines)
    open_again(sealed, seals)
    (sealed / "truth.json").write_text("abd")
    with pytest.raises(RuntimeError, match="not the truth that was published"):
        open_again(sealed, seals)


def sums_of(design, residual):
    return Sums(design.T @ design, design.T @ residual, float(residual @ residual), len(residual))


def test_baselines_on_independent_values_find_the_column_that_is_there():
    rng = np.random.default_rng(5)
    design = rng.normal(size=(4000, 4))
    design[:, 3] += 0.9 * design[:, 1]
    spans, effects = [[1], [2], [3]], ["a", "b", "c"]
    noise = rng.normal(size=4000)
    with_b = sums_of(design, noise + 0.2 * design[:, 2])
    assert by_bic(with_b, [0], spans, effects) == "b"
    assert by_correlation(with_b, spans, effects) == "b"
    nothing = sums_of(design, noise)
    assert by_bic(nothing, [0], spans, effects) == "consistent"
    assert by_correlation(nothing, spans, effects) == "consistent"
    # what the known terms explain is no candidate's merit for BIC; the frozen residual does not know
    known = sums_of(design, noise + 0.5 * design[:, 0] + 0.0 * design[:, 1])
    assert by_bic(known, [0], spans, effects) == "consistent"


# runs


def test_options_that_do_not_fit(tmp_path, capsys):
    assert main(["--out", str(tmp_path), "--tiers", "typo"]) == 2
    assert "no such tiers or forms: typo" in capsys.readouterr().err
    assert main(["--out", str(tmp_path), "--only", "plain-999"]) == 2
    assert "no such cases: plain-999" in capsys.readouterr().err
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "plain-000.json").write_text("{}")
    assert main(["--out", str(tmp_path), "--cases", "1"]) == 2
    assert "--resume goes on with them" in capsys.readouterr().err


def test_results_of_another_state_are_run_again(tmp_path):
    cases = plan({"plain": 2})
    state = {"generator": "g" * 64, "package": "p" * 64, "commit": "c" * 40}
    for case, package in zip(cases, ("p" * 64, "q" * 64), strict=True):
        document = result(name=case.name)
        document["state"] = state | {"package": package}
        document["case"]["seed"] = case.seed
        (tmp_path / f"{case.name}.json").write_text(json.dumps(document))
    done, left = finished(cases, tmp_path, state)
    assert [one["case"]["name"] for one in done] == ["plain-000"]
    assert left == [cases[1]]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_cases_from_making_to_page(tmp_path):
    names = ["plain-000", "null-000"]
    only = ["--seed", "20261122", *(part for name in names for part in ("--only", name))]
    out = tmp_path / "out"
    assert main(["--out", str(out), "--forms", "tuning", "--jobs", "1", *only]) == 0
    results = {name: json.loads((out / "results" / f"{name}.json").read_text()) for name in names}
    ledger = dict(line.split()[::2][:2] for line in (out / "ledger.txt").read_text().splitlines())
    for name, one in results.items():
        assert one["error"] is None
        assert ledger[name] == one["seals"]["truth.json"]
        assert 0.5 < one["cpu_seconds"] < 300.0
        assert set(one["baselines"]) == {"bic", "correlation"}
    # a recording without the effect, seen with the true terms, leaves the noise
    assert results["plain-000"]["chi2_of_truth"] == pytest.approx(1.0, abs=0.02)
    assert (out / "proof.md").exists()
    assert not any(Path(out / "given").iterdir())
    # nothing is run twice
    before = (out / "results" / "plain-000.json").stat().st_mtime_ns
    assert main(["--out", str(out), "--forms", "tuning", "--resume", *only]) == 0
    assert (out / "results" / "plain-000.json").stat().st_mtime_ns == before


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_forty_cases(tmp_path):
    """What a tool that just meets the figures fails by chance in less than 1 % of runs."""
    arguments = ["--forms", "tuning", "--ci", "--no-baselines", "--seed", "20261122"]
    assert main(["--out", str(tmp_path), *arguments]) == 0
    results = [json.loads(path.read_text()) for path in sorted((tmp_path / "results").glob("*.json"))]
    assert len(results) == 40
    assert [one["case"]["name"] for one in results if one["error"] is not None] == []
    assert [text for one in results for text in one["trouble"] if text.startswith("camera.yaml")] == []
    by_tier = {tier: [one for one in results if one["truth"]["tier"] == tier] for tier in CI_COUNTS}
    alarms = [one["case"]["name"] for one in by_tier["null"] if not named_right(one)]
    assert len(alarms) <= binom.ppf(0.99, len(by_tier["null"]), 0.05), alarms
    found = table.score(results)
    right = sum(map(named_right, found.counted))
    assert right >= binom.ppf(0.01, len(found.counted), 0.95)
    wrong = [one["case"]["name"] for one in found.counted if named_wrongly(one)]
    assert len(wrong) <= binom.ppf(0.99, len(found.counted), 0.02), wrong
    assert sum(map(named_right, by_tier["two"])) >= binom.ppf(0.01, len(by_tier["two"]), 0.80)
    unknown = [one for one in by_tier["unknown"] if table.is_visible(one, found.seen)]
    assert sum(map(named_right, unknown)) >= binom.ppf(0.01, len(unknown), 0.90)
    # bounds on few cases would hold for a tool that notices next to nothing
    assert len(found.counted) >= 8
