"""The report of a diagnosis as one HTML page: the missing physics, the evidence, and the pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.diagnose.added_light import median_integration_time
from rim_camera_ros.diagnose.files import PAGE
from rim_camera_ros.diagnose.report import as_json
from rim_camera_ros.diagnose.result import Diagnosis, Missing
from rim_camera_ros.diagnose.smooth import UNKNOWN
from rim_camera_ros.effects import AdditionalLight, CovariateTable, vocabulary
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.info.text import several
from rim_camera_ros.reports.diagnosis import candidates, sections, setup, words
from rim_camera_ros.reports.diagnosis.evidence import evidence
from rim_camera_ros.reports.page import Bullets, Card, Figure, Heading, Part, Table, Text, render
from rim_camera_ros.reports.words import joined, millimetres, noise_words
from rim_camera_ros.yaml_files import write_whole

Array = NDArray[Any]


_OF_INTERVALS = (
    "These intervals are those of single numbers. They are wide where offsets of the pixels or other numbers "
    "can absorb a change: the uncertainty of the distances by all of them together is stated above."
)


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
    report = as_json(result)
    rows = words.adjusted_rows(result)
    return render(
        "diagnosis",
        title="Diagnosis",
        under=(
            f"{result.camera.device}, {sensor.width} × {sensor.height} px: "
            f"{several(dataset.frames, 'frame')} of {several(dataset.poses, 'pose')}. "
            f"Recording {recording}, camera file {camera}, scene {scene}."
        ),
        first=words.first_line(result),
        mood="good" if result.verdict == "consistent" and not words.doubts(result) else "warn",
        cards=_cards(result),
        held_out=result.accuracy.held_out,
        verdict=result.verdict,
        named=bool(result.missing),
        moved=found.chi_before is not None,
        missing=[
            *(part for effect in result.missing for part in _missing(effect, result)),
            *([Text(_OF_INTERVALS)] if any(effect.distance_sigma for effect in result.missing) else []),
        ],
        further=_further(result),
        excluded=[Text(f"{note[:1].upper()}{note[1:]}.") for note in result.notes if _is_exclusion(note)],
        better=_improved(result) and not result.accuracy.got_worse,
        worst=setup.worst_pose(found),
        hypotheses=setup.hypotheses(report),
        adjusted=[Table(["parameter", "before", "after", "unit"], rows, numbers=(1, 2))] if rows else [],
        proof=_proof(result),
        curves=sections.curves(result, found),
        where=sections.where(result, found),
        candidates=candidates.ranking(result),
        poses=sections.poses(result, found),
        imperfections=setup.imperfections(report),
        noise=sections.variance(result),
        chance=candidates.nulls(result),
        unseen=words.unseen_table(result.unseen),
        notes=[Bullets(others)] if (others := [n for n in result.notes if not _is_exclusion(n)]) else [],
    )


def _is_exclusion(note: str) -> bool:
    """Return whether a note says what part of the recording the result is not about: it is no detail."""
    return note.startswith("excluded: ")


def _cards(result: Diagnosis) -> list[Card]:
    fit = result.accuracy
    whose = "held-out poses" if fit.held_out else "the fitted poses"
    noise = f"noise alone: {fit.noise_floor * 1e3:.2f} mm"
    if _improved(result):
        left, mood = noise_words(fit.chi2_after)
        squares = f"{words.chi(fit.chi2_before)} → {words.chi(fit.chi2_after)}"
        before = f"{noise_words(fit.chi2_before)[0]} before; chi-square per value {squares}"
        rms = f"{fit.rms_before * 1e3:.2f} → {fit.rms_after * 1e3:.2f} mm"
        label = f"RMS difference of {whose}, before and after; {noise}"
    else:
        left, mood = noise_words(fit.chi2_before)
        before = f"chi-square per value {words.chi(fit.chi2_before)}"
        rms, label = f"{fit.rms_before * 1e3:.2f} mm", f"RMS difference of {whose}; {noise}"
    smooth = result.final.fit.forward.correlated_error > 0
    apart = "apart from smooth errors of each pose; " if smooth else ""
    cards = [Card(rms, label), Card(left, f"unexplained at {whose} ({apart}{before})", mood)]
    sizes = [
        effect.magnitude
        for effect in result.missing
        if effect.magnitude is not None and _shows_in(effect.effect) != "amplitude"
    ]
    if sizes:
        unknown = any(effect.effect == UNKNOWN for effect in result.missing)
        sign = "±" if unknown else "up to "
        rest = "" if unknown else " (99 % of the pixel values are moved less)"
        cards.append(Card(sign + millimetres(max(sizes)), f"size of what is missing{rest}"))
    variance = result.variance
    if variance.repeated:
        wrong = variance.noise_is_wrong or variance.pixels_vary_together
        value = f"{np.sqrt(variance.ratio):.2g} times the noise stated" if wrong else "noise as stated"
        label = f"in repeated frames (measured variance {variance.ratio:.3f} times the camera file's)"
        cards.append(Card(value, label, "warn" if wrong else "good"))
    return cards


def _improved(result: Diagnosis) -> bool:
    """Return whether distances are predicted differently than before; another noise changes none."""
    fit = result.accuracy
    changed = (fit.rms_before, fit.chi2_before) != (fit.rms_after, fit.chi2_after)
    return changed and result.verdict not in ("consistent", "inconsistent_setup")


def _shows_in(effect: str) -> str | None:
    known = vocabulary().get(effect)
    return None if known is None else known.shows_in


def _evidence_words(effect: Missing, result: Diagnosis) -> str:
    """Return the evidence for an effect: the first by its probability, further ones by their added gain."""
    order = [found.effect for found in result.found]
    if _shows_in(effect.effect) in ("noise", "frames") and effect.effect not in order:
        return "This follows from repeated frames."
    number = order.index(effect.effect) if effect.effect in order else 0
    if number == 0:
        probability = words.probability(effect.probability)
        return f"Probability {probability}, among the effects of the vocabulary and none."
    gain, before = result.found[number].gain, joined(order[:number])
    if gain == result.found[number - 1].gain:
        other = result.found[number - 1].effect
        return f"Found together with {other}: the two gain {gain:,.0f} nats on held-out poses."
    return f"Found after {before}: it gains {gain:,.0f} nats more on held-out poses."


def _missing(effect: Missing, result: Diagnosis) -> list[Part]:
    heading = Heading(words.label_of(effect.effect))
    if effect.effect == UNKNOWN:
        return [heading, *_unknown(effect, result)]
    sentence = effect.sentence[:1].upper() + effect.sentence[1:]
    parts: list[Part] = [heading, Text(f"{sentence}. {_evidence_words(effect, result)}")]
    rows = words.parameter_rows(effect, result.camera)
    if rows:
        headings = ["parameter", "value", "95 % from", "to", "unit", "meaning"]
        parts.append(Table(headings, rows, numbers=(1, 2, 3)))
    if any("gon" in row[4] for row in rows):
        parts.append(Text("An angle of 1 gon is 1/400 of a full turn: 100 gon = 90°."))
    return parts


def _further(result: Diagnosis) -> list[Part]:
    """Return rivals, what to record, and what a smooth function still gains."""
    parts: list[Part] = []
    for names in result.indistinguishable:
        listed = joined([words.label_of(name) for name in names])
        parts.append(Text(f"Indistinguishable by this recording: {listed}."))
    if result.next_recording:
        parts += [Text("To decide, record next:"), Bullets(result.next_recording.split("; "))]
    if result.smooth_rest is not None and result.verdict == "missing_physics":
        name, gain = result.smooth_rest
        share = (
            f", {100 * gain / result.gained:.2g} % of what the effects named gain"
            if result.gained > 0
            else ""
        )
        parts.append(
            Text(
                f"Beyond that, a smooth function of {name.replace('_', ' ')} still gains {gain:,.0f} nats"
                f"{share}; chance does not. The form of what is named differs from the vocabulary's, or "
                "something else is missing."
            )
        )
    return parts


def _unknown(effect: Missing, result: Diagnosis) -> list[Part]:
    sentence = effect.sentence.partition("; described by")[0]
    parts: list[Part] = [Text(f"{sentence[:1].upper()}{sentence[1:]}.")]
    if effect.formula:
        parts.append(
            Text(
                f"Closed form that describes it best: {words.formula_words(effect.formula)}. Its constant "
                "cannot be distinguished from the fixed pattern."
            )
        )
    light = effect_of(result.camera, AdditionalLight)
    if effect.model == AdditionalLight.name and light is not None:
        return [*parts, _of_light(light, result)]
    known = effect_of(result.camera, CovariateTable)
    table = known if effect.model is not None else None
    if table is not None and len(table.covariates) == 2:
        from rim_camera_ros.reports.diagnosis.maps import surface

        drawn = [words.axis_of(n, np.asarray(k)) for n, k in zip(table.covariates, table.knots, strict=True)]
        picture = surface(
            [[factor * x for x in k] for (_, factor, _), k in zip(drawn, table.knots, strict=True)],
            np.asarray(table.values.values, float) * 1e3,
            [label for label, _, _ in drawn],
            log=[log for _, _, log in drawn],
            unit="mm",
        )
        caption = f"What it adds to distances over its two covariates: {CovariateTable.name} of camera.yaml."
        alt = f"Map of what it adds to distances over {joined([label for label, _, _ in drawn])}"
        parts.append(Figure(picture, alt, caption))
    elif table is None:
        why = "no smooth function of two covariates does"
        if known is not None:
            why = f"a camera file has one table, and this one's is of {' and '.join(known.covariates)}"
        parts.append(Text(f"camera.yaml does not model it: {why}."))
    return parts


def _of_light(light: AdditionalLight, result: Diagnosis) -> Figure:
    from rim_camera_ros.reports.diagnosis.maps import surface

    time = median_integration_time(result.baseline.fit)
    sensor = result.camera.sensor
    picture = surface(
        [
            np.linspace(-0.5, size - 0.5, number).tolist()
            for size, number in zip((sensor.width, sensor.height), light.strength.T.shape, strict=True)
        ],
        light.strength.T * result.camera.radiometry.gain * time,
        ["column [px]", "row [px]"],
        log=(False, False),
        unit="counts",
        image=True,
    )
    return Figure(
        picture,
        "Map of the light that is added, over columns and rows",
        f"The light that is added to that of the scene, at an integration time of {time:g}: {light.name} of "
        "camera.yaml.",
    )


def _proof(result: Diagnosis) -> list[Part]:
    if not _improved(result):
        return []
    from rim_camera_ros.reports.diagnosis.figures import proof

    fit = result.accuracy
    noise = fit.noise_floor

    def beyond(rms: float) -> str:
        return f"{np.sqrt(max(rms**2 - noise**2, 0.0)) * 1e3:.2f}"

    rms = [f"{fit.rms_before * 1e3:.2f}", f"{fit.rms_after * 1e3:.2f}"]
    rows = [
        ["RMS difference", *rms, f"{noise * 1e3:.2f}", "mm"],
        ["of it beyond noise", beyond(fit.rms_before), beyond(fit.rms_after), "0", "mm"],
        ["chi-square per value", words.chi(fit.chi2_before), words.chi(fit.chi2_after), "1", ""],
    ]
    held = (
        "Each fifth of the poses was predicted by models fitted to the other four fifths."
        if fit.held_out
        else "There are too few poses to hold any out: these are the poses of the fit itself."
    )
    picture = proof((fit.rms_before, fit.chi2_before), (fit.rms_after, fit.chi2_after), noise)
    alt = f"RMS difference before and after: {rms[0]} and {rms[1]} mm"
    headings = ["mean frames of each pose", "before", "after", "noise alone", "unit"]
    return [
        Figure(picture, alt, f"{held} Dashed: expected from the noise of the camera alone."),
        Table(headings, rows, numbers=(1, 2, 3)),
        *(Text(f"{note[:1].upper()}{note[1:]}.") for note in fit.notes()),
    ]
