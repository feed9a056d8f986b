"""The report of a calibration: its accuracy, each effect, and what the recordings do not determine."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.effect_status import EffectStatus
from rim_camera_ros.calibrate.run import Calibration
from rim_camera_ros.effects import PixelMap, vocabulary
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.info.text import several
from rim_camera_ros.reports import calibration_details as details
from rim_camera_ros.reports.calibration_details import in_mm, poses_of, stated
from rim_camera_ros.reports.effect_errors import EffectError, effect_errors
from rim_camera_ros.reports.figures import (
    Map,
    maps,
)
from rim_camera_ros.reports.page import (
    Bullets,
    Card,
    Figure,
    Mood,
    Part,
    Table,
    Tagged,
    render,
)
from rim_camera_ros.reports.walls import Wall, distances_of, setting_of, uncertainty
from rim_camera_ros.reports.words import joined, millimetres, noise_words

Array = NDArray[Any]

_MOODS: dict[str, tuple[str, Mood]] = {
    "fitted": ("fitted", "good"),
    "kept": ("kept", ""),
    "absent": ("absent", ""),
    "undetermined": ("not determined", "warn"),
    "left out": ("not fitted", ""),
}
#: Most effects that are named in the first sentence.
_MOST_OPEN = 2


def calibration_page(result: Calibration, *, title: str) -> str:
    """Return the report of a calibration as one HTML page."""
    accuracy = stated(result)
    # a page of a refused result is made where it is forced
    notes = [*(f"written as asked, though {reason}" for reason in result.refused), *result.notes]
    return render(
        "calibration",
        title=f"Calibration {title}",
        under=(
            f"{result.camera.device}: {several(result.frames, 'frame')} of {several(result.poses, 'pose')} "
            f"in {several(len(result.sources), 'recording')}, {result.camera.provenance.get('date', '')}"
        ),
        first=first_sentence(result),
        mood="good" if accuracy.after < accuracy.before else "warn",
        cards=_cards(result),
        notes=[Bullets(notes)] if notes else [],
        errors=_errors(result),
        uncertainty=_uncertainty(result),
        effects=_effects(result),
        curves=[*details.curves(result), *details.pattern(result)],
        parameters=[*details.parameters(result), *details.correlations(result)],
        whose=poses_of(accuracy),
        residuals=details.errors_over(result),
        integral=details.by_table(result),
        noise=details.noise(result),
        validity=details.validity(result),
        provenance=details.provenance(result),
    )


def first_sentence(result: Calibration) -> str:
    """Return the calibration in a sentence: accuracy, range, fitted effects, what to record next."""
    accuracy = stated(result)
    good = millimetres(accuracy.after)
    lead = (
        f"Good to {good}" if accuracy.after < accuracy.before else f"No better than the file before: {good}"
    )
    valid = result.camera.validity.distance
    if valid is not None:
        lead += f" between {valid[0]:.2g} and {valid[1]:.2g} m"
    lead += f" (file before: {millimetres(accuracy.before)}; "
    lead += f"noise of the averaged frames: {millimetres(accuracy.noise)})"
    if not accuracy.held_out:
        lead += ", on the poses that it was fitted to: there were too few to hold any out"
    if result.integral:
        return f"{lead}; a table by position was fitted, no effects."
    fitted = sum(status.status == "fitted" for status in result.statuses)
    words = f"{lead}; {several(fitted, 'effect')} fitted"
    open_ones = sorted(
        (x for x in result.statuses if x.status == "undetermined"), key=lambda x: _urgency(result, x)
    )
    if open_ones:
        names = [_title(x.effect) for x in open_ones]
        more = [f"{len(names) - _MOST_OPEN} more"] if len(names) > _MOST_OPEN + 1 else names[_MOST_OPEN:]
        words += f"; not determined: {joined([*names[:_MOST_OPEN], *more])}"
        record = open_ones[0].text.rpartition("record: ")[2]
        if "record: " in open_ones[0].text:
            words += f". For {names[0]} record {record}"
    return f"{words}."


def _urgency(result: Calibration, effect_status: EffectStatus) -> tuple[bool, bool]:
    return effect_status.effect not in result.camera.effects, not vocabulary()[
        effect_status.effect
    ].everywhere


def _title(effect: str) -> str:
    known = vocabulary().get(effect)
    return effect.replace("_", " ") if known is None else known.title


def _cards(result: Calibration) -> list[Card]:
    accuracy = stated(result)
    whose = f"{accuracy.poses} held-out poses" if accuracy.held_out else "the poses of the fit"
    items = [
        Card(
            f"{accuracy.before * 1e3:.2f} → {accuracy.after * 1e3:.2f} mm",
            f"RMS error of corrected mean frames before and after, {whose}",
        ),
        Card(in_mm(accuracy.systematic), "of it systematic: beyond noise and reference instrument"),
        Card(in_mm(accuracy.single), "predicted noise of one frame (median)"),
    ]
    chi_square = result.chi_square
    if chi_square is not None and not result.integral:
        words, mood = noise_words(chi_square)
        label = f"unexplained at held-out poses (chi-square per value {chi_square:.3f})"
        items.append(Card(words, label, mood))
    solution = result.solution
    if not result.integral:
        share = solution.outliers / max(solution.values, 1)
        label = f"of the distances beyond 4 standard deviations: {solution.outliers} of {solution.values}"
        items.append(Card(f"{share:.2%}".replace("%", " %"), label))
    return items


def _errors(result: Calibration) -> list[Part]:
    """Return the error of each effect before and after, in mm."""
    if result.integral:
        return []
    found = effect_errors(result)
    largest = sorted(found.items(), key=lambda item: -item[1].before)
    rows = [[f"{_title(name)} ({name})", *_millimetres(effect_error)] for name, effect_error in largest]
    own = _pattern_error(result)
    if own is not None:
        rows.append([f"offset of each pixel ({PixelMap.name})", *_millimetres(own)])
    headings = ["effect", "it moves distances by", "error before", "error after", "unit"]
    return [Table(headings, rows, numbers=(1, 2, 3))] if rows else []


def _pattern_error(result: Calibration) -> EffectError | None:
    pattern = effect_of(result.camera, PixelMap)
    variance = _pattern_variance(result)
    known = variance[np.isfinite(variance)]
    if pattern is None or not known.size:
        return None
    size, change = float(np.std(pattern.map.values)), float(np.std(_pattern_change(result)))
    return EffectError(size, change, float(np.sqrt(np.median(known))))


def _pattern_change(result: Calibration) -> Array:
    """Return the change of the offsets of pixels (H, W) [m] from those of the file before."""
    new, old = effect_of(result.camera, PixelMap), effect_of(result.before, PixelMap)
    if new is None:
        return np.zeros(result.camera.shape)
    return np.asarray(new.map.values - (0.0 if old is None else old.map.values), float)


def _pattern_variance(result: Calibration) -> Array:
    """Return the variance (H, W) [m^2] of the offsets of pixels as they were written, NaN where unseen.

    They are shrunk by the variance v of their estimate. Offsets with the variance s over the pixels have the
    variance s^2 / (s + v) after that, from which s follows; the error of each has the variance s v / (s + v).
    """
    variance = np.where(np.isfinite(result.pattern_variance), result.pattern_variance, np.nan)
    left = float(np.var(_pattern_change(result)))
    spread = (left + np.sqrt(left**2 + 4 * left * variance)) / 2
    return np.asarray(spread * variance / np.maximum(spread + variance, 1e-30))


def _millimetres(effect_error: EffectError) -> list[str]:
    after = f"± {effect_error.after * 1e3:.2f}" if np.isfinite(effect_error.after) else "not estimated"
    return [f"{effect_error.size * 1e3:.2f}", f"{effect_error.before * 1e3:.2f}", after, "mm"]


def _uncertainty(result: Calibration) -> list[Part]:
    """Return the standard deviation of corrected distances by the covariance, over the image."""
    if result.integral or not result.paths:
        return []
    camera = result.camera
    setting = setting_of(camera)
    walls = [Wall(distance, setting) for distance in distances_of(camera)]
    shown = uncertainty(camera, result.paths, result.covariance, walls, pattern=_pattern_variance(result))
    # a wall where the camera measures no distance has no error
    seen = [(wall, one * 1e3) for wall, one in zip(walls, shown, strict=True) if np.isfinite(one).any()]
    if not seen:
        return []
    walls, images = [wall for wall, _ in seen], [one for _, one in seen]
    top = max(float(np.nanquantile(image, 0.98)) for image in images)
    picture = maps(
        [
            Map(f"wall at {w.distance:.2f} m", image, top, from_zero=True)
            for w, image in zip(walls, images, strict=True)
        ],
        "mm",
    )
    words = joined(
        [
            f"{np.nanmedian(image):.2f} mm at {w.distance:.2f} m"
            for w, image in zip(walls, images, strict=True)
        ]
    )
    caption = (
        f"Standard deviation of corrected distances, median over the image: {words}. A grey wall "
        f"(reflectivity {walls[0].reflectivity:g}) perpendicular to the axis"
        + (f", integration time {setting:g}" if setting is not None else "")
        + ", warm camera."
    )
    alt = f"Maps of the calibration's uncertainty over the image; medians {words}"
    return [Figure(picture, alt, caption)]


def _effects(result: Calibration) -> list[Part]:
    rows = [(status.effect, *_MOODS[status.status], _words(result, status)) for status in result.statuses]
    order = [_MOODS[name][0] for name in _MOODS]
    rows.sort(key=lambda row: order.index(row[1]))
    return [Tagged(rows)]


def _words(result: Calibration, effect_status: EffectStatus) -> str:
    effect = result.camera.effects.get(effect_status.effect)
    if effect_status.status == "fitted" and effect is not None:
        more = effect_status.text.removeprefix("fitted").removeprefix("; ")
        return f"{effect.sentence()}{f' ({more})' if more else ''}"
    return effect_status.text.removeprefix("absent: ").removeprefix(
        "cannot be determined from these recordings: "
    )
