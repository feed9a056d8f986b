"""The pictures of a diagnosis as SVG. Importing this needs matplotlib."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.diagnose.result import Diagnosis
from rim_camera_ros.reports.diagnosis.classes import Bins
from rim_camera_ros.reports.figures import AFTER, BEFORE, svg

Array = NDArray[Any]

INK, GREY, PALE = "#1d2733", "#5b6878", "#c3ccd5"
#: Smooth functions of a covariate, which are no physics.
SMOOTH = "#d9c9a3"
_WIDTH = 10.4
_NATS = "held-out gain [nats]"


@dataclass(frozen=True)
class Clock:
    """Unit of a time axis: seconds in one, and its name."""

    seconds: float
    unit: str

    @classmethod
    def of(cls, times: Array) -> Clock:
        """Return a unit that suits times [s]."""
        span = float(np.max(times)) if np.size(times) else 0.0
        if span > 3 * 3600:
            return cls(3600.0, "h")
        return cls(60.0, "min") if span > 300 else cls(1.0, "s")


def proof(before: tuple[float, float], after: tuple[float, float], noise: float) -> bytes:
    """Return RMS [m] and chi-square per value of held-out poses, before and after, against the noise [m]."""

    def draw(figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        figure.get_layout_engine().set(wspace=0.1)
        rows = (
            (left, [1e3 * before[0], 1e3 * after[0]], 1e3 * noise, "RMS [mm]", "noise"),
            (right, [before[1], after[1]], 1.0, "chi-square per value", "noise: 1"),
        )
        for axis, values, floor, label, word in rows:
            everything = np.array([*values, floor])
            if everything.min() > 0 and everything.max() / everything.min() > 6:
                axis.set_xscale("log")
                axis.set_xlim(0.75 * everything.min(), 1.35 * everything.max())
                axis.xaxis.set_minor_formatter("")
                axis.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
            else:
                span = max(float(np.ptp(everything)), 0.02 * floor)
                axis.set_xlim(everything.min() - 0.25 * span, everything.max() + 0.25 * span)
            axis.axvline(floor, color=GREY, lw=1, ls=(0, (4, 3)), label=word)
            axis.annotate(
                "",
                (values[1], 0.5),
                (values[0], 0.5),
                arrowprops={"arrowstyle": "-|>", "color": GREY, "lw": 1},
            )
            axis.plot(values[0], 0.5, "o", ms=8, color=BEFORE, label="before")
            axis.plot(values[1], 0.5, "o", ms=8, color=AFTER, label="after")
            axis.set(yticks=[], ylim=(0, 1), xlabel=label)
            if axis.get_xscale() == "linear":
                axis.locator_params(axis="x", nbins=5)
            axis.spines["left"].set_visible(False)
            axis.grid(axis="y", visible=False)
        handles, labels = left.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=3)

    return svg((7.6, 1.45), draw)


def ranking(
    rows: Sequence[tuple[str, float, float | None, str]], *, threshold: float, unit: str = _NATS
) -> bytes:
    """Return gains as bars on a logarithmic scale: rows of label, gain [nats], own threshold, kind.

    Kinds are ``named``, ``other`` and ``smooth``. Gains below a nat are no bars but a word.
    """
    colours = {"named": AFTER, "other": PALE, "smooth": SMOOTH}

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        places = np.arange(len(rows))[::-1]
        top = max([threshold, *(gain for _, gain, _, _ in rows)])
        for place, (_, gain, own, kind) in zip(places, rows, strict=True):
            if gain > 1.0:
                axis.barh(place, gain - 1.0, left=1.0, height=0.62, color=colours[kind])
            words = f"{gain:,.0f}" if gain >= 9.5 else f"{gain:.1f}" if gain > 1 else "no gain"
            style: dict[str, Any] = (
                {"fontweight": "bold", "color": INK} if kind == "named" else {"color": GREY}
            )
            # the label is beyond a threshold that is next to the end of the bar
            end = max(gain, 1.0)
            if own is not None and end < own < end * (top * 1.6) ** 0.12:
                end = own
            axis.text(end * (top * 1.6) ** 0.008, place, words, va="center", fontsize=8, **style)
            if own is not None:
                axis.plot([own, own], [place - 0.4, place + 0.4], color="#a8324a", lw=1.1)
        axis.set_xscale("log")
        axis.set_xlim(1.0, top**1.12 * 1.6)
        axis.minorticks_off()
        axis.set_yticks(places, [label for label, *_ in rows])
        axis.set_ylim(-0.6, len(rows) - 0.4)
        axis.tick_params(axis="y", length=0)
        axis.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}")
        axis.set_xlabel(unit)
        axis.grid(axis="y", visible=False)

    return svg((8.6, 0.65 + 0.235 * len(rows)), draw)


def nulls(items: Sequence[tuple[str, Array, tuple[float, str], tuple[float, str], float]]) -> bytes:
    """Return histograms of the best gains by chance with threshold and score.

    Items are title, gains of the nulls (R,) [nats], threshold and score, both with their words, and the gain
    that the best of all effects exceeds by chance in 2 % of the cases.
    """

    def draw(figure: Any) -> None:
        axes = figure.subplots(1, len(items), squeeze=False)[0]
        for axis, (title, maxima, (threshold, limit), (score, word), rare) in zip(axes, items, strict=True):
            chance = max(float(maxima.max()), rare, 1.0)
            most = max(threshold, score)
            far = most > 4 * chance
            low = min(float(np.quantile(maxima, 0.002)), score, 0.0)
            middle = 1.3 * chance
            edges = np.linspace(min(low, float(maxima.min())), float(maxima.max()) + 1e-6, 26)
            axis.hist(maxima, edges, color=PALE)
            if far:
                # linear where the nulls are, logarithmic to where the score is
                axis.set_xscale("symlog", linthresh=middle, linscale=3.0)
                near = [
                    k * 10.0**n
                    for n in range(5)
                    for k in (1, 2, 5)
                    if 0.2 * middle < k * 10.0**n < 0.9 * middle
                ]
                beyond = [10.0**k for k in range(9) if 1.5 * middle < 10.0**k < 4 * most]
                axis.set_xticks(sorted({0.0, *near, *beyond}))
                axis.set_xlim(low - 0.05 * middle, 4 * most)
                axis.minorticks_off()
                axis.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}")
            else:
                axis.set_xlim(low - 0.05 * (most - low), 1.15 * max(most, chance))
            axis.axvline(threshold, color="#a8324a", lw=1.2, label=f"{limit}: {threshold:,.1f}")
            axis.axvline(
                rare, color="#a8324a", lw=1.1, ls=(0, (4, 3)), label=f"any effect by chance, 2 %: {rare:,.1f}"
            )
            number = f"{score:,.0f}" if abs(score) >= 10 else f"{score:.1f}"
            axis.axvline(score, color=AFTER if score > threshold else INK, lw=2, label=f"{word}: {number}")
            axis.set(title=title, xlabel=_NATS, ylabel=f"of {maxima.size} simulated recordings")
            axis.set_ylim(0, 1.7 * axis.get_ylim()[1])
            axis.legend(loc="upper center", frameon=True, framealpha=0.92, edgecolor="none")
            axis.grid(axis="x", visible=False)

    return svg((_WIDTH * min(1.0, 0.55 * len(items)), 2.6), draw)


@dataclass(frozen=True)
class Telling:
    """One curve: classes of a covariate with means of (without, after, effect) in the unit of ``y``.

    ``effect`` is what is modelled, (x, y) over finer classes; ``lines`` further curves by label; ``diagonal``
    draws y = x in its place; ``discrete`` a dash at each of a few values; ``band`` 95 % around the effect.
    """

    title: str
    x: str
    y: str
    bins: Bins
    effect: tuple[Array, Array]
    log: bool = False
    diagonal: bool = False
    lines: tuple[tuple[str, Array, Array], ...] = ()
    discrete: bool = False
    band: bool = False


def telling(items: Sequence[Telling]) -> bytes:
    """Return residuals without and with an effect over its covariate, and the effect itself."""
    columns = min(len(items), 3)
    rows = -(-len(items) // columns)
    width = (6.4, 5.2, 3.5)[columns - 1]

    def draw(figure: Any) -> None:
        axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
        handles: dict[str, Any] = {}
        for axis, experiment in zip(axes, items, strict=False):
            _draw_telling(axis, experiment)
            for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
                handles.setdefault(label, handle)
        for axis in axes[len(items) :]:
            axis.set_visible(False)
        figure.legend(handles.values(), handles.keys(), loc="outside upper left", ncols=5)

    return svg((width * columns, 0.35 + (2.9 if columns < 3 else 2.6) * rows), draw)


def _draw_telling(axis: Any, experiment: Telling) -> None:
    without, after, effect = experiment.bins.means
    width = 1.96 * experiment.bins.errors[1]
    if experiment.band:
        axis.fill_between(
            experiment.bins.x, effect - width, effect + width, color=GREY, alpha=0.25, lw=0, label="95 %"
        )
    axis.axhline(0.0, color="#9aa5b1", lw=0.8)
    dashes = {"ls": "none", "marker": "_", "ms": 14, "mew": 2} if experiment.discrete else {"lw": 1.6}
    if experiment.diagonal:
        reach = [float(experiment.bins.x.min()), float(experiment.bins.x.max())]
        axis.plot(reach, reach, color=INK, lw=1.6, label="the effect as modelled")
    else:
        axis.plot(*experiment.effect, color=INK, label="the effect as modelled", **dashes)
    for label, x, y in experiment.lines:
        axis.plot(x, y, color="#7a4f9a", lw=1.2, ls=(0, (5, 2)), label=label)
    # the contribution of the effect is known: both means are as uncertain as the residual
    bars = {"yerr": width, "fmt": "o", "ms": 3.6, "lw": 1.1, "capsize": 0}
    axis.errorbar(experiment.bins.x, without, color=BEFORE, label="recording - simulation without it", **bars)
    axis.errorbar(experiment.bins.x, after, color=AFTER, label="with it", **bars)
    axis.set(title=textwrap.fill(experiment.title, 42), xlabel=experiment.x, ylabel=experiment.y)
    if experiment.log:
        _logarithmic(axis)
    if experiment.discrete:
        axis.set_xticks(experiment.bins.x, [f"{x:g}" for x in experiment.bins.x])
        span = max(float(np.ptp(experiment.bins.x)), 1.0)
        axis.set_xlim(experiment.bins.x.min() - 0.15 * span, experiment.bins.x.max() + 0.15 * span)


def _logarithmic(axis: Any) -> None:
    """Make the horizontal axis logarithmic, with round numbers that do not overlap."""
    from matplotlib.ticker import LogLocator

    axis.set_xscale("log")
    low, high = axis.get_xlim()
    decades = np.log10(high / low)
    steps = (1.0, 2.0, 5.0) if decades < 2.2 else (1.0, 3.0) if decades < 3.2 else (1.0,)
    axis.xaxis.set_major_locator(LogLocator(subs=steps, numticks=12))
    axis.minorticks_off()
    axis.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}" if x >= 1 else f"{x:g}")


def poses(
    times: Array,
    chi_before: Array | None,
    chi_after: Array,
    *,
    strength: Array | None,
    stretches: Sequence[tuple[float, float]],
    marked: Sequence[int] = (),
) -> bytes:
    """Return chi-square per value of every pose over time [s], and the RMS [m] of the effects in each.

    ``stretches`` of time [s] are shaded; ``marked`` stations are ringed.
    """
    clock = Clock.of(times)

    def draw(figure: Any) -> None:
        axes = np.ravel(figure.subplots(1, 1 if strength is None else 2, squeeze=False))
        t = times / clock.seconds
        least = 0.004 * max(float(np.ptp(t)), 1e-9)
        for axis in axes:
            for low, high in stretches:
                low, high = low / clock.seconds, high / clock.seconds
                axis.axvspan(low - least, high + least, color="#eef1f4", lw=0, zorder=0)
            axis.set_xlabel(f"time since the first frame [{clock.unit}]")
        axis = axes[0]
        axis.axhline(1.0, color=GREY, lw=0.9, ls=(0, (4, 3)))
        if chi_before is not None:
            axis.plot(t, chi_before, "o", ms=4, color=BEFORE, label="before")
        label = "" if chi_before is None else "after"
        axis.plot(t, chi_after, "o", ms=4, color=AFTER, label=label)
        if len(marked):
            chosen = list(marked)
            axis.plot(
                t[chosen], chi_after[chosen], "o", ms=10, mfc="none", mec="#a8324a", mew=1.4, label="disagree"
            )
        everything = np.concatenate([chi_after, chi_after if chi_before is None else chi_before])
        if np.nanmax(everything) > 6 * np.nanmin(everything):
            axis.set_yscale("log")
            axis.yaxis.set_major_formatter(lambda x, _: f"{x:g}")
            axis.yaxis.set_minor_formatter("")
        axis.set(title="how well each pose agrees", ylabel="chi-square per value")
        if chi_before is not None or len(marked):
            axis.legend(loc="best")
        if strength is not None:
            axes[1].vlines(t, 0, 1e3 * strength, color=INK, lw=2)
            axes[1].set(title="what was found, in each pose", ylabel="RMS [mm]")
            axes[1].set_ylim(bottom=0)

    return svg((_WIDTH if strength is not None else 6.4, 2.6), draw)


def variance(result: Diagnosis) -> bytes:
    """Return measured over modelled variance of repeated frames over the amplitude."""
    bins = result.variance.bins

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        axis.axhline(1.0, color=GREY, lw=0.9, ls=(0, (4, 3)))
        x = [variance_bin.amplitude for variance_bin in bins]
        y = [variance_bin.ratio for variance_bin in bins]
        axis.errorbar(
            x,
            y,
            yerr=[1.96 * variance_bin.sigma for variance_bin in bins],
            fmt="o",
            ms=4,
            lw=1.2,
            color=BEFORE,
        )
        _logarithmic(axis)
        reach = max(0.1, 1.25 * max(abs(v - 1) for v in y))
        axis.set_ylim(1 - reach, 1 + reach)
        axis.set(xlabel="amplitude [counts]", ylabel="measured / modelled variance")

    return svg((5.6, 2.4), draw)
