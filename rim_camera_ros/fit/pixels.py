"""Which pixels of the stations take part: without gross outliers and inconsistent pixels beside edges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects import InternalReference
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.residuals import ROBUST_LIMIT, after_nuisances
from rim_camera_ros.geometry import beside_edges

Array = NDArray[Any]
Masks = list[tuple[Array, Array]]
#: Which pixels (H, W) of a station are within a margin [px] of edges.
Beside = Callable[[Prediction, int], Array]

#: A distance farther than this many robust standard deviations from its station's median residual, and than
#: `GROSS` [m], is no measurement of the scene.
GROSS_SIGMAS = 10.0
GROSS = 0.1
#: Noise of a single distance, as a share of the ambiguity range, above which it is not normal any more.
NOISIEST = 0.025
#: Pixels nearer than this to an edge of brightness or of a surface [px] are beside it.
BESIDE = 2
#: Pixels beside edges are excluded where their chi-square per value is at least `POOR`, and at least
#: `DISAGREE` times that elsewhere, if a share of `LEAST_LEFT` of all pixels remains. The ratio is small
#: because the fit is drawn towards both.
POOR = 1.5
DISAGREE = 1.1
LEAST_LEFT = 0.1
#: They are also excluded, up to `WIDEST` [px] from edges, where distances in a zone along edges differ from
#: those far from any edge by more than `STEP` [m], in the median of at least `LEAST_STATIONS` stations with
#: `LEAST_PIXELS` pixels in both.
WIDEST = 5
STEP = 0.001
LEAST_STATIONS = 8
LEAST_PIXELS = 4


def usable_pixels(forward: Forward) -> tuple[Masks, int]:
    """Return the pixels of each station for both channels, (H, W) each, and the number of gross outliers.

    A single outlier among thousands, metres off, would rule the first steps of an adjustment. Also excluded
    are the pixels of the internal reference, and pixels so dark that their noise wraps and terms of the
    amplitude are steep.
    """
    masks: Masks = []
    gross = 0
    darkest = NOISIEST * forward.camera.sensor.ambiguity
    path = effect_of(forward.camera, InternalReference)
    reference = None if path is None else path.region()
    for prediction in forward.predictions(slopes=False):
        # by the predicted amplitude: a selection by the measured one would take the bright half of the noise
        used = prediction.used & (
            prediction.sigma * np.sqrt(np.maximum(prediction.station.count, 1)) < darkest
        )
        if reference is not None:
            used[reference] = False
        if used.any():
            centre = np.median(prediction.residual[used])
            away = np.abs(prediction.residual - centre)
            limit = max(GROSS, GROSS_SIGMAS * 1.4826 * float(np.median(away[used])))
            wild = used & (away > np.maximum(limit, GROSS_SIGMAS * prediction.sigma))
            gross += int(wild.sum())
            used = used & ~wild
        masks.append((used, prediction.amplitude_used & used))
    return masks, gross


def beside_in_view(prediction: Prediction, margin: int) -> Array:
    """Return the pixels (H, W) of a station within ``margin`` [px] of edges, as `beside_edges`."""
    return beside_edges(prediction.view.geometry, margin)


def without_edges(
    fitted: Fit,
    masks: Sequence[tuple[Array, Array]],
    *,
    beside: Beside = beside_in_view,
) -> tuple[Masks, int, str] | None:
    """Return masks without pixels beside edges, the width of that zone [px], and a note; None: they agree.

    They disagree where chi-square is larger within `BESIDE` of edges, or where distances in a zone along
    edges differ from those of the same colour in the same pose. ``beside`` returns which pixels (H, W) of a
    station are within a margin [px] of edges. Outliers are clipped at the robust limit.
    """
    totals = np.zeros((2, 2))
    zones = _Zones()
    for prediction, (used, _) in zip(fitted.forward.predictions(), masks, strict=True):
        rest, _ = after_nuisances(prediction, fitted.pattern, fitted.nuisances)
        within = [beside(prediction, margin) for margin in range(BESIDE, WIDEST + 1)]
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.minimum(np.abs(rest) / prediction.sigma, ROBUST_LIMIT)
        for i, pixels in enumerate((prediction.used & ~within[0], prediction.used & within[0])):
            totals[i] += float(np.sum(z[pixels] ** 2)), float(pixels.sum())
        zones.add(prediction, rest, used, within)
    chi_square = totals[:, 0] / np.maximum(totals[:, 1], 1)
    poor = disagree(float(chi_square[1]), float(chi_square[0]))
    margin, step = zones.margin()
    if poor:
        margin = max(margin, BESIDE)
    left: Masks = []
    while margin >= BESIDE:
        predictions = fitted.forward.predictions(slopes=False)
        left = [
            (used & inner, lit & inner)
            for (used, lit), inner in zip(
                masks, (~beside(prediction, margin) for prediction in predictions), strict=True
            )
        ]
        if sum(int(used.sum()) for used, _ in left) >= LEAST_LEFT * totals[:, 1].sum():
            break
        margin -= 1
    if margin < BESIDE:
        return None
    lost = sum(int(used.sum()) for used, _ in masks) - sum(int(used.sum()) for used, _ in left)
    shifted = f"by up to {step * 1e3:.1f} mm compared with their colour, " if abs(step) > 0 else ""
    return (
        left,
        margin,
        f"excluded: {lost} distances within {margin} px of edges of brightness or surfaces, "
        f"which disagree with the others ({shifted}chi-square per value {chi_square[1]:.1f} against "
        f"{chi_square[0]:.1f}): stray light or blur that these recordings do not resolve",
    )


def disagree(beside: float, elsewhere: float) -> bool:
    """Return whether, by chi-squares per value, pixels beside edges fit badly and worse than the others."""
    return beside >= POOR and beside >= DISAGREE * elsewhere


class _Zones:
    """Differences of distances in zones along edges from those far from any, by colour and pose."""

    def __init__(self) -> None:
        self._found: dict[tuple[int, float], list[float]] = {}

    def add(self, predicted: Prediction, rest: Array, used: Array, within: Sequence[Array]) -> None:
        """Add a station: residuals [m], pixels, and which of them are within each margin, (H, W) each."""
        colours = predicted.view.geometry.reflectivity
        for colour in np.unique(colours[used]):
            mine = used & (colours == colour)
            far = mine & ~within[-1]
            if far.sum() < LEAST_PIXELS:
                continue
            level = float(np.median(rest[far]))
            nearer = np.zeros_like(mine)
            for number, zone in enumerate(within):
                pixels = mine & zone & ~nearer
                nearer = zone
                if pixels.sum() >= LEAST_PIXELS:
                    difference = float(np.median(rest[pixels])) - level
                    self._found.setdefault((number, float(colour)), []).append(difference)

    def margin(self) -> tuple[int, float]:
        """Return up to which margin distances disagree [px] (0: nowhere), and the greatest step [m]."""
        margin, most = 0, 0.0
        for number in range(WIDEST - BESIDE + 1):
            steps = [self._step(values) for (zone, _), values in self._found.items() if zone == number]
            step = max(steps, key=abs, default=0.0)
            if step == 0.0:
                break
            margin = BESIDE + number
            most = max(most, step, key=abs)
        return margin, most

    @staticmethod
    def _step(values: list[float]) -> float:
        """Return the median of the poses' differences, 0 where it is too small or not significant."""
        if len(values) < LEAST_STATIONS:
            return 0.0
        median = float(np.median(values))
        sigma = 1.4826 * 1.2533 * float(np.median(np.abs(np.array(values) - median))) / np.sqrt(len(values))
        return median if abs(median) > max(STEP, 3.0 * sigma) else 0.0


def more_pixels(masks: Sequence[tuple[Array, Array]], others: Sequence[tuple[Array, Array]]) -> bool:
    """Return whether masks (H, W) of the same stations include distances that others exclude."""
    return any(bool((mask[0] & ~other[0]).any()) for mask, other in zip(masks, others, strict=True))
