"""Which pixels beside edges of brightness take no part: as far as their distances are others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.pixels import usable_pixels, without_edges
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.geometry import beside_edges, see
from rim_camera_ros.scene import Scene, load_scene

from ..calibrate.helpers import camera, record


def too_far_beside_edges(dataset: Dataset, own: Camera, board: Scene, *, within: int) -> Dataset:
    """Distances of dark pixels within some pixels of edges 7 mm too far, as crosstalk makes them."""
    stations = []
    for one in dataset.stations:
        geometry = see(board, board.poses_for(one.truth), own.rays)
        wrong = beside_edges(geometry, within) & (geometry.reflectivity < 0.5)
        stations.append(replace(one, distance=one.distance + 0.007 * wrong))
    return replace(dataset, stations=stations)


def judged(dataset: Dataset, own: Camera, board: Scene) -> tuple[int, str, int] | None:
    masks, _ = usable_pixels(Forward(dataset, board, own))
    fitted = fit(Problem(dataset, board, masks=masks, pattern_prior=0.001), own)
    found = without_edges(fitted, masks)
    if found is None:
        return None
    left, margin, note = found
    assert all(not (a & ~b).any() for (a, _), (b, _) in zip(left, masks, strict=True))
    geometry = see(board, board.poses_for(dataset.stations[4].truth), own.rays)
    assert not (left[4][0] & beside_edges(geometry, margin)).any()
    return margin, note, sum(int((b & ~a).sum()) for (a, _), (b, _) in zip(left, masks, strict=True))


def near(tmp_path: Path) -> tuple[Dataset, Camera, Scene]:
    own = camera(tmp_path, DistanceScale(0.004))
    path = tmp_path / "wide.yaml"
    path.write_text(
        "format: rim_scene/1\n"
        "surfaces:\n"
        "- {name: board, type: plane, pose: truth, pose_sigma: [0.001, 0.0005],\n"
        "   texture: {cell: [0.62, 0.54], values: [[0.15, 0.8], [0.7, 0.2]]}}\n"
    )
    board = load_scene(path)
    dataset = record(own, board, poses=40)
    # where the board is near its tiles are wide enough to have an inside
    stations = [one for one in dataset.stations if one.truth["board"].position[2] < 2.4]
    assert len(stations) >= 10
    return replace(dataset, stations=stations), own, board


def test_as_far_as_distances_beside_edges_are_others(tmp_path: Path) -> None:
    dataset, own, board = near(tmp_path)
    wrong = too_far_beside_edges(dataset, own, board, within=3)
    found = judged(wrong, own, board)
    assert found is not None
    margin, note, lost = found
    assert margin == 3
    assert note.startswith(f"excluded: {lost} distances within 3 px of edges")
    assert "compared with their colour" in note


def test_none_where_they_are_the_same(tmp_path: Path) -> None:
    assert judged(*near(tmp_path)) is None


def test_margins_grow_around_the_same_edges(tmp_path: Path) -> None:
    dataset, own, board = near(tmp_path)
    geometry = see(board, board.poses_for(dataset.stations[0].truth), own.rays)
    shares = [float(np.mean(beside_edges(geometry, margin))) for margin in (2, 3, 5)]
    assert shares[0] < shares[1] < shares[2]
