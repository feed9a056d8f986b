"""Objects before a surface in all poses, and fixed patterns and physics that look like them. Nulls first."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rim_camera_ros.select.deviations import Deviations
from rim_camera_ros.select.standing_objects import objects_in_all_poses

SHAPE = (40, 50)
WALL, BOARD = 0, 1
Image = NDArray[np.float64]


def recording(
    wall: Image, board: Image, *, pattern: Image, tile: Image | None = None, saturates: bool = False
) -> tuple[list[Deviations], Image]:
    """Twelve stations of a wall, and a board before columns 5 to 34 in five of them; and their offsets.

    ``wall`` and ``board`` [m] are what is read too far there, in addition to the ``pattern`` and 5 mm noise.
    """
    rng = np.random.default_rng(7)
    columns = np.broadcast_to(np.arange(SHAPE[1]), SHAPE)
    surfaces, readings = [], []
    for number in range(12):
        surface = np.where((columns >= 5) & (columns < 35) & (number % 5 < 2), BOARD, WALL)
        surfaces.append(surface)
        readings.append(np.where(surface == WALL, wall, board) + pattern + rng.normal(0, 0.005, SHAPE))
    offsets = np.median(readings, axis=0)
    stations = [
        Deviations(
            recording=0,
            stamp=number,
            residual=reading - offsets,
            sigma=np.full(SHAPE, 0.005),
            used=np.ones(SHAPE, bool),
            described=np.ones(SHAPE, bool),
            tile=np.where(surface == WALL, 0 if tile is None else tile, 9),
            surface=surface,
            amplitude=np.zeros(SHAPE),
            lit=np.ones(SHAPE, bool),
            scatter=np.zeros(SHAPE),
            freedom=np.zeros(SHAPE, int),
            saturates=saturates,
        )
        for number, (surface, reading) in enumerate(zip(surfaces, readings, strict=True))
    ]
    return stations, offsets


PATTERN = np.random.default_rng(3).normal(0, 0.009, SHAPE)
NOTHING = np.zeros(SHAPE)
BOX = np.zeros(SHAPE)
BOX[12:24, 20:32] = -0.3


def excluded(stations: list[Deviations], offsets: Image) -> list[NDArray[np.bool_]]:
    return objects_in_all_poses(stations, offsets, limit=5.0)


def test_offsets_of_pixels_are_no_object() -> None:
    assert not np.any(excluded(*recording(NOTHING, NOTHING, pattern=PATTERN)))
    # nor is a block of pixels that reads both surfaces nearer
    assert not np.any(excluded(*recording(NOTHING, NOTHING, pattern=PATTERN + BOX)))


def test_what_no_other_surface_tells_from_offsets_stays() -> None:
    corner = np.roll(BOX, 17, axis=1)
    assert not np.any(excluded(*recording(corner, NOTHING, pattern=PATTERN)))


def test_a_box_before_the_wall() -> None:
    stations, offsets = recording(BOX, NOTHING, pattern=PATTERN)
    found = excluded(stations, offsets)
    for station, mask in zip(stations, found, strict=True):
        box = (BOX < 0) & (station.surface == WALL)
        assert (mask & box).sum() == box.sum()
        # and the pixels that it may partly cover, of the wall alone
        assert not (mask & (station.surface == BOARD)).any()
        assert mask.sum() <= 16 * 16
    assert any(mask.any() for mask in found)


def test_physics_that_follows_a_tile_is_no_object() -> None:
    """A dark square of a wall that stays where it is, read 0.3 m too near: its outline is that of a tile."""
    square = (BOX < 0).astype(float)
    assert not np.any(excluded(*recording(BOX, NOTHING, pattern=PATTERN, tile=square)))


def test_physics_without_a_step_is_no_object() -> None:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    light = -0.3 / (1 + ((u - 26) ** 2 + (v - 18) ** 2) / 4.0**2)
    assert not np.any(excluded(*recording(light, NOTHING, pattern=PATTERN)))


@pytest.mark.parametrize("far", [0.3, 0.05])
def test_what_is_farther_is_no_object(far: float) -> None:
    assert not np.any(excluded(*recording(-BOX / 0.3 * far, NOTHING, pattern=PATTERN)))


def test_rows_of_saturated_pixels_are_not_judged() -> None:
    assert not np.any(excluded(*recording(BOX, NOTHING, pattern=PATTERN, saturates=True)))


def test_a_box_before_tiles_of_which_physics_reads_one_too_near() -> None:
    """The left part of the wall is dark, and read 60 mm too near: that is physics, and the box is none."""
    dark = np.where(np.arange(SHAPE[1]) < 26, -0.06, 0.0) * np.ones(SHAPE)
    tile = (dark < 0).astype(float)
    found = excluded(*recording(BOX + dark, NOTHING, pattern=PATTERN, tile=tile))
    for station, mask in zip(*[recording(BOX, NOTHING, pattern=PATTERN)[0], found], strict=True):
        box = (BOX < 0) & (station.surface == WALL)
        assert (mask & box).sum() == box.sum()
    assert sum(mask.sum() for mask in found) < 12 * 16 * 16
    assert not np.any(excluded(*recording(dark, NOTHING, pattern=PATTERN, tile=tile)))
