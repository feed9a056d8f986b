"""Another board than the scene file describes, before a wall: of any width, height and tiles."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Covariance
from rim_camera_ros.diagnose.compare_setups import compare_setups
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.parameters import ArrayFile, NestedList
from rim_camera_ros.scene import Scene, ScenePose, Surface

from ..calibrate.helpers import camera, record, scene


@pytest.mark.long
@pytest.mark.parametrize(
    ("size", "cell", "hypothesis", "share", "sides"),
    [
        # the same tiles on another shape
        ((1.0, 1.5), (0.22, 0.41), "other_board", 0.95, (1.0 / 1.4, 1.5 / 1.1)),
        # tiles of other sizes on nearly the same shape
        ((1.3, 1.2), (0.45, 0.17), "other_pattern", 0.5, None),
    ],
)
def test_a_swapped_board_is_a_set_up(
    tmp_path: Path,
    size: tuple[float, float],
    cell: tuple[float, float],
    hypothesis: str,
    share: float,
    sides: tuple[float, float] | None,
) -> None:
    """The first was unknown physics after 221 s, as one factor on its size explained 38 %."""
    truth, plain = camera(tmp_path), scene(tmp_path)
    tiles = plain.surfaces[0]
    assert tiles.texture is not None
    wall = Surface("wall", "plane", ScenePose((0.0, 0.0, 5.2)), reflectivity=0.4)
    board = replace(tiles, type="rectangle", size=(1.4, 1.1))
    values = NestedList(np.ascontiguousarray(tiles.texture.values.values[:, ::-1].T))
    swapped = replace(board, size=size, texture=replace(tiles.texture, values=values, cell=cell))
    data = record(truth, Scene((swapped, wall)), poses=16, seed=5)
    covariance = (0.002 * truth.optics.fx) ** 2 * np.eye(2)
    stated = Covariance(("optics.fx", "optics.fy"), ArrayFile("covariance.npy", covariance))
    result = diagnose(data, Scene((board, wall)), replace(truth, covariance=stated))
    assert result.verdict == "inconsistent_setup"
    assert not result.missing
    assert result.setups[0].hypothesis == hypothesis
    assert result.setups[0].share > share
    if sides is not None:
        assert result.setups[0].sides == pytest.approx(sides, rel=0.05)
        assert re.search(r"0\.7\d* times as wide and 1\.[34]\d* times as high", result.setups[0].sentence)


def test_the_board_that_is_described_is_no_other(tmp_path: Path) -> None:
    truth, plain = camera(tmp_path), scene(tmp_path)
    wall = Surface("wall", "plane", ScenePose((0.0, 0.0, 5.2)), reflectivity=0.4)
    board = Scene((replace(plain.surfaces[0], type="rectangle", size=(1.4, 1.1)), wall))
    setups = compare_setups(record(truth, board, poses=16, seed=5), board, truth)
    assert setups[0].hypothesis == "as_given"
    assert not any(setup.is_better for setup in setups)


def test_a_board_of_another_size_is_that_first(tmp_path: Path) -> None:
    """Its size is sought between those tried before a board of any width, height and tiles is."""
    truth, plain = camera(tmp_path), scene(tmp_path)
    wall = Surface("wall", "plane", ScenePose((0.0, 0.0, 5.2)), reflectivity=0.4)
    tiles = plain.surfaces[0]
    assert tiles.texture is not None
    stated = replace(tiles, type="rectangle", size=(1.4, 1.1))
    larger = replace(
        stated, size=(1.4 * 1.17, 1.1 * 1.17), texture=replace(tiles.texture, cell=(0.31 * 1.17, 0.27 * 1.17))
    )
    data = record(truth, Scene((larger, wall)), poses=16, seed=5)
    first = compare_setups(data, Scene((stated, wall)), truth)[0]
    assert (first.hypothesis, first.surface) == ("scale", "board")
    assert first.value == pytest.approx(1.17, abs=0.02)
