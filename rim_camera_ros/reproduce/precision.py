"""Secs. 3.3.3 and 3.3.4: precision of one distance, its map over the array, power of the LEDs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.emission_pattern import squared_angle
from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.reports.figures import Curve, Map, Panel
from rim_camera_ros.reproduce.laboratory import (
    OBSERVED,
    OBSERVED_SR2,
    SETTINGS,
    TARGET,
    WARM,
    Laboratory,
    around,
    facing,
    plate,
    stations,
)
from rim_camera_ros.reproduce.reductions import fit_histogram, fit_noise
from rim_camera_ros.reproduce.results import Outcome, Picture, Printed, Row

Array = NDArray[np.float64]

_SEED = 3303
#: Table 3.3: c of the fitted Gaussian [m]; its counts a, width c and number of values give bins of 5 mm.
TABLE_3_3 = {"sr3000": (0.03728, 0.01226, 0.008728), "sr2": (0.02188, 0.007848, 0.006515)}
_BIN = 0.005
#: Wall of the histograms: the thesis measured 2.63 and 2.65 m at setting 100 and does not print the nominal.
_WALL = 2.6
_PIXELS = {"sr3000": OBSERVED, "sr2": OBSERVED_SR2}


def histograms(laboratory: Laboratory) -> Outcome:
    """Table 3.3: Gaussians fitted to histograms of 8000 distances, and the noise model from these."""
    rows: list[Row] = []
    panels: list[Panel] = []
    for name, printed in TABLE_3_3.items():
        camera = laboratory.camera(name)
        placed = [(setting, facing(_WALL)) for setting in SETTINGS]
        scene = stations(plate(TARGET, size=None), placed, frames=320, uptime=WARM[name])
        region = around(_PIXELS[name], 2)
        there = laboratory.record(camera, scene, region, seed=_SEED, words=f"histograms, {name}")
        sigmas, amplitudes, curves = [], [], []
        for result, c in zip(there, printed, strict=True):
            # pixels have different offsets, which are removed by their means
            values = (result.distance - result.distance.mean(axis=0) + result.distance.mean()).ravel()
            fitted = fit_histogram(values, bin_width=_BIN)
            sigmas.append(fitted.sigma)
            amplitudes.append(result.mean_amplitude)
            curves.append(_histogram(values, f"{result.setting:g}"))
            how = (
                f"white wall ({TARGET:.0%}) at {_WALL} m, 320 frames of 5 x 5 pixels (8000 distances), "
                "histogram with bins of "
                "5 mm, Gaussian by eq. 3.5, c / sqrt(2)"
            )
            shown = Printed.number(c * 1e3 / np.sqrt(2), f"{c * 1e3 / np.sqrt(2):.3g}")
            rows.append(
                Row(
                    f"{camera.device} sigma of one distance, setting {result.setting:g}",
                    "table 3.3",
                    shown,
                    fitted.sigma * 1e3,
                    "mm",
                    how,
                    2,
                    fitted.sigma * 1e3 / np.sqrt(2 * values.size),
                    "reflectivity and nominal distance of the target are not printed; stray light takes "
                    "amplitude from the middle; the width of the bins is in c of the table, which the camera "
                    "files take for noise, and again in ours",
                )
            )
        rows.append(_floor(camera, printed, amplitudes, sigmas))
        panels.append(
            Panel(f"{camera.device}, {_WALL} m", "distance - mean [mm]", "share per 5 mm", tuple(curves))
        )
    caption = "Histograms of 8000 distances for three integration times (appendix D)."
    return Outcome(tuple(rows), (Picture("fig_d", "Figs. 3.15, D.1, D.2", caption, tuple(panels)),))


def _histogram(values: Array, label: str) -> Curve:
    edges = np.arange(-0.1, 0.1001, _BIN)
    counts, _ = np.histogram(values - values.mean(), edges)
    return Curve((edges[1:] + edges[:-1]) / 2 * 1e3, counts / values.size, label=f"setting {label}")


def _floor(camera: Camera, c: tuple[float, ...], amplitude: list[float], sigma: list[float]) -> Row:
    """Return the row of the noise floor, by the same fit to the table (with the setting as A) and to ours."""
    table = fit_noise(SETTINGS, np.array(c) / np.sqrt(2))
    ours = fit_noise(amplitude, sigma)
    how = (
        "sigma^2 = floor^2 + (k / A)^2 through the three sigmas above with their mean amplitudes, "
        f"k = {ours.slope:.1f} m counts; the same through table 3.3 with A as the setting"
    )
    shown = Printed.number(table.floor * 1e3, f"{table.floor * 1e3:.1f}")
    return Row(f"{camera.device} noise floor", "table 3.3", shown, ours.floor * 1e3, "mm", how, 2)


# --- over the array --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Wall:
    """A white wall seen by the whole array: mean and standard deviation of n frames, (H, W), m and counts."""

    sigma: Array
    amplitude: Array
    mean: Array
    frames: int


def wall(laboratory: Laboratory, name: str, *, distance: float, frames: int, setting: int = 100) -> Wall:
    """Return the measurements of the whole array on a white wall at a distance in m."""

    def measure() -> Wall:
        camera = laboratory.camera(name)
        scene = stations(plate(size=None), [(setting, facing(distance))], frames=frames, uptime=WARM[name])
        simulation = Simulation(camera, scene, seed=_SEED + 1)
        number, total, square, light = 0, *(np.zeros(camera.shape) for _ in range(3))
        nominal = np.zeros(camera.shape)
        for exposure, frame in laboratory.frames(simulation, f"wall at {distance:g} m, {name}"):
            nominal = simulation.true_distance(exposure)
            # relative to the nominal distance, so that squares keep their precision
            error = frame.distance * camera.sensor.lsb - nominal
            number, total, square = number + 1, total + error, square + error**2
            light += frame.amplitude
        variance = (square - total**2 / number) / (number - 1)
        return Wall(np.sqrt(variance), light / number, nominal + total / number, number)

    return laboratory.once(f"wall {name} {distance} {frames} {setting}", measure)


def _corners(values: Array, size: int = 8) -> Array:
    """Return the values of the four corners of size x size pixels each."""
    cut = (slice(None, size), slice(-size, None))
    return np.concatenate([values[a, b].ravel() for a in cut for b in cut])


def sigma_map(laboratory: Laboratory) -> Outcome:
    """Fig. 3.17: standard deviation over the array at 2.463 m, setting 100."""
    rows, maps = [], []
    for name in ("sr2", "sr3000"):
        camera = laboratory.camera(name)
        seen = wall(laboratory, name, distance=2.463, frames=100)
        height, width = camera.shape
        centre = seen.sigma[height // 2 - 10 : height // 2 + 10, width // 2 - 10 : width // 2 + 10]
        how = "white wall at 2.463 m, setting 100, 100 frames, standard deviation of each pixel; median of "
        for label, low, high, values, where in (
            ("centre", 5.0, 10.0, centre, "the middle 20 x 20 pixels"),
            ("corners", 40.0, 50.0, _corners(seen.sigma), "four corners of 8 x 8 pixels"),
        ):
            why = ""
            if name == "sr2":
                why = "fig. 3.17 is noisier than table 3.3, by which the camera file's noise goes"
            rows.append(
                Row(
                    f"{camera.device} sigma, {label}",
                    "fig. 3.17",
                    Printed(low, high, f"{low:g}-{high:g}"),
                    float(np.median(values)) * 1e3,
                    "mm",
                    how + where,
                    1,
                    why=why,
                )
            )
        maps.append(Map(f"{camera.device}, 2.463 m, 100", seen.sigma * 1e3, 50.0, from_zero=True))
    caption = "Standard deviation of a single distance towards a white wall at 2.463 m, setting 100."
    return Outcome(tuple(rows), (Picture("fig_3_17", "Fig. 3.17", caption, maps=tuple(maps), unit="mm"),))


def led_power(laboratory: Laboratory) -> Outcome:
    """Sec. 3.3.4: power of the LEDs at 25 gon over that in the centre, from the amplitudes of a wall."""
    rows, curves = [], []
    for name in ("sr2", "sr3000"):
        camera = laboratory.camera(name)
        seen = wall(laboratory, name, distance=2.463, frames=100)
        angle = np.sqrt(squared_angle(camera))
        # without the wall's cos(incidence) / distance^2, with z / cos(angle), and the lens' cos^4
        emitted = seen.amplitude / np.cos(angle) ** (1 + 2 + 4)
        gon = angle * 200 / np.pi
        edges = np.arange(0.0, 36.0, 1.0)
        classes = [emitted[(gon >= a) & (gon < a + 1)] for a in edges]
        profile = np.array([np.nan if group.size < 8 else group.mean() for group in classes])
        profile /= emitted[gon < 2].mean()
        at = float(np.interp(25.0, edges + 0.5, profile)) * 100
        how = (
            "amplitudes of a white wall at 2.463 m, 100 frames, over cos(incidence) / distance^2 and cos^4 "
            "of "
            "the lens, mean of circles about the axis, relative to the centre; stray light is in it"
        )
        rows.append(
            Row(f"{camera.device} LED power at 25 gon", "sec. 3.3.4", Printed(30, 50, "30-50"), at, "%", how)
        )
        curves.append(Curve(edges + 0.5, profile * 100, label=camera.device))
    panel = Panel("Emitted power", "angle from the axis [gon]", "relative power [%]", tuple(curves))
    caption = "Power of the LEDs over the angle from the axis, from the amplitudes of a white wall."
    return Outcome(tuple(rows), (Picture("fig_3_21", "Fig. 3.21", caption, (panel,)),))
