"""Values that do not see the scene: defective pixels, and objects before surfaces; physics is neither."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.effects import registry
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.select.foreign_values import ForeignValues, exclusion_notes, foreign_values

from ..calibrate.helpers import camera, record, scene

Array = NDArray[Any]

STUCK = ((9, 11), (17, 30), (28, 22))
NOISY = ((12, 35), (30, 8))


def changed(data: Dataset, changes: dict[int, Array]) -> Dataset:
    """The dataset with distances [m] added in some stations."""
    return replace(
        data,
        stations=[
            replace(one, distance=one.distance + changes[number]) if number in changes else one
            for number, one in enumerate(data.stations)
        ],
    )


def with_defects(data: Dataset) -> Dataset:
    """Three pixels that always say 1.234 m, and two that scatter by 0.2 m from frame to frame."""
    rng = np.random.default_rng(5)
    stations = []
    for one in data.stations:
        distance, variance = one.distance.copy(), one.distance_variance.copy()
        for pixel in STUCK:
            distance[pixel], variance[pixel] = 1.234, 0.0
        for pixel in NOISY:
            distance[pixel] += 0.2 / np.sqrt(one.frames) * rng.standard_normal()
            variance[pixel] = 0.04
        stations.append(replace(one, distance=distance, distance_variance=variance))
    return replace(data, stations=stations)


def with_hand(data: Dataset, model: Camera, by: float = 0.12) -> tuple[Dataset, dict[int, Array]]:
    """A hand of 7 x 6 pixels, 0.12 m before the board, elsewhere in each of eight poses."""
    rng = np.random.default_rng(9)
    masks = {}
    for number in range(0, 24, 3):
        mask = np.zeros(model.shape, bool)
        v, u = rng.integers(4, 25), rng.integers(4, 32)
        mask[v : v + 7, u : u + 6] = True
        masks[number] = mask
    return changed(data, {number: -by * mask for number, mask in masks.items()}), masks


def _turned(mask: Array) -> Array:
    """What touches the left edge, at the top edge."""
    result = np.zeros_like(mask)
    side = min(mask.shape)
    result[:side, :side] = mask[:side, :side].T
    return result


def is_nothing(found: ForeignValues | None) -> bool:
    """Where nothing fits by decimetres, offsets of a few pixels may be those of half of their poses."""
    return found is None or (not found.stamps and not found.unlike and found.pixels <= 5)


def fitted(tmp_path: Path, data: Dataset) -> Fit:
    return fit(Problem(data, scene(tmp_path)), camera(tmp_path))


def test_stuck_and_noisy_pixels_are_found_and_no_others(tmp_path: Path) -> None:
    data = record(camera(tmp_path), scene(tmp_path), poses=24, seed=4)
    found = foreign_values(fitted(tmp_path, with_defects(data)))
    assert found is not None
    assert (found.pixels, found.stamps) == (5, frozenset())
    bad = np.any(list(found.masks.values()), axis=0)
    assert {tuple(int(k) for k in pixel) for pixel in np.argwhere(bad)} == {*STUCK, *NOISY}
    left = found.excluded_from(with_defects(data))
    assert all(one.count[bad].sum() == 0 for one in left.stations)
    assert all(np.isnan(one.distance[bad]).all() for one in left.stations)
    (note,) = exclusion_notes([found])
    assert note.startswith("excluded: defective pixels (5), which differ from their neighbours")
    assert foreign_values(fitted(tmp_path, left)) is None


def test_a_hand_is_found_where_it_is(tmp_path: Path) -> None:
    model = camera(tmp_path)
    data, hands = with_hand(record(model, scene(tmp_path), poses=24, seed=4), model)
    found = foreign_values(fitted(tmp_path, data))
    assert found is not None
    assert found.pixels == 0
    used = 0
    for number, mask in found.masks.items():
        assert number in hands
        # no farther than the pixels around it that it may partly cover
        rows, columns = (np.flatnonzero(hands[number].any(axis=axis)) for axis in (1, 0))
        around = np.zeros_like(mask)
        around[rows[0] - 2 : rows[-1] + 3, columns[0] - 2 : columns[-1] + 3] = True
        assert not (mask & ~around).any()
        used += int((mask & hands[number]).sum())
    # at the others 0.12 m are less than five sigma of a pixel
    assert len(found.masks) >= 4
    assert used > 0.7 * sum(int(hands[number].sum()) for number in found.masks)
    (note,) = exclusion_notes([found])
    assert f"in {len(found.stamps)} stations: something that the scene file does not describe" in note


def test_large_hands_in_all_poses_are_found(tmp_path: Path) -> None:
    """They cover 8 % of the image, enter it from any side, and tilt the pose that is fitted to them."""
    model = camera(tmp_path)
    data = record(model, scene(tmp_path), poses=24, seed=4)
    rng = np.random.default_rng(2)
    hands = {}
    for number in range(24):
        mask = np.zeros(model.shape, bool)
        at = rng.integers(0, 25)
        mask[at : at + 11, :12] = True
        # from the left, the right, the top and the bottom
        hands[number] = [mask, mask[:, ::-1], _turned(mask), _turned(mask)[::-1]][number % 4]
    rest = changed(data, {number: -0.3 * mask for number, mask in hands.items()})
    for _ in range(4):
        found = foreign_values(fitted(tmp_path, rest))
        if found is None:
            break
        rest = found.excluded_from(rest)
    kept = sum(int(((one.count > 0) & hands[number]).sum()) for number, one in enumerate(rest.stations))
    every = sum(int(((one.count > 0) & hands[number]).sum()) for number, one in enumerate(data.stations))
    assert every > 2000
    assert kept < 0.2 * every


def test_on_surfaces_of_unknown_tiles_there_are_no_objects(tmp_path: Path) -> None:
    """What follows the amplitude ends there by steps, as the brightness does."""
    model, board = camera(tmp_path), scene(tmp_path)
    data, _ = with_hand(record(model, board, poses=24, seed=4), model)
    unknown = replace(board, surfaces=(replace(board.surfaces[0], texture=None, reflectivity="unknown"),))
    found = foreign_values(fit(Problem(data, unknown), model))
    assert found is None or not found.stamps


def test_where_most_values_differ_it_is_no_object(tmp_path: Path) -> None:
    model = camera(tmp_path)
    data = record(model, scene(tmp_path), poses=12, seed=4)
    half = np.zeros(model.shape)
    half[:, :20] = -0.2
    assert is_nothing(foreign_values(fitted(tmp_path, changed(data, dict.fromkeys(range(6), half)))))


def test_farther_values_are_no_object_before_a_surface(tmp_path: Path) -> None:
    model = camera(tmp_path)
    data, _ = with_hand(record(model, scene(tmp_path), poses=24, seed=4), model, by=-0.12)
    found = foreign_values(fitted(tmp_path, data))
    assert found is None or not found.stamps


@pytest.mark.parametrize("name", sorted(registry()))
def test_no_effect_of_the_vocabulary_is_an_object_or_a_defect(tmp_path: Path, name: str) -> None:
    """The contract over the list of effects, each of its example's size, none of it in the camera file."""
    given = camera(tmp_path)
    effect: Effect = registry()[name].example(given)
    data = record(camera(tmp_path, effect), scene(tmp_path), poses=12, seed=6)
    assert is_nothing(foreign_values(fit(Problem(data, scene(tmp_path)), given)))


@pytest.mark.parametrize(
    "effect",
    [
        AmplitudeOffset({1.0: Hyperbola(12.0, 0.0)}),
        CyclicError((Harmonic(4, 0.08, 0.7),)),
        Scattering((Kernel(0.4, (3.0, 3.0)),)),
    ],
    ids=lambda effect: effect.name,
)
def test_nor_are_large_ones(tmp_path: Path, effect: Effect) -> None:
    given = camera(tmp_path)
    data = record(camera(tmp_path, effect), scene(tmp_path), poses=16, seed=7)
    assert foreign_values(fit(Problem(data, scene(tmp_path)), given)) is None


@pytest.mark.long
def test_a_hand_and_defects_before_a_board_are_consistent(tmp_path: Path) -> None:
    model, board = camera(tmp_path), scene(tmp_path)
    data, _ = with_hand(with_defects(record(model, board, poses=24, seed=4)), model)
    found = diagnose(data, board, model)
    assert (found.verdict, found.missing) == ("consistent", [])
    assert any("defective pixels" in note for note in found.notes)
    assert any("a hand, a cable or a clamp" in note for note in found.notes)


def test_what_was_found_in_several_rounds_is_one_note_a_kind() -> None:
    """Also where the rounds were fitted on different grids: images of the first are 2 x 3, then 1 x 2."""
    mask = np.zeros((2, 3), bool)
    mask[0, 1] = mask[1, 2] = True
    used, lit = np.ones((2, 3), bool), np.zeros((2, 3), bool)
    first = ForeignValues({0: mask, 4: mask}, 0, frozenset({(0, 11), (1, 11)}), 0.03)
    assert [int(distance.sum()) for distance, _ in first.kept([(used, lit)] * 6)] == [4, 6, 6, 6, 4, 6]
    second = ForeignValues({3: np.array([[True, False]])}, 0, frozenset({(1, 11)}), 0.001)
    third = ForeignValues({0: np.array([[False, True]])}, 2, frozenset(), 0.0)
    pixels, objects = exclusion_notes([first, second, third])
    assert "defective pixels (2)" in pixels
    assert objects.startswith("excluded: 3.1 % of the values, in 2 stations")
    assert exclusion_notes([ForeignValues({}, 0, frozenset(), 0.0)]) == exclusion_notes([]) == []
