"""The table of what else the scene could be: every set-up in words, in the order of the report."""

from __future__ import annotations

from rim_camera_ros.diagnose.hypotheses import _WORDS, AS_GIVEN
from rim_camera_ros.reports.diagnosis.setup import _HYPOTHESES, hypotheses
from rim_camera_ros.reports.page import Table


def test_every_setup_has_words() -> None:
    assert {*_WORDS, AS_GIVEN} == set(_HYPOTHESES)
    assert not [words for words in _HYPOTHESES.values() if "_" in words]


def test_the_trusted_files_lead_whatever_gained_a_little_more() -> None:
    """As `setup` in report.json: they lead, and the table does not sort anew by the gain."""
    setup = [
        {"hypothesis": "as_given", "surface": "", "gain": 0.0},
        {"hypothesis": "turned_90", "surface": "board", "gain": 8.4},
        {"hypothesis": "other_lens", "surface": None, "gain": -1234.6},
    ]
    (table,) = hypotheses({"setup": setup})
    assert isinstance(table, Table)
    assert table.rows == [
        ["as the scene file says", "-", "0"],
        ["turned by 90°", "board", "8"],
        ["seen through another lens", "-", "-1,235"],
    ]
    assert table.moods == {0: "good"}
    assert hypotheses({"setup": setup[:1]}) == []
