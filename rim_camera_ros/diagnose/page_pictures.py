"""The sections of a diagnosis' report that show pictures."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.calibrate.exploration import ALARM_RATE, gumbel_quantile
from rim_camera_ros.calibrate.needs import LEAST_SHARE
from rim_camera_ros.diagnose import page_words as words
from rim_camera_ros.diagnose.accuracy import LEFT
from rim_camera_ros.diagnose.page_classes import region
from rim_camera_ros.diagnose.page_evidence import Evidence
from rim_camera_ros.diagnose.result import Diagnosis, Ranked
from rim_camera_ros.diagnose.setup import errors_of_placements
from rim_camera_ros.diagnose.smooth import UNKNOWN
from rim_camera_ros.info.text import several
from rim_camera_ros.reports import html

_MOST_SMOOTH = 3
#: Share of an effect's energy above which it is plain to see and not stated.
_PLAIN = 0.2
_MOST_POSES = 8
#: Chi-square per value of a pose, and errors in sigmas of its instrument, that are shown as disagreeing.
_BAD_CHI, _BAD_ERROR = 4.0, 8.0
_AS_IF = (
    "The errors of the poses are those that the better simulation finds: without it they would hide part "
    "of the difference."
)


def curves(result: Diagnosis, found: Evidence) -> str:
    """Return residuals without and with what was found, over what it depends on."""
    if found.chi_before is None:
        return ""
    from rim_camera_ros.diagnose.page_curves import curves_of
    from rim_camera_ros.diagnose.page_figures import telling

    items = curves_of(result, found)
    if not items:
        return ""
    caption = (
        "Means over classes of pixels; bars: 95 % (1.96 standard errors, by the scatter between poses). "
        f"Without the effect the differences follow its curve, with it {_left(result)}. Each effect is "
        f"shown with all others in place, less its mean. {_AS_IF}"
    )
    return html.figure(telling(items), caption)


def _left(result: Diagnosis) -> str:
    """Return what is left with the effect, in words."""
    after = result.accuracy.chi2_after
    if not after > LEFT:
        return "nothing is left but noise"
    return f"is left what its form does not say (chi-square per value {after:.3g})"


def where(result: Diagnosis, found: Evidence) -> list[str]:
    """Return maps over the array."""
    from rim_camera_ros.diagnose import page_maps

    parts = []
    pixels = np.asarray(result.where.pixels, float)
    shown = pixels.max(initial=0.0) > 0
    caption = ""
    if shown:
        what = "what was left out" if result.missing else "what is still unexplained"
        caption = (
            f"Left: RMS over the poses of {what} (where.npy holds its square); outside of the smallest "
            f"region with 90 % of it paler: the region is {_percent(region(pixels).mean())} of the array"
        )
        if result.where.covariates and result.verdict != "inconsistent_setup":
            listed = words.joined(
                [f"{words.plain_name(n)} ({_percent(s)})" for n, s in result.where.covariates]
            )
            caption += f"; of its variance follow {listed}"
        caption += ". "
        if any(one.effect == "mixed_pixels" for one in result.missing):
            caption += "Mixed pixels count as they measure, between the surfaces beside them. "
    caption += (
        "Differences of distances between recording and simulation: RMS over the poses in standard "
        "deviations of a pose's mean; noise alone: 1. Grey: never compared."
    )
    if found.rms_before is not None:
        caption += f" {_AS_IF}"
    if np.isfinite(found.rms_after).any():
        title = "what was left out" if result.missing else "unexplained"
        picture = page_maps.where(pixels if shown else None, found.rms_before, found.rms_after, title=title)
        parts.append(html.figure(picture, caption))
    parts.append(_brightness(found))
    if found.image is not None:
        caption = (
            f"The pose that shows it best (pose {found.image.pose}, at {found.image.time:.0f} s): "
            "amplitude, recording minus simulation without and with what was found (means of 3 × 3 pixels, "
            "in sigmas of one pixel's mean over the frames), and what it adds. The mean of each pixel over "
            "all poses is taken out."
        )
        parts.append(html.figure(page_maps.pose_image(found.image), caption))
    return parts


def _percent(share: float) -> str:
    return f"{share * 100:.0f} %" if share >= 0.01 or share == 0 else f"{share * 100:.2g} %"


def _brightness(found: Evidence) -> str:
    from rim_camera_ros.reports.figures import Map, maps

    if found.brightness_before is None:
        return ""
    before, after = found.brightness_before * 100, found.brightness_after * 100
    rms = [float(np.sqrt(np.nanmean(np.clip(one, -50, 50) ** 2))) for one in (before, after)]
    if not rms[0] > max(0.5, 1.3 * rms[1]):
        return ""
    top = float(np.nanquantile(np.abs(before), 0.98))
    caption = (
        f"Differences of amplitudes, mean over the poses relative to the amplitude: RMS {rms[0]:.1f} % "
        f"before, {rms[1]:.1f} % after."
    )
    return html.figure(
        maps([Map("before", before, top), Map("after", after, top)], "% of the amplitude"), caption
    )


def poses(result: Diagnosis, found: Evidence) -> list[str]:
    """Return how well each pose agrees, and a table of those that do not."""
    from rim_camera_ros.diagnose import page_figures as figures

    told = errors_of_placements(found.errors)
    errors = {
        int(pose): (size, name.removeprefix("pose.").replace(".", ", "))
        for pose, placed in zip(found.poses, found.placements, strict=True)
        for size, name in [told.get(placed, (0.0, "-"))]
    }
    located = found.strength is not None and bool(result.missing)
    # the light of a second camera moves a pose as a whole: that says nothing of its instrument
    second = result.variance.pixels_vary_together
    bad = [
        i
        for i, (pose, chi) in enumerate(zip(found.poses, found.chi_after, strict=True))
        if not second and (chi > _BAD_CHI or errors[int(pose)][0] > _BAD_ERROR)
    ]
    picture = figures.poses(
        found.times,
        found.chi_before,
        found.chi_after,
        strength=found.strength,
        stretches=result.where.times if located else (),
        marked=bad,
    )
    caption = "Chi-square per value of each pose; noise alone: 1 (dashed)."
    if found.strength is not None:
        caption += " Right: RMS of what was found."
    if located:
        caption += " Shaded: times that hold 90 % of it."
    parts = [html.figure(picture, caption)]
    if bad:
        size_of = {i: errors[int(found.poses[i])][0] for i in bad}
        worst = sorted(bad, key=lambda i: max(float(found.chi_after[i]), size_of[i]), reverse=True)
        rows = []
        for i in worst[:_MOST_POSES]:
            size, name = errors[int(found.poses[i])]
            rows.append(
                [
                    str(found.poses[i]),
                    f"{found.times[i]:.1f}",
                    f"{found.chi_after[i]:.2f}",
                    f"{size:.1f}",
                    name,
                ]
            )
        headings = [
            "pose",
            "at [s]",
            "chi-square per value",
            "error of the pose [sigma of its instrument]",
            "of",
        ]
        parts.append(
            html.paragraph(f"{several(len(bad), 'pose')} of {len(found.poses)} do not agree with the others:")
        )
        parts.append(html.table(headings, rows, numbers=(0, 1, 2, 3)))
    elif second:
        parts.append(html.paragraph("The light of a second camera hides whether the poses agree."))
    elif told and result.verdict != "inconsistent_setup":
        pose, (size, name) = max(errors.items(), key=lambda one: one[1][0])
        parts.append(
            html.paragraph(
                f"All poses agree. The largest error found of a pose is {size:.1f} sigma of its instrument "
                f"({name}, pose {pose})."
            )
        )
    return parts


def _with_share(one: Ranked) -> str:
    label = words.label_of(one.effect)
    if one.identifiability is None or one.identifiability > _PLAIN:
        return label
    return f"{label} ({one.identifiability:.1%})"


def ranking(result: Diagnosis) -> str:
    """Return the gains of all candidates."""
    from rim_camera_ros.diagnose import page_figures as figures

    step = result.baseline
    own = {effect: float(step.thresholds[k]) for effect, k in step.best().items() if step.thresholds.size}
    named = {one.effect for one in result.missing}
    rows: list[tuple[str, float, float | None, str]] = [
        (_with_share(one), one.gain, own.get(one.effect), "named" if one.effect in named else "other")
        for one in result.ranking
    ]
    smooth = sorted(
        (
            (float(step.gains[k]), step.candidates[k].variant, float(step.thresholds[k]))
            for k in range(step.named, len(step.candidates))
        ),
        reverse=True,
    )
    dependent = {c for one in result.missing if one.effect == UNKNOWN for c in one.covariates}
    for gain, variant, threshold in smooth[:_MOST_SMOOTH]:
        kind = "named" if dependent and set(variant.split(",")) <= dependent else "smooth"
        listed = words.joined([words.plain_name(name) for name in variant.split(",")])
        rows.append((f"any smooth function of {listed}", gain, threshold, kind))
    if not rows:
        return ""
    if any(kind == "named" for _, _, _, kind in rows[len(result.ranking) :]):
        # the smooth function is what is unknown: one row tells it
        rows = [row for row in rows if row[0] != words.label_of(UNKNOWN)]
    rows.sort(key=lambda row: -row[1])
    absent = len([row for row in rows if row[3] == "named"]) == 0
    caption = (
        "What each effect alone would gain on held-out poses, everything else fitted with it; logarithmic. "
        "Red: its threshold; with nothing left out chance brings one effect or another beyond its own in "
        "about 2 % of recordings. "
        + ("No effect is named." if absent else "Coloured: what is named.")
        + " Sand: smooth functions without physics, as a check of the vocabulary. "
        "In brackets, where little is left: the share of an effect's signal that no other parameter could "
        "take on in this recording; of a small share a large effect is still seen."
    )
    return html.figure(figures.ranking(rows, threshold=step.threshold), caption)


def nulls(result: Diagnosis) -> str:
    """Return what chance alone would gain, with the scores in it."""
    from rim_camera_ros.diagnose import page_figures as figures

    items = []
    gained = 0.0
    steps = [result.baseline] if result.final is result.baseline else [result.baseline, result.final]
    for step in steps:
        gained = 0.0 if step is result.baseline else max(0.0, result.gained)
        if not step.null_maxima.size or not step.named:
            continue
        leader, k = next(iter(step.best().items()))
        chance, share = float(step.thresholds[k]), LEAST_SHARE * gained
        gained_share = f"{_percent(LEAST_SHARE)} of what was gained"
        limit = (chance, "its threshold") if chance >= share else (share, gained_share)
        rare = gumbel_quantile(step.null_maxima, 1 - ALARM_RATE)
        score = (float(step.gains[k]), f"best effect, {leader}")
        title = "before" if step is result.baseline else "after: is anything left?"
        items.append((title if len(steps) > 1 else "", step.null_maxima, limit, score, rare))
    if not items:
        return ""
    caption = (
        "Grey: the best gain of any effect in recordings simulated from the fitted camera, with noise and "
        "errors of poses like those found but nothing left out. Red: what the best effect must exceed; "
        "dashed: what any effect exceeds by chance in 2 % of the cases. Effects that gain much by chance "
        "have high thresholds of their own (marks above)."
    )
    if len(steps) > 1:
        caption += (
            f" A further effect must also gain {_percent(LEAST_SHARE)} of what was gained before, because a "
            "slight error in the form of a large effect breeds small false ones."
        )
    return html.figure(figures.nulls(items), caption)


def variance(result: Diagnosis) -> str:
    """Return what repeated frames say of the noise."""
    found = result.variance
    if not found.repeated:
        return html.paragraph(
            "No pose was recorded more than once, so that noise cannot be measured: the camera file's is "
            "taken for granted."
        )
    said = f"The variance of repeated frames is {found.ratio:.3f} ± {found.sigma:.3f} times the camera file's"
    if found.pixels_vary_together:
        said += ": with the light of a second camera in it, that says nothing of its noise section."
    else:
        said += f": its noise section {'is contradicted' if found.noise_is_wrong else 'holds'}."
    if found.common is not None:
        said += (
            f" All pixels together vary {found.common:.2f} ± {found.common_sigma:.2f} times as much as "
            "independent noise would"
        )
        said += ": a second camera shines in." if found.pixels_vary_together else "."
    parts = html.paragraph(said)
    if len(found.bins) > 1:
        from rim_camera_ros.diagnose import page_figures as figures

        caption = "Measured over modelled variance by amplitude, with 95 %. Dashed: as the camera file says."
        parts += html.figure(figures.variance(result), caption)
    return parts
