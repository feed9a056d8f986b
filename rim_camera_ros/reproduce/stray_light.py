"""Sec. 3.3.1: small targets before a white and a black wall."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.reports.figures import Curve, Panel
from rim_camera_ros.reproduce.laboratory import Laboratory, Measured, around, mean
from rim_camera_ros.reproduce.results import Outcome, Picture, Printed, Row
from rim_camera_ros.reproduce.targets import hyperbolas
from rim_camera_ros.scene import Scene

_SEED = 3301
#: Stations of the targets: three each before the white wall, the black one, the white one again.
_WALLS = 3


def scattering(laboratory: Laboratory) -> Outcome:
    """Fig. 3.10: distances to six targets of 2 x 2 cm at 1.660 m, white against black wall."""
    camera, whole = laboratory.camera("sr3000"), laboratory.scene("scattering")
    scene = Scene(whole.surfaces, schedule=whole.schedule[: 3 * _WALLS])
    targets = [i for i, surface in enumerate(scene.surfaces) if surface.name.startswith("target_")]
    first = scene.poses_for({name: pose.pose for name, pose in scene.schedule[0].poses.items()})
    seen = Simulation(camera, scene).geometry(first).surface
    pixels = [_middle(seen == i) for i in targets]
    there = laboratory.record(camera, scene, (slice(None), slice(None)), seed=_SEED, words="scattering")
    fitted = hyperbolas(laboratory)[100]
    walls = [there[_WALLS * k : _WALLS * (k + 1)] for k in range(3)]
    raw = np.array([[_distance(wall, pixel) for pixel in pixels] for wall in walls])
    light = np.array([[_amplitude(wall, pixel) for pixel in pixels] for wall in walls])
    reduced = raw - fitted.offset(light)
    # the first wall again at the end: a drift would show between the two
    difference = (reduced[0] + reduced[2]) / 2 - reduced[1]
    sigma = _sigma(walls[1], pixels[-1]) * np.sqrt(1.5)
    reflectivity = np.array([scene.surfaces[i].reflectivity for i in targets])
    how = (
        "six targets of 2 x 2 cm (85 to 6 %) at 1.660 m before a white, a black, and the white wall again "
        "(1.76 m), 3 x 20 frames each, pixel in the middle of each target; "
    )
    change = (
        how + "distance reduced for the amplitude (table 3.4 as fitted), before white minus before black wall"
    )
    printed = Printed(20.0, 100.0, "several centimetres")
    why = (
        "the amplitude term of table 3.4 alone is 0.35 m for the 6 % target before the black wall; the "
        "thesis "
        "does not print the reflectivities, and says in sec. 3.3.6 that dark targets were not as dark as "
        "thought"
    )
    rows = (
        Row(
            "white against black wall, median of six targets",
            "fig. 3.10",
            printed,
            float(np.median(difference)) * 1e3,
            "mm",
            change,
        ),
        Row(
            "white against black wall, darkest target",
            "fig. 3.10",
            printed,
            float(difference[-1]) * 1e3,
            "mm",
            change,
            1,
            sigma * 1e3,
        ),
        Row(
            "range over targets and walls, not reduced",
            "fig. 3.10",
            printed,
            float(np.ptp(raw)) * 1e3,
            "mm",
            how + "largest minus smallest distance",
            why=why,
        ),
    )
    curves = [
        tuple(
            Curve(reflectivity, values * 1e3, label=f"{name} wall", points=True)
            for name, values in (("white", (one[0] + one[2]) / 2), ("black", one[1]))
        )
        for one in (raw, reduced)
    ]
    axes = ("reflectivity of the target", "measured - nominal [mm]")
    panels = (
        Panel("Targets of 2 x 2 cm at 1.660 m", *axes, curves[0]),
        Panel("reduced for the amplitude", *axes, curves[1]),
    )
    caption = "Distances to small targets of different reflectivity before a white and before a black wall."
    return Outcome(rows, (Picture("fig_3_10", "Fig. 3.10", caption, panels),))


def _middle(mask: np.ndarray) -> tuple[int, int]:
    """Return the pixel of a mask that is nearest its centre of gravity, as row, column."""
    places = np.argwhere(mask)
    nearest = np.argmin(np.sum((places - places.mean(axis=0)) ** 2, axis=1))
    return int(places[nearest, 0]), int(places[nearest, 1])


def _distance(there: list[Measured], pixel: tuple[int, int]) -> float:
    """Return the mean of measured minus nominal distance of a pixel over stations, in m."""
    region = around(pixel, 0)
    return float(np.mean([mean(result.error[:, *region]) for result in there]))


def _amplitude(there: list[Measured], pixel: tuple[int, int]) -> float:
    """Return the mean amplitude of a pixel over stations in counts."""
    region = around(pixel, 0)
    return float(np.mean([mean(result.amplitude[:, *region]) for result in there]))


def _sigma(there: list[Measured], pixel: tuple[int, int]) -> float:
    """Return the 1-sigma in m of the mean over the stations."""
    values = np.concatenate([result.error[:, pixel[0], pixel[1]] for result in there])
    return float(np.std(values, ddof=1) / np.sqrt(values.size))
