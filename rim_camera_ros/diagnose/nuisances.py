"""Ordinary imperfections that a fit found, compared with the sizes that the files state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.hypotheses import DEPTH, LEAST_GAIN
from rim_camera_ros.effects.light_curves import LOBE_PREFIX, TILES
from rim_camera_ros.fit.design import BEYOND, COMMON_POSE, OPTICS, SENSOR
from rim_camera_ros.fit.problem import Fit
from rim_camera_ros.fit.surface_shape import SHAPE
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.compare import NOT_IN_ALL_POSES, Result
from rim_camera_ros.select.pixel_gains import GainSpread
from rim_camera_ros.select.thresholds import ALARM_RATE

#: Poses that a sentence names.
MOST_NAMED = 5
#: Name of the nuisance of pixels' gains.
PIXEL_GAIN = "pixel_gain"
#: Least 1-sigma of the change of a parameter of the optics, as a share of its stated sigma.
_LEAST_MOVE = 0.1


@dataclass(frozen=True)
class Nuisance:
    """An imperfection: the root mean square of the errors ``found``, and the 1-sigma that is ``stated``.

    ``gain`` [nats] is half the sum of squares of its errors in stated sigmas: their penalty by the prior.
    """

    name: str
    found: float
    stated: float
    unit: str = "-"
    gain: float = 0.0


#: Names by the beginning of the labels of their parameters, with the unit.
_KINDS = (
    ("reflectivity", TILES, "-"),
    ("lobe", LOBE_PREFIX, "-"),
    ("common_pose_offset", COMMON_POSE, "m"),
    ("common_pose_tilt", COMMON_POSE, "rad"),
    ("common_pose_scale", COMMON_POSE, "-"),
    ("flatness", SHAPE, "m"),
    ("optics", OPTICS, "px"),
    ("sensor_lag", SENSOR, "s"),
)


def nuisances_of(fitted: Fit, camera: Camera, gains: GainSpread | None = None) -> list[Nuisance]:
    """Return the errors found of reflectivities, powers, poses [m, rad], optics, and ``gains`` of pixels."""
    priors = {regressor.label: regressor.prior for regressor in fitted.equations.regressors}
    result = []
    for name, beginning, unit in _KINDS:
        labels = [
            parameter
            for parameter in fitted.parameters
            if parameter.startswith(beginning) and parameter in priors
        ]
        if beginning == COMMON_POSE:
            labels = [label for label in labels if _unit_of(label) == unit]
        if labels:
            result.append(_of(name, [(fitted.parameters[one], priors[one]) for one in labels], unit))
    pairs: dict[str, list[tuple[float, float]]] = {}
    for fold in fitted.equations.folds:
        for label, prior, at in fold.nuisances:
            kind = label.split(".", 2)[2]
            name = (
                "emitted_power"
                if kind == "gain"
                else "pose_offset"
                if kind.endswith("offset")
                else "pose_tilt"
            )
            if kind.startswith("light."):
                name = "stray_light"
            if kind == "gain" or kind.startswith(("pose.", "light.")):
                pairs.setdefault(name, []).append((at + fitted.nuisances.get(label, 0.0), prior))
    units = {"emitted_power": "-", "pose_offset": "m", "pose_tilt": "rad", "stray_light": "counts"}
    result += [_of(name, values, units[name]) for name, values in pairs.items()]
    if gains is not None:
        result.append(Nuisance(PIXEL_GAIN, gains.found, camera.radiometry.pattern_sigma))
    return result


def _unit_of(label: str) -> str:
    """Return the unit of an error that all poses share."""
    return {"offset": "m", "scale": "-"}.get(label.rpartition(".")[2], "rad")


def optics_beyond(fitted: Fit) -> str | None:
    """Return in words that the optics differ significantly from the file; None: they do not.

    By Wald's test of the principal axes of their covariance, at the rate `ALARM_RATE`. The change of a
    parameter with the variance P in the file and S in the fit has the variance P - S where the file is right
    (Demortier & Lyons, CDF note 5776, 2002).
    """
    priors = {regressor.label: regressor.prior for regressor in fitted.equations.regressors}
    own = [
        parameter for parameter in fitted.parameters if parameter.startswith(OPTICS) and parameter in priors
    ]
    if not own:
        return None
    moved = np.array([fitted.parameters[label] for label in own])
    stated = np.array([priors[label] for label in own])
    known = np.array([fitted.sigma[label] for label in own])
    variance = np.maximum(stated**2 - known**2, (_LEAST_MOVE * stated) ** 2)
    if float(np.sum(moved**2 / variance)) <= float(chdtri(len(own), ALARM_RATE)):
        return None
    return (
        f"the optics differ from the camera file by {np.max(np.abs(moved) / stated):.1f} times the sigma of "
        "its covariance, more than chance, so that it was not used"
    )


def conditional_on_physics(result: Result) -> Fit:
    """Return the last fit of a search, with residuals and errors conditional on possible changes of physics.

    These are changes of the forms of the effects found, and of the refused effects about which poses disagree
    the one that gains most, if there is any. Only errors that neither explains are attributed to poses,
    single ones or all of a surface: the residuals of a large effect with an inexact form are similar over a
    pose, or over all poses. Errors of poses that were moved remain.
    """
    step, disputed = result.explorations[-1], disputed_effect(result)
    if disputed is None and not step.forms:
        return step.fit
    return step.conditional_fit(result.problem, [] if disputed is None else [disputed])


def disputed_effect(result: Result) -> int | None:
    """Return the number of the refused candidate that gains most but not in all poses, if there is one."""
    effect = next((refused.effect for refused in result.refused if refused.why == NOT_IN_ALL_POSES), None)
    return None if effect is None else result.explorations[-1].best().get(effect)


def poses_beyond(fitted: Fit, camera: Camera, errors: Mapping[tuple[int, int], float]) -> str | None:
    """Return in words that errors of all poses together far exceed the stated ones; None: they do not.

    ``errors`` are those of the poses beyond, in stated 1-sigma.
    """
    for nuisance in nuisances_of(fitted, camera):
        if nuisance.name in ("pose_offset", "pose_tilt") and nuisance.found > BEYOND * nuisance.stated:
            size = f"{nuisance.found * 1e3:.2g} {'mm' if nuisance.unit == 'm' else 'mrad'}"
            worst = sorted(errors, key=lambda key: -errors[key])[:MOST_NAMED]
            which = f", most of all {', '.join(str(pose) for _, pose in worst)}" if worst else ""
            return (
                f"pose: poses err by {size} (RMS), {nuisance.found / nuisance.stated:.1f} times what is "
                f"stated{which}: these stand elsewhere, or the instrument is not as good as its pose_sigma "
                "says; correct the poses or state a larger pose_sigma"
            )
    return None


#: Set-ups that correspond to errors which all poses of a surface share, by the name of the nuisance. Shared
#: tilts are none: unknown physics over the array looks like them.
_COMMON = {"common_pose_offset": DEPTH}


#: Addition where there is one surface alone.
_OR_THE_CAMERA = (
    "; with one surface this cannot be distinguished from an offset or a scale of the camera's distances "
    "that its file lacks (rim calibrate)"
)


def common_pose_beyond(fitted: Fit, camera: Camera) -> str | None:
    """Return in words that errors which all poses of a surface share far exceed the stated ones.

    None where they do not: their gain must be that required of another set-up.
    """
    for nuisance in nuisances_of(fitted, camera):
        if nuisance.name in _COMMON and nuisance.gain > LEAST_GAIN:
            size = f"{nuisance.found * 1e3:.2g} {'mm' if nuisance.unit == 'm' else 'mrad'}"
            own = {
                label: abs(value)
                for label, value in fitted.parameters.items()
                if label.startswith(COMMON_POSE) and _unit_of(label) == nuisance.unit
            }
            surface = max(own, key=lambda label: own[label]).removeprefix(COMMON_POSE).rpartition(".")[0]
            return (
                f"{_COMMON[nuisance.name]}: poses of a surface err alike, by {size} (RMS over surfaces), "
                f"{nuisance.found / nuisance.stated:.1f} times what is stated, most of all those of {surface}"
                ": it stands elsewhere than its poses say; measure it anew, or state a larger pose_sigma"
                + (_OR_THE_CAMERA if len(own) == 1 else "")
            )
    return None


def flatness_beyond(fitted: Fit) -> str | None:
    """Return in words which surface departs from a plane by far more than is stated; None: none does.

    By the bow or twist that is largest in stated sigmas: its penalty by the prior must be what another set-up
    must gain. All together would exceed that by chance where there are many surfaces.
    """
    stated = {
        regressor.label: regressor.prior
        for regressor in fitted.equations.regressors
        if regressor.label.startswith(SHAPE)
    }
    sizes = {label: abs(fitted.parameters[label]) for label in stated}
    worst = max(sizes, key=lambda label: sizes[label] / stated[label], default=None)
    if worst is None or 0.5 * (sizes[worst] / stated[worst]) ** 2 <= LEAST_GAIN:
        return None
    surface, _, form = worst.removeprefix(SHAPE).rpartition(".")
    shape = "is twisted" if form == "twist" else f"bows along its {form[-1]} axis"
    return (
        f"shape: {surface} {shape} by {sizes[worst] * 1e3:.1f} mm, {sizes[worst] / stated[worst]:.0f} times "
        "what the scene file states (flatness_sigma), the same in all poses; mount it flat, or state a "
        "larger flatness_sigma"
    )


def offset_beyond(metres: float, nuisances: Sequence[Nuisance]) -> str | None:
    """Return in words that all distances differ from the files by so much; None: within errors of poses."""
    stated = [nuisance.stated for nuisance in nuisances if nuisance.name == "common_pose_offset"]
    if not stated or abs(metres) <= BEYOND * max(stated):
        return None
    return (
        f"all distances are {abs(metres) * 1e3:.1f} mm {'longer' if metres > 0 else 'shorter'} than by the "
        "files, at all poses alike: the camera has another offset than its file, or the poses another "
        "origin; one recording at one frequency cannot distinguish these, and offsets of pixels absorb it"
    )


def reflectivities_beyond(fitted: Fit, scene: Scene) -> str | None:
    """Return in words which surface has reflectivities far beyond their stated errors; None: none has."""
    priors = {regressor.label: regressor.prior for regressor in fitted.equations.regressors}
    for surface in scene.surfaces:
        beginning = f"{TILES}{surface.name}."
        own = [
            parameter
            for parameter in fitted.parameters
            if parameter.startswith(beginning) and parameter in priors
        ]
        if not own:
            continue
        # by the median: a tile that few pixels see is hardly determined
        found = float(np.median([abs(fitted.parameters[label]) / priors[label] for label in own]))
        if found > BEYOND:
            return (
                f"other_pattern: half of the tiles of {surface.name} reflect otherwise than the scene file "
                f"says by more than {found:.1f} times what it states: another board, turned or "
                "swapped; describe the board that was recorded, or state reflectivity: unknown"
            )
    return None


def _of(name: str, pairs: list[tuple[float, float]], unit: str) -> Nuisance:
    values = np.array(pairs)
    found, stated = np.sqrt(np.mean(values**2, axis=0))
    gain = 0.5 * float(np.sum((values[:, 0] / values[:, 1]) ** 2))
    return Nuisance(name, float(found), float(stated), unit, gain)
