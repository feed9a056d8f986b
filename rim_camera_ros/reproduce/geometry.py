"""Sensors (tables 2.2, 2.3) and photogrammetric calibration (sec. 3.2, tables 3.1, 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError
from rim_camera_ros.optics import Optics
from rim_camera_ros.photogrammetry import OpticsCovariance, estimate_optics, observe
from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.reproduce.laboratory import Laboratory, facing, plate, stations
from rim_camera_ros.reproduce.results import Outcome, Printed, Row

_SEED = 3200
#: Camera, columns, rows, table.
_SENSORS = (
    ("sr2", 160, 124, "table 2.2, app. A"),
    ("sr3000", 176, 144, "app. B, C"),
    ("pmd768s", 32, 24, "table 2.3"),
    ("pmd1ks2", 64, 16, "table 2.3"),
    ("pmd3ks", 64, 48, "table 2.3"),
    ("pmd19k", 160, 120, "table 2.3"),
)


def sensors(laboratory: Laboratory) -> Outcome:
    """Size of the arrays, counted in simulated frames; frames do not determine the pixel pitch."""
    rows = []
    for name, columns, lines, source in _SENSORS:
        camera = laboratory.camera(name)
        scene = stations(plate(size=None), [(16, facing(2.0))], frames=1, uptime=3600.0)
        (_, frame), *_ = laboratory.frames(Simulation(camera, scene, seed=_SEED), f"sensor of {name}")
        lit = frame.distance > 0
        how = "columns and rows that deliver distances in a frame of a white wall at 2 m"
        for label, printed, ours in (
            ("columns", columns, lit.any(axis=0).sum()),
            ("rows", lines, lit.any(axis=1).sum()),
        ):
            value = Printed.number(float(printed))
            rows.append(Row(f"{camera.device} {label}", source, value, float(ours), "px", how, 0))
    pitch = Printed.number(40.0, "39.2 x 54.8 / 40 / 100")
    how = (
        "frames give angles per pixel only: the pitch scales with the camera constant in mm, which nothing "
        "in the pictures determines; it is taken from the data sheet, as in the thesis, also below"
    )
    rows.append(Row("pixel pitch SR-2 / SR-3000 / 3k-S", "tables 2.2, 2.3, app. C", pitch, None, "um", how))
    return Outcome(tuple(rows))


@dataclass(frozen=True)
class _Printed:
    """Values of table 3.1 or 3.2: c, x_P, y_P with 1-sigma in mm, and K1 K2 K3 in mm^-2, ^-4, ^-6."""

    c: tuple[float, float]
    x_p: tuple[float, float]
    y_p: tuple[float, float]
    k: tuple[float, float, float]
    source: str

    @property
    def radial(self) -> float:
        """Radial correction in um at `_RADIUS`: K1 r^3 + K2 r^5 + K3 r^7."""
        return 1e3 * sum(k * _RADIUS ** (3 + 2 * i) for i, k in enumerate(self.k))


#: Where the radial distortion is compared, in mm from the principal point on the sensor; K1, K2, K3 are too
#: correlated to be compared one by one.
_RADIUS = 3.0


_OPTICS = {
    "sr2": _Printed(
        (7.656, 0.136), (-0.1158, 0.068), (0.1051, 0.067), (-2.388e-3, 1.286e-4, 0.0), "table 3.1"
    ),
    "sr3000": _Printed(
        (7.9955, 1.387e-2),
        (0.0997, 1.969e-2),
        (0.4357, 2.027e-2),
        (1.65764e-3, 3.78532e-5, -2.65190e-6),
        "table 3.2",
    ),
}


def optics(laboratory: Laboratory) -> Outcome:
    """Camera constant, principal point and radial distortion by a bundle adjustment of the circle field."""
    rows: list[Row] = []
    for name in _OPTICS:
        rows += _optics_rows(laboratory, name)
    return Outcome(tuple(rows))


def _optics_rows(laboratory: Laboratory, name: str) -> list[Row]:
    camera, printed = laboratory.camera(name), _OPTICS[name]
    scene = laboratory.scene("circle_field")
    simulation = Simulation(camera, scene, seed=_SEED)
    frames = (frame for _, frame in laboratory.frames(simulation, f"circle field, {name}"))
    observations = observe(frames, camera, scene)
    laboratory.progress(f"bundle adjustment, {name}")
    if camera.sensor.pixel_pitch is None:
        raise InputError("states no pixel_pitch", file=name, remedy="state sensor.pixel_pitch [m, m]")
    pitch = [1e3 * one for one in camera.sensor.pixel_pitch]
    columns, lines = camera.sensor.width, camera.sensor.height
    # approximate values as a data sheet gives them: an ideal lens of 8 mm, its axis in the middle
    start = Optics(fx=8.0 / pitch[0], fy=8.0 / pitch[1], cx=(columns - 1) / 2, cy=(lines - 1) / 2)
    estimated, covariance, report = estimate_optics(observations, start=start, significance=None)
    c = estimated.fx * pitch[0]
    how = (
        f"circle field of 25 labels, 16 stations, 20 frames each: {report.points} ellipses, bundle "
        "adjustment "
        f"of all nine parameters from an ideal lens of 8 mm, residuals {report.residual_rms:.3f} px RMS; "
        "pixel pitch by the data sheet"
    )
    field = "; the thesis had a field of LEDs for this camera" if name == "sr2" else ""
    why = "edges of simulated labels are jagged: one ray per pixel, targets good to 0.06 px"

    def row(
        label: str, value: tuple[float, float] | float, ours: float, sigma: float, digits: int, unit: str
    ) -> Row:
        if isinstance(value, float):
            shown = Printed.number(value, f"{value:.1f} by K1-K3")
        else:
            shown = Printed.number(value[0], f"{value[0]:g} +- {value[1]:g}")
        label = f"{camera.device} {label}"
        return Row(label, printed.source, shown, ours, unit, how + field, digits, sigma, why)

    sigma = report.sigmas
    x_p = (estimated.cx - (columns - 1) / 2) * pitch[0]
    y_p = (estimated.cy - (lines - 1) / 2) * pitch[1]
    shift, shift_sigma = _radial(estimated, covariance, c)
    return [
        row("camera constant c", printed.c, c, sigma["fx"] * pitch[0], 4, "mm"),
        row("principal point x_P", printed.x_p, x_p, sigma["cx"] * pitch[0], 4, "mm"),
        row("principal point y_P", printed.y_p, y_p, sigma["cy"] * pitch[1], 4, "mm"),
        row("radial distortion at 3 mm", printed.radial, shift * 1e3, shift_sigma * 1e3, 1, "um"),
    ]


def _radial(optics: Optics, covariance: OpticsCovariance, c: float) -> tuple[float, float]:
    """Return the radial correction in mm of a point measured at `_RADIUS`, and its 1-sigma.

    plumb_bob maps ideal to distorted radii, so the ideal radius is found by inversion (c in mm).
    """
    order = [covariance.parameters.index(f"optics.d.{i}") for i in (0, 1, 4)]
    matrix = covariance.matrix[np.ix_(order, order)]
    radii = np.linspace(0.0, 1.3 * _RADIUS / c, 4001)

    def correction(k: NDArray[np.float64]) -> float:
        imaged = radii * (1 + k[0] * radii**2 + k[1] * radii**4 + k[2] * radii**6)
        return float(np.interp(_RADIUS / c, imaged, radii)) * c - _RADIUS

    k = np.array([optics.d[i] for i in (0, 1, 4)])
    slope = np.array([(correction(k + step) - correction(k - step)) / 2e-4 for step in 1e-4 * np.eye(3)])
    return correction(k), float(np.sqrt(slope @ matrix @ slope))
