"""Physics that no effect of the vocabulary explains: found, fitted as a table, and described in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import added, in_order
from rim_camera_ros.diagnose.added_light import COVARIATES_OF_LIGHT, added_light, sentence_of_light
from rim_camera_ros.diagnose.formula import closed_form, product_form
from rim_camera_ros.diagnose.result import Missing
from rim_camera_ros.diagnose.smooth import UNKNOWN, pair_terms
from rim_camera_ros.diagnose.unknown import (
    FineStructure,
    fine_image,
    fine_structures,
    fine_table,
    smooth_pairs,
    with_table,
)
from rim_camera_ros.diagnose.where import Where, of_residuals, of_terms, of_values
from rim_camera_ros.effects import AdditionalLight, CovariateTable
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.fit.correlated_errors import correlated_error_of
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.residuals import after_nuisances
from rim_camera_ros.fit.variance_components import correlated_error_note, correlated_error_rms
from rim_camera_ros.select.at_rest import note_on_smoothing
from rim_camera_ros.select.compare import Result, curve_of_forms
from rim_camera_ros.select.effect_sizes import effect_size
from rim_camera_ros.select.exploration import Exploration, explore
from rim_camera_ros.select.thresholds import LEAST_EXPLAINED, noise_limit

Array = NDArray[Any]

_LEAST_UNKNOWN = 20.0
#: Share of the gain of the named effects that a smooth remainder must gain before they are in doubt.
DOUBT = 0.15


@dataclass(frozen=True)
class Rest:
    """The best description outside the vocabulary: its gain over the baseline, covariates, and camera.

    ``on_top`` is its gain conditional on the effects found, ``threshold`` its entry threshold. ``model`` is
    the effect of the camera that describes it (None: slopes per pixel, which no effect describes).
    """

    gain: float
    covariates: tuple[str, ...]
    camera: Camera
    on_top: float
    threshold: float
    model: str | None = CovariateTable.name
    fine: FineStructure | None = None


def best_rest(result: Result, samples: Mapping[str, Array], seed: int) -> Rest | None:
    """Find the best smooth term, fine structure or added light, conditional on the effects named.

    Added light is tried where a smooth term gains: its errors vary over the array, light and distance.
    """
    baseline, final = result.explorations[0], result.explorations[-1]
    options: list[Rest] = []
    best = final.best_further()
    structures = fine_structures(final.fit, result.folds)
    least = _LEAST_UNKNOWN
    if best is not None and best[0] > max(least, 1.5 * float(final.thresholds[best[1]])):
        gain, k = best
        threshold = float(final.thresholds[k])
        covariates = tuple(final.candidates[k].variant.split(","))
        camera = in_order(final.candidates[k].build(final.fit.camera, final.scores.values(final.spans[k])))
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
                camera = in_order(
                    step.candidates[k].build(step.fit.camera, step.scores.values(step.spans[k]))
                )
        over = gain
        for j in range(baseline.named, len(baseline.candidates)):
            if baseline.candidates[j].variant in (covariates[0], ",".join(covariates)):
                over = max(over, float(baseline.gains[j]))
        options.append(Rest(over, covariates, camera, gain, threshold))
    if structures and structures[0].gain > least:
        fine = structures[0]
        table = fine_table(fine)
        camera = final.fit.camera if table is None else with_table(final.fit.camera, table)
        model = None if table is None else CovariateTable.name
        options.append(Rest(fine.gain, fine.covariates, camera, fine.gain, least, model, fine))
    if best is not None and best[0] > float(final.thresholds[best[1]]):
        light = added_light(result, seed)
        if light is not None and light.on_top > max(least, 1.5 * light.threshold):
            options.append(
                Rest(
                    light.gain,
                    COVARIATES_OF_LIGHT,
                    light.camera,
                    light.on_top,
                    light.threshold,
                    AdditionalLight.name,
                )
            )
    return max(options, key=lambda rest: rest.on_top, default=None)


def explained_share(result: Result, unknown: Rest | None) -> float:
    """Return the share of the excess chi-square that the final fit explains, each step by its own pixels."""
    chi_squares = [exploration.scores.chi_square() for exploration in result.explorations]
    after, rows = chi_squares[-1]
    at = result.beside_edges
    explained = chi_squares[0][0] - after
    if at is not None:
        # from that step on there are more pixels
        explained += chi_squares[at][0] - chi_squares[at - 1][0]
    excess = explained + after - rows
    if excess <= 0:
        return 0.0
    by_unknown = 2 * unknown.gain if unknown is not None else 0.0
    return max(explained, by_unknown) / excess


def is_unknown(unknown: Rest, named: float, final: Exploration, result: Result) -> bool:
    """Return whether the remainder is more than inexact forms of the named effects leave."""
    if unknown.on_top < max(_LEAST_UNKNOWN, 1.5 * unknown.threshold):
        return False
    # an inexact form of a named effect leaves a smooth remainder over its own covariates
    curve = None if unknown.fine is not None else curve_of_forms(final, result.found)
    of_forms = 0.0 if curve is None else max(curve[0], 0.0)
    return unknown.on_top - of_forms > DOUBT * named


@dataclass(frozen=True)
class Described:
    """Unknown physics with its table fitted jointly with the known terms."""

    gain: float
    camera: Camera
    fit: Fit
    where: Where
    missing: Missing


def describe(unknown: Rest, baseline: Exploration, result: Result, seed: int) -> Described:
    """Fit the table or the light in place of the named effects and describe it."""
    start = baseline.fit.camera
    if unknown.model == AdditionalLight.name:
        return _describe_light(unknown, start, result, seed)
    table = effect_of(unknown.camera, CovariateTable)
    model = start
    where = of_residuals(baseline.fit)
    fitted = baseline.fit
    modelled = table is not None and effect_of(start, CovariateTable) is None
    if modelled:
        model, fitted = _refit_table(unknown, baseline, result, seed)
        where = of_terms(fitted, [CovariateTable.name], start)
    elif unknown.fine is not None:
        # slopes per pixel are no table of two covariates, but have a place and a size
        fine = unknown.fine
        where = of_values(fitted, lambda predicted: fine_image(fine, predicted))
    curve = next(iter(where.curves.items()), None)
    formula, missed = None, 0.0
    magnitude = 0.0
    fitted_table = effect_of(model, CovariateTable)
    values = None if not modelled or fitted_table is None else fitted_table.values.values
    if values is not None and fitted_table is not None and values.shape == (2, 2):
        first, second = fitted_table.covariates
        formula = product_form((first, second), fitted_table.knots, values)
        magnitude = abs(float(values[1, 1] - values[1, 0] - values[0, 1] + values[0, 0])) / 4
    elif unknown.fine is not None:
        magnitude = 2.0 * float(np.sqrt(np.mean(unknown.fine.slopes**2)))
    elif curve is not None:
        name, (x, y, sigma) = curve
        formula, missed = closed_form(name, x, y, sigma)
        magnitude = float(np.ptp(y) / 2)
    shown = " and ".join(unknown.covariates)
    sentence = (
        f"unknown physics: distances depend on {shown} in a way that no effect of the vocabulary explains, "
        f"by about ±{magnitude * 1e3:.3g} mm"
    )
    if formula is not None and missed == 0.0:
        sentence += f"; described by {formula}"
    elif formula is not None:
        sentence += f"; described by {formula}, which misses its curve by {missed * 1e3:.2g} mm (RMS)"
    missing = Missing(
        UNKNOWN,
        1.0,
        {},
        {},
        sentence,
        covariates=unknown.covariates,
        magnitude=magnitude,
        formula=formula,
        model=CovariateTable.name if modelled else None,
    )
    return Described(unknown.gain, model, fitted, where, missing)


def _describe_light(unknown: Rest, start: Camera, result: Result, seed: int) -> Described:
    """Fit light that does not come from the scene in place of the named effects, and describe it."""
    light = effect_of(unknown.camera, AdditionalLight)
    assert light is not None
    step = explore(
        replace(result.problem, geometry=(), reflectance=False, response=None),
        added(start, light),
        [],
        result.folds,
        views=result.fit.forward.views,
        seed=seed,
        replicates=0,
    )
    name = AdditionalLight.name
    fitted = step.fit
    magnitude = effect_size(fitted, [name], start)
    missing = Missing(
        UNKNOWN,
        1.0,
        {},
        {},
        sentence_of_light(fitted, magnitude),
        covariates=COVARIATES_OF_LIGHT,
        magnitude=magnitude,
        model=name,
    )
    return Described(unknown.gain, fitted.camera, fitted, of_terms(fitted, [name], start), missing)


def unexplained(fitted: Fit, chi_square: float) -> tuple[Missing, Where]:
    """Return the entry for a misfit that no effect and no smooth function explains, and where it is."""
    where = of_residuals(fitted)
    names = tuple(name for name, _ in where.covariates)
    most = f"; they vary most over {' and '.join(names)}" if names else ""
    limit, few, held = _gross_values(fitted)
    if held > LEAST_EXPLAINED:
        most += (
            f"; {few:.1%} of the values, beyond {limit:.1f} sigma, hold {held:.0%} of it, as a hand or a "
            "cable before the surfaces would"
        )
    if note_on_smoothing(fitted.forward.dataset) is not None:
        most += "; the driver smooths its images, which no camera file describes"
    sentence = (
        f"unknown physics: held-out values scatter by {np.sqrt(chi_square):.2f} times what noise and errors "
        f"of poses explain; neither an effect of the vocabulary nor a smooth function describes it{most}"
    )
    size = float(np.sqrt(max(chi_square - 1, 0.0) * np.mean(_variances(fitted))))
    return Missing(UNKNOWN, 1.0, {}, {}, sentence, covariates=names, magnitude=size), where


def _gross_values(fitted: Fit) -> tuple[float, float, float]:
    """Return the limit of noise [sigma], the share of distances beyond it, and that of the misfit in them."""
    squares = []
    for prediction in fitted.forward.predictions(slopes=False):
        rest, _ = after_nuisances(prediction, fitted.pattern, fitted.nuisances)
        squares.append((rest / prediction.sigma)[prediction.used] ** 2)
    every = np.concatenate(squares)
    limit = noise_limit(every.size)
    excess, gross = float(np.sum(every - 1)), every > limit**2
    held = float(np.sum(every[gross] - 1)) / excess if excess > 0 else 0.0
    # the others may scatter less than expected
    return limit, float(gross.mean()), min(held, 1.0)


def of_correlated_errors(fitted: Fit) -> tuple[Missing, Where]:
    """Return the entry for errors that neighbours share in a fit, independent by pose, and where they are."""
    where = of_values(fitted, lambda predicted: correlated_error_of(predicted, fitted.nuisances))
    sentence = f"unknown physics: {correlated_error_note(fitted)}"
    return Missing(UNKNOWN, 1.0, {}, {}, sentence, magnitude=correlated_error_rms(fitted)), where


def _variances(fitted: Fit) -> Array:
    """Return the variances [m^2] of the distances that were fitted."""
    return np.concatenate(
        [prediction.sigma[prediction.used] ** 2 for prediction in fitted.forward.predictions(slopes=False)]
    )


def _refit_table(unknown: Rest, baseline: Exploration, result: Result, seed: int) -> tuple[Camera, Fit]:
    """Estimate the table jointly with the baseline, without the effects that were named before."""
    from rim_camera_ros.diagnose.smooth import Axis, smooth_candidate

    table: Any = unknown.camera.effects[CovariateTable.name]
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
        replace(result.problem, geometry=(), reflectance=False, response=None),
        start,
        [],
        result.folds,
        further=[candidate],
        views=baseline.fit.forward.views,
        seed=seed,
        replicates=0,
    )
    model = in_order(candidate.build(step.fit.camera, step.scores.values(step.spans[0])))
    final = explore(
        replace(result.problem, geometry=(), reflectance=False, response=None),
        model,
        [],
        result.folds,
        views=baseline.fit.forward.views,
        seed=seed,
        replicates=0,
    )
    return final.fit.camera, final.fit
