"""A hand before the board, or a label on it, does not move what is calibrated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.calibrate import joint
from rim_camera_ros.calibrate.adjustment import Adjustment, adjust
from rim_camera_ros.calibrate.recordings import Watch
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.pixel_gains import UNKNOWN_GAINS

from ..select.test_foreign_values import with_hand
from ..select.test_pixel_gains import brighter, dust
from ..select.test_unlike_regions import dimmed, region, wall
from .helpers import camera, record, scene

TRUE = 0.012


def calibrated(
    tmp_path: Path, data: Dataset, effects: list[str] | None, board: Scene | None = None
) -> Adjustment:
    return adjust(
        camera(tmp_path),
        data,
        board or scene(tmp_path),
        effects,
        steps=(1, 1),
        surfaces=1,
        geometry=False,
        seed=0,
        threads=1,
        watch=Watch(None, None),
    )


def test_a_hand_in_a_third_of_the_poses_is_excluded(tmp_path: Path) -> None:
    truth = camera(tmp_path, CyclicError((Harmonic(4, TRUE, 0.7),)))
    data = record(truth, scene(tmp_path), poses=24, seed=4)
    clean = calibrated(tmp_path, data, ["cyclic_error"])
    disturbed, hands = with_hand(data, truth, by=0.25)
    found = calibrated(tmp_path, disturbed, ["cyclic_error"])
    here, there = found.outcome.solution.fit, clean.outcome.solution.fit
    path = "effects.cyclic_error.harmonics.0.amplitude"
    assert abs(here.parameters[path] - there.parameters[path]) < here.sigma[path]
    assert abs(here.parameters[path] - TRUE) < 3 * here.sigma[path]
    assert any("a hand, a cable or a clamp" in note for note in found.notes)
    assert not any("a hand, a cable or a clamp" in note for note in clean.notes)
    masks = found.problem.masks
    assert masks is not None
    lost = [int((hands[number] & masks[number][0]).sum()) for number in hands]
    assert sum(lost) < 0.25 * sum(int(mask.sum()) for mask in hands.values())


@pytest.mark.long
def test_effects_are_searched_without_a_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No effect is added that would explain the hand, not even before it is excluded."""
    truth = camera(tmp_path, CyclicError((Harmonic(4, TRUE, 0.7),)))
    disturbed, _ = with_hand(record(truth, scene(tmp_path), poses=24, seed=4), truth, by=0.25)
    searches: list[tuple[list[str], bool]] = []
    honest = joint.search

    def watched(*args: Any, **options: Any) -> Result:
        result = honest(*args, **options)
        searches.append(([finding.effect for finding in result.found], result.foreign is not None))
        return result

    monkeypatch.setattr(joint, "search", watched)
    found = calibrated(tmp_path, disturbed, None)
    assert found.outcome.found == ["cyclic_error"]
    assert [effects for effects, holds in searches if holds] == [[]] * sum(holds for _, holds in searches)
    assert searches[0][1]
    assert not searches[-1][1]


@pytest.mark.long
def test_dust_on_the_window_is_no_effect(tmp_path: Path) -> None:
    """Half the light is lost about a pixel, in all poses: distances and other effects are as without it."""
    truth = camera(tmp_path, CyclicError((Harmonic(4, TRUE, 0.7),)))
    data = record(truth, scene(tmp_path), poses=24, seed=4)
    clean = calibrated(tmp_path, data, None)
    found = calibrated(tmp_path, brighter(data, dust(truth.shape, 0.5, 6.0)), None)
    assert [one.outcome.found for one in (clean, found)] == [["cyclic_error"]] * 2
    assert any("dust on the window" in note for note in found.notes)
    assert not any("dust on the window" in note for note in clean.notes)
    assert found.problem.pixel_gains == UNKNOWN_GAINS
    path = "effects.cyclic_error.harmonics.0.amplitude"
    here, there = found.outcome.solution.fit, clean.outcome.solution.fit
    assert abs(here.parameters[path] - there.parameters[path]) < here.sigma[path]


def test_a_label_is_calibrated_by_the_light_that_it_reflects(tmp_path: Path) -> None:
    """Its distances are those of two fifths of the light, of which the scene file says nothing."""
    true = Hyperbola(9.0, -30.0)
    offset = AmplitudeOffset(MappingProxyType(dict.fromkeys((16.0, 60.0, 100.0), true)))
    data = record(camera(tmp_path, offset), wall(tmp_path), poses=24, seed=4)
    rng, stations = np.random.default_rng(6), []
    for one in data.stations:
        label = region(camera(tmp_path), (int(rng.integers(3, 24)), int(rng.integers(3, 30))), (8, 9))
        with np.errstate(divide="ignore"):
            farther = true.a / (0.4 * one.amplitude - true.b) - true.a / (one.amplitude - true.b)
        stations.append(dimmed(one, label, 0.4, nearer=-np.where(one.count > 0, farther, 0.0)))
    effects = ["amplitude_offset"]
    clean = calibrated(tmp_path, data, effects, wall(tmp_path))
    found = calibrated(tmp_path, replace(data, stations=stations), effects, wall(tmp_path))
    assert any("a part of a surface reflects otherwise" in note for note in found.notes)
    here, there = found.outcome.solution.fit, clean.outcome.solution.fit
    for setting in (16, 60, 100):
        path = f"effects.amplitude_offset.hyperbola.{setting}.a"
        assert abs(here.parameters[path] - there.parameters[path]) < here.sigma[path], path
