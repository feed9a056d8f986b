"""The result of a search compared with its remainder: effects by name, or unknown physics."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.begin import Begun, Inputs
from rim_camera_ros.diagnose.codes import MissingCodes, missing_codes, note_on_grid
from rim_camera_ros.diagnose.described import (
    Described,
    Rest,
    best_rest,
    describe,
    explained_share,
    is_unknown,
)
from rim_camera_ros.diagnose.noise_verdict import only_noise
from rim_camera_ros.diagnose.nuisances import conditional_on_physics
from rim_camera_ros.diagnose.variance import Variance, examine_variance
from rim_camera_ros.effects import OF_SURFACES, CovariateTable
from rim_camera_ros.effects.base import response_of
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.select.compare import Result
from rim_camera_ros.select.exploration import Exploration

#: Ratio of the gain of a term outside the vocabulary to that of the named ones above which it replaces them.
_BEYOND_NAMED = 1.2
_LIGHT_OF_SECOND_CAMERA = (
    "there is light of a second camera: nothing else can be determined; record with it switched off"
)


@dataclass(frozen=True)
class FoundPhysics:
    """The missing physics by held-out poses: the ``result`` of the search, or ``described`` in its place.

    ``rest`` is the best smooth function of the remainder of the search. ``dataset`` has the notes;
    ``variance`` and ``codes`` are the evidence of repeated frames and counts, given the physics.
    """

    result: Result
    dataset: Dataset
    rest: Rest | None
    described: Described | None
    variance: Variance
    codes: MissingCodes | None

    @property
    def baseline(self) -> Exploration:
        """The exploration with the known terms alone."""
        return self.result.explorations[0]

    @property
    def final(self) -> Exploration:
        """The exploration after all steps of the search."""
        return self.result.explorations[-1]

    @property
    def best_fit(self) -> Fit:
        """The fit with the missing physics."""
        return self.final.fit if self.described is None else self.described.fit

    @property
    def conditional(self) -> Fit:
        """The fit conditional on changes of the forms of the physics."""
        return conditional_on_physics(self.result) if self.described is None else self.best_fit

    @property
    def names(self) -> list[str]:
        """Names of the missing effects, or of the effect that describes unknown physics."""
        if self.described is not None:
            return [self.described.missing.model or CovariateTable.name]
        return [finding.effect for finding in self.result.found]

    @property
    def explained(self) -> float:
        """Share of the misfit that is explained."""
        return explained_share(self.result, self.rest)

    @property
    def is_modelled(self) -> bool:
        """Whether the physics is part of a fit: otherwise its residuals would be errors of neighbours."""
        return bool(self.result.found) if self.described is None else self.described.missing.model is not None


def physics_of(inputs: Inputs, begin: Begun, result: Result) -> FoundPhysics:
    """Return the physics found, with the best description of the remainder.

    Raises `RimError`, or numpy's LinAlgError, where unknown physics cannot be described.
    """
    dataset, camera = begin.dataset, inputs.camera
    if begin.sees_second_camera:
        dataset = replace(dataset, notes=[*dataset.notes, _LIGHT_OF_SECOND_CAMERA])
    inputs.say("looking for what no named effect explains")
    nothing = begin.sees_second_camera or begin.one_pose or bool(result.moved)
    rest = None if nothing else best_rest(result, begin.samples, inputs.seed)
    variance = _variance_given_response(result.explorations[-1].fit, camera)
    codes = missing_codes(dataset.codes, noise=camera.noise.floor / camera.sensor.lsb)
    precise = begin.variance.precise / camera.sensor.lsb
    if codes is not None and codes.is_fine_grid(precise):
        dataset = replace(dataset, notes=[*dataset.notes, note_on_grid(codes, camera, noise=precise)])
        codes = None
    described = None
    if rest is not None and _takes_their_place(rest, result, variance):
        described = describe(rest, result.explorations[0], result, inputs.seed)
    return FoundPhysics(result, dataset, rest, described, variance, codes)


def _variance_given_response(fitted: Fit, camera: Camera) -> Variance:
    """Return the evidence of repeated frames, given the response of the camera that a fit found."""
    variance = examine_variance(fitted.forward)
    responds = response_of(fitted.camera) is not None and response_of(camera) is None
    if responds and variance.noise_is_wrong:
        scaled = examine_variance(fitted.forward, free_scale=True)
        # a scale that does not explain all of it is no evidence about the noise
        return variance if scaled.noise_is_wrong else scaled
    return variance


def _takes_their_place(rest: Rest, result: Result, variance: Variance) -> bool:
    """Return whether a smooth function of a search's remainder replaces the effects that were found."""
    # a curve of the light that is not refitted leaves a smooth remainder, smaller than its own gain
    linear = any(finding.effect in OF_SURFACES for finding in result.found)
    if (linear and rest.on_top < result.gained) or only_noise(result, rest, variance):
        return False
    beyond = not result.found or rest.gain > _BEYOND_NAMED * result.found[0].gain
    return beyond and is_unknown(rest, result.gained, result.explorations[-1], result)
