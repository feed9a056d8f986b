"""The calibration of a camera from recordings, as the command ``rim calibrate`` and the node call it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from rim_camera_ros.bags import Topics
from rim_camera_ros.calibrate import checks
from rim_camera_ros.calibrate.acceptance import beyond_form, refusals
from rim_camera_ros.calibrate.adjustment import adjust, steps_of
from rim_camera_ros.calibrate.effect_status import EffectStatus
from rim_camera_ros.calibrate.held_out import Accuracy, evaluate
from rim_camera_ros.calibrate.integral import IntegralFit
from rim_camera_ros.calibrate.joint import Outcome, checked_names
from rim_camera_ros.calibrate.large_sensor import LargeSensor
from rim_camera_ros.calibrate.provenance import Source, checksum, provenance
from rim_camera_ros.calibrate.recordings import Progress, Reducer, Watch, joined, placed_by_schedule
from rim_camera_ros.calibrate.reference_scale import NAME as REFERENCE
from rim_camera_ros.calibrate.reference_scale import PATHS, FittedReference, fit_reference, with_reference
from rim_camera_ros.calibrate.solution import Solution, high_correlations, stated
from rim_camera_ros.calibrate.validity import supported
from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import PositionTable
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.data import Dataset, merged, with_stated_errors
from rim_camera_ros.fit.decimation import decimated_camera
from rim_camera_ros.fit.noise import POOR, NoiseFit, fit_noise
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.at_rest import at_rest, note_on_smoothing

Array = NDArray[Any]

_INTEGRAL = PositionTable.name
_REPLACED = "the table stands in the place of all effects"
#: Common variation of frames above which something changes all pixels from frame to frame.
_COMMON = 3.0


@dataclass(frozen=True)
class Request:
    """The input of a calibration.

    ``recordings`` are of one camera, ``camera`` is its file so far, ``scene`` is one scene for all
    recordings, or one for each in their order. ``effects`` None: those of the camera file and those that the
    recordings require; else exactly those (``empirical:COVARIATE`` for a smooth function of it;
    ``integral_table`` alone for a table by position). ``geometry`` estimates the optics jointly with them.
    ``camera_name``, ``scene_name`` and ``command`` go into the provenance, and so do the ``originals`` from
    which recordings were made for this. The result is the same with any number of ``threads``.
    """

    recordings: tuple[Path, ...]
    camera: Camera
    scene: Scene | tuple[Scene, ...] | None
    effects: tuple[str, ...] | None = None
    geometry: bool = False
    topics: Topics | None = None
    seed: int = 0
    threads: int = 1
    camera_name: str = ""
    scene_name: str | None = None
    command: str = ""
    originals: tuple[Path, ...] | None = None


@dataclass
class Calibration:
    """The result: the ``camera`` to be written, the camera before, and the contents of the report.

    ``paths`` and ``covariance`` are those of the fitted parameters that the data determine. ``accuracy`` is
    that of the camera on held-out poses, ``integral_accuracy`` that of a table by position by the same poses
    (None: not made). ``refused`` are the reasons not to use it (none: it is a good one); ``correlations``
    those above 0.9; ``pattern_variance`` (H, W) [m^2] is that of the offsets of pixels.
    """

    camera: Camera
    before: Camera
    solution: Solution
    statuses: list[EffectStatus]
    found: list[str]
    paths: list[str]
    covariance: Array
    correlations: list[tuple[str, str, float]]
    noise: NoiseFit | None
    accuracy: Accuracy
    integral_accuracy: Accuracy | None
    sources: list[Source]
    frames: int
    poses: int
    pattern_variance: Array
    integral: bool = False
    notes: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    @property
    def chi_square(self) -> float | None:
        """Chi-square per value of held-out poses by their predictive distribution; None: none held out."""
        return self.solution.held_out_chi_square()

    @property
    def sigma(self) -> dict[str, float]:
        """1-sigma of each parameter that the data determine."""
        return dict(zip(self.paths, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def calibrate(
    request: Request,
    *,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    reducer: Reducer | None = None,
    integral: bool = True,
) -> Calibration:
    """Calibrate, all in memory; nothing is written.

    ``progress`` is called with the progress; ``cancelled`` is called between frames, stations and iterations.
    ``reducer`` replaces the reduction of recordings to stations (to do it elsewhere). ``integral`` also makes
    the table by position, for comparison.

    Raises `InputError` for recordings, scene or effects that do not go together (one line with a remedy),
    `Cancelled`, and `RimError` where the adjustment finds no solution.
    """
    watch = Watch(progress, cancelled)
    camera = request.camera
    if not request.recordings:
        raise InputError("no recording is given", remedy="give one recording or more")
    only_integral = request.effects is not None and tuple(request.effects) == (_INTEGRAL,)
    words = () if only_integral else request.effects
    if words is not None:
        words = tuple(word for word in words if word != REFERENCE)
        checked_names(words)  # before recordings are read, which takes minutes
    recordings = [checks.examine(path, camera, request.topics) for path in request.recordings]
    notes = checks.agree(recordings)
    scenes = checks.scenes_of(recordings, request.scene)
    total = sum(one.frames for one in recordings)
    reduce_all = reducer if reducer is not None else watch.reducer(total)
    datasets = reduce_all(request.recordings, camera, request.topics, scenes)
    notes += placed_by_schedule(datasets, scenes)
    for one, own, recording in zip(datasets, scenes, recordings, strict=True):
        one.with_poses(own, recording.path)
        checks.require_fixed_poses(one, own, recording.path)
    scene, datasets = joined(scenes, datasets)
    dataset = merged(datasets)
    notes += dataset.notes
    dataset = replace(dataset, notes=[])
    dataset = checks.with_plausible_poses(at_rest(dataset), scene, camera, watch.ticking("poses"))
    checks.require_variety(dataset, scene, camera, request.effects)
    notes += dataset.notes
    scene = with_stated_errors(scene, dataset)
    smoothed = note_on_smoothing(dataset)
    notes += [] if smoothed is None else [smoothed]
    watch.say("noise")
    noise = fit_noise(dataset, camera)
    if noise is not None:
        camera = replace(camera, noise=noise.noise)
        notes += _noise_notes(noise)
    else:
        notes.append("noise as in the camera file: there are too few repeated frames to fit it")
    adjusted = adjust(
        camera,
        dataset,
        scene,
        words,
        steps=(1, 1) if request.geometry else steps_of(camera, request.effects),
        surfaces=max(len(one.surfaces) for one in scenes),
        geometry=request.geometry,
        seed=request.seed,
        threads=request.threads,
        watch=watch,
    )
    outcome, problem = adjusted.outcome, adjusted.problem
    notes += [*adjusted.notes, *outcome.notes, *outcome.solution.notes]
    watch.say("hyperbola or curve")
    beyond = beyond_form(problem, outcome.solution) if words is not None else None
    notes += [] if beyond is None else [beyond]
    return _finished(
        request,
        outcome,
        problem.dataset,
        noise,
        notes,
        watch,
        scene=scene,
        large=adjusted.large,
        edges_within=adjusted.edges_within,
        integral=integral,
        only_integral=only_integral,
    )


def _finished(
    request: Request,
    outcome: Outcome,
    dataset: Dataset,
    noise: NoiseFit | None,
    notes: list[str],
    watch: Watch,
    *,
    scene: Scene,
    large: LargeSensor | None,
    edges_within: int,
    integral: bool,
    only_integral: bool,
) -> Calibration:
    solution = outcome.solution
    statuses = outcome.effect_statuses()
    fitted = solution.fit
    asked = request.effects is not None and REFERENCE in request.effects
    path: FittedReference | None = None
    if asked or request.effects is None:
        watch.say("internal reference")
        path = fit_reference(solution, asked=asked)
        statuses = [
            path.status if path is not None and status.effect == REFERENCE else status for status in statuses
        ]
    forward = fitted.forward
    watch.say("held-out poses")
    masks = [used for used, _ in forward.pixels_used()]
    numbers = range(len(solution.scores.trained))
    cameras = {k: with_reference(solution.camera(k), path, leave_out=k) for k in numbers} or {
        0: with_reference(solution.camera(), path)
    }
    arguments = (dataset, forward.views)
    split = solution.folds if numbers else {}
    before = request.camera if large is None else decimated_camera(request.camera, large.step)
    accuracy = evaluate(*arguments, cameras, split, before, masks, held_out=bool(numbers), tick=watch.tick)
    table, by_table = None, None
    if integral or only_integral:
        watch.say("table by position")
        table = IntegralFit(forward, split, masks, tick=watch.tick)
        tables = table.cameras([*numbers, None])
        made = {k: tables[k] for k in numbers} or {0: tables[None]}
        by_table = evaluate(*arguments, made, split, before, masks, held_out=bool(numbers), tick=watch.tick)
    paths, covariance = solution.covariance()
    camera, variance = solution.camera(), solution.pattern_variance()
    validity = supported(forward)
    if large is not None:
        watch.say("offsets of all pixels")
        camera, variance = large.finished(solution, edges_within=edges_within, tick=watch.tick)
        covariance, validity = large.covariance(paths, covariance), large.validity(validity)
    camera = with_reference(camera, path)
    if path is not None and path.effect is not None:
        paths, covariance = [*paths, *PATHS], block_diag(covariance, path.covariance)
    if only_integral:
        statuses = [
            replace(status, status="left out", text=_REPLACED) if status.status == "kept" else status
            for status in statuses
        ]
        assert table is not None
        camera = table.cameras([None])[None]
        paths, covariance = [], np.zeros((0, 0))
    camera = replace(camera, validity=validity)
    camera = stated(camera, paths, covariance) if not only_integral else replace(camera, covariance=None)
    watch.say("checksums")
    sources = _sources(request.originals or request.recordings, dataset, watch.tick)
    camera = replace(
        camera,
        provenance=provenance(
            sources=sources,
            command=request.command,
            camera=request.camera_name,
            scene=request.scene_name,
            fitted=[_INTEGRAL] if only_integral else sorted({_owner(path) for path in paths}),
            not_fitted={status.effect: status.text for status in statuses if status.status != "fitted"},
            accuracy=_stated_accuracy(by_table, None)
            if only_integral and by_table
            else _stated_accuracy(accuracy, solution),
            notes=notes,
        ),
    )
    return Calibration(
        camera=camera,
        before=request.camera,
        solution=solution,
        statuses=statuses,
        found=outcome.found,
        paths=paths,
        covariance=covariance,
        correlations=high_correlations(paths, covariance),
        noise=noise,
        accuracy=accuracy,
        integral_accuracy=by_table,
        sources=sources,
        frames=dataset.frames,
        poses=dataset.poses,
        pattern_variance=variance,
        integral=only_integral,
        notes=notes,
        refused=refusals(fitted, by_table if only_integral and by_table else accuracy, scene),
    )


def _owner(path: str) -> str:
    parts = path.split(".")
    return parts[1] if parts[0] == "effects" else parts[0]


def _stated_accuracy(accuracy: Accuracy, solution: Solution | None) -> Mapping[str, Any]:
    """Return the accuracy that the camera file states; without a solution of effects, the errors alone."""
    by_fit = {} if solution is None else _of_fit(solution)
    return {
        "held_out_poses": accuracy.poses if accuracy.held_out else 0,
        "rms_m": round(accuracy.after, 6),
        "rms_before_m": round(accuracy.before, 6),
        "noise_m": round(accuracy.noise, 6),
        "reference_m": round(accuracy.reference, 6),
        "systematic_m": round(accuracy.systematic, 6),
        **by_fit,
    }


def _of_fit(solution: Solution) -> Mapping[str, Any]:
    chi_square = solution.held_out_chi_square()
    return {
        "chi_square_per_value": None if chi_square is None else round(chi_square, 4),
        "outliers": solution.outliers,
        "values": solution.values,
    }


def _sources(paths: Sequence[Path], dataset: Dataset, tick: Callable[[], None]) -> list[Source]:
    result = []
    for number, path in enumerate(paths):
        own = [station for station in dataset.stations if station.recording == number]
        frames, poses = sum(one.frames for one in own), len({one.pose for one in own})
        result.append(Source(os.fspath(path), checksum(path, tick=tick), frames, poses))
    return result


def _noise_notes(noise: NoiseFit) -> list[str]:
    notes = []
    if noise.misfit > POOR:
        notes.append(
            f"noise over amplitude departs by {noise.misfit:.0%} (RMS) from floor, shot and amplitude "
            "terms: the predicted sigma is as wrong"
        )
    if noise.common is not None and noise.common > _COMMON:
        notes.append(
            f"pixels vary together from frame to frame ({noise.common:.1f} times what independent noise "
            "would): another light source or camera, or motion; intervals are too narrow by what that adds"
        )
    return notes
