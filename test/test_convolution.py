"""Stray light forward and back, against plain sums over an infinite grid and dense linear algebra."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rim_camera_ros.camera import Camera, Optics, Sensor
from rim_camera_ros.convolution import (
    Spreading,
    complex_image,
    gaussian_matrix,
    gaussian_matrix_by_sigma,
    gaussian_profile,
    planar,
    shift,
)
from rim_camera_ros.effects.scattering import Ghost, Kernel, Scattering
from rim_camera_ros.effects.signal import Context

Kernels = list[tuple[float, float, float]]
GhostOf = tuple[float, float, float]


def _image(shape: tuple[int, int], seed: int = 3) -> np.ndarray:
    """A complex image with bright, dark and empty pixels."""
    rng = np.random.default_rng(seed)
    s = rng.uniform(0, 1, shape) ** 4 * 3000 * np.exp(2j * np.pi * rng.uniform(0, 1, shape))
    s[rng.uniform(0, 1, shape) < 0.1] = 0
    return s


def _gauss(offset: int, sigma: float) -> float:
    """One weight of a Gaussian sampled at whole pixels whose sum over all of them is 1."""
    if sigma == 0:
        return float(offset == 0)
    reach = range(-int(40 * sigma) - 5, int(40 * sigma) + 6)
    return math.exp(-0.5 * (offset / sigma) ** 2) / math.fsum(
        math.exp(-0.5 * (k / sigma) ** 2) for k in reach
    )


def _matrix(shape: tuple[int, int], kernels: Kernels, ghost: GhostOf | None) -> np.ndarray:
    """The operator written out pixel by pixel, (H W, H W)."""
    height, width = shape
    n = height * width
    direct = 1 - sum(k[0] for k in kernels) - (ghost[0] if ghost else 0)
    h = direct * np.eye(n)
    for weight, su, sv in kernels:
        gu = {k: _gauss(k, su) for k in range(-width, width + 1)}
        gv = {k: _gauss(k, sv) for k in range(-height, height + 1)}
        for to in range(n):
            for origin in range(n):
                dv, du = to // width - origin // width, to % width - origin % width
                h[to, origin] += weight * gv[dv] * gu[du]
    if ghost:
        weight, du, dv = ghost
        for to in range(n):
            v, u = to // width - dv, to % width - du
            for row in (math.floor(v), math.floor(v) + 1):
                for column in (math.floor(u), math.floor(u) + 1):
                    if 0 <= row < height and 0 <= column < width:
                        share = (1 - abs(v - row)) * (1 - abs(u - column))
                        h[to, row * width + column] += weight * share
    return h


CASES: list[tuple[tuple[int, int], Kernels, GhostOf | None]] = [
    ((9, 13), [(0.2, 3.0, 4.5)], None),
    ((9, 13), [(0.2, 1.1, 0.7)], None),
    ((9, 13), [(0.2, 0.0, 4.0)], None),
    ((9, 13), [(0.1, 0.3, 6.0), (0.15, 4.0, 2.6), (0.07, 30.0, 11.0)], None),
    ((9, 13), [], (0.06, 2.0, -3.0)),
    ((9, 13), [], (0.06, -2.3, 1.8)),
    ((9, 13), [(0.12, 2.6, 3.1), (0.1, 9.0, 8.0)], (0.03, 4.7, -2.25)),
    ((9, 13), [(0.12, 1.6, 0.4), (0.1, 9.0, 8.0)], (0.03, 40.0, 0.0)),
    # the light that stays is the smaller part
    ((9, 13), [(0.7, 1.2, 0.8)], None),
    ((9, 13), [(0.45, 0.8, 1.4), (0.4, 5.0, 3.0)], (0.05, 1.5, 0.5)),
    ((9, 13), [(0.9, 6.0, 7.0)], None),
    ((1, 1), [(0.3, 2.0, 5.0)], (0.1, 1.0, 0.0)),
    ((1, 8), [(0.3, 2.0, 5.0)], (0.1, 2.0, 0.0)),
    ((7, 1), [(0.3, 5.0, 0.9)], (0.1, 0.0, 1.5)),
    ((3, 4), [(0.3, 500.0, 1e6)], None),
]


@pytest.mark.parametrize(("shape", "kernels", "ghost"), CASES)
def test_apply_is_the_plain_sum(shape: tuple[int, int], kernels: Kernels, ghost: GhostOf | None) -> None:
    if kernels and max(max(k[1:]) for k in kernels) > 1e5:
        pytest.skip("the plain sum takes too long")
    s = _image(shape)
    expected = (_matrix(shape, kernels, ghost) @ s.ravel()).reshape(shape)
    for dtype, tolerance in ((np.float64, 1e-11), (np.float32, 2e-6)):
        found = complex_image(Spreading(shape, kernels, ghost, dtype=dtype).apply(planar(s).astype(dtype)))
        np.testing.assert_allclose(found, expected, atol=tolerance * 3000)


@pytest.mark.parametrize(("shape", "kernels", "ghost"), CASES)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-10), (np.float32, 1e-5)])
def test_solve_undoes_apply(
    shape: tuple[int, int], kernels: Kernels, ghost: GhostOf | None, dtype: type, tolerance: float
) -> None:
    s = planar(_image(shape)).astype(dtype)
    operator = Spreading(shape, kernels, ghost, dtype=dtype)
    found = operator.solve(operator.apply(s))
    assert found.dtype == dtype
    np.testing.assert_allclose(found, s, atol=tolerance * 3000 / operator.direct)


def test_solve_against_dense_algebra() -> None:
    shape, kernels, ghost = (8, 11), [(0.25, 2.7, 3.3), (0.2, 0.9, 1.3)], (0.04, 1.6, -2.0)
    s = _image(shape, seed=8)
    expected = np.linalg.solve(_matrix(shape, kernels, ghost), s.ravel()).reshape(shape)
    found = complex_image(Spreading(shape, kernels, ghost).solve(planar(s)))
    np.testing.assert_allclose(found, expected, atol=1e-8)


@pytest.mark.parametrize("kernels", [[(0.1, 6.0, 5.0)], [(0.1, 6.0, 5.0), (0.06, 1.0, 1.4)]])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_guess_does_not_change_the_solution(kernels: Kernels, dtype: type) -> None:
    shape, ghost = (24, 31), (0.01, 3.4, -6.1)
    s = planar(_image(shape)).astype(dtype)
    operator = Spreading(shape, kernels, ghost, dtype=dtype)
    light = operator.apply(s)
    guess = (s * dtype(1.0005)).astype(dtype)
    np.testing.assert_allclose(
        operator.solve(light, guess=guess), s, atol=(2e-5 if dtype == np.float32 else 1e-10) * 3000
    )


def test_single_precision_on_a_whole_sensor() -> None:
    """The SR-3000's kernels: 1e-5 of the amplitude is 0.012 mm at most, typically far less."""
    shape, kernels = (144, 176), [(0.08, 12.0, 12.0), (0.08, 48.0, 48.0)]
    s = _image(shape)
    light = Spreading(shape, kernels, None).apply(planar(s))
    found = Spreading(shape, kernels, None, dtype=np.float32).solve(light.astype(np.float32))
    exact = Spreading(shape, kernels, None).solve(light)
    np.testing.assert_allclose(exact, planar(s), atol=1e-8)
    assert np.sqrt(np.mean((found - exact) ** 2)) < 3e-7 * 3000
    assert np.abs(found - exact).max() < 3e-6 * 3000


def test_light_is_conserved_far_from_the_edges() -> None:
    shape = (81, 91)
    s = np.zeros(shape, complex)
    s[40, 45] = 1000 * np.exp(0.7j)
    kernels, ghost = [(0.1, 3.0, 2.0), (0.2, 5.0, 6.0)], (0.05, 7.25, -11.5)
    found = complex_image(Spreading(shape, kernels, ghost).apply(planar(s)))
    assert found.sum() == pytest.approx(1000 * np.exp(0.7j), rel=1e-9)
    direct_and_peaks = (
        1000 * np.exp(0.7j) * (0.65 + 0.1 * _gauss(0, 3) * _gauss(0, 2) + 0.2 * _gauss(0, 5) * _gauss(0, 6))
    )
    assert found[40, 45] == pytest.approx(direct_and_peaks, rel=1e-9)


def test_light_falls_beside_the_sensor() -> None:
    """A corner pixel keeps a quarter of a wide halo, and a bit."""
    s = np.zeros((40, 40), complex)
    s[0, 0] = 1
    found = complex_image(Spreading((40, 40), [(0.4, 5.0, 5.0)], None).apply(planar(s))).sum()
    quarter = (0.5 + 0.5 * _gauss(0, 5)) ** 2
    assert found == pytest.approx(0.6 + 0.4 * quarter, rel=1e-9)


def test_noise_is_amplified_by_no_more_than_stated() -> None:
    """At most 1 / (d - w_g): the smallest singular value of the operator is at least d - w_g."""
    for kernels, ghost in (([(0.3, 2.0, 3.0), (0.2, 0.8, 0.9)], None), ([(0.3, 4.0, 3.0)], (0.1, 1.0, 2.5))):
        h = _matrix((8, 9), kernels, ghost)
        direct = 1 - sum(k[0] for k in kernels) - (ghost[0] if ghost else 0)
        bound = direct - (ghost[0] if ghost else 0)
        assert np.linalg.svd(h, compute_uv=False).min() >= bound - 1e-9


@pytest.mark.filterwarnings("error")
@settings(derandomize=True, max_examples=80, deadline=None)
@given(st.one_of(st.floats(0, 40), st.floats(0, 1e-3), st.floats(40, 1e12)))
def test_profiles_have_sum_one(sigma: float) -> None:
    half = gaussian_profile(2000, sigma)
    assert half[0] > 0
    assert np.all(np.diff(half) <= 0)
    total = 2 * math.fsum(half.tolist()) - half[0]
    assert total == pytest.approx(1, rel=1e-9) if sigma < 150 else total < 1


@pytest.mark.parametrize("sigma", [0.4, 1.7, 2.9, 3.1, 25.0])
def test_derivative_by_sigma(sigma: float) -> None:
    step = 1e-5
    expected = (gaussian_matrix(12, sigma + step) - gaussian_matrix(12, sigma - step)) / (2 * step)
    np.testing.assert_allclose(gaussian_matrix_by_sigma(12, sigma), expected, atol=1e-9)
    assert not gaussian_matrix_by_sigma(12, 0.0).any()


def test_shift_by_hand() -> None:
    image = np.array([[1.0, 2.0, 4.0], [8.0, 16.0, 32.0]])
    assert shift(image, columns=1, rows=0).tolist() == [[0, 1, 2], [0, 8, 16]]
    assert shift(image, columns=0, rows=-1).tolist() == [[8, 16, 32], [0, 0, 0]]
    assert shift(image, columns=0.25, rows=0).tolist() == [[0.75, 1.75, 3.5], [6, 14, 28]]
    assert shift(image, columns=-0.5, rows=0.5).tolist() == [[0.75, 1.5, 1.0], [6.75, 13.5, 9.0]]
    assert not shift(image, columns=3, rows=0).any()
    assert not shift(image, columns=-1e6, rows=0.5).any()


def test_weights_that_leave_nothing() -> None:
    with pytest.raises(ValueError, match=r"leave only 0\.04 of the light in its place"):
        Spreading((4, 4), [(0.5, 3.0, 3.0), (0.46, 9.0, 9.0)], None)
    with pytest.raises(
        ValueError, match=r"the ghost's weight 0\.3 reaches that of the light in its place, 0\.3"
    ):
        Spreading((4, 4), [(0.4, 3.0, 3.0)], (0.3, 1.0, 0.0))
    with pytest.raises(ValueError, match=r"weights add up to 0\.96, at most 0\.95"):
        Scattering((Kernel(0.5, (3.0, 3.0)), Kernel(0.46, (3.0, 3.0))))
    with pytest.raises(ValueError, match=r"ghost's weight 0\.45 must stay below .*0\.15"):
        Scattering((Kernel(0.4, (3.0, 3.0)),), Ghost(0.45, (2.0, 0.0)))
    with pytest.raises(ValueError, match="give kernels or a ghost"):
        Scattering(())


def test_the_effect_is_this_operator() -> None:
    """Sigma along the row first, shift in columns first; a positive shift moves a ghost towards greater u."""
    camera = Camera(
        sensor=Sensor(width=12, height=7, pixel_pitch=(1e-4, 1e-4), modulation_frequency=20e6),
        optics=Optics(fx=30.0, fy=30.0, cx=6.0, cy=3.0),
    )
    effect = Scattering((Kernel(0.2, (4.0, 0.5)),), Ghost(0.05, (3.0, -2.0)))
    s = _image((7, 12))
    expected = _matrix((7, 12), [(0.2, 4.0, 0.5)], (0.05, 3.0, -2.0)) @ s.ravel()
    np.testing.assert_allclose(effect.apply(s, Context(camera=camera)).ravel(), expected, atol=1e-8)
    np.testing.assert_allclose(
        effect.invert(effect.apply(s, Context(camera=camera)), Context(camera=camera)), s, atol=1e-7
    )
    assert effect.total_weight == pytest.approx(0.25)
