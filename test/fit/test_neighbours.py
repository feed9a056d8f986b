"""Correlations of the noise of pixels with that of others, against filters and movements of known size."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from rim_camera_ros.fit.neighbours import Neighbours, neighbours_of, pooled

SHAPE = (60, 80)


def images(noise: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Complex images of a scene with a gradient of light and phase, with noise [counts] (F, H, W)."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    light = (400.0 + 5.0 * u) * np.exp(1j * (0.3 + 0.01 * v))
    result: NDArray[np.complex128] = light * (1 + 1j * noise / np.abs(light))
    return result


def test_independent_pixels() -> None:
    found = neighbours_of(images(np.random.default_rng(1).normal(0, 4, (6, *SHAPE))))
    assert found is not None
    assert found.pairs == pytest.approx(5 * (54 * 80 + 60 * 74))
    assert found.pairs_later == pytest.approx(4 * (54 * 80 + 60 * 74))
    for value in (*found.near, found.far):
        assert abs(value) < 4 * found.sigma
    assert abs(found.far_later) < 4 * found.sigma_later


def test_a_mean_of_three_by_three() -> None:
    """Neighbours at lag 1 share 6 of 9 values, at lag 2 3 of 9, at lag 3 and more none."""
    white = np.random.default_rng(2).normal(0, 4, (6, *SHAPE))
    found = neighbours_of(images(np.stack([ndimage.uniform_filter(one, 3) for one in white])))
    assert found is not None
    assert found.near == pytest.approx((6 / 9, 3 / 9), abs=0.02)
    assert abs(found.far) < 0.03


def test_a_part_of_the_image_that_moves_in_the_last_frame() -> None:
    noise = np.random.default_rng(3).normal(0, 4, (4, *SHAPE))
    noise[3, 10:50, 20:70] += 8.0
    found = neighbours_of(images(noise))
    assert found is not None
    # 2000 of 4800 pixels have a variance of 8^2 / 4 in addition to 16
    share = 2000 * 16 / (2000 * 16 + 4800 * 16)
    assert found.far == pytest.approx(share, rel=0.15)
    assert found.far_later > 0.8 * share
    # a first frame that differs is not in the frames after it
    first = neighbours_of(images(noise[::-1]))
    assert first is not None
    assert first.far == pytest.approx(found.far)
    assert abs(first.far_later) < 4 * first.sigma_later


def test_pixels_that_are_not_valid_and_single_frames() -> None:
    frames = images(np.random.default_rng(4).normal(0, 4, (3, *SHAPE)))
    assert neighbours_of(frames[:1]) is None
    frames[1, :, 1:] = 0
    assert neighbours_of(frames[:, :40]) is None  # 40 pixels are valid
    only = neighbours_of(frames)
    assert only is not None
    assert only.pairs == 2 * 54  # those of one column


def test_the_mean_over_stations_is_weighted() -> None:
    assert pooled([None]) is None
    several = [Neighbours((0.3, 0.1), 0.0, 0.0, 300.0, 200.0), Neighbours((0.7, 0.5), 0.4, 0.2, 100.0, 56.0)]
    found = pooled([several[0], None, several[1]])
    assert found is not None
    assert found.near == pytest.approx((0.4, 0.2))
    assert (found.far, found.far_later) == pytest.approx((0.1, 0.05))
    assert (found.sigma, found.sigma_later) == pytest.approx((0.05, 0.0625))
