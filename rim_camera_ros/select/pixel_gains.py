"""Gains of single pixels by the recording, compared with the size that the camera file states.

Fits estimate gains within their stated size. Larger gains would count as errors of predicted amplitudes,
whose size is estimated from the residuals: light that goes from pixel to pixel would not be noticed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.fit.design import BEYOND
from rim_camera_ros.fit.pose_errors import WIDER
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.variance_components import PATCH
from rim_camera_ros.select.thresholds import STANDARD_ERRORS

Array = NDArray[Any]

#: Variance of a pixel's log gain less the mean of its four neighbours', for independent gains of variance 1;
#: and that of its mean over a row or column, for independent gains of rows or columns.
_OF_DIFFERENCE, _OF_LINES = 1.25, 0.375
#: Relative 1-sigma of gains, of pixels and of lines, that is ordinary whatever the camera file states.
ORDINARY_GAINS = 0.01
#: Relative 1-sigma of gains where neighbours share them: a window may be covered by dust to any degree.
UNKNOWN_GAINS = 0.5


@dataclass(frozen=True)
class GainSpread:
    """1-sigma of the gains of neighbouring pixels: ``found``, its lower limit ``least``, and ``stated``.

    ``lines`` is the lower limit of the 1-sigma of gains that whole rows or columns share, apart from the mean
    of their pixels' own gains; ``shared`` that of the mean gains of cells of `PATCH` by `PATCH` pixels.
    ``relative_to_neighbours`` (H, W) is by how much each pixel is brighter than the mean of its four
    neighbours [relative], as a mean over the poses; NaN where less than two poses show it.
    """

    found: float
    least: float
    stated: float
    relative_to_neighbours: Array = field(repr=False, compare=False)
    lines: float = 0.0
    shared: float = 0.0

    @property
    def is_shared(self) -> bool:
        """Whether means of neighbours err by more than independent gains would make them, as by dust."""
        return self.shared > WIDER * max(self.found, self.stated, ORDINARY_GAINS) / PATCH

    @property
    def are_unknown(self) -> bool:
        """Whether gains must be unknown, as neighbours share them, and are not beyond what is stated."""
        return self.stated < UNKNOWN_GAINS and self.is_shared and not self.is_beyond

    def note_of_shared(self) -> str:
        """Return in words what gains that neighbours share are, and what was done."""
        return (
            f"neighbouring pixels differ together in gain, by {self.shared:.1%} or more (cells of {PATCH} x "
            f"{PATCH} px), as dust on the window or a rim of the lens would make them; gains are unknown "
            "here, so that only changes of amplitudes from pose to pose count"
        )

    @property
    def is_beyond(self) -> bool:
        """Whether gains are larger than the camera file allows, and larger than ordinary."""
        return self.least > BEYOND * max(self.stated, ORDINARY_GAINS) or self.are_of_lines

    @property
    def are_of_lines(self) -> bool:
        """Whether gains of rows or columns, which no file states, are larger than ordinary."""
        return self.lines > BEYOND * ORDINARY_GAINS

    @property
    def of_line_means(self) -> float:
        """Lower limit of the 1-sigma of the difference between means over a row or column and neighbours'."""
        return self.lines * float(np.sqrt(_OF_LINES))


def spread_of_gains(fitted: Fit) -> GainSpread | None:
    """Return how much neighbouring pixels differ in gain; None where less than two poses show it.

    The estimate is from products over two poses of the difference of a pixel's log brightness from the mean
    of its four neighbours on the same tile: noise is independent between poses, and what is smooth over the
    array cancels. A texture that the scene file lacks counts as gains where it rests before the camera.
    """
    forward = fitted.forward
    shape = forward.camera.shape
    placed: dict[tuple[int, int], tuple[Array, Array]] = {}
    cells: dict[tuple[int, int], tuple[Array, Array]] = {}
    for prediction in forward.predictions(slopes=False):
        lit = prediction.amplitude_used & (prediction.station.amplitude > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            light = np.where(lit, np.log(prediction.station.amplitude / prediction.model_reading), np.nan)
        if forward.amplitude_model.pixels is not None:
            light = light + forward.amplitude_model.pixels
        key = (prediction.station.recording, prediction.station.placed)
        apart, count = placed.setdefault(key, (np.zeros(shape), np.zeros(shape)))
        sums, pixels = cells.setdefault(key, _no_cells(shape))
        sums += _in_cells(np.nan_to_num(light))
        pixels += _in_cells(np.isfinite(light))
        own = _relative_to_neighbours(light, prediction.view.geometry.tile)
        seen = np.isfinite(own)
        apart[seen] += own[seen]
        count += seen
    images = [np.where(count > 0, apart / np.maximum(count, 1), np.nan) for apart, count in placed.values()]
    of_pixels = _variance(images)
    if of_pixels is None:
        return None
    found, least = (float(np.sqrt(max(pixel, 0.0) / _OF_DIFFERENCE)) for pixel in of_pixels)
    brighter, poses = _totals(images)
    brighter = np.where(poses > 1, brighter / np.maximum(poses, 1), np.nan)
    stated = fitted.equations.pixels.gain
    lines = max(_of_lines(images, axis) for axis in (0, 1))
    return GainSpread(found, least, stated, brighter, lines, _shared(list(cells.values())))


def _no_cells(shape: tuple[int, ...]) -> tuple[Array, Array]:
    return _in_cells(np.zeros(shape)), _in_cells(np.zeros(shape))


def _in_cells(image: Array) -> Array:
    """Return the sums of an image over cells of `PATCH` by `PATCH` pixels, of which an end may be left."""
    rows, columns = (size // PATCH for size in image.shape)
    whole = image[: rows * PATCH, : columns * PATCH].astype(float)
    return np.asarray(whole.reshape(rows, PATCH, columns, PATCH).sum(axis=(1, 3)))


def _shared(cells: Sequence[tuple[Array, Array]]) -> float:
    """Return the lower limit of the 1-sigma of the mean gains of cells; 0 where it is not determined.

    ``cells`` are sums of log brightness and numbers of pixels of each pose. The mean of a pose is subtracted:
    it is due to the emitted power.
    """
    images = []
    for total, count in cells:
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.where(2 * count >= PATCH**2, total / count, np.nan)
        if np.isfinite(mean).any():
            images.append(mean - np.nanmean(mean))
    found = _variance(images) if images else None
    return 0.0 if found is None else float(np.sqrt(max(found[1], 0.0)))


def _totals(images: Sequence[Array], *, square: bool = False) -> tuple[Array, Array]:
    """Return the sum of images (H, W; NaN: not seen) or of their squares, and how many show each pixel."""
    total, count = np.zeros(images[0].shape), np.zeros(images[0].shape)
    for image in images:
        seen = np.isfinite(image)
        total[seen] += image[seen] ** 2 if square else image[seen]
        count += seen
    return total, count


def _variance(images: Sequence[Array]) -> tuple[float, float] | None:
    """Return the variance of what pixels show in all poses, and its lower limit; None: it is not determined.

    It is the mean product of two ``images`` (H, W; NaN: not seen), whose noise is independent.
    """
    (total, poses), (squares, _) = _totals(images), _totals(images, square=True)
    several = poses > 1
    if several.sum() < 2:
        return None
    return _mean_product((total**2 - squares)[several], (poses * (poses - 1))[several])


def _of_lines(images: Sequence[Array], axis: int) -> float:
    """Return the lower limit of the 1-sigma of gains of lines along an ``axis``; 0 where not determined.

    It is from products of two pixels of a line in two poses: gains of single pixels do not contribute. The
    mean of all pixels is subtracted, as it is due to the light.
    """
    total, poses = _totals(images)
    if not poses.any():
        return 0.0
    common = total.sum() / poses.sum()
    squares, _ = _totals([image - common for image in images], square=True)
    total = total - common * poses
    sums = np.array([np.nansum(image - common, axis=axis) for image in images])
    counts = np.array([np.isfinite(image).sum(axis=axis) for image in images])
    products = sums.sum(axis=0) ** 2 - (sums**2).sum(axis=0) - (total**2 - squares).sum(axis=axis)
    pairs = counts.sum(axis=0) ** 2 - (counts**2).sum(axis=0) - (poses**2 - poses).sum(axis=axis)
    several = pairs > 0
    if several.sum() < 2:
        return 0.0
    _, least = _mean_product(products[several], pairs[several])
    return float(np.sqrt(max(least, 0.0) / _OF_LINES))


def _mean_product(products: Array, pairs: Array) -> tuple[float, float]:
    """Return the mean of ``products`` (N,), each a sum over so many ``pairs``, and its lower limit."""
    mean = float(products.sum() / pairs.sum())
    error = float(np.sqrt(np.sum((products - mean * pairs) ** 2)) / pairs.sum())
    return mean, mean - STANDARD_ERRORS * error


def _relative_to_neighbours(image: Array, tile: Array) -> Array:
    """Return an image less the mean of its four neighbours (H, W), NaN where they see another tile."""
    result = np.full(image.shape, np.nan)
    inner = (slice(1, -1), slice(1, -1))
    sides = [(slice(1, -1), slice(2, None)), (slice(1, -1), slice(None, -2))]
    sides += [(slice(2, None), slice(1, -1)), (slice(None, -2), slice(1, -1))]
    alike = np.all([tile[side] == tile[inner] for side in sides], axis=0)
    apart = image[inner] - np.mean([image[side] for side in sides], axis=0)
    result[inner] = np.where(alike, apart, np.nan)
    return result
