"""Light that the scene does not send: unknown physics with a form, a place and a phase of its own."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, save_camera
from rim_camera_ros.diagnose.added_light import place_of_light
from rim_camera_ros.diagnose.full_grid import restated
from rim_camera_ros.diagnose.result import Missing
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.effects.added_light import AddedLight
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.decimation import decimated_camera
from rim_camera_ros.reports.diagnosis.page import page

from ..calibrate.helpers import camera, record, scene

KNOWN = (EmissionPattern((-1.3, 0.7)), CyclicError((Harmonic(4, 0.011, 0.7),), (0.004, -0.002)))


def ring(cam: Camera, *, counts: float, away: float) -> np.ndarray:
    """A ring of light [counts] off the middle, as from ``away`` [m]."""
    v, u = np.mgrid[: cam.sensor.height, : cam.sensor.width]
    radius = np.hypot(u - 0.4 * cam.sensor.width, v - 0.6 * cam.sensor.height)
    size = 0.3 * cam.sensor.width
    strength = counts * np.exp(-(((radius - size) / (0.4 * size)) ** 2))
    return strength * np.exp(2j * np.pi * away / cam.sensor.ambiguity)


def with_light(data: Dataset, cam: Camera, light: np.ndarray) -> Dataset:
    """The recording with light [counts at the first station's setting] added to its means, by hand."""
    first = cam.integration_time(data.stations[0].settings)
    wave = 2 * np.pi / cam.sensor.ambiguity
    for k, one in enumerate(data.stations):
        more = light * cam.integration_time(one.settings) / first
        own = np.exp(1j * wave * one.distance)
        phasor = one.amplitude * own + more
        moved = np.angle(phasor * np.conj(own)) / wave
        data.stations[k] = replace(one, distance=one.distance + moved, amplitude=np.abs(phasor))
    return data


def test_the_place_is_in_pixels_of_the_whole_sensor(tmp_path: Path) -> None:
    """The strongest of three knots is in the middle of both sides; every third pixel is used."""
    light = AddedLight(
        real=((0.0, 0.0, 0.0), (0.0, -0.004, 0.001), (0.0, 0.0, 0.0)), imaginary=((0.0, 0.0, 0.0),) * 3
    )
    full = camera(tmp_path, light)
    small = decimated_camera(full, 3)
    found = Missing("unknown", 1.0, {}, {}, f"most at {place_of_light(small)}", model=light.name)
    words = restated(found, small, full, 3).sentence
    column, row = (int(number) for number in re.findall(r"\d+", words))
    assert abs(column - full.sensor.width / 2) <= 1
    assert abs(row - full.sensor.height / 2) <= 1


@pytest.mark.long
def test_light_of_the_housing_is_located_modelled_and_said(tmp_path: Path) -> None:
    truth, board = camera(tmp_path, *KNOWN), scene(tmp_path)
    data = record(truth, board, seed=21)
    median = float(np.median([np.median(one.amplitude[one.count > 0]) for one in data.stations]))
    light = ring(truth, counts=0.015 * median, away=2.1)
    result = diagnose(with_light(data, truth, light), board, truth)
    assert result.verdict == "unknown_physics"
    (missing,) = result.missing
    assert missing.effect == "unknown"
    assert missing.model == "added_light"
    assert "light of the emitter that does not come from the scene" in missing.sentence
    away = re.search(r"as from ([\d.]+) m", missing.sentence)
    assert away is not None
    assert float(away[1]) == pytest.approx(2.1, abs=0.15)
    # no effect of the vocabulary was tried in its place
    assert result.final is result.baseline
    # held-out poses: beyond the noise before, down to it after
    assert result.accuracy.chi2_before > 1.3
    assert result.accuracy.chi2_after < 1.08
    # where it is: half of its own maximum, both ways
    strength = np.abs(light)
    found = result.camera.effects["added_light"]
    assert isinstance(found, AddedLight)
    save_camera(result.camera, tmp_path / "found.yaml")
    assert load_camera(tmp_path / "found.yaml").effects["added_light"] == found
    words = page(result, recording="a", camera="b", scene="c")
    assert "Map of the light that is added" in words
    inside, reported = strength > 0.5 * strength.max(), result.where.pixels
    assert reported[inside].mean() > 5 * reported[strength < 0.1 * strength.max()].mean()
