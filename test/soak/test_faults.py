"""Short versions of the soak; the long ones are marked slow or run by `make soak`."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("psutil")

from test.soak import faults, load, mutations

pytestmark = pytest.mark.ros


@pytest.mark.parametrize("count", [4, pytest.param(50, marks=[pytest.mark.slow, pytest.mark.timeout(900)])])
def test_kills(tmp_path: Path, count: int) -> None:
    found = faults.kills(tmp_path, count=count)
    assert found["kills"] >= count - 2
    assert found["stale"] == found["backwards"] == found["wrong"] == found["tracebacks"] == 0
    assert found["paired"] > 10
    # the start of a process on a busy machine is not what is tested here; docs/reliability.md has figures
    assert max(seconds for _, seconds in found["back_s"]) < 15.0


@pytest.mark.parametrize("seconds", [4.0, pytest.param(60.0, marks=pytest.mark.slow)])
def test_hostile_messages(tmp_path: Path, seconds: float) -> None:
    found = faults.hostile(tmp_path, seconds=seconds, rate=500.0)
    assert found["running"]
    assert found["tracebacks"] == 0
    assert found["good"] >= 5 * seconds
    # while other tests run, a queue of the last messages loses some; the long run is by itself
    least = 1.0 if seconds > 10 else 0.75
    assert least * found["good"] <= found["good_corrected"] <= found["good"]
    assert found["refused"] > 0.5 * found["hostile"]
    assert found["dropped"] > 0
    before, most, last = found["memory_mb"]
    assert max(most, last) < before + 30.0
    assert found["log_lines"] < 40 + 3 * seconds  # a flood does not fill the log


@pytest.mark.parametrize(
    "seconds", [15.0, pytest.param(300.0, marks=[pytest.mark.slow, pytest.mark.timeout(600)])]
)
def test_reconfiguration_every_second(tmp_path: Path, seconds: float) -> None:
    found = faults.reconfiguration(tmp_path, seconds=seconds)
    assert found["changes"] >= 0.5 * seconds
    assert found["tracebacks"] == 0
    correction = found["correction"]
    assert correction["frames"] > 10 * seconds
    assert correction["dropped_frames"] == correction["refused_messages"] == correction["not corrected"] == 0
    assert found["driver"]["not_published"] == 0
    # frames are counted at two moments of the same second
    assert abs(correction["frames"] - found["driver"]["frames"]) <= 60
    for _, early, _, late in found["memory_mb"].values():
        assert late < early + 20.0
    before, after = found["descriptors"]
    assert all(count < 100 for count in after)
    assert after[0] <= before[0] + 2
    assert after[1] <= before[1] + 2


@pytest.mark.parametrize(
    "seconds", [10.0, pytest.param(3600.0, marks=[pytest.mark.slow, pytest.mark.timeout(4000)])]
)
def test_one_process_at_50_hz(tmp_path: Path, seconds: float) -> None:
    found = load.endurance(tmp_path, seconds=seconds)
    driver, correction = found["counts"].values()
    assert found["tracebacks"] == driver["not_published"] == correction["refused_messages"] == 0
    assert correction["not corrected"] == 0
    assert correction["frames"] > 5 * seconds
    # none vanishes uncounted; both nodes count at two moments of the same second
    assert abs(driver["frames"] - correction["frames"] - correction["dropped_frames"]) <= 60
    if seconds > 10:  # while other tests run, it is stopped for more than three periods at times
        assert correction["dropped_frames"] <= 1e-3 * driver["frames"]
    _, early, _, late = found["memory_mb"]
    assert late < early + 5.0
    assert found["descriptors"][1] <= found["descriptors"][0] + 2


@pytest.mark.parametrize("maximum_age", [0.1, None])
def test_ages_while_processes_are_busy(tmp_path: Path, maximum_age: float | None) -> None:
    found = load.overload(tmp_path, seconds=10.0, maximum_age=maximum_age, processes=4)
    assert found["running"]
    assert found["tracebacks"] == 0
    assert found["clouds"] > 25
    # the node publishes nothing older; what arrives late was on its way
    assert found["age_ms"]["p99"] < 500.0


@pytest.mark.parametrize(
    "minutes", [1.0, pytest.param(30.0, marks=[pytest.mark.slow, pytest.mark.timeout(900)])]
)
def test_playback_of_a_day(tmp_path: Path, minutes: float) -> None:
    found = faults.playback(tmp_path, minutes=minutes)
    assert found["frames"] == 300 * minutes
    assert found["missing"] == found["others"] == found["tracebacks"] == 0
    assert found["before_first"] < 5  # topics are found one by one
    assert found["in_order"]
    for _, early, _, late in found["memory_mb"].values():
        assert late < early + 10.0


@pytest.mark.slow
def test_many_readers_and_one_that_never_reads(tmp_path: Path) -> None:
    found = faults.readers(tmp_path, seconds=3.0)
    assert found["running"]
    assert found["with_readers_hz"] > 0.6 * found["alone_hz"]
    assert found["never_reading_hz"] > 0.6 * found["alone_hz"]
    assert found["memory_mb"][1] < found["memory_mb"][0] + 40.0


def test_clock_jumps(tmp_path: Path) -> None:
    found = faults.clock_jumps(tmp_path)
    assert found["corrected"] == found["frames"] == 100
    assert found["jumps_counted"] == 4
    assert found["tracebacks"] == 0


def test_a_full_disk_and_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    found = faults.full_disk(tmp_path)
    assert found["refused"]
    assert "cannot be written" in found["message"]
    assert found["file_whole"]
    assert found["left_over"] == []
    assert found["written_later"]
    refused, message = found["read_only"]
    assert refused
    assert "start the node with another folders:=FOLDER" in message


@pytest.mark.parametrize(
    "count", [150, pytest.param(10_000, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])]
)
def test_damaged_files(tmp_path: Path, count: int) -> None:
    found = mutations.run(tmp_path, count=count)
    assert found["crashes"] == []
    assert found["outside"] == []
    assert found["slowest_s"] < 5.0
    assert found["refused"] > found["accepted"] > 0


@pytest.mark.parametrize("count", [5, pytest.param(100, marks=[pytest.mark.slow, pytest.mark.timeout(900)])])
def test_damaged_parameter_files(tmp_path: Path, count: int) -> None:
    found = mutations.parameter_files(tmp_path, count=count)
    assert found["bad"] == []
    assert found["refused"] > 0
