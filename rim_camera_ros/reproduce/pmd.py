"""The PMD sensors (table 2.3, sec. 2.3.2): image area, dynamic range, suppression of unmodulated light."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.background_light import BackgroundLight
from rim_camera_ros.errors import InputError
from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.reproduce.laboratory import Laboratory, facing, plate, stations
from rim_camera_ros.reproduce.principles import bare
from rim_camera_ros.reproduce.results import Outcome, Printed, Row

_SEED = 2320
#: Sensor whose dynamic range is scaled by pixel area to the others: that of the camera in the thesis.
_REFERENCE = "pmd3ks"
#: Ratio of unmodulated to modulated light that reaches a pixel in spite of the filter (sec. 2.3.1).
_BACKGROUND_RATIO = 100.0
#: Integration times [ms], and levels of unmodulated light [counts], between which a pixel begins to saturate.
_TIMES, _LEVELS = (1.0, 1e3), (1e3, 1e9)
#: Number of bisections, after which the limit is known to 2e-6 of its value.
_STEPS = 24


@dataclass(frozen=True)
class _Sensor:
    """A column of table 2.3: image area [mm], dynamic range [dB], its increase by SBI [dB] or None (na)."""

    name: str
    area: tuple[float, float]
    dynamic_range: float
    suppression: float | None


_TABLE_2_3 = (
    _Sensor("pmd768s", (6.75, 3.73), 78.0, 50.0),
    _Sensor("pmd1ks2", (9.94, 3.37), 78.0, 50.0),
    _Sensor(_REFERENCE, (6.4, 4.8), 74.0, 50.0),
    _Sensor("pmd19k", (6.4, 4.8), 65.0, None),
)


def sensors(laboratory: Laboratory) -> Outcome:
    """Table 2.3: values that follow from pixel and light, and the precision under 100 times other light."""
    rows: list[Row] = []
    for sensor in _TABLE_2_3:
        rows += _area_rows(laboratory, sensor)
    measured = {sensor.name: _dynamic_range(laboratory, sensor.name) for sensor in _TABLE_2_3}
    how = (
        "greatest amplitude that a pixel delivers unsaturated, over the noise of amplitudes in the dark; "
        "their variance over 400 frames at five faint lights follows a line, of which the value without "
        "light counts. The camera file's noise is stated from the printed dynamic range and 16 bit: the row "
        "shows that light, noise and read-out keep it"
    )
    for sensor in _TABLE_2_3:
        name = f"dynamic range {laboratory.camera(sensor.name).device}"
        value = Printed.number(sensor.dynamic_range)
        rows.append(Row(name, "table 2.3", value, measured[sensor.name], "dB", how))
    rows += _area_law(laboratory, measured[_REFERENCE])
    rows += [_suppression(laboratory, sensor) for sensor in _TABLE_2_3 if sensor.suppression is not None]
    rows.append(_under_background(laboratory))
    return Outcome(tuple(rows))


def _pitch(laboratory: Laboratory, name: str) -> tuple[float, float]:
    pitch = laboratory.camera(name).sensor.pixel_pitch
    if pitch is None:
        raise InputError("states no pixel_pitch", file=name, remedy="state sensor.pixel_pitch [m, m]")
    return pitch


def _light(camera: Camera, setting: float) -> Simulation:
    scene = stations(plate(size=None), [(setting, facing(2.0))], frames=1, uptime=3600.0)
    return Simulation(camera, scene, seed=_SEED, noise=False)


def _amplitude(laboratory: Laboratory, camera: Camera, setting: float) -> float:
    """Return the counts that a pixel on the axis delivers without noise, of a white wall at 2 m."""
    (_, frame), *_ = laboratory.frames(_light(camera, setting), f"light of {camera.device}")
    height, width = camera.shape
    return float(frame.amplitude[height // 2, width // 2])


def _area_rows(laboratory: Laboratory, sensor: _Sensor) -> list[Row]:
    camera = laboratory.camera(sensor.name)
    simulation = _light(bare(camera), 5.0)
    (_, frame), *_ = laboratory.frames(simulation, f"sensor of {camera.device}")
    lit = frame.distance > 0
    counted = lit.any(axis=0).sum(), lit.any(axis=1).sum()
    how = "columns and rows that deliver distances in a simulated frame times the pixel size of the table"
    rows = []
    for side, printed, number, pitch in zip(
        ("width", "height"), sensor.area, counted, _pitch(laboratory, sensor.name), strict=True
    ):
        label = f"{camera.device} image area, {side}"
        value = Printed.number(printed)
        rows.append(Row(label, "table 2.3", value, float(number) * pitch * 1e3, "mm", how, 2))
    return rows


def _dynamic_range(laboratory: Laboratory, name: str) -> float:
    """Return 20 log10 of the greatest unsaturated amplitude over the amplitude's noise in the dark."""
    camera = bare(laboratory.camera(name))
    dark, bright = _TIMES
    for _ in range(_STEPS):
        middle = math.sqrt(dark * bright)
        if _amplitude(laboratory, camera, middle) >= camera.sensor.saturation:
            bright = middle
        else:
            dark = middle
    greatest = _amplitude(laboratory, camera, dark)
    per_setting = greatest / dark
    # from ten times the noise on: below, amplitudes are cut off at 0
    sigma = camera.noise.amplitude * 2 * math.pi / camera.sensor.ambiguity
    faint = np.array([10.0, 15.0, 20.0, 25.0, 30.0]) * sigma
    scene = stations(
        plate(size=None), [(a / per_setting, facing(2.0)) for a in faint], frames=400, uptime=3600.0
    )
    middle_of = tuple(slice(n // 2 - 4, n // 2 + 4) for n in camera.shape)
    measured = laboratory.record(
        camera, scene, (middle_of[0], middle_of[1]), seed=_SEED, words=f"noise of {camera.device}"
    )
    light = [result.mean_amplitude for result in measured]
    variance = [float(result.amplitude.var(axis=0, ddof=1).mean()) for result in measured]
    _, in_the_dark = np.polyfit(light, variance, 1)
    return 20.0 * math.log10(greatest / math.sqrt(in_the_dark))


def _area_law(laboratory: Laboratory, reference: float) -> list[Row]:
    """Return the dynamic ranges expected from that of one sensor by the areas of the pixels."""
    how = (
        "the PMD 3k-S's dynamic range of the rows above and the area of the pixels alone: a well holds "
        "electrons in proportion to its area, resetting it leaves a noise of their square root, so that the "
        "range grows by 10 log10 of the area"
    )
    rows = []
    for sensor in _TABLE_2_3:
        if sensor.name in (_REFERENCE, "pmd1ks2"):  # the pixel of the 1k-S 2 is that of the 768-S, turned
            continue
        ratio = math.prod(_pitch(laboratory, sensor.name)) / math.prod(_pitch(laboratory, _REFERENCE))
        name = f"dynamic range {laboratory.camera(sensor.name).device} by its pixel's area"
        value = Printed.number(sensor.dynamic_range)
        rows.append(Row(name, "table 2.3", value, reference + 10.0 * math.log10(ratio), "dB", how))
    return rows


def _suppression(laboratory: Laboratory, sensor: _Sensor) -> Row:
    """Return in dB how much more unmodulated light a pixel accepts than without suppression."""
    camera = bare(laboratory.camera(sensor.name))
    without = replace(camera, sensor=replace(camera.sensor, background_suppression=0.0))
    levels = [_saturating_level(laboratory, each) for each in (without, camera)]
    ours = 20.0 * math.log10(levels[1] / levels[0])
    how = (
        "unmodulated light at which a pixel that sees a white wall at 2 m (1 ms) saturates, with the circuit "
        "over without it. The camera file states the suppression; the row shows what a pixel then takes"
    )
    value = Printed.number(sensor.suppression or 0.0)
    return Row(f"more light by SBI, {camera.device}", "table 2.3, sec. 2.3.2", value, ours, "dB", how)


def _saturating_level(laboratory: Laboratory, camera: Camera) -> float:
    low, high = _LEVELS
    for _ in range(_STEPS):
        middle = math.sqrt(low * high)
        lit = with_effects(camera, {"background_light": BackgroundLight(level=middle)})
        if _amplitude(laboratory, lit, 1.0) >= camera.sensor.saturation:
            high = middle
        else:
            low = middle
    return math.sqrt(low * high)


def _under_background(laboratory: Laboratory) -> Row:
    """Return the factor by which other light of the stated ratio reduces the precision of distances."""
    camera = bare(laboratory.camera(_REFERENCE))
    # only photon noise, as in eq. 2.8
    camera = replace(camera, noise=replace(camera.noise, floor=0.0, amplitude=0.0))
    level = _BACKGROUND_RATIO * _amplitude(laboratory, camera, 5.0)
    lit = with_effects(camera, {"background_light": BackgroundLight(level=level)})
    scene = stations(plate(size=None), [(5.0, facing(2.0))], frames=400, uptime=3600.0)
    region = (slice(22, 26), slice(30, 34))
    noise = [
        laboratory.record(other, scene, region, seed=_SEED, words="noise under other light")[0].sigma
        for other in (camera, lit)
    ]
    expected = math.sqrt(1.0 + _BACKGROUND_RATIO)
    how = (
        "white wall at 2 m, 5 ms, 400 frames of 4 x 4 pixels: sigma of one distance under unmodulated light "
        "of a hundred times the signal (sec. 2.3.1) over that without, noise of photons alone; the thesis' "
        "value is eq. 2.8 with B = A and B = 101 A. Suppression keeps the pixel from saturating, not the "
        "photons from being noisy"
    )
    printed = Printed.number(expected, "sqrt(101) = 10.05")
    count = 2.0 * 399 * 16
    return Row(
        "sigma under background 100 : 1, PMD 3k-S",
        "eq. 2.8, sec. 2.3.1",
        printed,
        noise[1] / noise[0],
        "-",
        how,
        2,
        sigma=noise[1] / noise[0] * math.sqrt(2.0 / count),
    )
