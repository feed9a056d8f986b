"""The report of a diagnosis as one HTML page: what was left out, the proof, and the pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.diagnose import page_pictures as pictures
from rim_camera_ros.diagnose import page_words as words
from rim_camera_ros.diagnose.files import PAGE
from rim_camera_ros.diagnose.page_evidence import evidence
from rim_camera_ros.diagnose.result import Diagnosis, Missing
from rim_camera_ros.diagnose.smooth import UNKNOWN
from rim_camera_ros.diagnose.where import OF_AMPLITUDE
from rim_camera_ros.info.text import several
from rim_camera_ros.reports import html
from rim_camera_ros.yaml_files import write_whole

Array = NDArray[Any]

#: What is told by the variance of repeated frames.
_OF_FRAMES = ("noise", "interference")


def write_page(result: Diagnosis, folder: Path, *, recording: str, camera: str, scene: str) -> None:
    """Write report.html into an existing folder.

    Raises `RimError` where it cannot be written.
    """
    text = page(result, recording=recording, camera=camera, scene=scene)
    write_whole(folder / PAGE, lambda stream: stream.write(text.encode()))


def page(result: Diagnosis, *, recording: str, camera: str, scene: str) -> str:
    """Return the report as one HTML page that needs no other file."""
    found = evidence(result)
    dataset = result.baseline.fit.forward.dataset
    sensor = result.camera.sensor
    moved = found.chi_before is not None
    under = (
        f"{result.camera.device}, {sensor.width} × {sensor.height} px: {several(dataset.frames, 'frame')} of "
        f"{several(dataset.poses, 'pose')}. Recording {recording}, camera file {camera}, scene {scene}."
    )
    adjusted = html.section("Known terms that moved", _adjusted(result))
    return html.page(
        "Diagnosis",
        under,
        [
            _verdict(result),
            html.section(_heading(result), *_missing(result)),
            "" if result.missing else adjusted,
            html.section("The proof: poses that the model was not fitted to", _proof(result)),
            html.section("The curve that gave it away", pictures.curves(result, found)),
            html.section(
                "Where it is" if moved else "Differences over the array", *pictures.where(result, found)
            ),
            html.section(
                "When it is, and how well the poses agree" if moved else "Poses",
                *pictures.poses(result, found),
            ),
            html.section("Candidates", pictures.ranking(result)),
            html.section("How much chance alone would gain", pictures.nulls(result)),
            adjusted if result.missing else "",
            html.section("Noise of repeated frames", pictures.variance(result)),
            html.section("What this recording cannot show", _unseen(result)),
            html.section("Notes", html.bullets(result.notes)),
            html.section("Terms used", _terms()),
        ],
    )


def _verdict(result: Diagnosis) -> str:
    mood = "good" if result.verdict == "consistent" else "warn"
    fit = result.accuracy
    cards = [html.Card(words.verdict(result), f"verdict: {result.verdict}", mood)]
    numbers = []
    whose = "held-out poses" if fit.held_out else "the fitted poses"
    if _improved(result):
        numbers += [
            html.Card(
                f"{fit.rms_before * 1e3:.2f} → {fit.rms_after * 1e3:.2f} mm",
                f"RMS difference of {whose}, before and after; noise alone: {fit.noise_floor * 1e3:.2f} mm",
            ),
            html.Card(
                f"{words.chi(fit.chi2_before)} → {words.chi(fit.chi2_after)}",
                "chi-square per value of the same poses, before and after; noise alone: 1",
            ),
        ]
    else:
        numbers += [
            html.Card(
                f"{fit.rms_before * 1e3:.2f} mm",
                f"RMS difference of {whose}; noise alone: {fit.noise_floor * 1e3:.2f} mm",
            ),
            html.Card(words.chi(fit.chi2_before), "chi-square per value of the same poses; noise alone: 1"),
        ]
    sizes = [
        one.magnitude
        for one in result.missing
        if one.magnitude is not None and one.effect not in OF_AMPLITUDE
    ]
    if sizes:
        unknown = any(one.effect == UNKNOWN for one in result.missing)
        sign = "±" if unknown else "up to "
        label = "size of what was left out" + (
            "" if unknown else " (99 % of the pixel values are moved less)"
        )
        numbers.append(html.Card(sign + words.millimetres(max(sizes)), label))
    if result.variance.repeated:
        numbers.append(
            html.Card(
                f"{result.variance.ratio:.3f}",
                "measured variance of repeated frames / that of the camera file",
            )
        )
    return html.cards(cards) + html.cards(numbers)


def _improved(result: Diagnosis) -> bool:
    """Say whether distances are predicted otherwise than before; noise alone changes none."""
    fit = result.accuracy
    changed = (fit.rms_before, fit.chi2_before) != (fit.rms_after, fit.chi2_after)
    return changed and result.verdict not in ("consistent", "inconsistent_setup")


def _evidence_words(one: Missing, result: Diagnosis) -> str:
    """Return how sure an effect is: the first by its probability, further ones by their gain beside it."""
    order = [found.effect for found in result.found]
    if one.effect in _OF_FRAMES and one.effect not in order:
        return "This follows from repeated frames."
    number = order.index(one.effect) if one.effect in order else 0
    if number == 0:
        return (
            f"Probability {words.probability(one.probability)}, among the effects of the vocabulary and none."
        )
    gain, before = result.found[number].gain, words.joined(order[:number])
    if gain == result.found[number - 1].gain:
        other = result.found[number - 1].effect
        return f"Found together with {other}: the two gain {gain:,.0f} nats on held-out poses."
    return f"Found after {before}: it gains {gain:,.0f} nats more on held-out poses."


def _heading(result: Diagnosis) -> str:
    return "What was left out" if result.missing else "What this means"


def _missing(result: Diagnosis) -> list[str]:
    parts = []
    for one in result.missing:
        parts.append(f"<h3>{html.text(words.label_of(one.effect))}</h3>")
        if one.effect == UNKNOWN:
            parts.append(_unknown(result))
            continue
        sentence = one.sentence[:1].upper() + one.sentence[1:]
        parts.append(html.paragraph(f"{sentence}. {_evidence_words(one, result)}"))
        rows = words.parameter_rows(one, result.camera)
        if rows:
            headings = ["parameter", "value", "95 % from", "to", "unit", "meaning"]
            parts.append(html.table(headings, rows, numbers=(1, 2, 3)))
    match result.verdict:
        case "consistent":
            parts.append(
                html.paragraph(
                    "The differences between recording and simulation are those of noise, of the errors "
                    "stated for the poses, and of one constant offset per pixel. No effect that the camera "
                    "file lacks gains more on held-out poses than chance would, and no parameter of a "
                    "known one is contradicted."
                )
            )
        case "wrong_parameters":
            parts.append(
                html.paragraph(
                    "Adjusting the parameters that the camera file has already explains the recording. No "
                    "effect needs to be added; the values below replace the old ones."
                )
            )
        case "inconsistent_setup":
            parts.append(
                html.paragraph(
                    "Physics of a camera cannot explain such differences, so none is named. Check the "
                    "scene file, the poses of the recording and that the camera file is this camera's, "
                    "then diagnose again."
                )
            )
    for names in result.indistinguishable:
        listed = words.joined([words.label_of(name) for name in names])
        parts.append(html.paragraph(f"Cannot be told apart by this recording: {listed}."))
    if result.next_recording:
        parts.append(html.paragraph("To decide, record next:"))
        parts.append(html.bullets(result.next_recording.split("; ")))
    if result.smooth_rest is not None and result.verdict == "missing_physics":
        name, gain = result.smooth_rest
        share = (
            f", {100 * gain / result.gained:.2g} % of what the effects named gain"
            if result.gained > 0
            else ""
        )
        parts.append(
            html.paragraph(
                f"Beyond that, a smooth function of {name.replace('_', ' ')} still gains {gain:,.0f} nats"
                f"{share}; chance does not. The form of what is named differs from the vocabulary's, or "
                "something else is left out."
            )
        )
    if _improved(result) and not result.accuracy.got_worse:
        parts.append(
            html.paragraph(
                "camera.yaml in the folder of this report is the camera file with all of this that a camera "
                "file describes: simulating and correcting with it is the better simulation and correction."
            )
        )
    return parts


def _unknown(result: Diagnosis) -> str:
    one = next(one for one in result.missing if one.effect == UNKNOWN)
    sentence = one.sentence.partition("; described by")[0]
    parts = [html.paragraph(f"{sentence[:1].upper()}{sentence[1:]}.")]
    if one.formula:
        parts.append(
            html.paragraph(
                f"Closed form that describes it best: {words.formula_words(one.formula)}. Its constant "
                "cannot be told from the fixed pattern."
            )
        )
    known: Any = result.camera.effects.get("empirical")
    table = known if one.modelled else None
    if table is not None and len(table.covariates) == 2:
        from rim_camera_ros.diagnose.page_maps import surface

        drawn = [words.axis_of(n, np.asarray(k)) for n, k in zip(table.covariates, table.knots, strict=True)]
        picture = surface(
            [[factor * x for x in k] for (_, factor, _), k in zip(drawn, table.knots, strict=True)],
            np.asarray(table.values.values, float),
            [label for label, _, _ in drawn],
            log=[log for _, _, log in drawn],
        )
        caption = "What it adds to distances over its two covariates: effect empirical of camera.yaml."
        parts.append(html.figure(picture, caption))
    elif table is None:
        why = "no smooth function of two covariates does"
        if known is not None:
            why = f"a camera file has one table, and this one's is of {' and '.join(known.covariates)}"
        parts.append(html.paragraph(f"camera.yaml does not model it: {why}."))
    return "".join(parts)


def _adjusted(result: Diagnosis) -> str:
    rows = words.adjusted_rows(result)
    if not rows:
        return ""
    said = (
        "These had taken up part of what was left out, and moved when it was added."
        if result.missing
        else "The recording contradicts these values of the camera file."
    )
    return html.paragraph(said) + html.table(["parameter", "before", "after", "unit"], rows, numbers=(1, 2))


def _proof(result: Diagnosis) -> str:
    if not _improved(result):
        return ""
    from rim_camera_ros.diagnose.page_figures import proof

    fit = result.accuracy
    noise = fit.noise_floor

    def beyond(rms: float) -> str:
        return f"{np.sqrt(max(rms**2 - noise**2, 0.0)) * 1e3:.2f}"

    rows = [
        [
            "RMS difference",
            f"{fit.rms_before * 1e3:.2f}",
            f"{fit.rms_after * 1e3:.2f}",
            f"{noise * 1e3:.2f}",
            "mm",
        ],
        ["of it beyond noise", beyond(fit.rms_before), beyond(fit.rms_after), "0", "mm"],
        ["chi-square per value", words.chi(fit.chi2_before), words.chi(fit.chi2_after), "1", ""],
    ]
    held = (
        "Each fifth of the poses was predicted by models fitted to the other four fifths."
        if fit.held_out
        else "There are too few poses to hold any out: these are the poses of the fit itself."
    )
    worse = "".join(html.paragraph(f"{note[:1].upper()}{note[1:]}.") for note in fit.notes())
    picture = proof((fit.rms_before, fit.chi2_before), (fit.rms_after, fit.chi2_after), noise)
    figure = html.figure(picture, f"{held} Dashed: what the noise of the camera alone makes.")
    headings = ["mean frames of each pose", "before", "after", "noise alone", "unit"]
    return figure + html.table(headings, rows, numbers=(1, 2, 3)) + worse


def _unseen(result: Diagnosis) -> str:
    if not result.unseen:
        return ""
    said = (
        "Whether these effects act or not makes no difference to such a recording: it speaks neither for nor "
        "against."
    )
    return html.paragraph(said) + words.unseen_table(result.unseen)


def _terms() -> str:
    return html.bullets(
        [
            "Pose: frames of the same true poses; they are averaged. Held-out: predicted by a model that "
            "was fitted to other poses only.",
            "Gain [nats]: natural logarithm of how much more probable held-out poses become by an effect; "
            "10 nats are a factor of 22,000.",
            "Chi-square per value: mean square of the differences in units of their expected noise; 1 "
            "means down to the noise.",
            "Fixed pattern: a constant offset per pixel. It is estimated in every comparison and never "
            "counts as missing physics. So are errors of the poses, within their stated accuracy, and of "
            "the emitted power.",
            "Sigma: one standard deviation.",
            "Noise alone: what the camera's noise leaves in mean frames. Errors of the poses and offsets of "
            "pixels that are not known well add to an RMS; chi-square allows for them.",
        ]
    )
