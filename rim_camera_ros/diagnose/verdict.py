"""The verdict: from findings to statements, in steps of which later ones may overrule earlier ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rim_camera_ros.calibrate.plan import shipped_experiments
from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.accuracy import Accuracy, accuracy, judged_by_all_errors
from rim_camera_ros.diagnose.adjusted import Adjusted, adjusted_terms, beyond_file, parameters_matter
from rim_camera_ros.diagnose.described import of_correlated_errors, unexplained
from rim_camera_ros.diagnose.found_physics import FoundPhysics
from rim_camera_ros.diagnose.intervals import distances_known_to, intervals_of, uncertainty_of
from rim_camera_ros.diagnose.menu import distinguishing_experiments, recommended
from rim_camera_ros.diagnose.naming import (
    first_frames,
    large_gains,
    missing_codes_of,
    missing_effect,
    next_recording,
    notes_of_light,
    notes_of_refused,
    ranking_of,
    unseen_effects,
    with_unknown,
)
from rim_camera_ros.diagnose.noise_verdict import OF_NOISE, separate_unknown, with_variance
from rim_camera_ros.diagnose.result import Diagnosis, Missing, Ranked
from rim_camera_ros.diagnose.second_camera import second_camera, with_second_camera
from rim_camera_ros.diagnose.smooth import UNKNOWN
from rim_camera_ros.diagnose.where import (
    Where,
    nowhere,
    of_change,
    of_noise,
    of_repeated_frames,
    of_residuals,
    of_scatter,
    of_terms,
    of_values,
)
from rim_camera_ros.effects import vocabulary
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.variance_components import correlated_error_note
from rim_camera_ros.select.candidates import change_of_forms
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.pixel_gains import GainSpread
from rim_camera_ros.select.thresholds import LEAST_EXPLAINED

#: Chi-square per value of held-out poses above which a recording that nothing explains is not consistent:
#: where nothing was missing it was 1.02 at most.
_UNEXPLAINED = 1.05
#: Least probability of a named effect: more probable than not.
LEAST_PROBABILITY = 0.5
_AS_KNOWN = (
    "known terms fit this recording better with other parameters, which are within the errors of the camera "
    "file (its covariance, or that of plain least squares of such a recording)"
)
_AGAINST = (
    "held-out poses got worse with {}: what is missing is something else, which no named effect describes"
)
_LITTLE = (
    "{0} would explain {1.explained:.0%} of what does not fit (chi-square of all errors of held-out poses "
    "{1.judged[0]:.3g} -> {1.judged[1]:.3g}): most of what is missing is something else"
)
_NOT_NAMED_GIVEN_LARGE_GAINS = "not named, as light that goes from pixel to pixel may look like it"
_NOT_NAMED_GIVEN_FIRST_FRAMES = "not named, as the means of first frames that differ may look like it"
_NOT_NAMED_GIVEN_CODES = "not named, as missing counts may look like it; mend those first"


@dataclass(frozen=True)
class Findings(FoundPhysics):
    """The evidence for a verdict: the physics found, the ``camera`` file, and further findings.

    ``reason`` is why the set-up cannot be trusted (None: it can). ``shifted`` says that unmodulated light
    shifts distances; ``left_over`` is the mean chi-square per distance of the poses; ``gains`` are those of
    neighbouring pixels.
    """

    camera: Camera
    reason: str | None
    shifted: bool
    left_over: float
    gains: GainSpread | None
    seed: int

    @property
    def fitted(self) -> Fit:
        """The fit after all steps of the search."""
        return self.final.fit


@dataclass
class _Draft:
    """The verdict after the steps so far; ``model`` is the improved camera."""

    verdict: str
    model: Camera
    where: Where
    ranking: list[Ranked]
    ties: list[list[str]]
    notes: list[str]
    missing: list[Missing] = field(default_factory=list)
    adjusted: list[Adjusted] = field(default_factory=list)


def verdict_of(found: Findings, say: Callable[[str], None]) -> Diagnosis:
    """Return the diagnosis by the findings; ``say`` takes progress in words."""
    draft = _begun(found)
    for step in (_wrong_parameters, _of_variance, _first_frames, _large_gains, _unknown_alone, _codes_first):
        step(draft, found)
    advice = {}
    for finding in found.result.found:
        names = sorted({finding.effect, *finding.ties})
        if finding.ties and names in draft.ties:
            at = found.result.explorations[finding.step]
            proposals = distinguishing_experiments(at, names, shipped_experiments(), progress=say)
            advice[tuple(names)] = recommended(proposals, threshold=at.threshold)
    unknown = found.described if draft.verdict == "unknown_physics" else None
    table = None if unknown is None else unknown.fit
    measure = accuracy(found.camera, draft.model, found.result, table)
    measure = judged_by_all_errors(measure, found.camera, draft.model, found.result, table)
    left = min(measure.chi2_before, found.left_over)
    correlated = found.fitted.forward.correlated_error > 0
    if draft.verdict == "consistent" and correlated:
        draft.verdict = "unknown_physics"
        missing, draft.where = of_correlated_errors(found.fitted)
        draft.missing = [missing]
    elif correlated:
        draft.notes.append(correlated_error_note(found.fitted))
    if draft.verdict == "consistent" and measure.held_out and left > _UNEXPLAINED:
        # neither an effect nor a smooth function explains it, but it is reported
        draft.verdict = "unknown_physics"
        missing, draft.where = unexplained(found.fitted, measure.chi2_before)
        draft.missing = [missing]
    if draft.verdict in ("missing_physics", "wrong_parameters"):
        measure = _made_sure(draft, found, measure)
    named = {effect.effect for effect in draft.missing}
    return Diagnosis(
        verdict=draft.verdict,
        missing=draft.missing,
        adjusted=draft.adjusted,
        ranking=draft.ranking,
        indistinguishable=draft.ties,
        where=draft.where,
        accuracy=measure,
        variance=found.variance,
        camera=draft.model,
        baseline=found.baseline,
        final=found.final if found.reason is None else found.baseline,
        found=found.result.found if draft.verdict == "missing_physics" else [],
        next_recording=next_recording(draft.ties, advice),
        reason=found.reason,
        unseen=[name for name in unseen_effects(found.baseline) if name not in named],
        notes=[*draft.notes, *measure.notes()],
        gained=found.result.gained,
        smooth_rest=None if found.rest is None else (" and ".join(found.rest.covariates), found.rest.on_top),
    )


def _made_sure(draft: _Draft, found: Findings, measure: Accuracy) -> Accuracy:
    """Test names and terms that moved by held-out poses; return the accuracy of what remains.

    The probability of a name is multiplied by the share of the misfit that the model explains: a model that
    explains little has not found the missing physics. Names against which held-out poses are evidence are
    dropped.
    """
    sure = [
        effect
        if effect.effect in OF_NOISE
        else replace(effect, probability=measure.explained * effect.probability)
        for effect in draft.missing
    ]
    names = ", ".join(effect.effect for effect in (sure or draft.adjusted))
    draft.missing = [effect for effect in sure if effect.probability >= LEAST_PROBABILITY]
    certain = bool(draft.missing) if sure else measure.explained >= LEAST_EXPLAINED
    if certain and not measure.got_worse:
        return measure
    draft.notes.append(_AGAINST.format(names) if measure.got_worse else _LITTLE.format(names, measure))
    draft.verdict, draft.ties, draft.model = "unknown_physics", [], found.camera
    missing, draft.where = unexplained(found.baseline.fit, measure.chi2_before)
    draft.missing = [missing]
    return replace(
        measure,
        rms_after=measure.rms_before,
        chi2_after=measure.chi2_before,
        all_after=measure.all_before,
    )


def _begun(found: Findings) -> _Draft:
    """Begin with the search: a set-up that cannot be trusted, unknown physics, named effects, or nothing."""
    result, fitted = found.result, found.fitted
    ranking = ranking_of(found.baseline, result)
    _tie_with_better(result, ranking)
    draft = _Draft(
        verdict="consistent",
        model=fitted.camera,
        where=nowhere(fitted),
        ranking=ranking,
        ties=[sorted({finding.effect, *finding.ties}) for finding in result.found if finding.ties],
        notes=sorted({*fitted.notes, *fitted.forward.notes, *found.dataset.notes, *notes_of_light(fitted)}),
    )
    if found.reason is not None:
        draft.verdict, draft.model, draft.ties = "inconsistent_setup", found.camera, []
        draft.where = of_residuals(found.baseline.fit)
    elif found.described is not None:
        draft.verdict, draft.model, draft.ties = "unknown_physics", found.described.camera, []
        draft.where, draft.missing = found.described.where, [found.described.missing]
        draft.ranking = with_unknown(draft.ranking, found.described.gain)
    elif result.found:
        _name(draft, found)
    else:
        draft.notes += notes_of_refused(result)
    return draft


def _tie_with_better(result: Result, ranking: Sequence[Ranked]) -> None:
    """Tie the first effect with those that gain more over the known terms: only the fit preferred it."""
    if not result.found:
        return
    first = result.found[0]
    own = max((rival.gain for rival in ranking if rival.effect == first.effect), default=0.0)
    named = {finding.effect for finding in result.found}
    for rival in ranking:
        if rival.gain > own and rival.effect not in named and rival.effect not in first.ties:
            first.ties.append(rival.effect)


def _name(draft: _Draft, found: Findings) -> None:
    """Name the effects that were found, with their parameters and where they act."""
    result, fitted, final = found.result, found.fitted, found.final
    draft.verdict = "missing_physics"
    probabilities = {rival.effect: rival.probability for rival in draft.ranking}
    uncertainty = uncertainty_of(final, result.problem, seed=found.seed)
    intervals = intervals_of(fitted, uncertainty)
    names = [finding.effect for finding in result.found]
    known = distances_known_to(fitted, result.problem, uncertainty, names)
    for finding in result.found:
        share = sum(probabilities.get(name, 0.0) for name in sorted({finding.effect, *finding.ties}))
        if finding is not result.found[0]:
            # conditional on the effects before it, against no further effect
            share = float(1 / (1 + np.exp(-min(finding.gain, 500.0))))
        draft.missing.append(
            missing_effect(
                finding.effect,
                fitted,
                intervals,
                share,
                origin=found.camera,
                distance_sigma=known.get(finding.effect),
            )
        )
    beyond = change_of_forms(draft.model, names, final.forms, final.conditional.values())
    draft.where = of_terms(fitted, names, found.camera, rest=beyond)
    draft.notes += notes_of_refused(result)


def _wrong_parameters(draft: _Draft, found: Findings) -> None:
    """Add known terms that moved; where nothing is missing they may be the cause of the misfit."""
    if draft.verdict == "inconsistent_setup":
        return
    moved_in = found.baseline.fit if draft.verdict == "consistent" else found.fitted
    moved_in = moved_in if found.described is None else found.described.fit
    draft.adjusted = adjusted_terms(found.camera, moved_in)
    if draft.verdict != "consistent":
        return
    alone = found.variance.pixels_vary_together
    if draft.adjusted and not alone and parameters_matter(found.camera, found.result, draft.adjusted):
        draft.verdict = "wrong_parameters"
        draft.where = of_change(found.fitted, found.camera)
        return
    if draft.adjusted and not alone and not beyond_file(found.camera, found.result.explorations[-1].fit):
        moved = ", ".join(term.effect for term in draft.adjusted)
        draft.notes.append(f"{_AS_KNOWN}: {moved}")
    draft.adjusted, draft.model = [], found.camera


def _of_variance(draft: _Draft, found: Findings) -> None:
    """Add the evidence of repeated frames: light of a second camera, unmodulated light, or another noise."""
    fitted, camera, variance = found.fitted, found.camera, found.variance
    second = None if draft.verdict == "inconsistent_setup" else second_camera(fitted, camera, variance)
    if second is None:
        shifted = found.rest is not None or bool(draft.missing) or found.shifted
        draft.verdict, draft.missing, draft.model = with_variance(
            draft.verdict, draft.missing, draft.model, variance, draft.ties, shifted, camera.effects.keys()
        )
    else:
        draft.verdict, draft.missing, draft.adjusted, draft.model = with_second_camera(
            second, draft.verdict, draft.missing, draft.adjusted, draft.model
        )
        draft.notes += second.notes
        if not draft.where.pixels.any():
            draft.where = of_scatter(fitted, second.effect)
    if not draft.where.pixels.any() and any(effect.effect in OF_NOISE for effect in draft.missing):
        draft.where = of_noise(fitted, camera, draft.model)


def _unknown_alone(draft: _Draft, found: Findings) -> None:
    """With unknown physics, name nothing else as missing."""
    if draft.verdict == "unknown_physics":
        draft.missing, further, notes = separate_unknown(draft.missing, found.camera)
        draft.adjusted, draft.notes = [*draft.adjusted, *further], [*draft.notes, *notes]


def _first_frames(draft: _Draft, found: Findings) -> None:
    """Report first frames that differ alone: in the means of poses they look like other physics."""
    if not found.variance.begins or draft.verdict == "inconsistent_setup":
        return
    names = [effect.effect for effect in draft.missing if effect.effect != UNKNOWN]
    draft.verdict, draft.adjusted, draft.ties = "unknown_physics", [], []
    draft.missing, draft.model = [first_frames()], found.camera
    draft.where = of_repeated_frames(found.baseline.fit)
    if names:
        draft.notes.append(f"{_NOT_NAMED_GIVEN_FIRST_FRAMES}: {', '.join(names)}")


def _large_gains(draft: _Draft, found: Findings) -> None:
    """Report pixels that see other light than their neighbours in every pose; with named effects as a note.

    Light from neighbours moves where a pixel looks, and mixes surfaces: effects that do the same are not
    named.
    """
    if found.gains is None or not found.gains.is_beyond or draft.verdict == "inconsistent_setup":
        return
    said = large_gains(found.gains)
    names = [effect.effect for effect in draft.missing if effect.effect != UNKNOWN]
    if draft.verdict == "wrong_parameters":
        names += [term.effect for term in draft.adjusted]
    if draft.verdict == "unknown_physics" or not all(vocabulary()[name].is_of_neighbours() for name in names):
        draft.notes.append(said.sentence)
        return
    draft.verdict, draft.missing, draft.model = "unknown_physics", [said], found.camera
    draft.adjusted, draft.ties = [], []
    brighter = found.gains.relative_to_neighbours
    # noise is circular in the complex plane: a relative amplitude corresponds to a phase, and so to metres
    draft.where = of_values(
        found.baseline.fit, lambda predicted: brighter * (predicted.context.ambiguity / (2 * np.pi))
    )
    if names:
        draft.notes.append(f"{_NOT_NAMED_GIVEN_LARGE_GAINS}: {', '.join(names)}")


def _codes_first(draft: _Draft, found: Findings) -> None:
    """Report counts that never occur alone: they look like other physics."""
    if found.codes is None or draft.verdict == "inconsistent_setup":
        return
    names = [effect.effect for effect in draft.missing]
    draft.verdict, draft.adjusted = "unknown_physics", []
    draft.missing = [missing_codes_of(found.codes, found.camera)]
    draft.model, draft.where = found.camera, of_residuals(found.fitted)
    if names:
        draft.notes.append(f"{_NOT_NAMED_GIVEN_CODES}: {', '.join(names)}")
