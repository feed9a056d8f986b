"""The experiments of the reproduction by name, and how they are run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.reproduce import (
    array,
    geometry,
    incidence,
    linearity,
    pmd,
    precision,
    principles,
    reference,
    stray_light,
    targets,
    temperature,
)
from rim_camera_ros.reproduce.laboratory import Laboratory, Progress
from rim_camera_ros.reproduce.results import Outcome


@dataclass(frozen=True)
class Experiment:
    """A set-up of the thesis: name on the command line, title, and function that simulates and reduces it."""

    name: str
    title: str
    run: Callable[[Laboratory], Outcome]


#: In the order of the thesis.
EXPERIMENTS = (
    Experiment("ambiguity", "Ambiguity range (eqs. 2.4, 2.12)", principles.ambiguity),
    Experiment("two_cameras", "Two cameras (eq. 2.11)", principles.two_cameras),
    Experiment("dynamic_range", "Dynamic range (eq. 2.13)", principles.dynamic_range),
    Experiment("sensors", "Sensors (tables 2.2, 2.3)", geometry.sensors),
    Experiment("pmd_sensors", "PMD sensors (table 2.3)", pmd.sensors),
    Experiment("coordinates", "Precision of coordinates (table 2.4)", principles.coordinates),
    Experiment("optics", "Photogrammetric calibration (sec. 3.2)", geometry.optics),
    Experiment("scattering", "Scattering (sec. 3.3.1)", stray_light.scattering),
    Experiment("histograms", "Precision of one distance (sec. 3.3.3)", precision.histograms),
    Experiment("sigma_map", "Precision over the array (sec. 3.3.3)", precision.sigma_map),
    Experiment("led_power", "Emitting system (sec. 3.3.4)", precision.led_power),
    Experiment("grey_wedge", "Target reflectivity (secs. 3.3.3, 3.3.5)", targets.grey_wedge),
    Experiment("incidence", "Angle of incidence (sec. 3.3.6)", incidence.incidence),
    Experiment("warm_up", "Warm-up (secs. 3.3.7, 4.3.1)", temperature.warm_up),
    Experiment("ambient", "External temperature (sec. 3.3.7)", temperature.ambient),
    Experiment("linearity_sr2", "Linearity of the SR-2 (sec. 3.3.8)", linearity.sr2),
    Experiment("linearity_sr3000", "Linearity of the SR-3000 (sec. 3.3.8)", linearity.sr3000),
    Experiment("phase_map", "Linearity over the array (sec. 3.3.8)", array.phase_map),
    Experiment("fixed_pattern", "Fixed pattern (sec. 3.3.9)", array.fixed_pattern),
    Experiment("reference_warm_up", "Internal reference, warm-up (sec. 4.3.1)", reference.warm_up),
    Experiment("reference_climate", "Internal reference, temperature (sec. 4.3.2)", reference.climate),
    Experiment("reference_two", "Internal reference, two distances (sec. 4.3.2.3)", reference.two_distances),
)


@dataclass(frozen=True)
class Done:
    """An experiment with its results."""

    experiment: Experiment
    outcome: Outcome


def chosen(names: Sequence[str] | None) -> tuple[Experiment, ...]:
    """Return the experiments of these names in the order of the thesis; None: all.

    Raises `InputError` for a name that is not known.
    """
    if names is None:
        return EXPERIMENTS
    known = [experiment.name for experiment in EXPERIMENTS]
    for name in names:
        if name not in known:
            raise InputError(
                f"no experiment '{name}'",
                place="--only",
                remedy=nearest_name(name, known),
            )
    return tuple(experiment for experiment in EXPERIMENTS if experiment.name in names)


def reproduce(experiments: Sequence[Experiment], *, progress: Progress = lambda words: None) -> list[Done]:
    """Simulate and reduce the experiments; seeds are fixed, so that results are repeatable."""
    laboratory = Laboratory(progress)
    return [Done(experiment, experiment.run(laboratory)) for experiment in experiments]
