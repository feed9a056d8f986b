"""The input of a joint adjustment, and its result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.effects import OPTICS, CovariateTable
from rim_camera_ros.effects.base import effect_of, response_of
from rim_camera_ros.effects.candidate import Block
from rim_camera_ros.effects.light_curves import RESPONSE, RIPPLES, SURFACES, LightCurves
from rim_camera_ros.effects.sections import REFLECTANCE_PRIOR, light_block
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.covariate_table import empirical_block
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import (
    gain_block,
    imperfection_blocks,
    linear_blocks,
    pose_block,
    present_blocks,
)
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import NormalEquations, Reduced
from rim_camera_ros.fit.pixel_elimination import PATTERN_PRIOR
from rim_camera_ros.fit.shifts import Shift
from rim_camera_ros.fit.steps import moved_from, moved_light
from rim_camera_ros.fit.views import Views
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.scene import Scene, ScenePose

Array = NDArray[Any]


@dataclass(frozen=True)
class FreeResponse:
    """A free curve over the amplitude in addition to the one parameter of a response.

    The curve is relative to light of ``level`` [counts]; its relative 1-sigma is ``sigma``. ``parameter`` is,
    by its path, the value and 1-sigma of the parameter without the curve: jointly with a free curve it is not
    identifiable, and the parameter alone corrects best.
    """

    level: float
    sigma: float = REFLECTANCE_PRIOR
    parameter: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Problem:
    """What is fitted: the data, the scene, the free effects, and the nuisance parameters.

    ``effects`` None frees all that the camera has; ``geometry`` are the names of `effects.OPTICS` to
    estimate; ``robust`` bounds the weight of outliers; ``pattern`` estimates an offset per pixel.
    ``masks`` restrict the pixels, ``patches`` state how many pixels share an error of the predicted
    amplitude, ``shifts`` are the differences of another recording (all as in `Forward`);
    ``stray_light`` [counts] as in `accumulate`; ``reflectance`` estimates deviations of surfaces from
    Lambert's law, ``response`` a free curve in addition to the effect on the response.
    ``pattern_prior`` [m] is the 1-sigma of an offset per pixel, ``pixel_gains`` (relative) that of its gain
    (None: as the camera file states). ``correlated_error`` and
    ``variance_factors`` as in `Forward`.
    The table over covariates is fitted only where ``effects`` names it. ``imperfections`` estimates
    quantities that scene and camera files do not state exactly, within their stated errors
    (`design.imperfection_blocks`). ``amplitude_error`` is the relative 1-sigma of predicted amplitudes, which
    likelihoods that are compared must share (None: estimated).
    The priors of parameters that the camera ``origin`` has are those of ``origin``, about its values,
    wherever a fit begins: results of earlier fits must not constrain later ones. None: those of the start.
    ``tick`` is called for each station in every pass and may raise to end the work; ``threads`` share it.
    """

    dataset: Dataset
    scene: Scene
    origin: Camera | None = None
    effects: tuple[str, ...] | None = None
    geometry: tuple[str, ...] = ()
    gain: bool = True
    pattern: bool = True
    robust: bool = True
    masks: Sequence[tuple[Array, Array]] | None = None
    patches: Mapping[tuple[int, int], Array] | None = None
    shifts: Sequence[Shift] | None = None
    stray_light: float = 0.0
    reflectance: bool = False
    response: FreeResponse | None = None
    pattern_prior: float = PATTERN_PRIOR
    pixel_gains: float | None = None
    correlated_error: float = 0.0
    variance_factors: Mapping[tuple[int, int], float] = field(default_factory=dict)
    imperfections: bool = True
    amplitude_error: float | None = None
    tick: Callable[[], None] | None = None
    threads: int = 1

    @property
    def moves_edges(self) -> bool:
        """Whether a fit moves rays or surfaces, and edges with them to other pixels."""
        poses = (surface.pose for surface in self.scene.surfaces)
        return bool(self.geometry) or any(isinstance(pose, ScenePose) and pose.free for pose in poses)

    @property
    def has_pattern_field(self) -> bool:
        """Whether a smooth field is estimated in addition to offsets of pixels that are taken to be small."""
        return self.pattern and self.pattern_prior < PATTERN_PRIOR


@dataclass(frozen=True)
class Point:
    """The values at which a fit ended, from which another begins; without the data, so that it is small."""

    camera: Camera
    parameters: Mapping[str, float]
    nuisances: Mapping[str, float]
    pattern: Array
    amplitude_model: AmplitudeModel
    light_curves: LightCurves | None


@dataclass
class Fit:
    """The result of an adjustment, from the camera ``start`` to ``camera``.

    ``parameters`` are by dotted path (``radiometry.gain`` in counts), ``covariance`` in their order.
    ``pattern`` (H, W) [m] is the fixed pattern in addition to that of the camera file; ``nuisances`` are the
    estimated errors of poses and powers; ``chi_square`` is that of the ``rows`` observations after the fit,
    without prior terms. ``equations`` are those at the solution, ``forward`` its predictions. ``moving``, of
    a fit that has not converged, is the last step of each parameter in units of its sigma. ``at_bounds`` are
    the numbers of parameters at a bound which the data would exceed, and by how many of their sigmas.
    """

    start: Camera
    camera: Camera
    scene: Scene
    parameters: dict[str, float]
    covariance: Array
    pattern: Array
    nuisances: dict[str, float]
    chi_square: float
    rows: int
    converged: bool
    iterations: int
    equations: NormalEquations
    reduced: Reduced
    forward: Forward
    priors: Array
    notes: list[str] = field(default_factory=list)
    moving: dict[str, float] = field(default_factory=dict)
    at_bounds: Mapping[int, float] = field(default_factory=dict)
    response: FreeResponse | None = None

    @property
    def point(self) -> Point:
        """The values at which the fit ended."""
        model, curves = self.forward.amplitude_model, self.forward.light_curves
        return Point(self.camera, self.parameters, self.nuisances, self.pattern, model, curves)

    def by_another(self, camera: Camera) -> Forward:
        """Return the predictions by another camera, given the imperfections that this fit found.

        Powers, reflectivities and weak lobes are those found, so that only the physics differs: the camera,
        `SURFACES` that deviate from Lambert's law, and the curve of a response that the other camera lacks.
        """
        here = self.forward
        forward = Forward(here.dataset, self.scene, camera, views=here.views)
        forward.amplitude_model, forward.shifts, forward.masks = here.amplitude_model, here.shifts, here.masks
        if here.light_curves is not None:
            physics = SURFACES if response_of(camera) is not None else (*SURFACES, *RESPONSE)
            forward.light_curves = here.light_curves.without(physics)
        return forward

    @property
    def sigma(self) -> dict[str, float]:
        """1-sigma of each parameter."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def freed(problem: Problem, fitted: Fit) -> Problem:
    """Return the problem in which exactly those effects and light curves are free that a fit estimated."""
    names = {path.split(".")[1] for path in fitted.parameters if path.startswith("effects.")}
    curves = fitted.forward.light_curves
    return replace(
        problem,
        effects=tuple(sorted(names)),
        reflectance=curves is not None and not curves.values.keys().isdisjoint(SURFACES),
        response=fitted.response if curves is not None and curves.responds else None,
    )


def forward_of(
    problem: Problem, scene: Scene, camera: Camera, *, views: Views | None, offsets: Mapping[str, float]
) -> Forward:
    """Return the predictions of a problem by a camera, with the curves of the light in the ``offsets``."""
    forward = Forward(problem.dataset, scene, camera, views=views)
    forward.masks, forward.patches = problem.masks, problem.patches
    forward.shifts, forward.tick = problem.shifts, problem.tick
    forward.variance_factors, forward.threads = problem.variance_factors, problem.threads
    forward.camera_of_noise = problem.origin
    forward.correlated_error = problem.correlated_error
    forward.light_curves = moved_light(
        offsets, None if problem.response is None else problem.response.level, scene
    )
    if problem.imperfections:
        forward.linear = linear_blocks(camera, scene, pattern_field=problem.has_pattern_field)
    return forward


def clean_by(camera: Camera, problem: Problem, scene: Scene, *, views: Views | None) -> Problem:
    """Return a problem with only those of its pixels that are clean of edges by a camera's rays as well.

    Pixels that an edge has reached contain information about the position of the edge, not about distances.
    """
    forward = forward_of(problem, scene, camera, views=views, offsets={})
    masks = [
        (prediction.used & prediction.view.clean, prediction.amplitude_used & prediction.view.clean)
        for prediction in forward.predictions(slopes=False)
    ]
    return replace(problem, masks=masks)


def light_groups(problem: Problem, camera: Camera) -> list[tuple[str, ...]]:
    """Return the curves of the light that are fitted jointly with the camera."""
    # harmonics of a modulation make the light ripple: pulses have none
    groups = [RIPPLES] if problem.gain and measurement_of(camera).demodulates else []
    if problem.reflectance:
        groups.append(SURFACES)
    if problem.response is not None and response_of(camera) is not None:
        groups.append(RESPONSE)
    return groups


def blocks_of(problem: Problem, camera: Camera, scene: Scene) -> list[Block]:
    """Return the regressors of all that is free in a problem."""
    response = problem.response
    widths = {} if response is None else {path: sigma for path, (_, sigma) in response.parameter.items()}
    blocks = present_blocks(camera, effects=problem.effects, origin=problem.origin, widths=widths)
    table = effect_of(camera, CovariateTable)
    if table is not None and problem.effects is not None and table.name in problem.effects:
        blocks.append(empirical_block(table))
    if problem.gain:
        blocks.append(gain_block())
    blocks += [OPTICS[name].block(camera) for name in problem.geometry]
    for labels in light_groups(problem, camera):
        sigma = response.sigma if response is not None and labels is RESPONSE else REFLECTANCE_PRIOR
        blocks.append(light_block(labels, sigma=sigma))
    if problem.imperfections:
        blocks += imperfection_blocks(
            camera, scene, lobe=not problem.reflectance, pattern_field=problem.has_pattern_field
        )
    free = [
        (f"scene.{surface.name}.{axis}", 1.0 if axis in "xyz" else 0.3)
        for surface in scene.surfaces
        if isinstance(surface.pose, ScenePose)
        for axis in surface.pose.free
    ]
    if free:
        blocks.append(pose_block(free))
    return blocks


def away_from_priors(problem: Problem, start: Camera) -> dict[str, float]:
    """Return the deviations of a start's numbers from the means of their priors, by path; 0 where absent."""
    away = moved_from(problem.origin, start)
    if problem.response is not None:
        numbers = camera_numbers(start)
        for path, (value, _) in problem.response.parameter.items():
            away[path] = numbers.get(path, value) - value
    return away


def keeps_amplitude_error(warm: Camera, camera: Camera) -> bool:
    """Return whether a fit keeps the amplitude error of another: where the two have different effects.

    Their likelihoods can then be compared, as they have the same noise.
    """
    return bool(warm.effects.keys() ^ camera.effects.keys())
