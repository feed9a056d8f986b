"""Views are shared where the same rays meet the same tiles, however those reflect."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rim_camera_ros.fit.views import Views
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.scene import Scene

from ..calibrate.helpers import camera, record, scene


def changed(board: Scene, *, values: np.ndarray | None = None, cell: float = 1.0) -> Scene:
    """The scene with other reflectivities of the tiles, or tiles of another size."""
    surface = board.surfaces[0]
    texture = surface.texture
    assert texture is not None
    texture = replace(
        texture,
        cell=(texture.cell[0] * cell, texture.cell[1] * cell),
        values=texture.values if values is None else NestedList(values),
    )
    painted = replace(surface, texture=texture, reflectivity_sigma=0.4)
    return replace(board, surfaces=(painted, *board.surfaces[1:]))


def test_views_of_other_reflectivities_are_those_that_would_be_computed(tmp_path: Path) -> None:
    given, board = camera(tmp_path), scene(tmp_path)
    station = record(given, board, poses=1, seed=3).stations[0]
    texture = board.surfaces[0].texture
    assert texture is not None
    other = changed(board, values=np.array(0.05 + 0.8 * texture.values.values[::-1]))
    views = Views(given, board)
    first = views.view(station)
    shared = views.of_scene(given, other)
    assert shared is not None
    found, expected = shared.view(station), Views(given, other).view(station)
    np.testing.assert_array_equal(found.geometry.reflectivity, expected.geometry.reflectivity)
    assert not np.array_equal(found.geometry.reflectivity, first.geometry.reflectivity, equal_nan=True)
    np.testing.assert_array_equal(found.geometry.tile, expected.geometry.tile)
    np.testing.assert_array_equal(found.clean, expected.clean)
    assert [one.path for one in found.pose_columns] == [one.path for one in expected.pose_columns]
    for mine, theirs in zip(found.pose_columns, expected.pose_columns, strict=True):
        np.testing.assert_array_equal(mine.amplitude, theirs.amplitude)


def test_views_are_not_shared_where_rays_or_tiles_are_elsewhere(tmp_path: Path) -> None:
    given, board = camera(tmp_path), scene(tmp_path)
    views = Views(given, board)
    assert views.of_scene(given, board) is views
    assert views.of_scene(given, changed(board, cell=1.05)) is None
    longer = replace(given, optics=replace(given.optics, fx=1.1 * given.optics.fx))
    assert views.of_scene(longer, board) is None
    assert views.of_scene(longer, changed(board)) is None
    assert views.of_scene(given, changed(board)) is not None
