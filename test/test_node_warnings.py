"""Warnings of nodes do not flap: states with two limits, and what is logged of what comes and goes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import CorrectedFrame, Flag, RawFrame, Settings
from rim_camera_ros.nodes.common.findings import (
    QUIET,
    SETTLED,
    Announcements,
    Finding,
    Flow,
    Hysteresis,
    Level,
)
from rim_camera_ros.nodes.common.lifecycle import ACTIVE
from rim_camera_ros.nodes.correction.status import CorrectionStatus
from rim_camera_ros.nodes.driver.status import DriverStatus
from rim_camera_ros.pipeline.consistency import Verdict

OK, WARN, ERROR = Level.OK, Level.WARN, Level.ERROR


def lines(levels: Iterable[Level]) -> list[tuple[int, Level, str]]:
    """Return what is logged, with its second, of findings that come once a second."""
    announcements = Announcements()
    said = []
    for second, level in enumerate(levels):
        finding = Finding()
        finding.worse(level, f"second {second}")
        line = announcements.line("check", finding, now=1000.0 + second)
        if line is not None:
            said.append((second, *line))
    return said


def test_what_holds_is_logged_once_and_when_it_is_over() -> None:
    assert lines([OK] * 3 + [WARN] * 200 + [OK] * 20) == [
        (3, WARN, "check: second 3"),
        (203 - 1 + int(SETTLED), OK, "check: fine again"),
    ]


def test_what_comes_and_goes_faster_than_it_settles_is_one_state() -> None:
    flapping = ([WARN] * 3 + [OK] * 3) * 50
    assert lines([*flapping, *[OK] * 10]) == [
        (0, WARN, "check: second 0"),
        (296 + int(SETTLED), OK, "check: fine again"),
    ]


def test_a_warning_that_comes_back_is_logged_once_a_minute() -> None:
    said = lines(([WARN] * 2 + [OK] * 9) * 33)  # the simulated room's schedule of 11 s, six minutes
    warned = [second for second, level, _ in said if level == WARN]
    assert len(warned) == 6
    assert min(np.diff(warned)) >= QUIET[WARN]
    assert said[2] == (66, WARN, "check: second 66 [5 more like it]")
    assert len(said) == 12  # and each time that it is over


def test_a_warning_that_was_held_back_is_logged_when_its_time_has_come() -> None:
    said = lines([WARN] * 2 + [OK] * 10 + [WARN] * 100)
    assert said == [
        (0, WARN, "check: second 0"),
        (1 + int(SETTLED), OK, "check: fine again"),
        (60, WARN, "check: second 60"),
    ]


def test_an_error_is_logged_also_soon_after_a_warning() -> None:
    said = lines([WARN] * 2 + [ERROR] * 2 + [WARN] * 30 + [ERROR] * 3 + [OK] * 10)
    assert said == [
        (0, WARN, "check: second 0"),
        (2, ERROR, "check: second 2"),
        (34, ERROR, "check: second 34"),
        (36 + int(SETTLED), OK, "check: fine again"),
    ]


def test_a_state_of_great_values_and_one_of_small_ones() -> None:
    great, small = Hysteresis(begin=0.8, end=0.7), Hysteresis(begin=0.01, end=0.02)
    values = (0.8, 0.81, 0.75, 0.7, 0.69, 0.75, 0.9)
    assert [great.holds(one) for one in values] == [False, True, True, True, False, False, True]
    assert [small.holds(one) for one in (0.01, 0.009, 0.015, 0.021, 0.015)] == [
        False, True, True, False, False,
    ]  # fmt: skip


@pytest.fixture
def status() -> CorrectionStatus:
    made = CorrectionStatus()
    made.phase = ACTIVE
    made.use(load_camera(find_camera("sr3000")), "sr3000", off=set())
    return made


def with_share(status: CorrectionStatus, flag: Flag, share: float) -> Level:
    """Return the level of the pixels with a share of them flagged; half of the others have no distance."""
    flags = np.zeros((10, 100), np.uint8)
    flags.flat[: round(1000 * share)] = flag.value
    distance = np.full(flags.shape, 2.0, np.float32)
    frame = RawFrame(stamp=7, distance=flags.astype(np.uint16), amplitude=flags.astype(np.uint16))
    sample = CorrectedFrame(stamp=7, distance=distance, sigma=distance, amplitude=distance, flags=flags)
    status.corrected(frame, processing=0.01, sample=sample)
    return status.pixels().level


@pytest.mark.parametrize(
    ("flag", "shares"),
    [
        (Flag.LOW_AMPLITUDE, (0.79, 0.81, 0.79, 0.71, 0.69, 0.79)),
        (Flag.SATURATED, (0.19, 0.21, 0.19, 0.16, 0.14, 0.19)),
    ],
)
def test_a_share_of_pixels_about_its_limit(
    status: CorrectionStatus, flag: Flag, shares: tuple[float, ...]
) -> None:
    assert [with_share(status, flag, one) for one in shares] == [OK, WARN, WARN, WARN, OK, OK]


def test_the_warm_up_ends_below_where_it_begins(status: CorrectionStatus) -> None:
    def level(uptime: float) -> Level:
        image = np.zeros((144, 176), np.uint16)
        status.last = RawFrame(stamp=7, distance=image, amplitude=image, settings=Settings(uptime=uptime))
        return status.warm_up().level

    # of the file's terms the slow one is left: amplitude / time constant * exp(-t / time constant) [m/s]
    drift = load_camera(find_camera("sr3000")).effects["warm_up_drift"]
    slow = max(drift.terms, key=lambda one: one.time_constant)  # type: ignore[attr-defined]
    at_one = slow.time_constant * math.log(abs(slow.amplitude) / slow.time_constant / (1e-3 / 60))
    at_end = at_one + slow.time_constant * math.log(1 / 0.8)
    uptimes = (at_one + 1, at_one - 2, at_one + 1, at_end - 1, at_end + 2, at_one + 2)
    assert [level(one) for one in uptimes] == [OK, WARN, WARN, WARN, OK, OK]


def test_a_noise_about_its_limit(status: CorrectionStatus, monkeypatch: pytest.MonkeyPatch) -> None:
    verdict = Verdict(ratio=1.0, dark=1.0, bright=1.0, amplitude=500.0, comparisons=20)
    watch = status._watch
    assert watch is not None

    def level(ratio: float) -> Level:
        monkeypatch.setattr(type(watch), "verdict", replace(verdict, dark=ratio))
        return status.consistency().level

    assert [level(one) for one in (1.24, 1.26, 1.22, 1.19, 1.22)] == [OK, WARN, WARN, OK, OK]
    assert [level(one) for one in (0.81, 0.79, 0.82, 0.84, 0.81)] == [OK, WARN, WARN, OK, OK]


def test_the_first_frame_may_take_longer_than_the_next_ones() -> None:
    flow = Flow()
    assert (flow.silent(104.9, begun=100.0), flow.silent(105.5, begun=100.0)) == (0.0, 5.5)
    for k in range(21):
        flow.add(110.0 + 0.1 * k, stamp=10**8 * (k + 1), latency=0.01, processing=0.01)
    assert flow.silent(112.9, begun=100.0) == 0.0
    assert flow.silent(113.1, begun=100.0) == pytest.approx(1.1)
    # activated anew, the frames of before do not count
    assert (flow.silent(124.0, begun=120.0), flow.silent(126.0, begun=120.0)) == (0.0, 6.0)


def test_a_slow_flow_that_stops_is_silent_after_three_periods_and_stays_so() -> None:
    """The rate is 0 once the window is empty: the period is that of the frames that came."""
    flow = Flow()
    for k in range(10):
        flow.add(100.0 + k, stamp=10**9 * (k + 1), latency=0.01, processing=0.01)
    assert flow.silent(111.9, begun=90.0) == 0.0
    for now in (112.1, 114.5, 118.0, 140.0):
        assert flow.silent(now, begun=90.0) == pytest.approx(now - 109.0)
    once = Flow()  # one frame alone has no period
    once.add(100.0, stamp=1, latency=0.01, processing=0.01)
    assert once.silent(101.5, begun=90.0) == pytest.approx(1.5)


def test_a_rate_about_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    class Camera:
        frame_rate = 25.0

    status = DriverStatus(phase=ACTIVE)

    def level(rate: float) -> Level:
        monkeypatch.setattr(type(status.flow), "rate", lambda self, now: rate)
        status.flow.last = 1e12  # just now
        return status.frames(Camera()).level  # type: ignore[arg-type]

    assert [level(one) for one in (22.6, 22.4, 22.6, 23.6, 23.8, 22.6)] == [OK, WARN, WARN, WARN, OK, OK]
