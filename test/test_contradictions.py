"""The check of reports against themselves sees what it should."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from .contradictions import contradictions

REPORT: dict[str, Any] = {
    "verdict": "missing_physics",
    "missing": [{"effect": "cyclic_error", "probability": 0.98}],
    "adjusted": [],
    "ranking": [
        {"effect": "cyclic_error", "held_out_gain": 210.0},
        {"effect": "distance_scale", "held_out_gain": 31.0},
    ],
    "indistinguishable": [],
    "fit": {
        "rms_before": 0.014,
        "rms_after": 0.011,
        "chi2_before": 1.4,
        "chi2_after": 1.02,
        "held_out": True,
    },
}


def test_a_report_that_agrees_with_itself() -> None:
    assert contradictions(REPORT) == []
    tied = copy.deepcopy(REPORT)
    tied["ranking"][1]["held_out_gain"] = 230.0
    tied["indistinguishable"] = [["cyclic_error", "distance_scale"]]
    assert contradictions(tied) == []


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"missing": []}, "missing_physics with 0 missing"),
        ({"verdict": "consistent"}, "consistent with 1 missing"),
        ({"missing": [{"effect": "cyclic_error", "probability": 1e-17}]}, "named with probability 1e-17"),
        ({"reason": "a board is turned"}, "a reason do not go together"),
        (
            {"setup": [{"hypothesis": "scale", "gain": 42.0}, {"hypothesis": "as_given", "gain": 0.0}]},
            "though scale ranks above the set-up as given",
        ),
        ({"verdict": "wrong_parameters", "missing": []}, "wrong parameters without any that moved"),
        (
            {
                "ranking": [
                    {"effect": name, "held_out_gain": gain}
                    for name, gain in (("cyclic_error", 2.0), ("x", 3.0))
                ]
            },
            "cyclic_error ranks below x",
        ),
        (
            {"fit": {**REPORT["fit"], "rms_after": 0.014, "chi2_after": 1.4}},
            "does not improve held-out poses",
        ),
        ({"fit": {**REPORT["fit"], "rms_after": 0.026, "chi2_after": 6.7}}, "does not improve"),
    ],
)
def test_a_contradiction_is_seen(changes: dict[str, Any], said: str) -> None:
    found = contradictions({**copy.deepcopy(REPORT), **changes})
    assert len(found) == 1
    assert said in found[0]
