"""A camera carried over a floor: every pixel sees nearly the same in all poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.calibrate.run import Request, calibrate
from rim_camera_ros.camera_file import load_camera, with_effects, with_numbers
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.fold_sums import Fold
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import reduce_folds
from rim_camera_ros.fit.pixel_elimination import PixelPriors
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.scene import load_scene
from rim_camera_ros.select.evidence import folds_of
from rim_camera_ros.select.exploration import explore

from .floor import ONE_COLOUR, UNKNOWN, floor_camera, floor_scene, write_floor

#: a [m counts] and b [counts] of what the recordings' camera does.
TRUE_A, TRUE_B = -13.0, 20.0


def offset(a: float = TRUE_A) -> AmplitudeOffset:
    return AmplitudeOffset({1.0: Hyperbola(a, TRUE_B)})


@pytest.mark.long
@pytest.mark.parametrize("colour", [ONE_COLOUR, UNKNOWN])
def test_an_offset_by_amplitude_is_found_where_poses_are_alike(colour: str, tmp_path: Path) -> None:
    """It ended in a LinAlgError: offsets of pixels take on all but 1e-6 of what candidates would do."""
    write_floor(tmp_path / "bag", floor_camera(tmp_path, offset()), tmp_path, poses=10)
    request = Request(
        (tmp_path / "bag",),
        load_camera(tmp_path / "camera.yaml"),
        load_scene(floor_scene(tmp_path, colour)),
        effects=("amplitude_offset",),
    )
    result = calibrate(request, integral=False)
    a = result.solution.fit.parameters["effects.amplitude_offset.hyperbola.1.a"]
    assert result.solution.fit.converged
    # two kinds of tiles, 30 % apart, are described as one or not at all: amplitudes are what was measured
    assert a == pytest.approx(TRUE_A, abs=3 * result.sigma["effects.amplitude_offset.hyperbola.1.a"])
    assert result.sigma["effects.amplitude_offset.hyperbola.1.a"] < 0.4
    assert result.refused == []


@pytest.mark.parametrize("colour", [ONE_COLOUR, UNKNOWN])
def test_how_readings_follow_the_predicted_light(colour: str, tmp_path: Path) -> None:
    """Terms see the amplitude as far as it is predicted; the rest of it is measured, whatever the power."""
    write_floor(tmp_path / "bag", floor_camera(tmp_path, offset(), scale=4), tmp_path, poses=2)
    scene = load_scene(floor_scene(tmp_path, colour))
    camera = with_effects(load_camera(tmp_path / "camera.yaml"), {"amplitude_offset": offset()})
    data = reduce_recording(tmp_path / "bag", camera, scene=scene)
    model = AmplitudeModel({(0, pose): 1.0 for pose in range(2)}, tau=0.02)
    step = 1e-3
    images = [
        [one.distance for one in Forward(data, scene, changed).predictions(model)]
        for changed in (
            with_numbers(camera, {"radiometry.gain": 25000.0 * (1 + sign * step)}) for sign in (1, -1)
        )
    ]
    for one, up, down in zip(Forward(data, scene, camera).predictions(model), *images, strict=True):
        column, _ = one.gain_column()
        expected = (up - down)[one.used] / (2 * step)
        # how far it follows depends a little on the power, too
        assert column[one.used] == pytest.approx(expected, rel=0.3, abs=2e-5)
        light = one.amplitude[one.used]
        by_prediction_alone = -TRUE_A * light / (light - TRUE_B) ** 2
        follows = column[one.used] / by_prediction_alone
        if colour == UNKNOWN:
            assert np.abs(follows).max() == 0.0
        else:
            # dark pixels by most of it, bright ones, which are measured well, by little
            bright = light > np.quantile(light, 0.9)
            assert 0.0 < follows[bright].mean() < 0.3 < follows[light < np.quantile(light, 0.1)].mean() < 1.0


def test_a_fit_converges_where_amplitudes_are_measured(tmp_path: Path) -> None:
    """Power and lobe change nothing then; steps in them went on for ever, and took the others along."""
    write_floor(tmp_path / "bag", floor_camera(tmp_path, offset(), scale=4), tmp_path, poses=12)
    start = with_effects(load_camera(tmp_path / "camera.yaml"), {"amplitude_offset": offset(-20.0)})
    scene = load_scene(floor_scene(tmp_path, UNKNOWN))
    data = reduce_recording(tmp_path / "bag", start, scene=scene)
    fitted = fit(Problem(data, scene), start)
    assert fitted.converged
    assert fitted.iterations <= 6
    assert fitted.parameters["radiometry.gain"] == pytest.approx(25000.0, rel=1e-6)
    a = "effects.amplitude_offset.hyperbola.1.a"
    assert fitted.parameters[a] == pytest.approx(TRUE_A, abs=3 * fitted.sigma[a])


def test_a_past_exploration_keeps_no_sums_per_pixel(tmp_path: Path) -> None:
    """Those of the gains of pixels stayed, a gigabyte and more in a diagnosis of a large sensor."""
    write_floor(tmp_path / "bag", floor_camera(tmp_path, offset(), scale=4), tmp_path, poses=5)
    camera = with_effects(load_camera(tmp_path / "camera.yaml"), {"amplitude_offset": offset()})
    scene = load_scene(floor_scene(tmp_path, ONE_COLOUR))
    data = reduce_recording(tmp_path / "bag", camera, scene=scene)
    folds = folds_of(data)
    step = explore(Problem(data, scene), camera, [], folds, replicates=0, iterations=1)
    held = sum(
        fold.pixel.nbytes + fold.gain.nbytes for fold in step.fit.equations.folds if fold.gain is not None
    )
    assert held > 5 * 2 * 8 * 44 * 36 * len(step.fit.parameters)
    gains = step.scores.held_out()
    step.forget()
    assert [fold.pixel.nbytes for fold in step.fit.equations.folds] == [0] * 5
    assert [fold.gain.nbytes for fold in step.fit.equations.folds if fold.gain is not None] == [0] * 5
    assert step.scores.held_out() == gains


def test_what_elimination_leaves_is_no_less_than_nothing() -> None:
    """A column that is the same in all looks of a pixel is an offset of it: rounding alone is left."""
    rng = np.random.default_rng(4)
    pixels, looks, weight = 400, 7, 1e6
    level = rng.uniform(0.5, 3.0, pixels)
    # the first is known by nothing but the prior of the offsets, 5 cm; the second by its changes
    first = np.repeat(1e7 * level[:, None], looks, axis=1)
    second = level[:, None] + 0.1 * rng.standard_normal((pixels, looks))
    readings = 0.3 * second + 1e-3 * rng.standard_normal((pixels, looks))
    columns = np.stack([first, 1.7 * first, second, readings], axis=-1)
    flat = columns.reshape(-1, 4)
    fold = Fold(
        [], weight * flat.T @ flat, weight * columns.sum(axis=1), np.full(pixels, weight * looks), looks
    )
    reduced = reduce_folds([fold], np.ones(3), PixelPriors())
    values = np.linalg.eigvalsh(reduced.gram / np.outer(*[np.sqrt(np.diag(fold.gram)[:3])] * 2))
    assert values.min() > -1e-16
    # what is left has a solution, which is that of a fit in the differences of each pixel
    unit = np.sqrt(np.diag(reduced.gram))
    scaled = reduced.gram / np.outer(unit, unit)
    found = np.linalg.lstsq(scaled, reduced.right / unit, rcond=1e-12)[0] / unit
    changes, differences = (one - one.mean(axis=1, keepdims=True) for one in (second, readings))
    assert found[2] == pytest.approx(float((changes * differences).sum() / (changes**2).sum()), rel=1e-4)


def test_offsets_of_pixels_reach_the_rim_of_what_was_seen() -> None:
    """A mean about a pixel at the rim is that of the pixels on one side; a slope was lost there."""
    from rim_camera_ros.calibrate.solution import shrink

    rng = np.random.default_rng(2)
    slope = 0.0013 * np.arange(80)[:, None] + 0.0002 * np.arange(60)[None, :]
    variance = np.full((80, 60), 0.002**2)
    variance[:25], variance[:, 52:] = np.inf, np.inf
    measured = np.where(np.isfinite(variance), slope + 0.002 * rng.standard_normal((80, 60)), 0.0)
    error = shrink(measured, variance) - slope
    # three pixels at the rim, by the mean of each row: it was 2.9 mm
    assert np.abs(error[25:28, 10:45].mean(axis=1)).max() < 0.0008
    assert np.abs(error[77:, 10:45].mean(axis=1)).max() < 0.0008
    assert np.abs(error[40:70, 10:45].mean()) < 0.0002
    assert np.isfinite(error).all()
    # ten pixels and more from any that was seen the mean of all, 50 mm, is the guess, drawn out by nothing
    assert np.abs(error[:15, :40]).max() < 0.08


def test_what_hardly_any_pose_sees_does_not_spoil_what_replicates_say_of_the_others() -> None:
    # nothing tells the first two from each other; the third is a curve at an angle that no pose reaches,
    # where its tail is 1e-23: rounding of the right side is far more than that
    rng = np.random.default_rng(11)
    pixels, looks, weight = 40, 25, 1e4
    first = rng.standard_normal((pixels, looks))
    columns = np.stack([first, first, 1e-23 * rng.standard_normal((pixels, looks)), 0 * first], axis=-1)
    flat = columns.reshape(-1, 4)
    fold = Fold(
        [], weight * flat.T @ flat, weight * columns.sum(axis=1), np.full(pixels, weight * looks), looks
    )
    reduced = reduce_folds([fold], np.array([0.1, 0.1, 0.2]), PixelPriors())
    right = reduced.gram @ [300.0, 5.0, 0.0]
    found = reduced.without_errors(right + np.array([0.0, 0.0, 1e-8]))
    np.testing.assert_allclose(found[:2], right[:2], rtol=1e-9)
    assert abs(found[0] - found[1]) < 1e-12 * found[0]
