"""Which pixels of the stations take part: no gross outliers, and nothing beside edges that disagrees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from rim_camera_ros.calibrate.adjustment import Fit
from rim_camera_ros.calibrate.forward import Forward
from rim_camera_ros.calibrate.residuals import ROBUST_LIMIT, after_nuisances
from rim_camera_ros.effects.reference_path import ReferencePath
from rim_camera_ros.scene import Geometry

Array = NDArray[Any]
Masks = list[tuple[Array, Array]]

#: A distance farther than this many robust standard deviations from its station's median residual, and than
#: `GROSS` [m], is no measurement of the scene.
GROSS_SIGMAS = 10.0
GROSS = 0.1
#: Noise of a single distance, as a share of the ambiguity range, above which it is no normal one any more.
NOISIEST = 0.025
#: Pixels nearer than this to an edge of brightness or of a surface [px] are beside it.
BESIDE = 2
#: Where chi-square per value beside edges exceeds the first number, and that elsewhere by the second as a
#: ratio, they are left out, if the third is left as a share of all. The ratio is small because the
#: fit is drawn towards both.
POOR = 1.5
DISAGREE = 1.1
LEAST_LEFT = 0.1


def usable_pixels(forward: Forward) -> tuple[Masks, int]:
    """Return the pixels of each station for both channels, (H, W) each, and the number of gross outliers.

    One of them among thousands, metres off, would rule the first steps of an adjustment. Pixels so dark that
    their noise wraps, and terms of the amplitude are steep, take no part, nor do those of the internal
    reference.
    """
    masks: Masks = []
    gross = 0
    darkest = NOISIEST * forward.camera.sensor.ambiguity
    path = forward.camera.effects.get("reference_path")
    reference = path.region() if isinstance(path, ReferencePath) else None
    for one in forward.predictions(slopes=False):
        # by the predicted amplitude: picking by the measured one would pick the bright half of the noise
        used = one.used & (one.sigma * np.sqrt(np.maximum(one.station.count, 1)) < darkest)
        if reference is not None:
            used[reference] = False
        if used.any():
            centre = np.median(one.residual[used])
            away = np.abs(one.residual - centre)
            limit = max(GROSS, GROSS_SIGMAS * 1.4826 * float(np.median(away[used])))
            wild = used & (away > np.maximum(limit, GROSS_SIGMAS * one.sigma))
            gross += int(wild.sum())
            used = used & ~wild
        masks.append((used, one.amplitude_used & used))
    return masks, gross


def beside_edges(geometry: Geometry) -> NDArray[np.bool_]:
    """Return the pixels (H, W) within `BESIDE` of another surface, another brightness, or nothing."""
    size = 2 * BESIDE + 1
    bright = np.where(geometry.hit, geometry.reflectivity, -1.0)
    surface = geometry.surface
    same = minimum_filter(bright, size) == maximum_filter(bright, size)
    same &= minimum_filter(surface, size) == maximum_filter(surface, size)
    return np.asarray(~same)


def without_edges(fitted: Fit, masks: Sequence[tuple[Array, Array]]) -> tuple[Masks, str] | None:
    """Return the masks without the pixels beside edges, and a note, where they disagree with the others.

    None where they agree: what blurs and strays is modelled or too small. Outliers count no more than at
    the robust limit.
    """
    totals = np.zeros((2, 2))
    left: Masks = []
    for one, (used, lit) in zip(fitted.forward.predictions(), masks, strict=True):
        rest, _ = after_nuisances(one, fitted.pattern, fitted.nuisances)
        edge = beside_edges(one.view.geometry)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.minimum(np.abs(rest) / one.sigma, ROBUST_LIMIT)
        for i, pixels in enumerate((one.used & ~edge, one.used & edge)):
            totals[i] += float(np.sum(z[pixels] ** 2)), float(pixels.sum())
        left.append((used & ~edge, lit & ~edge))
    chi_square = totals[:, 0] / np.maximum(totals[:, 1], 1)
    few = totals[0, 1] < LEAST_LEFT * totals[:, 1].sum()
    if few or chi_square[1] < POOR or chi_square[1] < DISAGREE * chi_square[0]:
        return None
    return left, (
        f"left out: {int(totals[1, 1])} distances within {BESIDE} px of edges of brightness or surfaces, "
        f"which disagree with the others (chi-square per value {chi_square[1]:.1f} against "
        f"{chi_square[0]:.1f}): "
        "stray light or blur that these recordings do not resolve"
    )
