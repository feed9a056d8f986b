"""The demonstration's picture: truth, before, after, error."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rim_camera_ros.demo.evaluate import Comparison


def draw(comparison: Comparison, path: Path) -> None:
    """Write one PNG of the last frame: the known scene, raw and corrected errors, and their histograms."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    c = comparison
    figure, axes = plt.subplots(2, 3, figsize=(15, 8.2), constrained_layout=True)
    figure.suptitle(
        f"SR-3000 with every effect on, before and after the correction ({c.frames} frames, last one shown)"
    )
    raw = c.truth + c.raw_error
    span = (float(np.nanpercentile(c.truth, 1)), float(np.nanpercentile(c.truth, 99)))
    panels = (
        (axes[0, 0], c.truth, "known scene: radial distance", "m", "viridis", span),
        (axes[0, 1], raw, "before: raw distance", "m", "viridis", span),
        (
            axes[0, 2],
            c.corrected,
            "after: corrected distance\n(white: too dark, saturated or no measurement)",
            "m",
            "viridis",
            span,
        ),
        (axes[1, 0], c.raw_error * 1e3, "error before", "mm", "RdBu_r", (-600.0, 600.0)),
        (
            axes[1, 1],
            c.corrected_error * 1e3,
            "error after\n(white: also mixed pixels)",
            "mm",
            "RdBu_r",
            (-60.0, 60.0),
        ),
    )
    for axis, values, title, unit, colours, limits in panels:
        image = axis.imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1], interpolation="nearest")
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("column [px]")
        axis.set_ylabel("row [px]")
        figure.colorbar(image, ax=axis, label=unit, shrink=0.85)
    axis = axes[1, 2]
    usable = np.isfinite(c.corrected_error)
    bins = np.linspace(-600, 600, 241)
    for values, label, colour in (
        (c.raw_error[usable], f"before: RMS {c.before.rms * 1e3:.0f} mm", "tab:red"),
        (c.corrected_error[usable], f"after: RMS {c.after.rms * 1e3:.0f} mm", "tab:blue"),
    ):
        axis.hist(np.clip(values * 1e3, -599, 599), bins=bins, alpha=0.65, label=label, color=colour)
    axis.set_yscale("log")
    axis.set_xlabel("error [mm], clipped at ±600 mm")
    axis.set_ylabel("pixels of the last frame")
    axis.set_title("the same pixels before and after", fontsize=10)
    axis.legend(fontsize=9)
    figure.savefig(path, dpi=90)
    plt.close(figure)
