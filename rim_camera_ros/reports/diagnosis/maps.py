"""The pictures of a diagnosis over the array, as SVG. Importing this needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.reports.diagnosis.classes import region
from rim_camera_ros.reports.diagnosis.evidence import PoseImage, SetupImage
from rim_camera_ros.reports.figures import svg

Array = NDArray[Any]

_GREY = "#5b6878"
#: Pixels that were never compared.
_NEVER = "#c3cad1"
_WIDTH = 10.4


def where(pixels: Array | None, before: Array | None, after: Array, *, title: str) -> bytes:
    """Return maps side by side: the root of where.npy (H, W) in single-frame sigmas with its region outlined,
    and RMS residuals before and after in sigmas of a pose's mean (1: noise) on one scale.
    """
    named = (("before", before), ("after", after))
    residuals = [(word, image) for word, image in named if image is not None]
    if len(residuals) == 1:
        residuals = [("recording - simulation", after)]
    top = max(1.5, _high(residuals[0][1], 0.96))

    def draw(figure: Any) -> None:
        count = len(residuals) + (pixels is not None)
        axes = list(figure.subplots(1, count, squeeze=False)[0])
        for axis in axes:
            axis.grid(False)
            axis.set_facecolor(_NEVER)
            axis.tick_params(labelsize=8)
            axis.set_xlabel("column [px]", fontsize=8)
        axes[0].set_ylabel("row [px]", fontsize=8)
        if pixels is not None:
            axis = axes.pop(0)
            values = np.sqrt(np.maximum(pixels, 0.0))
            picture = axis.imshow(values, cmap="viridis", vmin=0, vmax=_high(values), interpolation="nearest")
            outline = simplified(region(pixels))
            if outline.any() and not outline.all():
                axis.contourf(outline, levels=[-0.5, 0.5], colors="white", alpha=0.35)
                axis.contour(outline, levels=[0.5], colors="white", linewidths=1.3)
            axis.set_title(title)
            _bar(figure, picture, axis, "sigma of a frame", below=True)
        # the scale begins below the noise: its texture stays dark, larger residuals are bright
        low = 0.8 if top < 4 else 0.0
        for axis, (word, image) in zip(axes, residuals, strict=True):
            picture = axis.imshow(image, cmap="viridis", vmin=low, vmax=top, interpolation="nearest")
            axis.set_title(word)
        _bar(figure, picture, axes, "sigma of a pose's mean", below=True)

    count = len(residuals) + (pixels is not None)
    return svg((_WIDTH * min(1.0, 0.36 * count), 3.6), draw)


def _high(values: Array, share: float = 0.99) -> float:
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share)) if finite.size and finite.max() > 0 else 1.0


def simplified(inside: Array) -> Array:
    """Return a region (H, W) for an outline: smoothed, without holes and islands below 1 % of the array."""
    import cv2

    if inside.mean() < 0.15:
        return np.asarray(inside, np.float32)
    size = max(3, int(min(inside.shape) / 24) | 1)
    smooth = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), size / 3)
    for sign in (1, 0):
        count, labels, stats, _ = cv2.connectedComponentsWithStats(
            ((smooth > 0.5) == bool(sign)).astype(np.uint8)
        )
        for k in range(1, count):
            if stats[k, cv2.CC_STAT_AREA] < 0.01 * inside.size:
                smooth[labels == k] = 1.0 - sign
    return np.asarray(smooth)


def pose_image(image: PoseImage) -> bytes:
    """Return one pose: amplitudes, residuals without and with the effects found, and their contribution."""
    import cv2

    def smooth(values: Array) -> Array:
        known = np.isfinite(values)
        weight = cv2.blur(known.astype(np.float64), (3, 3))
        total = cv2.blur(np.where(known, values, 0.0).astype(np.float64), (3, 3))
        return np.asarray(np.where(known, total / np.maximum(weight, 1e-9), np.nan))

    part = image.part * 1e3
    without, after = smooth(image.without), smooth(image.after)
    limit = max(2.0, float(np.nanquantile(np.abs(without), 0.98)))
    most = max(float(np.nanquantile(np.abs(part), 0.995)), 1e-9)

    def draw(figure: Any) -> None:
        axes = figure.subplots(1, 4)
        amplitude = np.where(image.amplitude > 0, image.amplitude, np.nan)
        shown = axes[0].imshow(np.log10(amplitude), cmap="gray", interpolation="nearest")
        _bar(figure, shown, axes[0], "log10 of counts", below=True)
        rows = (
            ("without what was found", without, limit, "sigma"),
            ("with it", after, limit, "sigma"),
            ("what was found", part, most, "mm"),
        )
        for axis, (title, values, top, unit) in zip(axes[1:], rows, strict=True):
            shown = axis.imshow(values, cmap="RdBu_r", vmin=-top, vmax=top, interpolation="nearest")
            axis.set_title(title)
            _bar(figure, shown, axis, unit, below=True)
        axes[0].set_title("amplitude")
        for axis in axes:
            axis.grid(False)
            axis.set(xticks=[], yticks=[])
            axis.set_facecolor(_NEVER)

    return svg((_WIDTH, 2.9), draw)


def recorded_and_simulated(image: SetupImage) -> bytes:
    """Return a pose's recorded and simulated amplitude side by side, and the difference of distances."""
    both = (image.recorded, image.simulated)
    lit = np.concatenate([amplitude[np.isfinite(amplitude) & (amplitude > 0)] for amplitude in both])
    low, high = np.quantile(lit, [0.01, 0.99]) if lit.size else (1.0, 10.0)
    limits = np.log10(max(low, 1.0)), np.log10(max(high, 2.0 * low, 2.0))
    difference = image.difference * 1e3
    known = np.abs(difference[np.isfinite(difference)])
    most = max(float(np.quantile(known, 0.95)) if known.size else 1.0, 1e-9)

    def draw(figure: Any) -> None:
        axes = figure.subplots(1, 3)
        gray = {"cmap": "gray", "vmin": limits[0], "vmax": limits[1], "interpolation": "nearest"}
        both = (("recorded", image.recorded), ("simulated", image.simulated))
        for axis, (word, values) in zip(axes[:2], both, strict=True):
            shown = axis.imshow(np.log10(np.where(values > 0, values, np.nan)), **gray)
            axis.set_title(f"{word} amplitude")
        _bar(figure, shown, list(axes[:2]), "log10 of counts", below=True)
        shown = axes[2].imshow(difference, cmap="RdBu_r", vmin=-most, vmax=most, interpolation="nearest")
        axes[2].set_title("recorded - simulated distance")
        _bar(figure, shown, axes[2], "mm", below=True)
        for axis in axes:
            axis.grid(False)
            axis.set(xticks=[], yticks=[])
            axis.set_facecolor(_NEVER)

    return svg((_WIDTH, 3.6), draw)


def surface(
    knots: Sequence[Sequence[float]],
    values: Array,
    labels: Sequence[str],
    *,
    log: Sequence[bool],
    unit: str,
    image: bool = False,
) -> bytes:
    """Return a table over two covariates as a picture, multilinear between its knots.

    As an ``image`` its values are 0 or more, and rows go downwards.
    """
    from scipy.interpolate import RegularGridInterpolator

    fine = [
        np.geomspace(k[0], k[-1], 161) if scaled else np.linspace(k[0], k[-1], 161)
        for k, scaled in zip(knots, log, strict=True)
    ]
    table = RegularGridInterpolator(tuple(np.asarray(k, float) for k in knots), values)
    x, y = np.meshgrid(*fine, indexing="ij")
    shown = table(np.clip(np.stack([x, y], axis=-1), [k[0] for k in knots], [k[-1] for k in knots]))

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        axis.grid(False)
        limit = float(np.quantile(np.abs(shown), 0.995)) or 1.0
        picture = axis.pcolormesh(
            *fine,
            shown.T,
            cmap="viridis" if image else "RdBu_r",
            vmin=0.0 if image else -limit,
            vmax=limit,
            shading="nearest",
            rasterized=True,
        )
        if image:
            axis.invert_yaxis()
            axis.set_aspect("equal")
        for scaled, side in zip(log, ("x", "y"), strict=True):
            if scaled:
                axis.set(**{f"{side}scale": "log"})
        axis.set(xlabel=labels[0], ylabel=labels[1])
        _bar(figure, picture, axis, unit)

    return svg((6.4, 3.2), draw)


def _bar(figure: Any, picture: Any, axis: Any, unit: str, *, below: bool = False) -> None:
    side = "bottom" if below else "right"
    bar = figure.colorbar(
        picture,
        ax=axis,
        shrink=0.8 if not isinstance(axis, list) else 0.4,
        pad=0.03,
        location=side,
        aspect=30 if below else 20,
    )
    bar.set_label(unit, color=_GREY)
    bar.outline.set_visible(False)
