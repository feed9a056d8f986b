"""What a soak is held against: figures at a limit pass, those beyond it are said."""

from __future__ import annotations

import re
from typing import Any

import pytest

from test.soak import limits

COUNTS = {
    "/camera/driver: frames": {"frames": 180_000, "skipped": 58, "not_published": 0},
    "/camera/correction: frames": {
        "frames": 180_000,
        "dropped_frames": 0,
        "refused_messages": 0,
        "not corrected": 0,
    },
}
#: Figures at their limits.
GOOD: dict[str, dict[str, Any]] = {
    "kills": {"kills": 50, "back_s": [("driver", 4.0)], "stale": 0, "backwards": 0, "wrong": 0},
    "hostile": {"good": 600, "good_corrected": 600, "memory_mb": [129.3, 140.0, 169.3]},
    "endurance": {"counts": COUNTS, "memory_mb": [150.9, 151.0, 151.2, 155.9]},
    "latency": {"one process": {"median": 5.0, "p99": 12.0}, "two": {"median": 9.0, "p99": 20.0}},
    "overload": {"older": 0},
    "clock_jumps": {"frames": 100, "corrected": 100},
    "full_disk": {"refused": True, "file_whole": True, "written_later": True, "left_over": []},
    "playback": {"missing": 0, "others": 0, "in_order": True, "memory_mb": {"driver": [138.2, 143.2]}},
    "reconfiguration": {
        "correction": {"dropped_frames": 0, "not corrected": 0},
        "driver": {"not_published": 0},
        "memory_mb": {"correction": [156.8, 196.8]},
    },
}


@pytest.mark.parametrize("name", GOOD)
def test_figures_at_their_limits_pass(name: str) -> None:
    assert limits.beyond(name, GOOD[name], load=0.5) == []
    assert limits.beyond(name, {**GOOD[name], "tracebacks": 2}, load=0.5) == ["2 tracebacks"]


@pytest.mark.parametrize(
    ("name", "changed", "said"),
    [
        ("kills", {"back_s": [("driver", 3.9), ("correction", 4.1)]}, "1 of 50 back after more than 4 s"),
        ("kills", {"stale": 3}, "3 clouds stale"),
        ("hostile", {"good_corrected": 593}, "7 of 600 good frames not corrected"),
        ("hostile", {"memory_mb": [129.3, 171.0, 170.0]}, r"memory of correction grew by 40\.7 MB"),
        ("endurance", {"memory_mb": [150.0, 151.0, 155.1]}, r"memory of camera_node grew by 5\.1 MB"),
        ("latency", {"one process": {"median": 5.2, "p99": 11.0}}, r"median 5\.2 ms, more than 5 ms"),
        ("latency", {"one process": {"median": 4.0, "p99": 12.5}}, r"p99 12\.5 ms, more than 12 ms"),
        ("overload", {"older": 2}, "2 clouds older than maximum_age"),
        ("clock_jumps", {"corrected": 99}, "1 frames lost"),
        ("overload", {"running": False}, "a node has ended"),
        ("full_disk", {"file_whole": False}, "the old file is damaged"),
        ("full_disk", {"left_over": ["kept.yaml.tmp"]}, r"kept\.yaml\.tmp is left over"),
        ("playback", {"in_order": False}, "clouds out of order"),
        (
            "reconfiguration",
            {"correction": {"dropped_frames": 1, "not corrected": 2}},
            "3 frames lost",
        ),
    ],
)
def test_what_is_beyond_a_limit_is_said(name: str, changed: dict[str, Any], said: str) -> None:
    found = limits.beyond(name, {**GOOD[name], **changed}, load=0.5)
    assert len(found) == 1
    assert re.match(said, found[0])


def test_one_frame_dropped_in_an_hour_is_said() -> None:
    correction = {**COUNTS["/camera/correction: frames"], "dropped_frames": 1}
    counts = {**COUNTS, "/camera/correction: frames": correction}
    assert limits.beyond("endurance", {**GOOD["endurance"], "counts": counts}, load=4.0) == [
        "1 frames dropped"
    ]


def test_times_of_a_busy_machine_are_not_judged() -> None:
    slow = {"one process": {"median": 50.0, "p99": 120.0}}
    assert limits.is_judged("latency", load=1.0)
    assert not limits.is_judged("latency", load=1.1)
    assert limits.beyond("latency", slow, load=1.1) == []
    assert limits.is_judged("endurance", load=8.0)


def test_every_limit_is_of_a_row() -> None:
    rows = pytest.importorskip("test.soak.__main__").rows(100.0)
    assert set(GOOD) <= set(rows)
