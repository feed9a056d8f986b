"""The diagnosis: from a recording and what is believed of it to a verdict, a model and the proof that it
helps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.adjustment import Fit, Problem
from rim_camera_ros.calibrate.coarser import (
    coarseness,
    coarser_camera,
    coarser_dataset,
    finer_camera,
    finer_image,
)
from rim_camera_ros.calibrate.library import LINEAR, Facts, added
from rim_camera_ros.calibrate.nulls import null_scores
from rim_camera_ros.calibrate.prediction import Forward
from rim_camera_ros.calibrate.search import OF_POSES, Exploration, Found, Result, explore, search
from rim_camera_ros.calibrate.selection import folds_of
from rim_camera_ros.calibrate.stations import Dataset
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_effects
from rim_camera_ros.diagnose.accuracy import Accuracy, accuracy
from rim_camera_ros.diagnose.adjusted import LEAST_GAIN, LEAST_TOTAL, Adjusted, adjusted_terms, total_change
from rim_camera_ros.diagnose.codes import MissingCodes, missing_codes
from rim_camera_ros.diagnose.setup import check_setup
from rim_camera_ros.diagnose.smooth import UNKNOWN, axes_of, pair_terms, single_terms
from rim_camera_ros.diagnose.unknown import (
    closed_form,
    fine_structures,
    fine_table,
    smooth_pairs,
    with_table,
)
from rim_camera_ros.diagnose.variance import Variance, examine_variance
from rim_camera_ros.diagnose.where import OF_AMPLITUDE, Where, nowhere, of_change, of_residuals, of_terms
from rim_camera_ros.effects import registry
from rim_camera_ros.effects.background_light import BackgroundLight
from rim_camera_ros.errors import RimError
from rim_camera_ros.scene import Scene

Array = NDArray[Any]

#: A smooth rest must gain this share of what the named effects gained before they are doubted.
DOUBT = 0.15
#: A term outside the vocabulary must gain this share more than the named ones to take their place.
BEYOND = 1.2
_LEAST_UNKNOWN = 20.0
#: 1-sigma of light that all pixels share, as a share of the median amplitude, once it is known to be there.
_COMMON_LIGHT = 0.1


@dataclass(frozen=True)
class Missing:
    """What was left out: effect (or `unknown`), its probability, parameters with 95 % intervals by path
    (relative to the effect), and the sentence; for unknown physics covariates, magnitude [m] and closed form.
    """

    effect: str
    probability: float
    parameters: Mapping[str, float]
    interval: Mapping[str, tuple[float, float]]
    sentence: str
    covariates: tuple[str, ...] = ()
    magnitude: float | None = None
    formula: str | None = None


@dataclass
class Diagnosis:
    """The result; `rim_camera_ros.diagnose.report` writes it."""

    verdict: str
    missing: list[Missing]
    adjusted: list[Adjusted]
    ranking: list[tuple[str, float, float]]
    indistinguishable: list[list[str]]
    where: Where
    before: Where
    accuracy: Accuracy
    variance: Variance
    camera: Camera
    baseline: Exploration
    final: Exploration
    found: list[Found]
    next_recording: str | None
    reason: str | None = None
    unseen: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    smooth_rest: tuple[str, float] | None = None


@dataclass(frozen=True)
class _Unknown:
    """The best description that is not of the vocabulary: its gain over the baseline, covariates, camera."""

    gain: float
    covariates: tuple[str, ...]
    camera: Camera
    on_top: float
    threshold: float


def diagnose(
    dataset: Dataset,
    scene: Scene,
    camera: Camera,
    *,
    against: Dataset | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Compare a recording with what the camera and scene files say of it.

    ``against`` is a recording of the simulation, with the same stations, which is then compared with. Of a
    large sensor every k-th pixel is looked at.

    Raises `InputError` where no pixel can be compared.
    """
    say = progress if progress is not None else _silent
    step = coarseness(camera)
    if step == 1:
        return _diagnose(dataset, scene, camera, against, seed, say)
    small = coarser_camera(camera, step)
    result = _diagnose(
        coarser_dataset(dataset, step),
        scene,
        small,
        None if against is None else coarser_dataset(against, step),
        seed,
        say,
    )
    result.camera = finer_camera(result.camera, camera, step)
    pixels = finer_image(result.where.pixels, camera.shape, step)
    result.where = replace(result.where, pixels=pixels)
    result.notes.append(f"every {step}th pixel of every {step}th row was looked at")
    return result


def _diagnose(
    dataset: Dataset,
    scene: Scene,
    camera: Camera,
    against: Dataset | None,
    seed: int,
    say: Callable[[str], None],
) -> Diagnosis:
    moves = scene.camera_motion.moves
    facts = Facts.of(dataset, moves=moves, surfaces=len(scene.surfaces), camera=camera)
    shifts = None
    if against is not None:
        shifts = Forward(dataset, scene, camera).shifts_to(against)
    say("looking at the covariates")
    forward = Forward(dataset, scene, camera)
    forward.estimate_amplitudes()
    variance = examine_variance(forward)
    light = _COMMON_LIGHT * facts.amplitude if variance.pixels_vary_together else 0.0
    problem = Problem(dataset, scene, shifts=shifts, stray_light=light)
    samples = axes_of(forward, seed=seed)
    smooth = single_terms(samples)
    try:
        result = search(problem, camera, facts, further=smooth, seed=seed, progress=say)
    except (RimError, np.linalg.LinAlgError):
        return _hopeless(problem, camera, variance, seed)
    baseline, final = result.explorations[0], result.explorations[-1]
    if variance.pixels_vary_together:
        # the light of a second camera shifts whole poses at random, which a drift can imitate
        result.found = [one for one in result.found if one.effect not in OF_POSES]
    say("looking for what no named effect explains")
    unknown = _unknown(result, samples, problem, seed)
    variance = examine_variance(final.fit.forward)
    codes = missing_codes(dataset.codes, noise=camera.noise.floor / camera.sensor.lsb)
    named = result.log_likelihood - result.start_log_likelihood
    explained = _explained(baseline, result, unknown)
    described = None
    # a curve of the light that is not refitted leaves a smooth rest by itself
    linear = any(one.effect in LINEAR for one in result.found)
    if unknown is not None and not linear and _is_unknown(unknown, named, baseline, final):
        described = _described(unknown, baseline, result, seed)
    setup = check_setup(
        final.fit if described is None else described.fit,
        explained=explained,
        physics=bool(result.found) or described is not None,
    )
    reason = None if variance.pixels_vary_together or codes is not None else setup.reason
    say("held-out poses before and after")
    return _verdict(
        camera=camera,
        dataset=dataset,
        result=result,
        unknown=described,
        rest=unknown,
        variance=variance,
        codes=codes,
        reason=reason,
        seed=seed,
    )


def _hopeless(problem: Problem, camera: Camera, variance: Variance, seed: int) -> Diagnosis:
    """Return the diagnosis of a recording for which no parameters can be found: the setup is another.

    Raises `InputError` where not one pixel can be compared.
    """
    frozen = replace(problem, effects=(), gain=False, robust=False)
    folds = folds_of(problem.dataset)
    step = explore(frozen, camera, [], folds, replicates=0, iterations=0, seed=seed)
    setup = check_setup(step.fit)
    reason = setup.reason or (
        "no parameters of the camera bring recording and scene together: another scene, a board swapped or "
        "turned, or poses of another recording"
    )
    likelihood = step.scores.log_likelihood()
    result = Result(camera, [], [step], likelihood, likelihood, frozen, folds)
    return Diagnosis(
        verdict="inconsistent_setup",
        missing=[],
        adjusted=[],
        ranking=[],
        indistinguishable=[],
        where=of_residuals(step.fit),
        before=of_residuals(step.fit),
        accuracy=accuracy(camera, camera, result),
        variance=variance,
        camera=camera,
        baseline=step,
        final=step,
        found=[],
        next_recording=None,
        reason=reason,
        notes=list(problem.dataset.notes),
    )


def _silent(text: str) -> None:
    return None


def _explained(baseline: Exploration, result: Result, unknown: _Unknown | None) -> float:
    """Return the share of the baseline's excess chi-square that the final fit explains."""
    before, rows = baseline.scores.chi_square()
    after, _ = result.explorations[-1].scores.chi_square()
    excess = before - rows
    if excess <= 0:
        return 0.0
    by_unknown = 2 * unknown.gain if unknown is not None else 0.0
    return max(before - after, by_unknown) / excess


def _is_unknown(unknown: _Unknown | None, named: float, baseline: Exploration, final: Exploration) -> bool:
    if unknown is None:
        return False
    if unknown.on_top < max(_LEAST_UNKNOWN, 1.5 * unknown.threshold):
        return False
    return unknown.on_top > DOUBT * named


def _unknown(result: Result, samples: Mapping[str, Array], problem: Problem, seed: int) -> _Unknown | None:
    """Find the best smooth term or fine structure, over the baseline and on top of what was named."""
    baseline, final = result.explorations[0], result.explorations[-1]
    options: list[_Unknown] = []
    best = final.best_further()
    structures = fine_structures(final.fit, result.folds)
    least = _LEAST_UNKNOWN
    if best is not None and best[0] > max(least, 1.5 * float(final.thresholds[best[1]])):
        gain, k = best
        threshold = float(final.thresholds[k])
        covariates: tuple[str, ...] = (final.candidates[k].variant,)
        camera = final.candidates[k].build(final.fit.camera, final.scores.values(final.spans[k]))
        pairs = pair_terms(dict(samples), smooth_pairs(final))
        if pairs and gain > 2 * least:
            step = explore(
                result.problem,
                final.fit.camera,
                [],
                result.folds,
                further=pairs,
                views=final.fit.forward.views,
                seed=seed,
                replicates=0,
                iterations=1,
            )
            two = step.best_further()
            if two is not None and two[0] > 1.1 * gain + threshold:
                gain, k = two
                covariates = tuple(step.candidates[k].variant.split(","))
                camera = step.candidates[k].build(step.fit.camera, step.scores.values(step.spans[k]))
        over = gain
        for j in range(baseline.named, len(baseline.candidates)):
            if baseline.candidates[j].variant == covariates[0]:
                over = max(over, float(baseline.gains[j]))
        options.append(_Unknown(over, covariates, camera, gain, threshold))
    if structures and structures[0].gain > least:
        fine = structures[0]
        table = fine_table(fine, final.fit)
        camera = final.fit.camera if table is None else with_table(final.fit.camera, table)
        options.append(_Unknown(fine.gain, fine.covariates, camera, fine.gain, least))
    return max(options, key=lambda one: one.on_top, default=None)


def _verdict(
    *,
    camera: Camera,
    dataset: Dataset,
    result: Result,
    unknown: _Described | None,
    rest: _Unknown | None,
    variance: Variance,
    codes: MissingCodes | None,
    reason: str | None,
    seed: int,
) -> Diagnosis:
    baseline, final = result.explorations[0], result.explorations[-1]
    fitted = final.fit
    notes = sorted({*fitted.notes, *fitted.forward.notes, *dataset.notes})
    unseen = _unseen(baseline)
    ranking = _ranking(baseline, result)
    probabilities = {name: p for name, p, _ in ranking}
    ties = [sorted({one.effect, *one.ties}) for one in result.found if one.ties]
    missing: list[Missing] = []
    model = fitted.camera
    if variance.pixels_vary_together:
        named = {one.effect for one in result.found}
        dropped = {name for name in OF_POSES if name not in camera.effects and name not in named}
        model = with_effects(model, {name: one for name, one in model.effects.items() if name not in dropped})
    origin = camera
    where = nowhere(fitted)
    if reason is not None:
        verdict = "inconsistent_setup"
        model = camera
        where = of_residuals(baseline.fit)
        final = baseline
        ties = []
    elif unknown is not None and (not result.found or unknown.gain > BEYOND * result.found[0].gain):
        model, where, missing = unknown.camera, unknown.where, [unknown.missing]
        verdict = "unknown_physics"
        ties = []
    elif result.found:
        verdict = "missing_physics"
        intervals = intervals_of(final, seed=seed)
        for one in result.found:
            share = sum(probabilities.get(name, 0.0) for name in {one.effect, *one.ties})
            if one is not result.found[0]:
                # given those before it, against nothing more being missing
                share = float(1 / (1 + np.exp(-min(one.gain, 500.0))))
            missing.append(_missing(one.effect, fitted, intervals, min(max(share, 0.0), 1.0)))
        where = of_terms(fitted, [one.effect for one in result.found], origin)
    else:
        verdict = "consistent"
    adjusted = adjusted_terms(camera, baseline.fit if verdict == "consistent" else fitted)
    if verdict == "consistent":
        if adjusted and _parameters_matter(camera, result):
            verdict = "wrong_parameters"
            where = of_change(fitted, camera)
        else:
            adjusted = []
            model = camera
    if verdict == "inconsistent_setup":
        adjusted = []
    shifted = rest is not None or bool(missing)
    verdict, missing, model = _with_variance(verdict, missing, adjusted, model, variance, ties, shifted)
    if codes is not None and verdict != "inconsistent_setup":
        verdict, missing = "unknown_physics", [_codes(codes, camera)]
        where = of_residuals(fitted)
    measure = accuracy(camera, model, result, unknown if verdict == "unknown_physics" else None)
    return Diagnosis(
        verdict=verdict,
        missing=missing,
        adjusted=adjusted,
        ranking=ranking,
        indistinguishable=ties,
        where=where,
        before=of_residuals(baseline.fit),
        accuracy=measure,
        variance=variance,
        camera=model,
        baseline=baseline,
        final=final,
        found=result.found if verdict == "missing_physics" else [],
        next_recording=_next_recording(ties, unseen, verdict),
        reason=reason,
        unseen=unseen,
        notes=notes,
        smooth_rest=None if rest is None else (" and ".join(rest.covariates), rest.on_top),
    )


def _ranking(baseline: Exploration, result: Result) -> list[tuple[str, float, float]]:
    """Return effect, probability and held-out gain [nats] of every effect alone, the best first.

    The gain of what was fitted non-linearly is that of the fit.
    """
    gains = {effect: float(baseline.gains[k]) for effect, k in baseline.best().items()}
    if result.found:
        first = result.found[0]
        gains[first.effect] = max(first.gain, gains.get(first.effect, first.gain))
        for one in result.found[1:]:
            gains.setdefault(one.effect, one.gain)
    values = np.array([*gains.values(), 0.0])
    weights = np.exp(values - values.max())
    weights /= weights.sum()
    ranking = [(name, float(w), g) for (name, g), w in zip(gains.items(), weights[:-1], strict=True)]
    return sorted(ranking, key=lambda one: -one[2])


def _unseen(step: Exploration) -> list[str]:
    """Return the effects that this recording could not show: less is learnt of them than chance."""
    seen: dict[str, float] = {}
    for k in range(step.named):
        name = step.candidates[k].effect
        seen[name] = max(seen.get(name, 0.0), step.scores.information(step.spans[k]))
    absent = set(registry()) - set(step.fit.camera.effects) - set(seen)
    hidden = {name for name, info in seen.items() if info < 1.0}
    silent = {"integral_table", "empirical", "reference_path", "fixed_pattern_offset"}
    return sorted((absent | hidden) - silent)


def intervals_of(step: Exploration, *, seed: int = 0) -> dict[str, tuple[float, float, float]]:
    """Return value and 95 % interval of each parameter.

    From a parametric bootstrap (replicates of noise, errors of poses and powers in the normal equations,
    around the fit), widened where a jackknife over folds of poses says so.
    """
    fitted, scores = step.fit, step.scores
    count = len(fitted.parameters)
    nulls = null_scores(
        fitted.equations,
        range(count),
        replicates=200,
        seed=seed + 1,
        temper=scores.temper,
        errors=fitted.nuisances,
    )
    matrix = scores.full.gram[:count, :count] + np.diag(scores.prior[:count] ** -2)
    scale = scores.prior[:count]
    inner = matrix * scale[:, None] * scale[None, :]
    draws = scale[:, None] * np.linalg.solve(inner, nulls.full.right[:count] * scale[:, None])
    # the prior shrinks replicates as it shrinks the estimate: its own width belongs to the interval
    posterior = np.sqrt(np.diag(np.linalg.inv(inner))) * scale
    spread = np.maximum(draws.std(axis=1), posterior)
    if len(scores.trained) >= 4:
        folds = len(scores.trained)
        parts = np.array(
            [list(scores.values(leave_out=k).values())[:count] for k in range(folds)], dtype=float
        )
        jackknife = np.sqrt((folds - 1) / folds * np.sum((parts - parts.mean(axis=0)) ** 2, axis=0))
        spread = np.maximum(spread, np.where(jackknife > 2.5 * spread, jackknife, 0.0))
    gain = fitted.camera.radiometry.gain
    result = {}
    for i, (path, value) in enumerate(fitted.parameters.items()):
        width = 1.96 * spread[i] * (gain if path == "radiometry.gain" else 1.0)
        result[path] = (value, value - width, value + width)
    return result


def _missing(
    name: str, fitted: Fit, intervals: Mapping[str, tuple[float, float, float]], probability: float
) -> Missing:
    camera = fitted.camera
    effect = camera.effects.get(name)
    if effect is None:
        if name in LINEAR:
            return Missing(name, probability, {}, {}, _GEOMETRY_SENTENCE[name])
        prefix = "optics."
        own = {path.removeprefix(prefix): v for path, v in intervals.items() if path.startswith(prefix)}
        sentence = _GEOMETRY_SENTENCE[name]
        values = {
            path.removeprefix(prefix): v
            for path, v in camera_numbers(camera).items()
            if path.startswith(prefix)
        }
    else:
        prefix = f"effects.{name}."
        own = {path.removeprefix(prefix): v for path, v in intervals.items() if path.startswith(prefix)}
        sentence = effect.sentence()
        values = {
            path.removeprefix(prefix): v
            for path, v in camera_numbers(camera).items()
            if path.startswith(prefix)
        }
    size = None if name in OF_AMPLITUDE else _size(fitted, name)
    if size is not None:
        sentence += f"; it moves distances by up to {size * 1e3:.3g} mm in this recording"
    return Missing(
        effect=name,
        probability=probability,
        parameters=values,
        interval={path: (low, high) for path, (_, low, high) in own.items()},
        sentence=sentence,
        magnitude=size,
    )


_GEOMETRY_SENTENCE = {
    "radiometry": "radiometry: surfaces do not reflect as Lambert says; amplitudes depend otherwise on "
    "the angle "
    "of incidence than the scene's simulation",
    "camera_constant": "camera constant: focal length or principal point differ from the camera file's",
    "lens_distortion": "lens distortion: the rays bend other than the camera file's distortion says",
}


def _size(fitted: Fit, name: str) -> float | None:
    from rim_camera_ros.calibrate.search import contribution

    values = []
    for one in fitted.forward.predictions():
        image = contribution(one, name, fitted.start)
        values.append(np.abs(np.broadcast_to(image, one.used.shape)[one.used]))
    everything = np.concatenate(values) if values else np.zeros(0)
    return float(np.quantile(everything, 0.99)) if everything.size else None


@dataclass(frozen=True)
class _Described:
    """Unknown physics with its table fitted jointly with the known terms."""

    gain: float
    camera: Camera
    fit: Fit
    where: Where
    missing: Missing


def _described(unknown: _Unknown, baseline: Exploration, result: Result, seed: int) -> _Described:
    """Fit the table in place of the named effects and describe it."""
    start = baseline.fit.camera
    table = unknown.camera.effects.get("empirical")
    model = start
    where = of_residuals(baseline.fit)
    fitted = baseline.fit
    if table is not None and "empirical" not in start.effects:
        model, fitted = _refit_table(unknown, baseline, result, seed)
        where = of_terms(fitted, ["empirical"], start)
    curve = next(iter(where.curves.items()), None)
    formula = None
    magnitude = float(np.sqrt(np.mean(where.pixels))) if where.pixels.size else 0.0
    if curve is not None:
        name, (x, y, sigma) = curve
        formula = closed_form(name, x, y, sigma)
        magnitude = float(np.ptp(y) / 2)
    shown = " and ".join(unknown.covariates)
    sentence = (
        f"unknown physics: distances depend on {shown} in a way that no effect of the vocabulary explains, "
        f"by about ±{magnitude * 1e3:.2g} mm"
    )
    if formula is not None:
        sentence += f"; described by {formula}"
    missing = Missing(
        UNKNOWN, 1.0, {}, {}, sentence, covariates=unknown.covariates, magnitude=magnitude, formula=formula
    )
    return _Described(unknown.gain, model, fitted, where, missing)


def _refit_table(unknown: _Unknown, baseline: Exploration, result: Result, seed: int) -> tuple[Camera, Fit]:
    """Estimate the table jointly with the baseline, without the effects that had stood in for it."""
    from rim_camera_ros.diagnose.smooth import Axis, smooth_candidate

    table: Any = unknown.camera.effects["empirical"]
    start = baseline.fit.camera
    if len(table.covariates) == 2 and len(table.knots[0]) > 40:
        # fine structure: its own shrinkage is better than the adjustment's
        model = added(start, table)
        step = explore(
            result.problem, model, [], result.folds, views=baseline.fit.forward.views, seed=seed, replicates=0
        )
        return step.fit.camera, step.fit
    axes = [Axis(name, knots) for name, knots in zip(table.covariates, table.knots, strict=True)]
    candidate = smooth_candidate(axes)
    step = explore(
        replace(result.problem, geometry=()),
        start,
        [],
        result.folds,
        further=[candidate],
        views=baseline.fit.forward.views,
        seed=seed,
        replicates=0,
    )
    model = candidate.build(step.fit.camera, step.scores.values(step.spans[0]))
    final = explore(
        replace(result.problem, geometry=()),
        model,
        [],
        result.folds,
        views=baseline.fit.forward.views,
        seed=seed,
        replicates=0,
    )
    return final.fit.camera, final.fit


def _parameters_matter(camera: Camera, result: Result) -> bool:
    """Say whether freeing the known terms gains on held-out poses beyond the threshold."""
    fitted = result.explorations[-1].fit
    changed_gain = abs(fitted.camera.radiometry.gain / camera.radiometry.gain - 1) > LEAST_GAIN
    if total_change(camera, fitted) < LEAST_TOTAL and not changed_gain:
        return False
    frozen = replace(result.problem, effects=(), gain=False, geometry=())
    folds = folds_of(result.problem.dataset)
    step = explore(frozen, camera, [], folds, replicates=0, views=result.fit.forward.views, iterations=2)
    gain = result.explorations[-1].scores.log_likelihood() - step.scores.log_likelihood()
    return gain > max(result.explorations[0].threshold, 10.0)


def _with_variance(
    verdict: str,
    missing: list[Missing],
    adjusted: list[Adjusted],
    model: Camera,
    variance: Variance,
    ties: list[list[str]],
    shifted: bool,
) -> tuple[str, list[Missing], Camera]:
    """Add what repeated frames say: a second camera, or another noise than the file's.

    Unmodulated light shifts distances as well (``shifted``: something does); what only adds noise is noise.
    """
    if verdict == "inconsistent_setup":
        return verdict, missing, model
    if variance.pixels_vary_together and "interference" not in model.effects:
        sentence = (
            "interference: all pixels vary together from frame to frame, "
            f"{variance.common or 0:.0f} times as much as independent noise would: a second camera"
        )
        missing = [*missing, Missing("interference", 1.0, {}, {}, sentence)]
        return ("missing_physics" if verdict != "unknown_physics" else verdict), missing, model
    if variance.noise_is_wrong:
        before, after = model.noise, variance.noise
        possible = variance.background > 0 and "background_light" not in model.effects
        if possible:
            ties.append(["background_light", "noise"])
        if possible and shifted:
            level = variance.background
            sentence = (
                f"background light: {level:.3g} counts of unmodulated light add photon noise; the "
                f"variance of "
                f"repeated frames is {variance.ratio:.2f} times the model's, most where it is dark"
            )
            named = Missing("background_light", 0.7, {"level": level}, {}, sentence)
            model = added(model, BackgroundLight(level=level))
            if {one.effect for one in missing} <= {UNKNOWN} and all(
                set(one.covariates) <= {"amplitude", "distance", "contrast"} for one in missing
            ):
                # what it adds to the distance goes with the light that a surface reflects of it
                missing, verdict = [], "missing_physics"
        else:
            sentence = (
                f"noise: the variance of repeated frames is {variance.ratio:.2f} times the model's; they fit "
                f"floor {after.floor * 1e3:.2g} mm and {after.amplitude:.3g} m*counts over the amplitude"
            )
            numbers = {"floor": after.floor, "shot": after.shot, "amplitude": after.amplitude}
            named = Missing("noise", 1.0, numbers, {}, sentence)
            adjusted.append(
                Adjusted(
                    "noise",
                    {"floor": before.floor, "shot": before.shot, "amplitude": before.amplitude},
                    numbers,
                )
            )
            model = replace(model, noise=after)
        missing = [*missing, named]
        if verdict != "unknown_physics":
            verdict = "missing_physics"
    return verdict, missing, model


def _codes(codes: MissingCodes, camera: Camera) -> Missing:
    step = codes.step * camera.sensor.lsb
    sentence = (
        f"unknown physics: beside {codes.share:.0%} of the frequent distance counts lie counts that never "
        f"occur "
        f"(steps of {codes.step:.0f} counts, {step * 1e3:.2g} mm): the read-out leaves out codes"
    )
    return Missing(
        UNKNOWN, 1.0, {}, {}, sentence, ("distance",), step / np.sqrt(12), "staircase of the distance"
    )


def _next_recording(ties: Sequence[Sequence[str]], unseen: Sequence[str], verdict: str) -> str | None:
    """Return what to record to tell rivals apart."""
    if not ties:
        return None
    known = registry()
    parts = []
    for names in ties:
        parts += [f"for {name}: {known[name].observable}" for name in names if name in known]
    return "; ".join(parts) if parts else None
