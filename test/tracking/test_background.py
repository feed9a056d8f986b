"""The background against the normal distribution and closed forms of its recursion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm

from rim_camera_ros.errors import InputError
from rim_camera_ros.tracking.background import Background, BackgroundSettings

SHAPE = (48, 64)


def learnt(
    settings: BackgroundSettings, distance: float = 3.0, sigma: float = 0.02
) -> tuple[Background, np.ndarray, np.ndarray]:
    """Return a background that has seen ``warm_start`` frames of one distance, at 10 Hz until time 0."""
    background = Background(settings)
    image, noise = np.full(SHAPE, distance), np.full(SHAPE, sigma)
    for i in range(settings.warm_start):
        assert background.take(image, noise, time=(i - settings.warm_start + 1) / 10) is None
    assert background.missing_frames == 0
    return background, image, noise


@pytest.mark.parametrize(("threshold", "time_constant"), [(2.0, 1e6), (3.0, 1e6), (2.5, 5.0)])
def test_false_alarms_on_noise_alone_have_the_nominal_rate(threshold: float, time_constant: float) -> None:
    settings = BackgroundSettings(
        threshold=threshold, model_error=0.0, warm_start=40, time_constant=time_constant
    )
    background = Background(settings)
    rng = np.random.default_rng(11)
    sigma = np.where(np.arange(SHAPE[1]) < 20, 0.01, 0.05) * np.ones(SHAPE)  # bright and dark pixels
    mean = 2.0 + 0.03 * np.arange(SHAPE[1])
    alarms = np.zeros(SHAPE[1])
    frames = 400
    for i in range(settings.warm_start + frames):
        moving = background.take(mean + sigma * rng.standard_normal(SHAPE), sigma, time=i / 10)
        if moving is not None:
            alarms += moving.sum(axis=0)
    nominal = norm.sf(threshold)
    for part in (slice(0, 20), slice(20, None)):
        count = frames * SHAPE[0] * alarms[part].size
        error = math.sqrt(nominal / count)
        assert alarms[part].sum() / count == pytest.approx(nominal, abs=5 * error + 0.03 * nominal)


def test_variance_settles_at_that_of_exponential_forgetting() -> None:
    settings = BackgroundSettings(warm_start=5, time_constant=2.0)
    background, image, noise = learnt(settings)
    for i in range(1, 400):
        background.take(image, noise, time=i / 10)
    gain = 1 - math.exp(-0.1 / 2.0)
    assert background.sigma is not None
    assert background.sigma == pytest.approx(0.02 * math.sqrt(gain / (2 - gain)), rel=1e-6)


def test_a_mean_of_all_samples_at_first() -> None:
    """Before forgetting limits it, the mean's variance is sigma^2 / n."""
    settings = BackgroundSettings(warm_start=2, time_constant=1e9)
    background, image, noise = learnt(settings)
    for i in range(1, 9):
        background.take(image, noise, time=i / 10)
    assert background.sigma is not None
    assert background.sigma == pytest.approx(0.02 / math.sqrt(10), rel=1e-6)


def test_a_slow_change_is_followed_with_the_time_constant() -> None:
    settings = BackgroundSettings(warm_start=30, time_constant=0.5)
    background, image, noise = learnt(settings)
    for i in range(1, 8):
        moving = background.take(image + 0.015, noise, time=i / 10)
        assert moving is not None
        assert not moving.any()
    assert background.distance is not None
    assert background.distance == pytest.approx(3.0 + 0.015 * (1 - math.exp(-0.7 / 0.5)), abs=1e-9)


def test_somebody_who_passes_during_the_warm_start_leaves_no_trace() -> None:
    background = Background(BackgroundSettings(warm_start=15))
    for i in range(15):
        image = np.full(SHAPE, 4.0)
        image[10:30, 4 * i : 4 * i + 20] = 2.5  # at most 5 of 15 frames at a pixel
        background.take(image, np.full(SHAPE, 0.02), time=i / 10)
    assert background.distance == pytest.approx(np.full(SHAPE, 4.0))


def test_what_is_nearer_moves_and_what_is_farther_does_not() -> None:
    settings = BackgroundSettings(threshold=4.0, model_error=0.03, warm_start=100)
    background, image, noise = learnt(settings)
    limit = 4.0 * math.sqrt(0.02**2 + math.pi / 2 * 0.02**2 / 100 + 0.03**2)
    image[5, 7] -= limit + 1e-4
    image[5, 8] -= limit - 1e-4
    image[5, 9] += 0.5
    moving = background.take(image, noise, time=0.1)
    assert moving is not None
    assert np.argwhere(moving).tolist() == [[5, 7]]


def test_a_pixel_without_background_moves_where_something_comes_and_is_learnt_when_it_stays() -> None:
    settings = BackgroundSettings(warm_start=4, absorb_after=0.95)
    background = Background(settings)
    image, noise = np.full(SHAPE, 3.0), np.full(SHAPE, 0.02)
    image[2, 3] = np.nan
    for i in range(4):
        background.take(image, noise, time=i / 10)
    image[2, 3], image[40, 50] = 2.2, np.nan
    seen = [background.take(image, noise, time=0.4 + i / 10) for i in range(12)]
    assert [bool(one[2, 3]) for one in seen if one is not None] == [True] * 11 + [False]
    assert not any(one[40, 50] for one in seen if one is not None)


@pytest.mark.parametrize(
    ("change", "patience", "moves"), [(-0.8, "absorb_after", True), (0.8, "reveal_after", False)]
)
def test_what_stays_becomes_background(change: float, patience: str, moves: bool) -> None:
    others = {"absorb_after": 60.0, "reveal_after": 60.0}
    background, image, noise = learnt(BackgroundSettings(warm_start=5, **{**others, patience: 2.0}))
    image[3:9, 4:20] += change
    for i in range(1, 21):
        moving = background.take(image, noise, time=i / 10)
        assert moving is not None
        assert moving[3:9, 4:20].all() == moves
        assert background.distance is not None
        assert background.distance[5, 6] == pytest.approx(3.0)
    background.take(image, noise, time=2.11)
    moving = background.take(image, noise, time=2.2)
    assert moving is not None
    assert not moving.any()
    assert background.distance is not None
    assert background.distance[5, 6] == pytest.approx(3.0 + change)


def test_somebody_who_walks_is_not_absorbed() -> None:
    background, image, noise = learnt(BackgroundSettings(warm_start=5, absorb_after=1.0))
    for i in range(1, 60):
        image[:] = 3.0
        image[4:20, 4:20] = 2.5 - 0.03 * i  # towards the camera
        moving = background.take(image, noise, time=i / 10)
        assert moving is not None
        assert moving[4:20, 4:20].all()


def test_other_sizes_are_refused() -> None:
    background, _, _ = learnt(BackgroundSettings(warm_start=3))
    with pytest.raises(InputError, match=r"30 x 20 px and 30 x 20 px, the background has 64 x 48 px \(learn"):
        background.take(np.ones((20, 30)), np.ones((20, 30)), time=1.0)
    with pytest.raises(InputError, match=r"64 x 48 px and 48 x 64 px"):
        Background().take(np.ones((48, 64)), np.ones((64, 48)), time=0.0)
