"""The selection of effects and their joint fit: by search, or exactly the requested ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from rim_camera_ros.calibrate.effect_status import (
    EffectStatus,
    statuses,
    undeterminable,
    undetermined_effects,
)
from rim_camera_ros.calibrate.sandwich_covariance import widening
from rim_camera_ros.calibrate.solution import Solution, count_outliers
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import added, with_effects
from rim_camera_ros.effects import (
    OF_SURFACES,
    OPTICS,
    CovariateTable,
    PixelMap,
    PositionTable,
    effects_of,
    known_effects,
    vocabulary,
)
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.light_curves import SURFACES
from rim_camera_ros.effects.sections import light_block
from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.fit.covariate_table import empirical_block, empirical_covariates, empirical_start
from rim_camera_ros.fit.design import gain_block, present_blocks
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.residuals import ROBUST_LIMIT
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.views import Views
from rim_camera_ros.select.candidates import candidates
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.evidence import Scores, folds_of
from rim_camera_ros.select.exploration import explore
from rim_camera_ros.select.foreign_values import ForeignValues
from rim_camera_ros.select.search import search
from rim_camera_ros.select.subsample import MANY_PIXELS, at_stations, subsample_of
from rim_camera_ros.select.thresholds import WITHOUT_REPLICATES

Say = Callable[[str], None]
Key = tuple[int, int]

#: Most pixel values by which effects are tried that are not fitted.
MOST_VALUES = 3_000_000
#: Reasons to keep an effect as in the file: the recordings do not determine it, or it was not requested.
_KEPT_UNDETERMINED = "as in the file: these recordings do not determine it"
_KEPT_NOT_REQUESTED = "as in the file: not among --effects"
_LAMBERT = (
    "the surfaces do not reflect as Lambert says: their light over the angle of incidence is fitted as a "
    "curve, "
    "which is not part of the camera file"
)


@dataclass
class Outcome:
    """The solution of a problem, and its effects; ``effect_statuses`` returns the status of each effect.

    ``part`` is the result of a search of some of the poses, where not all were searched.
    """

    solution: Solution
    problem: Problem
    effect_statuses: Callable[[], list[EffectStatus]]
    found: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    part: Result | None = None
    foreign: ForeignValues | None = None


def by_search(
    problem: Problem,
    camera: Camera,
    facts: Facts,
    *,
    views: Views,
    say: Say,
    seed: int = 0,
    part_is_enough: bool = False,
    begin: Result | None = None,
    may_hold_foreign: bool = False,
) -> Outcome:
    """Fit the effects of the camera file that the recordings determine, and add those that a search finds.

    Large recordings are searched by some of their poses first; the search goes on with all poses, unless
    ``part_is_enough``. ``begin`` is the result by some of the poses, where it is known already. With
    ``may_hold_foreign`` values that do not see the scene are looked for before anything is added.
    """
    kept = _undetermined(problem, camera, say)
    names = [name for name in [*effects_of(camera), *OPTICS] if name not in kept and _is_fitted(name)]
    free = replace(problem, effects=tuple(names))
    asked = [name for name in names if name not in camera.effects and name not in problem.geometry]
    # surfaces that deviate from Lambert's law could otherwise be mistaken for other effects
    asked += sorted(OF_SURFACES)
    few = subsample_of(free, seed=seed, hold=MANY_PIXELS)
    if few is not None and begin is None:
        say(f"{len(few)} of {len(free.dataset.stations)} stations first")
        some = at_stations(free, few)
        begin = search(some, camera, facts, effects=asked, seed=seed, views=views, progress=say)
        # only its result is needed; its predictions are large
        begin = replace(begin, explorations=[])
    if begin is not None:
        say("all stations")
    part = begin if part_is_enough else None
    pool = asked if part is None else []
    result = search(
        free,
        camera,
        facts,
        effects=pool,
        begin=begin,
        may_hold_foreign=may_hold_foreign and begin is None,
        seed=seed,
        views=views,
        progress=say,
    )
    last = result.explorations[-1]
    solution = _solved(last.fit, last.scores, result.folds, camera, result.problem)
    named = list(last.candidates)[: len(last.spans)]
    ties = {finding.effect: finding.ties for finding in result.found}

    def effect_statuses() -> list[EffectStatus]:
        return statuses(
            last.fit,
            last.scores,
            named,
            last.spans,
            start=camera,
            kept=kept,
            threshold=last.threshold,
            ties=ties,
        )

    joined = [finding.effect for finding in result.found]
    notes = [_LAMBERT] if set(joined) & OF_SURFACES else []
    found_names = [name for name in joined if name not in OF_SURFACES]
    return Outcome(solution, result.problem, effect_statuses, found_names, notes, part, result.foreign)


def exactly(
    problem: Problem,
    camera: Camera,
    facts: Facts,
    words: Sequence[str],
    *,
    views: Views,
    say: Say,
    begin: Camera | None = None,
) -> Outcome:
    """Fit exactly the effects that are named; those absent start from the library's best variant.

    ``begin`` is a camera of an earlier fit of them, from which to go on.

    Raises `InputError` for unknown names, and where the recordings determine none of them.
    """
    names, covariates = checked_names(words)
    own = effect_of(camera, CovariateTable)
    if own is not None and own.name in words:
        covariates = own.covariates
    folds = folds_of(problem.dataset)
    geometry = tuple(dict.fromkeys([*problem.geometry, *(n for n in names if n in OPTICS)]))
    origin = problem.origin or camera
    problem = replace(problem, effects=tuple(names), geometry=geometry, origin=origin)
    notes: list[str] = []
    if own is not None and covariates is not None and covariates != own.covariates:
        notes.append(
            f"{own.name}: the file's table of {' and '.join(own.covariates)} gave way to one of "
            f"{' and '.join(covariates)}"
        )
    camera_start = camera
    camera, unseen = _with_absent(
        problem, camera if begin is None else begin, facts, names, folds, views, say
    )
    kept = {name: _KEPT_NOT_REQUESTED for name in camera.effects if name not in names and _is_fitted(name)}
    pool = [
        candidate for candidate in candidates(camera, facts) if candidate.effect not in (*geometry, *unseen)
    ]
    if covariates is not None:
        camera = _with_empirical(problem, camera, covariates, views)
    say("fitting " + (", ".join(names) or "offsets of pixels"))
    step = explore(problem, camera, [], folds, views=views, replicates=0, progress=say)
    fitted, scores = step.fit, step.scores
    undetermined = undetermined_effects(scores, [n for n in names if n in fitted.camera.effects])
    for name in dict.fromkeys([*unseen, *undetermined]):
        notes.append(f"{name} cannot be determined from these recordings: {undeterminable(name)}")
    asked = set(names) - {PixelMap.name}
    if asked and asked <= {*unseen, *undetermined}:
        raise InputError(
            notes[-1], place="--effects", remedy="without --effects those are fitted that can be"
        )
    solution = _solved(fitted, scores, folds, camera_start, problem)
    if undetermined:
        remaining = tuple(n for n in names if n not in undetermined)
        camera = _restored(fitted.camera, camera_start, undetermined)
        again = replace(problem, effects=remaining)
        step = explore(again, camera, [], folds, views=views, replicates=0, progress=say)
        solution = _solved(step.fit, step.scores, folds, camera_start, again)
        fitted = step.fit
        problem = again
        kept |= {name: _KEPT_UNDETERMINED for name in undetermined if name in camera_start.effects}
    final, pool_camera = problem, fitted.camera

    def effect_statuses() -> list[EffectStatus]:
        say("what else the recordings say")
        few, few_folds = _some_stations(final, folds)
        probe = explore(few, pool_camera, pool, few_folds, views=views, replicates=0, iterations=1)
        found = statuses(
            probe.fit,
            probe.scores,
            pool,
            probe.spans,
            start=camera_start,
            kept=kept,
            threshold=WITHOUT_REPLICATES,
        )
        return [
            replace(effect_status, status="left out", text=f"not among --effects; {effect_status.text}")
            if effect_status.status == "absent" and (effect_status.gain or 0.0) > WITHOUT_REPLICATES
            else effect_status
            for effect_status in found
        ]

    added_names = [n for n in names if n not in camera_start.effects]
    return Outcome(solution, problem, effect_statuses, added_names, notes)


def checked_names(words: Sequence[str]) -> tuple[list[str], tuple[str, ...] | None]:
    """Return the names of --effects and the covariates of the table over them, None without it.

    Raises `InputError` for a name that is not of the vocabulary, or that no joint fit can estimate.
    """
    names: list[str] = []
    covariates: tuple[str, ...] | None = None
    known = [*known_effects(), *OPTICS]
    for word in words:
        name = word.partition(":")[0]
        if name not in known or (":" in word and name != CovariateTable.name):
            raise InputError(f"unknown effect '{word}'", place="--effects", remedy=nearest_name(name, known))
        if name == CovariateTable.name:
            covariates = empirical_covariates(word)
        elif not _is_fitted(name) and name != PixelMap.name:
            raise InputError(
                f"{name} is not estimated from means of frames",
                place="--effects",
                remedy="leave it out: what the camera file says of it stays"
                if name != PositionTable.name
                else f"give it alone: --effects {name}",
            )
        names.append(name)
    return list(dict.fromkeys(names)), covariates


def _is_fitted(name: str) -> bool:
    """Whether the joint fit of mean frames estimates it."""
    return vocabulary()[name].estimated == "joint"


def _undetermined(problem: Problem, camera: Camera, say: Say) -> dict[str, str]:
    """Return the effects of the camera file that these recordings do not determine, with the reason."""
    names = [name for name in camera.effects if _is_fitted(name)]
    if not names:
        return {}
    say("what the recordings determine")
    fitted = fit(problem, camera, iterations=2)
    count = len(fitted.parameters)
    scores = Scores(fitted.equations, range(count))
    return dict.fromkeys(undetermined_effects(scores, names), _KEPT_UNDETERMINED)


def _with_absent(
    problem: Problem,
    camera: Camera,
    facts: Facts,
    names: Sequence[str],
    folds: Mapping[Key, int],
    views: Views,
    say: Say,
) -> tuple[Camera, list[str]]:
    """Return the camera with the effects that it lacks, and which of them do not show in the data.

    They are added one after the other, the one that explains most first, each by its best variant conditional
    on those added before.
    """
    missing = [n for n in names if n not in camera.effects and _is_fitted(n) and n not in OPTICS]
    unseen = [n for n in missing if not candidates(camera, facts, effects=[n])]
    missing = [n for n in missing if n not in unseen]
    while missing:
        say("starting values of " + ", ".join(missing))
        pool = candidates(camera, facts, effects=missing)
        step = explore(problem, camera, pool, folds, views=views, replicates=0, iterations=1)
        best = step.best()
        name = next(iter(best))
        camera = step.camera_with([best[name]])
        missing.remove(name)
    return camera, unseen


def _with_empirical(problem: Problem, camera: Camera, covariates: tuple[str, ...], views: Views) -> Camera:
    """Return the camera with a smooth function of the covariates, its own or one that begins at zero."""
    effect = effect_of(camera, CovariateTable)
    if effect is not None and effect.covariates == covariates:
        return camera
    forward = Forward(problem.dataset, problem.scene, camera, views=views)
    forward.masks = problem.masks
    forward.estimate_amplitudes()
    return added(camera, empirical_start(forward, covariates))


def _some_stations(problem: Problem, folds: Mapping[Key, int]) -> tuple[Problem, dict[Key, int]]:
    """Return the problem with evenly chosen stations, so few that candidates are tried within a minute."""
    stations = problem.dataset.stations
    pixels = stations[0].distance.size
    step = -(-len(stations) * pixels // MOST_VALUES)
    chosen = range(0, len(stations), max(1, min(step, len(stations) // 10)))
    masks = None if problem.masks is None else [problem.masks[i] for i in chosen]
    dataset = replace(problem.dataset, stations=[stations[i] for i in chosen])
    kept = {(station.recording, station.pose) for station in dataset.stations}
    numbers = {old: new for new, old in enumerate(sorted({folds[key] for key in kept}))}
    return replace(problem, dataset=dataset, masks=masks), {key: numbers[folds[key]] for key in kept}


def _restored(camera: Camera, before: Camera, names: Sequence[str]) -> Camera:
    """Return the camera with some effects as they were before, or without those that were absent before."""
    effects = {name: effect for name, effect in camera.effects.items() if name not in names}
    effects |= {name: before.effects[name] for name in names if name in before.effects}
    return with_effects(camera, effects)


def _solved(
    fitted: Fit, scores: Scores, folds: Mapping[Key, int], start: Camera, problem: Problem
) -> Solution:
    outliers, values = count_outliers(fitted, limit=ROBUST_LIMIT)
    blocks = present_blocks(fitted.camera, effects=problem.effects)
    if problem.gain:
        blocks.append(gain_block())
    blocks += [OPTICS[name].block(fitted.camera) for name in problem.geometry]
    if problem.reflectance:
        blocks.append(light_block(SURFACES))
    table = effect_of(fitted.camera, CovariateTable)
    if table is not None:
        blocks.append(empirical_block(table))
    return Solution(
        fitted,
        scores,
        folds,
        start,
        outliers,
        values,
        list(fitted.notes),
        widening(fitted, scores, blocks),
    )
