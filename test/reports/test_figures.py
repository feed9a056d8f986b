"""Pictures and pages: what is drawn is what was given, and nothing is taken for markup."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from rim_camera_ros.camera import Camera, Validity
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.effects import registry
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.files import find_camera
from rim_camera_ros.reports.curves import effect_panels
from rim_camera_ros.reports.figures import (
    Covariate,
    Curve,
    Map,
    Panel,
    class_edges,
    maps,
    matrix,
    panels,
    residuals,
)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return load_camera(find_camera("sr3000"))


def test_the_band_of_a_hyperbola(camera: Camera) -> None:
    """A / (A - b): sigma^2 = (sa / (A - b))^2 + (a sb / (A - b)^2)^2 + twice the covariance."""
    one = with_effects(camera, {"amplitude_offset": AmplitudeOffset({60.0: Hyperbola(40.0, 12.0)})})
    from dataclasses import replace

    one = replace(one, validity=Validity(amplitude=(100.0, 5000.0)))
    paths = [
        "radiometry.gain",
        "effects.amplitude_offset.hyperbola.60.a",
        "effects.amplitude_offset.hyperbola.60.b",
    ]
    covariance = np.array([[9.0, 0.0, 0.0], [0.0, 0.25, -0.3], [0.0, -0.3, 4.0]])
    (panel,) = effect_panels(one, paths, covariance)
    (curve,) = panel.curves
    assert curve.sigma is not None
    assert curve.x[[0, -1]] == pytest.approx([100.0, 5000.0])
    d = curve.x - 12.0
    np.testing.assert_allclose(curve.y, 1e3 * 40 / d, rtol=1e-9)
    variance = 0.25 / d**2 + 4.0 * (40 / d**2) ** 2 - 2 * 0.3 * (1 / d) * (40 / d**2)
    np.testing.assert_allclose(curve.sigma, 1e3 * np.sqrt(variance), rtol=1e-4)


@pytest.mark.parametrize("name", sorted(registry()))
def test_every_effect_is_drawn_or_omitted(camera: Camera, name: str) -> None:
    one = with_effects(camera, {name: registry()[name].example(camera)})
    found = effect_panels(one, [], np.zeros((0, 0)), before=one)
    for panel in found:
        for curve in panel.curves:
            assert np.isfinite(curve.y).all()
            assert np.abs(curve.y).max() > 0
    if found:
        ElementTree.fromstring(panels(found))


def test_classes_follow_the_values() -> None:
    assert class_edges(np.array([16.0, 60.0, 60.0, 100.0]), 24, log=False).tolist() == [
        -6.0,
        38.0,
        80.0,
        120.0,
    ]
    edges = class_edges(np.geomspace(10, 1000, 5000), 20, log=True)
    assert len(edges) == 21
    np.testing.assert_allclose(np.diff(np.log(edges)), np.log(edges[-1] / edges[0]) / 20)
    assert class_edges(np.full(7, 3.0), 5, log=False).tolist() == [2.5, 3.5]


def test_pictures_are_svg() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.uniform(1, 5, 4000), rng.standard_normal(4000)
    covariates = [Covariate("distance [m]", x), Covariate("amplitude", np.exp(x), log=True)]
    image = rng.standard_normal((9, 12))
    image[0, 0] = np.nan
    for svg in (
        residuals(covariates, 3 * y, y, expected=np.ones(4000)),
        maps([Map("mean", image), Map("RMS", np.abs(image), from_zero=True)], "mm"),
        matrix(["a", "b"], np.array([[1.0, -0.4], [-0.4, 1.0]])),
        panels([Panel("noise", "A", "mm", (Curve(x[:5], y[:5], np.ones(5), points=True),), log=True)]),
    ):
        assert ElementTree.fromstring(svg).tag.endswith("svg")


def test_a_pixel_that_nothing_covers_leaves_no_picture_empty() -> None:
    ElementTree.fromstring(maps([Map("nothing", np.full((4, 5), np.nan))], "mm"))
