"""Predictions and equations of the window in which rays meet the scene are those of the whole array."""

from __future__ import annotations

import gc
import weakref
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects import ORDER
from rim_camera_ros.effects.base import DistanceTerm, Effect
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.light_curves import LOBE, RESPONSE, LightCurves
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.scattering import Ghost, Kernel, Scattering
from rim_camera_ros.fit import forward as forward_module
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.design import imperfection_blocks, linear_blocks, pose_block, present_blocks
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import NormalEquations, accumulate
from rim_camera_ros.fit.prediction import Prediction, random_effects
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.fit.shifts import shifts_between
from rim_camera_ros.fit.views import NEAR
from rim_camera_ros.scene import Scene, load_scene
from rim_camera_ros.select.candidates import candidates
from rim_camera_ros.select.edge_pixels import edge_candidates

from ..calibrate.helpers import SCENE, camera, record, scene

POINTWISE = [kind for kind in ORDER if kind.pointwise]
IMAGES = [
    "distance", "amplitude", "residual", "amplitude_residual", "sigma", "amplitude_sigma", "amplitude_noise",
    "amplitude_share", "amplitude_freedom", "slope_distance", "slope_amplitude", "slope_published",
    "model_amplitude", "model_reading", "model_slope", "amplitude_follows", "amplitude_measured",
]  # fmt: skip


def small_board(tmp_path: Path) -> Scene:
    """A board of 0.9 x 0.6 m: the whole array where it is near, a twentieth of it at 4 m."""
    path = tmp_path / "scene.yaml"
    path.write_text(
        SCENE.replace("type: plane", "type: rectangle\n  size: [0.9, 0.6]").replace("0.31", "0.16")
    )
    return load_scene(path)


def forward_of(stated: Camera, board: Scene, data: Dataset) -> Forward:
    result = Forward(data, board, stated)
    gains = np.exp(0.02 * np.random.default_rng(5).standard_normal(stated.shape))
    poses = {(one.recording, one.pose): 1.0 + 0.01 * one.pose for one in data.stations}
    result.amplitude_model = AmplitudeModel(poses, tau=0.03, pixels=np.log(gains))
    values = {label: 0.01 * (1 + i % 3) for i, label in enumerate([*LOBE, *RESPONSE[:1]])}
    result.light_curves = LightCurves(values, level=300.0)
    return result


def whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forward_module, "window_of", lambda view, measured, margin: None)


def windows(predictions: list[Prediction]) -> list[float]:
    return [one.inner.used.size / one.used.size for one in predictions]


@pytest.mark.parametrize("kind", POINTWISE, ids=lambda kind: str(kind.name))
def test_predictions_are_the_same(
    kind: type[Effect], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, board = camera(tmp_path), small_board(tmp_path)
    stated = with_effects(plain, {kind.name: kind.example(plain)})
    data = record(stated, board, poses=8, seed=4)
    in_windows = list(forward_of(stated, board, data).predictions())
    assert min(windows(in_windows)) < 0.1 < max(windows(in_windows)) == 1.0
    own = present_blocks(stated)
    assert all(block.pointwise for block in own)
    columns = [
        [block.columns(one.for_columns(block)) for block in own if not block.in_order] for one in in_windows
    ]
    whole(monkeypatch)
    for one in in_windows:
        # also those images of which somebody may not think
        images = [getattr(one, name.name) for name in fields(one)] + [
            image for signal in (one.delivered, *one.before.values()) for image in vars(signal).values()
        ]
        shapes = {image.shape for image in images if isinstance(image, np.ndarray) and image.ndim == 2}
        assert shapes == {stated.shape}
    for one, found, expected in zip(
        in_windows, columns, forward_of(stated, board, data).predictions(), strict=True
    ):
        assert expected.of_window is None
        assert np.array_equal(one.used, expected.used)
        assert np.array_equal(one.amplitude_used, expected.amplitude_used)
        seen = expected.view.geometry.hit
        for name in IMAGES:
            got, want = (np.broadcast_to(getattr(p, name), seen.shape)[seen] for p in (one, expected))
            np.testing.assert_allclose(got, want, rtol=1e-12, err_msg=name)
        pixels = np.flatnonzero(expected.used)
        for mine, block in zip(found, [b for b in own if not b.in_order], strict=True):
            for got, want in zip(mine, block.columns(expected), strict=True):
                np.testing.assert_allclose(
                    one.places(pixels).take(got[0]), np.take(want[0], pixels), rtol=1e-9, atol=1e-12
                )


def equations(forward: Forward) -> NormalEquations:
    stated, board, data = forward.camera, forward.scene, forward.dataset
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    blocks = [*present_blocks(stated), *imperfection_blocks(stated, board, pattern_field=True)]
    blocks += [pose_block([])] + [one.block for one in (*candidates(stated, facts), *edge_candidates())]
    folds = {(one.recording, one.pose): one.pose % 3 for one in data.stations}
    return accumulate(forward, blocks, fold_of=folds, stray_light=2.0)


def spread(*effects: Effect) -> dict[str, Effect]:
    return {effect.name: effect for effect in effects}


SCATTERING = Scattering(
    kernels=(Kernel(0.08, (4.0, 2.5)), Kernel(0.03, (15.0, 12.0))), ghost=Ghost(0.01, (3, -2))
)
SPREADING = {
    "none": {},
    "scattering": spread(SCATTERING),
    "blur": spread(MixedPixels(blur=0.6)),
    "footprint": spread(MixedPixels(blur=0.3, footprint=0.8)),
    "both": spread(MixedPixels(blur=0.5), SCATTERING),
}


@pytest.mark.parametrize("around", [False, True], ids=["dark around", "a wall around"])
@pytest.mark.parametrize("spreading", SPREADING)
@pytest.mark.parametrize("correlated_error", [0.0, 0.004])
def test_equations_are_the_same(
    correlated_error: float, spreading: str, around: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a camera with all that acts on each pixel by itself, and what spreads light; among the candidates
    are others.

    What would spread the light of the wall is a candidate: where nothing spreads it yet, that is taken as
    measured, the light of the scene as the mean of prediction and measurement.
    """
    tolerance = 1e-7 if not SPREADING[spreading] else 1e-6
    if around and SCATTERING.name not in SPREADING[spreading]:
        tolerance = 1e-3
    plain, board = camera(tmp_path), small_board(tmp_path)
    stated = with_effects(
        plain, {kind.name: kind.example(plain) for kind in POINTWISE} | SPREADING[spreading]
    )
    data = record(stated, board, poses=8, seed=5)
    if around:
        data = replace(data, stations=[with_wall(one) for one in data.stations])
    forward = forward_of(stated, board, data)
    forward.correlated_error = correlated_error
    found = equations(forward)
    assert min(windows(list(forward.predictions(slopes=False)))) < 0.5
    whole(monkeypatch)
    forward = forward_of(stated, board, data)
    forward.correlated_error = correlated_error
    expected = equations(forward)
    assert [one.label for one in found.regressors] == [one.label for one in expected.regressors]
    for mine, theirs in zip(found.folds, expected.folds, strict=True):
        scale = np.sqrt(np.outer(np.diag(theirs.gram), np.diag(theirs.gram)))
        np.testing.assert_allclose(
            mine.gram / np.maximum(scale, 1e-30), theirs.gram / np.maximum(scale, 1e-30), atol=tolerance
        )
        unit = np.maximum(np.sqrt(np.diag(theirs.gram)), 1e-30)
        for got, want in ((mine.pixel, theirs.pixel), (mine.gain, theirs.gain)):
            assert got is not None
            assert want is not None
            np.testing.assert_allclose(
                got / unit, want / unit, rtol=1e-5, atol=10 * tolerance * np.abs(want / unit).max()
            )
        assert mine.log_sigma == pytest.approx(theirs.log_sigma, rel=1e-12)


def with_wall(station: Station) -> Station:
    """A wall that the scene does not describe, wherever the station saw nothing."""
    nothing = station.count == 0
    images = {
        "distance": np.where(nothing, 4.8, station.distance),
        "amplitude": np.where(nothing, 45.0 + np.arange(44), station.amplitude),
        "count": np.where(nothing, station.frames, station.count),
    }
    return replace(station, **images)


def measured_in_part(dataset: Dataset) -> Dataset:
    """A recording of a plane that fills the array, with values of 14 x 17 pixels somewhere in each pose."""
    stations = []
    for one in dataset.stations:
        seen = np.zeros(one.count.shape, bool)
        top, left = 3 * one.pose, 26 - 3 * one.pose
        seen[top : top + 14, left : left + 17] = True
        stations.append(one.without(~seen))
    return replace(dataset, stations=stations)


@pytest.mark.parametrize("correlated_error", [0.0, 0.004])
@pytest.mark.parametrize(("spreading", "within"), [("none", 1e-9), ("scattering", 0.15)])
def test_a_surface_that_is_measured_in_part(
    spreading: str, within: float, correlated_error: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is compared is the same; derivatives are without the light that comes from unmeasured parts.

    Scattering spreads 12 % of the light, of which next to all comes from there. As a candidate it sees the
    light of these parts, too, but for the gains of their pixels.
    """
    plain, board = camera(tmp_path), scene(tmp_path)
    stated = with_effects(
        plain, {kind.name: kind.example(plain) for kind in POINTWISE} | SPREADING[spreading]
    )
    data = measured_in_part(record(stated, board, poses=8, seed=7))

    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    spreading_candidates = [
        one.block
        for one in candidates(stated, facts)
        if one.effect == SCATTERING.name and spreading == "none"
    ]

    def found() -> tuple[list[Prediction], list[np.ndarray], list[np.ndarray]]:
        forward = forward_of(stated, board, data)
        forward.correlated_error = correlated_error
        columns, of_candidates = [], []
        for one in forward.predictions():
            drawn = random_effects(one, gain_sigma=0.02, stray_light=0.0)
            used = np.flatnonzero(one.used)
            pixels = one.places(used)
            columns.append(np.stack([pixels.take(change[0]) * sigma for _, sigma, _, *change in drawn]))
            for block in spreading_candidates:
                spread_columns = block.columns(one.for_columns(block))
                of_candidates += [np.take(column[1], used) for column in spread_columns]
        return list(forward.predictions()), columns, of_candidates

    mine, own, spread_here = found()
    assert max(windows(mine)) < 0.3
    assert bool(spread_here) == (spreading == "none")
    whole(monkeypatch)
    expected, theirs, spread_there = found()
    for got, want in zip(spread_here, spread_there, strict=True):
        assert np.sqrt(np.mean((got - want) ** 2)) < 0.03 * np.sqrt(np.mean(want**2))
    for got, want in zip(mine, expected, strict=True):
        assert np.array_equal(got.used, want.used)
        assert want.used.any()
        for name in IMAGES:
            a, b = (np.broadcast_to(getattr(one, name), want.used.shape)[want.used] for one in (got, want))
            np.testing.assert_allclose(a, b, rtol=1e-9, err_msg=name)
    for columns, wanted in zip(own, theirs, strict=True):
        size = np.sqrt(np.mean(wanted**2, axis=1))
        assert np.all(np.sqrt(np.mean((columns - wanted) ** 2, axis=1)) <= within * size)


def test_terms_of_neighbours_see_the_whole_array(tmp_path: Path) -> None:
    plain, board = camera(tmp_path), small_board(tmp_path)
    data = record(plain, board, poses=6, seed=4)
    kinds = [one for one in ORDER if issubclass(one, DistanceTerm) and one.predictable and not one.pointwise]
    assert kinds
    for kind in kinds:
        stated = with_effects(plain, {kind.name: kind.example(plain)})
        assert windows(list(Forward(data, board, stated).predictions(slopes=False))) == [1.0] * 6, kind.name


def test_masks_margins_and_shifts_are_of_the_whole_array(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stated, board = camera(tmp_path), small_board(tmp_path)
    data = record(stated, board, poses=8, seed=4)
    other = replace(data, stations=[replace(one, distance=one.distance + 0.013) for one in data.stations])

    def found() -> list[np.ndarray]:
        forward = forward_of(stated, board, data)
        near = forward.pixels_near_edges(NEAR)
        forward.masks = [(used & (np.arange(44) % 3 > 0), lit) for used, lit in near]
        forward.patches = forward.patches_seen()
        forward.shifts = shifts_between(data, other, board, stated)
        return [
            np.stack([np.where(one.used, image, 0.0) for image in (one.used, one.residual, one.sigma)])
            for one in forward.predictions()
        ]

    mine = found()
    whole(monkeypatch)
    for got, want in zip(mine, found(), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-12)


def test_residuals_after_nuisances_are_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, board = camera(tmp_path), small_board(tmp_path)
    stated = with_effects(plain, {kind.name: kind.example(plain) for kind in POINTWISE})
    data = record(stated, board, poses=8, seed=6)
    pattern = 0.004 * np.random.default_rng(2).standard_normal(stated.shape)

    def found() -> list[np.ndarray]:
        forward = forward_of(stated, board, data)
        forward.correlated_error = 0.004
        forward.linear = linear_blocks(stated, board, pattern_field=True)
        labels = [one.label for block in forward.linear for one in block.regressors]
        nuisances = {label: 0.003 * (1 + i % 4) for i, label in enumerate(labels)}
        result = []
        for one in forward.predictions():
            for i, (name, sigma, *_) in enumerate(random_effects(one, gain_sigma=0.02, stray_light=2.0)):
                nuisances[name] = sigma * (1 - i % 3)
            left = after_nuisances(one, pattern, nuisances)
            result.append(np.stack([np.where(one.used, image, 0.0) for image in left]))
        return result

    mine = found()
    whole(monkeypatch)
    for got, want in zip(mine, found(), strict=True):
        assert np.abs(want).max() > 0
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-12)


def test_views_that_are_not_kept_leave_the_memory_at_once(tmp_path: Path) -> None:
    """Those of a large sensor take 30 MB each: a cycle of references would keep all of them for a while."""
    stated, board = camera(tmp_path), small_board(tmp_path)
    data = record(stated, board, poses=8, seed=4)
    forward = Forward(data, board, stated)
    forward.views._most = 2
    gc.disable()
    try:
        views = [weakref.ref(one.view.geometry) for one in forward.predictions()]
        assert sum(view() is not None for view in views) <= 3
    finally:
        gc.enable()
