"""Parts of a surface that reflect otherwise than their tiles, and hands of two or three pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from rim_camera_ros.camera import Camera
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.parameters import NestedList
from rim_camera_ros.scene import Scene, Texture
from rim_camera_ros.select.foreign_values import exclusion_notes, foreign_values

from ..calibrate.helpers import camera, record, scene

Mask = NDArray[np.bool_]
#: Where a label of 6 x 5 pixels is seen, by the number of the station.
LABELS = {2: (8, 12), 7: (20, 25), 11: (15, 6)}


def region(model: Camera, at: tuple[int, int], size: tuple[int, int]) -> Mask:
    mask = np.zeros(model.shape, bool)
    mask[at[0] : at[0] + size[0], at[1] : at[1] + size[1]] = True
    return mask


def dimmed(
    station: Station, mask: Mask, share: float, *, nearer: float | NDArray[np.float64] = 0.0
) -> Station:
    return replace(
        station,
        amplitude=np.where(mask, share * station.amplitude, station.amplitude).astype(np.float32),
        distance=station.distance - nearer * mask,
    )


def wall(tmp_path: Path) -> Scene:
    """A wall of one colour: regions are judged away from the edges of tiles."""
    whole = scene(tmp_path)
    return replace(whole, surfaces=(replace(whole.surfaces[0], texture=None, reflectivity=0.5),))


def fitted(tmp_path: Path, data: Dataset) -> Fit:
    return fit(Problem(data, wall(tmp_path)), camera(tmp_path))


@pytest.mark.parametrize("share", [0.5, 1.8])
def test_a_label_is_found_and_its_distances_are_used(tmp_path: Path, share: float) -> None:
    model = camera(tmp_path)
    data = record(model, wall(tmp_path), poses=16, seed=4)
    stations = list(data.stations)
    for number, at in LABELS.items():
        stations[number] = dimmed(stations[number], region(model, at, (6, 5)), share)
    data = replace(data, stations=stations)
    found = foreign_values(fitted(tmp_path, data))
    assert found is not None
    assert not found.stamps
    assert set(found.unlike) == set(LABELS)
    (note,) = exclusion_notes([found])
    assert "of the amplitudes: a part of a surface reflects otherwise than the scene file says" in note
    rest = found.excluded_from(data)
    again = fitted(tmp_path, rest)
    assert foreign_values(again) is None
    for number, prediction in enumerate(again.forward.predictions()):
        if number not in LABELS:
            continue
        mask = region(model, LABELS[number], (6, 5)) & prediction.used
        assert mask.any()
        # the distances are used, at the amplitudes that were measured
        assert not prediction.amplitude_used[mask].any()
        assert prediction.amplitude[mask] == pytest.approx(prediction.station.amplitude[mask])


def test_nothing_reflects_otherwise_where_tiles_are_as_they_are_said_to_be(tmp_path: Path) -> None:
    assert (
        foreign_values(fitted(tmp_path, record(camera(tmp_path), wall(tmp_path), poses=16, seed=4))) is None
    )


def test_light_that_falls_off_smoothly_is_no_label(tmp_path: Path) -> None:
    model = camera(tmp_path)
    data = record(model, wall(tmp_path), poses=16, seed=4)
    v, u = np.mgrid[: model.shape[0], : model.shape[1]]
    shade = 1 - 0.5 / (1 + ((v - 18) ** 2 + (u - 20) ** 2) / 6.0**2)
    stations = list(data.stations)
    for number in LABELS:
        one = stations[number]
        stations[number] = replace(one, amplitude=(one.amplitude * shade).astype(np.float32))
    found = foreign_values(fitted(tmp_path, replace(data, stations=stations)))
    assert found is None or not found.unlike


def test_beside_the_edge_of_a_tile_light_may_mix(tmp_path: Path) -> None:
    """A strip along an edge that is darker in a few poses."""
    whole = wall(tmp_path)
    halves = Texture((0.8, 0.8), NestedList(np.array([[0.5, 0.4]])))
    two = replace(whole, surfaces=(replace(whole.surfaces[0], texture=halves),))
    model = camera(tmp_path)
    data = record(model, two, poses=16, seed=4)
    predictions = list(fit(Problem(data, two), model).forward.predictions(slopes=False))
    stations = list(data.stations)
    for number in LABELS:
        tile = predictions[number].view.geometry.tile
        edge = ndimage.maximum_filter(tile, 5) != ndimage.minimum_filter(tile, 5)
        stations[number] = dimmed(stations[number], edge, 0.6)
    found = foreign_values(fit(Problem(replace(data, stations=stations), two), model))
    assert found is None or not found.unlike


def test_three_pixels_are_a_hand_if_their_amplitudes_differ_too(tmp_path: Path) -> None:
    """A tail of physics is as large in distance, and has the amplitudes of the tile."""
    model = camera(tmp_path)
    data = record(model, wall(tmp_path), poses=16, seed=4)
    near = min(range(16), key=lambda number: float(np.nanmedian(data.stations[number].distance)))
    mask = region(model, (17, 21), (1, 3))
    hands, tails = list(data.stations), list(data.stations)
    hands[near] = dimmed(hands[near], mask, 2.5, nearer=0.06)
    tails[near] = dimmed(tails[near], mask, 1.0, nearer=0.06)
    found = foreign_values(fitted(tmp_path, replace(data, stations=hands)))
    assert found is not None
    assert set(found.masks) == {near}
    assert found.masks[near][mask].all()
    tail = foreign_values(fitted(tmp_path, replace(data, stations=tails)))
    assert tail is None or not tail.stamps
