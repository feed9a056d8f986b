"""Curves over the angle of incidence against the lobes of real surfaces in closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rim_camera_ros.effects.light_curves import (
    DIFFUSE,
    LOBE_DIFFUSE,
    LOBE_GLOSS,
    SURFACES,
    LightCurves,
)

LABELS = (*LOBE_DIFFUSE, *LOBE_GLOSS)
ANGLES = np.radians(np.linspace(0.0, 75.0, 301)).reshape(1, -1)


def view(reflectivity: float) -> SimpleNamespace:
    everywhere = np.ones(ANGLES.shape)
    return SimpleNamespace(
        incidence=ANGLES, distance=2.0 * everywhere, reflectivity=reflectivity * everywhere, tile=0
    )


def gauss(angle: np.ndarray, width: float) -> np.ndarray:
    return np.asarray(np.exp(-((angle / width) ** 2)))


@pytest.mark.parametrize("degrees", [9.0, 13.0, 17.0])
def test_a_lobe_is_fitted_to_a_fiftieth_of_its_height(degrees: float) -> None:
    """Straight lines between the same angles miss 5 to 11 % of lobes of 17 to 9 degrees."""
    columns = LightCurves().columns(view(0.3), 7.5, LABELS)[: len(LOBE_DIFFUSE)]
    design = np.column_stack([one.ravel() for one in columns])
    lobe = gauss(ANGLES.ravel(), np.radians(degrees))
    fitted = design @ np.linalg.lstsq(design, lobe - 1.0, rcond=None)[0]
    assert np.abs(fitted - (lobe - 1.0)).max() < 0.02


def test_the_gloss_of_a_print_is_fitted_to_a_fiftieth_of_its_height() -> None:
    """Half the light more within some 6 degrees: heights at every 10 degrees miss 12 % of it."""
    columns = LightCurves().columns(view(0.3), 7.5, SURFACES)[: len(DIFFUSE)]
    design = np.column_stack([np.ones(ANGLES.size), *(one.ravel() for one in columns)])
    lobe = 0.5 * gauss(ANGLES.ravel(), np.radians(5.7))
    fitted = design @ np.linalg.lstsq(design, lobe, rcond=None)[0]
    assert np.abs(fitted - lobe).max() < 0.01


@pytest.mark.parametrize("labels", [LABELS, SURFACES])
def test_columns_are_the_derivatives_of_the_factor(labels: tuple[str, ...]) -> None:
    geometry = view(0.12)
    values = {label: 0.01 * (k % 3) for k, label in enumerate(labels)}
    curves = LightCurves(values)

    def logarithm(moved: dict[str, float]) -> np.ndarray:
        changed = LightCurves({**values, **moved})
        return np.log(changed.factor(geometry, 7.5))

    # those of a weak lobe are at a factor of 1, and followed by those of the falloff
    scale = curves.factor(geometry, 7.5) if labels is LABELS else 1.0
    columns = curves.columns(geometry, 7.5, labels)[: len(labels)]
    for label, column in zip(labels, columns, strict=True):
        step = (logarithm({label: values[label] + 1e-5}) - logarithm({label: values[label] - 1e-5})) / 2e-5
        assert column == pytest.approx(step * scale, rel=1e-6, abs=1e-8)


def test_lobes_are_even_in_the_angle() -> None:
    """Near normal incidence a lobe is a parabola: half the angle has a quarter of the change."""
    curves = LightCurves({DIFFUSE[1]: 0.1})
    change = curves.surfaces(view(0.5)).ravel() - 1.0
    at = {degrees: change[np.argmin(np.abs(ANGLES - np.radians(degrees)))] for degrees in (0, 0.25, 0.5, 10)}
    assert at[0] == 0.0
    assert at[0.5] / at[0.25] == pytest.approx(4.0, rel=0.1)
    assert at[10] == pytest.approx(0.1, rel=1e-3)


def test_gloss_is_stronger_on_dark_surfaces() -> None:
    curves = LightCurves({LOBE_GLOSS[0]: 0.02})
    dark, bright = (curves.factor(view(one), 7.5)[0, 0] - 1.0 for one in (0.1, 0.6))
    assert (dark, bright) == pytest.approx((0.06, 0.01))
