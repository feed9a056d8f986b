"""The curve by which an effect shows: the covariate to draw, and the classes of residuals over it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.diagnose.formula import formula_curve
from rim_camera_ros.diagnose.result import Diagnosis
from rim_camera_ros.effects import CovariateTable, vocabulary
from rim_camera_ros.reports.diagnosis.classes import Bins, binned, explained
from rim_camera_ros.reports.diagnosis.evidence import Evidence
from rim_camera_ros.reports.diagnosis.figures import Telling
from rim_camera_ros.reports.diagnosis.words import axis_of, title_of

Array = NDArray[Any]

_MOST = 6
_FINE = 60
_LEAST_SHARE = 0.03


def curves_of(result: Diagnosis, found: Evidence) -> list[Telling]:
    """Return the telling curves of all effects that are shown."""
    items: list[Telling] = []
    for name in found.changed:
        if vocabulary()[name].shows_in == "amplitude":
            items += _of_amplitude(found, name)
        else:
            items += _of_distance(result, found, name)
    return items[:_MOST]


def _of_distance(result: Diagnosis, found: Evidence, name: str) -> list[Telling]:
    samples = found.samples
    part = samples.parts[name]
    names = [c for c in _covariates(result, name) if _varies(samples.covariates[c])][:1]
    items = []
    for covariate in names:
        settings = np.unique(samples.setting[np.isfinite(samples.setting)])
        effect = result.camera.effects.get(name)
        # a term that depends on the setting alone is drawn over it
        rows = effect is not None and covariate != "integration_time" and bool(effect.rows())
        if rows and 1 < settings.size <= 4:
            for setting in settings:
                own = samples.setting == setting
                items += _over(found, name, covariate, own, f"{title_of(name)}, setting {setting:g}")
        else:
            items += _over(found, name, covariate, np.ones(part.size, bool), title_of(name), result)
    if items:
        return items
    items = _against_itself(found, name)
    best = explained(samples, part)
    if best and best[0][1] > _LEAST_SHARE:
        items += _over(found, name, best[0][0], np.ones(part.size, bool), title_of(name))
    return items


def _covariates(result: Diagnosis, name: str) -> tuple[str, ...]:
    table = result.camera.effects.get(name)
    if isinstance(table, CovariateTable):
        return tuple(table.covariates) if len(table.covariates) == 1 else ()
    return vocabulary()[name].drawn_over


def _varies(values: Array) -> bool:
    known = values[np.isfinite(values)]
    return bool(known.size) and float(np.ptp(known)) > 1e-6 * max(1e-6, float(np.abs(known).max()))


def _over(
    found: Evidence, name: str, covariate: str, own: Array, title: str, result: Diagnosis | None = None
) -> list[Telling]:
    samples = found.samples
    label, factor, log = axis_of(covariate, samples.covariates[covariate][own])
    drawn = _drawn(
        samples.covariates[covariate][own] * factor,
        samples.parts[name][own] * 1e3,
        samples.after[own] * 1e3,
        weight=samples.weight[own],
        station=samples.station[own],
    )
    if drawn is None:
        return []
    bins, effect = drawn
    unknown = name == CovariateTable.name and result is not None
    return [
        Telling(
            title,
            label,
            "distance [mm]",
            bins,
            effect,
            log,
            lines=_closed_form(result, bins, effect[0], factor) if unknown and result is not None else (),
            discrete=covariate == "integration_time" and bins.x.size <= 6,
            band=unknown,
        )
    ]


def _drawn(
    x: Array, part: Array, after: Array, *, weight: Array, station: Array, by_size: bool = False
) -> tuple[Bins, tuple[Array, Array]] | None:
    """Return classes of (without, after, effect), and the effect over finer ones; None below two classes."""
    bins = binned(x, (after + part, after, part), weight=weight, station=station, count=18, by_size=by_size)
    if bins.x.size < 2:
        return None
    fine = binned(x, (part,), weight=weight, station=station, count=_FINE)
    return bins, (fine.x, fine.means[0])


def _closed_form(
    result: Diagnosis, bins: Bins, reach: Array, factor: float
) -> tuple[tuple[str, Array, Array], ...]:
    formula = next((effect.formula for effect in result.missing if effect.formula), None)
    if formula is None:
        return ()
    x = np.linspace(reach.min(), reach.max(), 200)
    y = formula_curve(formula, x / factor)
    at = formula_curve(formula, bins.x / factor)
    if y is None or at is None or not np.all(np.isfinite(y)):
        return ()
    # a constant belongs to the fixed pattern, so that only the shape is comparable
    shift = float(np.average(bins.means[2] - at * 1e3, weights=1 / np.maximum(bins.errors[1], 1e-9) ** 2))
    return (("closed form", x, y * 1e3 + shift),)


def _against_itself(found: Evidence, name: str) -> list[Telling]:
    samples = found.samples
    part, after = samples.parts[name] * 1e3, samples.after * 1e3
    drawn = _drawn(part, part, after, weight=samples.weight, station=samples.station, by_size=True)
    if drawn is None:
        return []
    return [Telling(title_of(name), "predicted effect [mm]", "distance [mm]", *drawn, diagonal=True)]


def _of_amplitude(found: Evidence, name: str) -> list[Telling]:
    samples = found.samples
    covariate = (*vocabulary()[name].drawn_over, "amplitude")[0]
    x = samples.covariates[covariate]
    if not _varies(x):
        return []
    label, factor, log = axis_of(covariate, x)
    part, after = samples.brightness_part * 100, samples.brightness * 100
    drawn = _drawn(x * factor, part, after, weight=np.ones(x.size), station=samples.station)
    return [] if drawn is None else [Telling(title_of(name), label, "amplitude [%]", *drawn, log)]
