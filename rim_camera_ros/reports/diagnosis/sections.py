"""The sections of a diagnosis' report that show pictures."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.diagnose.accuracy import LEFT
from rim_camera_ros.diagnose.result import Diagnosis
from rim_camera_ros.diagnose.setup import errors_of_placements
from rim_camera_ros.effects import vocabulary
from rim_camera_ros.info.text import several
from rim_camera_ros.reports.diagnosis import words
from rim_camera_ros.reports.diagnosis.classes import region
from rim_camera_ros.reports.diagnosis.evidence import Evidence
from rim_camera_ros.reports.page import Figure, Part, Table, Text
from rim_camera_ros.reports.words import joined, percent

_MOST_POSES = 8
#: Chi-square per value of a pose, and errors in sigmas of its instrument, that are shown as disagreeing.
_BAD_CHI, _BAD_ERROR = 4.0, 8.0
_AS_IF = (
    "The errors of the poses are those that the better simulation finds: without it they would hide part "
    "of the difference."
)


def curves(result: Diagnosis, found: Evidence) -> list[Part]:
    """Return residuals without and with the effects found, over their covariates."""
    if found.chi_before is None:
        return []
    from rim_camera_ros.reports.diagnosis.curves import curves_of
    from rim_camera_ros.reports.diagnosis.figures import telling

    items = curves_of(result, found)
    if not items:
        return []
    caption = (
        "Means over classes of pixels; bars: 95 % (1.96 standard errors, by the scatter between poses). "
        f"Without the effect the differences follow its curve, with it {_left(result)}. Each effect is "
        f"shown with all others in place, less its mean. {_AS_IF}"
    )
    titles = joined([experiment.title for experiment in items])
    alt = f"Differences with and without {titles}, over {items[0].x}"
    return [Figure(telling(items), alt, caption)]


def _left(result: Diagnosis) -> str:
    """Return the remainder with the effect, in words."""
    after = result.accuracy.chi2_after
    if not after > LEFT:
        return "nothing is left but noise"
    return f"a remainder is left that its form does not explain (chi-square per value {after:.3g})"


def where(result: Diagnosis, found: Evidence) -> list[Part]:
    """Return maps over the array."""
    from rim_camera_ros.reports.diagnosis import maps as page_maps

    parts: list[Part] = []
    pixels = np.asarray(result.where.pixels, float)
    shown = pixels.max(initial=0.0) > 0
    caption = ""
    if shown:
        what = "the missing physics" if result.missing else "what is still unexplained"
        caption = (
            f"Left: RMS over the poses of {what} (where.npy holds its square); outside of the smallest "
            f"region with 90 % of it paler: the region is {percent(region(pixels).mean())} of the array"
        )
        if result.where.covariates and result.verdict != "inconsistent_setup":
            listed = joined([f"{words.plain_name(n)} ({percent(s)})" for n, s in result.where.covariates])
            caption += f"; of its variance follow {listed}"
        caption += ". "
        if any(
            vocabulary()[effect.effect].at_edges for effect in result.missing if effect.effect in vocabulary()
        ):
            caption += "Mixed pixels count as they measure, between the surfaces beside them. "
    caption += (
        "Differences of distances between recording and simulation: RMS over the poses in standard "
        "deviations of a pose's mean; noise alone: 1. Grey: never compared."
    )
    if found.rms_before is not None:
        caption += f" {_AS_IF}"
    if np.isfinite(found.rms_after).any():
        title = "missing physics" if result.missing else "unexplained"
        picture = page_maps.where(pixels if shown else None, found.rms_before, found.rms_after, title=title)
        alt = "Maps over the image of what differs, before and after"
        parts.append(Figure(picture, alt, caption))
    parts += _brightness(found)
    if found.image is not None:
        caption = (
            f"The pose that shows it best (pose {found.image.pose}, at {found.image.time:.0f} s): "
            "amplitude, recording minus simulation without and with what was found (means of 3 × 3 pixels, "
            "in sigmas of one pixel's mean over the frames), and what it adds. The mean of each pixel over "
            "all poses is taken out."
        )
        alt = f"Pose {found.image.pose}: amplitude, differences without and with what was found"
        parts.append(Figure(page_maps.pose_image(found.image), alt, caption))
    return parts


def _brightness(found: Evidence) -> list[Part]:
    from rim_camera_ros.reports.figures import Map, maps

    # surfaces of unknown reflectivity have none anywhere
    if found.brightness_before is None or not np.isfinite(found.brightness_before).any():
        return []
    before, after = found.brightness_before * 100, found.brightness_after * 100
    rms = [float(np.sqrt(np.nanmean(np.clip(image, -50, 50) ** 2))) for image in (before, after)]
    if not rms[0] > max(0.5, 1.3 * rms[1]):
        return []
    top = float(np.nanquantile(np.abs(before), 0.98))
    caption = (
        f"Differences of amplitudes, mean over the poses relative to the amplitude: RMS {rms[0]:.1f} % "
        f"before, {rms[1]:.1f} % after."
    )
    picture = maps([Map("before", before, top), Map("after", after, top)], "% of the amplitude")
    return [Figure(picture, "Maps of the differences of amplitudes before and after", caption)]


def poses(result: Diagnosis, found: Evidence) -> list[Part]:
    """Return how well each pose agrees, and a table of those that do not."""
    from rim_camera_ros.reports.diagnosis import figures

    greatest = errors_of_placements(found.errors)
    errors = {
        int(pose): (size, name.removeprefix("pose.").replace(".", ", "))
        for pose, placed in zip(found.poses, found.placements, strict=True)
        for size, name in [greatest.get(placed, (0.0, "-"))]
    }
    located = found.strength is not None and bool(result.missing)
    # the light of a second camera moves a pose as a whole: that is no error of its instrument
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
    alt = f"Chi-square per value of {several(len(found.poses), 'pose')} over time"
    parts: list[Part] = [Figure(picture, alt, caption)]
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
        parts.append(Text(f"{several(len(bad), 'pose')} of {len(found.poses)} do not agree with the others:"))
        parts.append(Table(headings, rows, numbers=(0, 1, 2, 3)))
    elif second:
        parts.append(Text("The light of a second camera hides whether the poses agree."))
    elif greatest and result.verdict != "inconsistent_setup":
        pose, (size, name) = max(errors.items(), key=lambda item: item[1][0])
        parts.append(
            Text(
                f"All poses agree. The largest error found of a pose is {size:.1f} sigma of its instrument "
                f"({name}, pose {pose})."
            )
        )
    return parts


def variance(result: Diagnosis) -> list[Part]:
    """Return the evidence of repeated frames on the noise."""
    found = result.variance
    if not found.repeated:
        return [
            Text(
                "No pose was recorded more than once, so that noise cannot be measured: the camera file's is "
                "taken for granted."
            )
        ]
    said = f"The variance of repeated frames is {found.ratio:.3f} ± {found.sigma:.3f} times the camera file's"
    if found.pixels_vary_together:
        said += ": as it contains light of a second camera, it is no evidence on the noise section."
    else:
        said += f": its noise section {'is contradicted' if found.noise_is_wrong else 'holds'}."
    if found.common is not None:
        said += (
            f" All pixels together vary {found.common:.2f} ± {found.common_sigma:.2f} times as much as "
            "independent noise would"
        )
        said += ": there is light of a second camera." if found.pixels_vary_together else "."
    parts: list[Part] = [Text(said)]
    if len(found.bins) > 1:
        from rim_camera_ros.reports.diagnosis import figures

        caption = "Measured over modelled variance by amplitude, with 95 %. Dashed: as the camera file says."
        alt = "Measured over modelled variance of repeated frames over the amplitude"
        parts.append(Figure(figures.variance(result), alt, caption))
    return parts
