"""Stations in which something moves, and drivers that smooth: excluded and said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.neighbours import Neighbours
from rim_camera_ros.fit.reduction import reduce_frames
from rim_camera_ros.select.at_rest import at_rest, note_on_smoothing

from ..calibrate.bags import frames
from ..calibrate.helpers import camera, scene

STILL = Neighbours((0.004, -0.002), 0.003, 0.001, 4e4, 2e4)


def recording(**found: Neighbours | None) -> Dataset:
    """Twenty stations of three frames; ``found`` by ``at`` and their number."""
    stations: list[Any] = [
        SimpleNamespace(
            recording=0, pose=k, placed=k, time=10.0 * k, frames=3, neighbours=found.get(f"at{k}", STILL)
        )
        for k in range(20)
    ]
    return Dataset(stations, ["bag"], ["kept"], 60)


def test_stations_at_rest_stay() -> None:
    still = recording()
    assert at_rest(still) is still
    # one frame each: nothing is known
    single = recording(**{f"at{k}": None for k in range(20)})
    assert at_rest(single) is single
    assert note_on_smoothing(single) is None


def test_a_few_that_move_are_excluded_with_their_times() -> None:
    moved = replace(STILL, far=0.12, far_later=0.1)
    kept = at_rest(recording(at4=moved, at11=moved))
    assert [station.pose for station in kept.stations] == [k for k in range(20) if k not in (4, 11)]
    assert kept.frames == 54
    first, note = kept.notes
    assert first == "kept"
    assert note.startswith("excluded: 2 of 20 stations, at 40.0 s, 110.0 s, in which something moves")


@pytest.mark.parametrize(
    "found",
    [
        {"at3": replace(STILL, far=0.05, far_later=0.05)},  # less than a noise model is known to
        {"at3": replace(STILL, far=0.4)},  # only the first frame differs
        {"at3": replace(STILL, far=0.4, far_later=0.4, pairs=100.0)},  # by chance
        {"at3": replace(STILL, far=0.4, far_later=0.4, pairs_later=100.0)},  # by chance in two frames
        {f"at{k}": replace(STILL, far=0.4, far_later=0.4) for k in (1, 5, 8, 13)},  # no accident
    ],
)
def test_what_is_no_movement_of_a_few(found: dict[str, Neighbours]) -> None:
    whole = recording(**found)
    assert at_rest(whole) is whole


def test_drivers_that_smooth() -> None:
    smooth = Neighbours((0.35, 0.11), 0.002, 0.0, 4e4, 2e4)
    note = note_on_smoothing(recording(**{f"at{k}": smooth for k in range(20)}))
    assert note is not None
    assert "by 0.35 at 1 px and 0.11 at 2 px" in note
    assert "switch off the driver's filters" in note
    # light that all pixels share is no filter
    common = Neighbours((0.31, 0.3), 0.3, 0.3, 4e4, 2e4)
    assert note_on_smoothing(recording(**{f"at{k}": common for k in range(20)})) is None


def test_frames_in_which_a_part_of_the_scene_moves(tmp_path: Path) -> None:
    """From images: in one of fourteen poses half of the array comes 40 mm nearer before the third frame."""
    truth = camera(tmp_path)
    taken = list(frames(truth, scene(tmp_path), poses=14, repeats=4, seed=1))
    counts = round(0.04 / truth.sensor.lsb)
    for frame in taken[5 * 4 + 2 : 6 * 4]:
        frame.distance[:, : truth.sensor.width // 2] -= counts
    dataset = Dataset(list(reduce_frames(taken, truth)), frames=len(taken))
    kept = at_rest(dataset)
    assert [station.pose for station in kept.stations] == [k for k in range(14) if k != 5]
    assert kept.frames == 13 * 4
    assert "excluded: 1 of 14 stations" in kept.notes[0]
    assert note_on_smoothing(kept) is None
