"""Chapter 2: ambiguity and resolution, dynamic range, two cameras, precision of coordinates."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.coordinates import coordinate_precision, object_coordinates
from rim_camera_ros.effects.interference import Interference
from rim_camera_ros.phasor import to_phasor
from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.reports.figures import Curve, Panel
from rim_camera_ros.reproduce.laboratory import Laboratory, facing, plate, stations
from rim_camera_ros.reproduce.results import Outcome, Picture, Printed, Row, Table

_SEED = 2001
_CENTRE = (slice(80, 85), slice(88, 93))


def bare(camera: Camera) -> Camera:
    """Return the camera without effects: ideal light, noise and read-out only."""
    return replace(camera, effects={}, covariance=None)


# --- ambiguity -------------------------------------------------------------------------------------


def ambiguity(laboratory: Laboratory) -> Outcome:
    """Ambiguity range and size of a count, from a wall that moves through the ambiguity (eqs. 2.4, 2.12)."""
    camera = bare(laboratory.camera("sr3000"))
    places = np.round(np.arange(0.5, 8.55, 0.1), 3)
    placed = [(16 if z < 1.05 else 100, facing(float(z))) for z in places]
    scene = stations(plate(size=None), placed, frames=10, uptime=360.0)
    simulation = Simulation(camera, scene, seed=_SEED)
    counts: dict[int, list[float]] = {}
    nominal: dict[int, float] = {}
    for exposure, frame in laboratory.frames(simulation, "wall through the ambiguity"):
        counts.setdefault(exposure.station, []).append(float(frame.distance[_CENTRE].mean()))
        nominal[exposure.station] = float(simulation.true_distance(exposure)[_CENTRE].mean())
    # where noise wraps a part of the counts their mean is meaningless
    whole = [i for i, values in sorted(counts.items()) if np.ptp(values) < np.mean(values) / 10]
    distance = np.array([nominal[i] for i in whole])
    raw = np.array([np.mean(counts[i]) for i in whole])
    length, count = wrapping(distance, raw)
    how = (
        "wall without any effect moved from 0.5 to 8.5 m every 0.1 m, 10 frames of 5 x 5 pixels each; "
        "counts over nominal distance by one line that falls once by a whole range"
    )
    rows = (
        Row("ambiguity range", "eq. 2.4", Printed.number(7.5), length, "m", how, 4, why="c / (2 f), rounded"),
        Row("size of a count, 16 bit", "eq. 2.12", Printed.number(0.114), count * 1e3, "mm", how, 4),
    )
    return Outcome(rows)


def wrapping(distance: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """Return ambiguity range and size of a count, both in m, from mean counts at nominal distances [m].

    They follow from a line with a step where the counts fall: counts = c0 + slope d - jump [d beyond the
    fall].
    """
    fall = int(np.argmin(np.diff(counts)))
    behind = (np.arange(len(counts)) > fall).astype(float)
    columns = np.stack([np.ones_like(distance), distance, -behind], axis=1)
    _, slope, jump = np.linalg.lstsq(columns, counts, rcond=None)[0]
    return float(jump / slope), float(1.0 / slope)


# --- dynamic range ---------------------------------------------------------------------------------


def dynamic_range(laboratory: Laboratory) -> Outcome:
    """Ratio of the amplitudes of a bright near and a dark far surface (eq. 2.13)."""
    camera = bare(laboratory.camera("sr3000"))
    # no sensor covers this range at one setting: the light is taken without saturation
    camera = replace(camera, sensor=replace(camera.sensor, saturation=1e9))
    amplitude = []
    for z, reflectivity in ((0.2, 1.0), (7.5, 0.05)):
        scene = stations(plate(reflectivity, size=None), [(100, facing(z))], frames=1, uptime=360.0)
        simulation = Simulation(camera, scene, noise=False, quantised=False)
        (_, frame), *_ = laboratory.frames(simulation, "dynamic range")
        amplitude.append(float(frame.amplitude[82, 90]))
    ratio = amplitude[0] / amplitude[1]
    how = "walls at 0.2 m (100 %) and 7.5 m (5 %), setting 100, pixel on the axis, amplitudes before read-out"
    rows = (
        Row("dynamic range", "eq. 2.13", Printed.number(89.0), 20 * math.log10(ratio), "dB", how),
        Row("the same as a ratio", "eq. 2.13", Printed.number(28000.0, "1 : 28 000"), ratio, "-", how, 0),
    )
    return Outcome(rows)


# --- two cameras -----------------------------------------------------------------------------------


def two_cameras(laboratory: Laboratory) -> Outcome:
    """Remaining signal of a second camera at 20.1 MHz after 1 ms (eq. 2.11)."""
    camera = bare(laboratory.camera("sr3000"))
    setting = round((1e-3 - camera.sensor.exposure[0]) / camera.sensor.exposure[1])
    offsets = np.array([0.0, 1e3, 3e3, 1e4, 3e4, 1e5])
    left = np.array([_light_left(laboratory, camera, setting, offset) for offset in offsets])
    suppression = -20 * np.log10(left / left[0])
    how = (
        f"wall at 1 m, exposure 1 ms (setting {setting}), 100 frames; RMS over the frames of the phasor that "
        "all pixels have in common, second camera at 20.1 MHz over one at the same frequency; the phase of "
        "the second camera is random from frame to frame"
    )
    printed = Printed(40.0, math.inf, "better than 40")
    row = Row("suppression of a second camera, 0.1 MHz apart", "eq. 2.11", printed, float(suppression[-1]),
              "dB", how)  # fmt: skip
    panel = Panel(
        "Second camera, exposure 1 ms", "difference of the frequencies [Hz]", "suppression [dB]",
        (Curve(offsets[1:], suppression[1:], points=True),), log=True,
    )  # fmt: skip
    caption = "Light of a second camera that is left after demodulation, against its frequency difference."
    return Outcome((row,), (Picture("eq_2_11", "Eq. 2.11", caption, (panel,)),))


def _light_left(laboratory: Laboratory, camera: Camera, setting: int, offset: float) -> float:
    """Return the RMS amplitude in counts of the light that is common to all pixels of a frame."""
    other = Interference(frequency=camera.sensor.modulation_frequency + offset, amplitude=1500.0)
    lit = replace(camera, effects={"interference": other})
    scene = stations(plate(size=None), [(setting, facing(1.0))], frames=100, uptime=360.0)
    simulation = Simulation(lit, scene, seed=_SEED)
    common = []
    for _, frame in laboratory.frames(simulation, "two cameras"):
        metres = frame.distance.astype(float) * camera.sensor.lsb
        light = to_phasor(metres, frame.amplitude.astype(float), camera.sensor.ambiguity)
        common.append(complex(light.mean()))
    values = np.array(common)
    return float(np.sqrt(np.mean(np.abs(values - values.mean()) ** 2)))


# --- coordinates -----------------------------------------------------------------------------------

#: Table 2.4: c [mm], share of the pixel that is sigma of x_s and y_s, D, s_D; then X s_X Y s_Y Z s_Z, all m.
TABLE_2_4 = (
    (8.0, 1.0, 7.5, 0.01, -2.542, 0.031, -2.754, 0.041, 6.493, 0.022),
    (8.0, 0.5, 7.5, 0.01, -2.542, 0.019, -2.754, 0.024, 6.493, 0.016),
    (8.0, 1.0, 2.0, 0.01, -0.676, 0.009, -0.732, 0.011, 1.732, 0.010),
    (8.0, 0.5, 2.0, 0.01, -0.676, 0.006, -0.732, 0.007, 1.732, 0.009),
    (8.0, 1.0, 7.5, 0.02, -2.542, 0.032, -2.754, 0.041, 6.493, 0.026),
    (8.0, 0.5, 7.5, 0.02, -2.542, 0.020, -2.754, 0.024, 6.493, 0.022),
    (8.0, 1.0, 2.0, 0.02, -0.676, 0.011, -0.732, 0.013, 1.732, 0.018),
    (8.0, 0.5, 2.0, 0.02, -0.676, 0.008, -0.732, 0.010, 1.732, 0.018),
    (12.0, 1.0, 7.5, 0.01, -1.826, 0.023, -1.978, 0.031, 6.998, 0.014),
    (12.0, 0.5, 7.5, 0.01, -1.826, 0.013, -1.978, 0.017, 6.998, 0.011),
    (12.0, 1.0, 2.0, 0.01, -0.485, 0.006, -0.525, 0.009, 1.866, 0.010),
    (12.0, 0.5, 2.0, 0.01, -0.485, 0.004, -0.525, 0.005, 1.866, 0.009),
    (12.0, 1.0, 7.5, 0.02, -1.826, 0.023, -1.978, 0.031, 6.998, 0.021),
    (12.0, 0.5, 7.5, 0.02, -1.826, 0.014, -1.978, 0.017, 6.998, 0.020),
    (12.0, 1.0, 2.0, 0.02, -0.485, 0.008, -0.525, 0.010, 1.866, 0.019),
    (12.0, 0.5, 2.0, 0.02, -0.485, 0.006, -0.525, 0.007, 1.866, 0.019),
)  # fmt: skip
_QUANTITIES = ("X", "s_X", "Y", "s_Y", "Z", "s_Z")


def coordinates(laboratory: Laboratory) -> Outcome:
    """Table 2.4: coordinates of a corner pixel and their precision by error propagation (eqs. 2.17-2.19)."""
    laboratory.progress("precision of coordinates")
    ours = np.array([_coordinates(c * 1e-3, share, d, s) for c, share, d, s, *_ in TABLE_2_4])
    printed = np.array([row[4:] for row in TABLE_2_4])
    rows = []
    how = (
        "eqs. 2.17-2.19 with c = 8 and 12 mm (the headings 0.008 and 0.012 mm are misprints) and s_f = "
        "0.05 mm, closed derivatives; calculated, as in the thesis; the largest deviation of 16 printed "
        "values"
    )
    for i, name in enumerate(_QUANTITIES):
        worst = int(np.argmax(np.abs(ours[:, i] - printed[:, i])))
        why = "-2.7547 is printed -2.754" if name == "Y" else ""
        value = Printed.number(float(printed[worst, i]), f"{printed[worst, i]:.3f}")
        rows.append(
            Row(
                f"{name}, the worst of 16 rows",
                "table 2.4",
                value,
                float(ours[worst, i]),
                "m",
                how,
                4,
                why=why,
            )
        )
    table = Table(
        "Table 2.4, all rows: printed / ours [m]",
        ("c [mm]", "s_x, s_y [px]", "D [m]", "s_D [m]", *_QUANTITIES),
        tuple(
            (
                *(f"{x:g}" for x in row[:4]),
                *(f"{p:.3f} / {q:.4f}" for p, q in zip(row[4:], mine, strict=True)),
            )
            for row, mine in zip(TABLE_2_4, ours, strict=True)
        ),
    )
    return Outcome(tuple(rows), tables=(table,))


def _coordinates(c: float, share: float, distance: float, sigma: float) -> tuple[float, ...]:
    """Return X s_X Y s_Y Z s_Z in m for pixel spacings of the SR-2 (39.2 x 54.8 um)."""
    x_s, y_s = 3.136e-3, 3.398e-3
    place = object_coordinates(x_s=x_s, y_s=y_s, camera_constant=c, distance=distance)
    spread = coordinate_precision(
        x_s=x_s,
        y_s=y_s,
        camera_constant=c,
        distance=distance,
        sigma_x_s=share * 39.2e-6,
        sigma_y_s=share * 54.8e-6,
        sigma_distance=sigma,
        sigma_camera_constant=0.05e-3,
    )
    return tuple(float(one) for pair in zip(place, spread, strict=True) for one in pair)
