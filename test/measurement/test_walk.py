"""Single photons and gates as users meet them: every command, nothing missing, and true differences found."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags import Recording
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, save_camera
from rim_camera_ros.cli import main
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.gate_timing import GateTiming
from rim_camera_ros.effects.integration_time_offset import IntegrationTimeOffset
from rim_camera_ros.files import find_scene
from rim_camera_ros.measurement import measurement_of

from ..diagnose.helpers import run
from .recordings import board, record, small

DISTANCES = np.linspace(0.5, 2.4, 14)
#: Of photons three settings in turn; of gates as long as the board is far, so that it is as bright.
TIMES = {
    "epfl64": [(100.0, 200.0, 400.0)[i % 3] for i in range(14)],
    "gated": [max(2.0, float(round(14 * z * z))) for z in DISTANCES],
}
AS_STATED = GateTiming(delay=(0.0,) * 3, width=(0.0,) * 3)


@dataclass(frozen=True)
class Files:
    """A recording of a true camera, the file of the stated one, and the scene of both."""

    folder: Path

    @classmethod
    def of(cls, folder: Path, true: Camera, stated: Camera, times: list[float], *, seed: int = 5) -> Files:
        scene = board(folder / "scene.yaml", list(DISTANCES), times)
        record(folder / "bag", true, stated, scene, seed=seed)
        save_camera(stated, folder / "camera.yaml")
        return cls(folder)

    def diagnosed(self) -> dict[str, Any]:
        self._run("diagnose", self.folder / "found")
        report: dict[str, Any] = json.loads((self.folder / "found" / "report.json").read_text())
        return report

    def calibrated(self) -> Camera:
        self._run("calibrate", self.folder / "made.yaml")
        return load_camera(self.folder / "made.yaml")

    def _run(self, command: str, out: Path) -> None:
        given = {"camera": self.folder / "camera.yaml", "scene": self.folder / "scene.yaml"}
        run(command, self.folder / "bag", out=out, threads=1, **given)


def sigma_of(camera: Camera, weights: dict[str, float]) -> float:
    """Return the 1-sigma of a sum of numbers of a camera file, by its covariance."""
    covariance = camera.covariance
    assert covariance is not None
    vector = np.array([weights.get(one, 0.0) for one in covariance.parameters])
    assert np.count_nonzero(vector) == len(weights)
    return float(np.sqrt(vector @ covariance.matrix.values @ vector))


def photons(*effects: Effect) -> Camera:
    return small("epfl64", *effects)


def gates(*, late: float = 0.0, longer: float = 0.0) -> tuple[Camera, Camera]:
    """Return a camera whose gate 1 opens late and whose gate 0 stays open longer [s], and the stated one."""
    stated = small("gated", AS_STATED)
    own = list(stated.measurement.gates)
    own[1] = replace(own[1], delay=own[1].delay + late)
    own[0] = replace(own[0], width=own[0].width + longer)
    return replace(stated, measurement=replace(stated.measurement, gates=tuple(own))), stated


@pytest.mark.parametrize(("name", "role"), [("epfl32", "histogram"), ("gated", "gates")])
def test_said_simulated_and_corrected(
    name: str, role: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", name]) == 0
    assert {"histogram": "128 bins of 156.2 ps", "gates": "their ratios determine 0 .. 3.22 m"}[role] in (
        capsys.readouterr().out
    )
    run("simulate", find_scene("corner"), "--samples", camera=name, frames=2, seed=3, out=tmp_path / "bag")
    assert main(["info", str(tmp_path / "bag"), "--camera", name]) == 0
    assert f"{role}/image_raw" in capsys.readouterr().out
    run("correct", tmp_path / "bag", camera=name, out=tmp_path / "corrected")
    with Recording(tmp_path / "bag") as raw, Recording(tmp_path / "corrected") as bag:
        frame, corrected = next(raw.frames()), next(bag.corrected_frames())
    camera = measurement_of(corrected_by := _shipped(name)).correction(corrected_by)
    np.testing.assert_allclose(corrected.distance, camera.correct(frame).distance, equal_nan=True)
    assert np.isfinite(corrected.distance).mean() > 0.8


def _shipped(name: str) -> Camera:
    from rim_camera_ros.files import find_camera

    return load_camera(find_camera(name))


# --- nothing is wrong ---------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["epfl64", "gated"])
def test_nothing_is_missing_where_the_file_is_right(name: str, tmp_path: Path) -> None:
    camera = photons() if name == "epfl64" else gates()[1]
    files = Files.of(tmp_path, camera, camera, TIMES[name], seed=11)
    found = files.diagnosed()
    assert (found["verdict"], found["missing"], found["adjusted"]) == ("consistent", [], [])
    assert not [one for one in found["notes"] if "at all poses alike" in one]
    assert found["fit"]["chi2_before"] < 1.05
    made = files.calibrated()
    assert set(made.effects) == {*camera.effects, "fixed_pattern_offset"}
    assert made.noise == camera.noise
    assert made.radiometry.gain == pytest.approx(
        camera.radiometry.gain, abs=3 * sigma_of(made, {"radiometry.gain": 1.0})
    )


# --- single photons -----------------------------------------------------------------------------


@pytest.mark.slow
def test_wrong_terms_of_single_photons_are_wrong_parameters_and_are_recovered(tmp_path: Path) -> None:
    """A clock that is slow by 0.4 % and offsets by setting; what is common to these is an offset of all."""
    true = photons(
        DistanceScale(scale=0.004), IntegrationTimeOffset(offset={100.0: 0.005, 200.0: 0.012, 400.0: -0.007})
    )
    stated = photons(
        DistanceScale(scale=0.0), IntegrationTimeOffset(offset={100.0: 0.0, 200.0: 0.0, 400.0: 0.0})
    )
    files = Files.of(tmp_path, true, stated, TIMES["epfl64"])
    found = files.diagnosed()
    assert (found["verdict"], found["missing"]) == ("wrong_parameters", [])
    assert {one["effect"] for one in found["adjusted"]} == {"distance_scale", "integration_time_offset"}
    made = files.calibrated()
    scale = made.effects["distance_scale"].scale
    error = sigma_of(made, {"effects.distance_scale.scale": 1.0})
    assert error < 0.0004
    assert scale == pytest.approx(0.004, abs=3 * error)
    offset, key = made.effects["integration_time_offset"].offset, "effects.integration_time_offset.offset."
    for one, other, difference in ((200, 100, 0.007), (400, 100, -0.012)):
        error = sigma_of(made, {f"{key}{one}": 1.0, f"{key}{other}": -1.0})
        assert error < 0.001
        assert offset[one] - offset[other] == pytest.approx(difference, abs=3 * error)


@pytest.mark.slow
def test_a_slow_clock_of_single_photons_is_named(tmp_path: Path) -> None:
    found = Files.of(tmp_path, photons(DistanceScale(scale=0.004)), photons(), TIMES["epfl64"]).diagnosed()
    assert found["verdict"] == "missing_physics"
    (named,) = found["missing"]
    assert named["effect"] == "distance_scale"
    low, high = named["interval"]["scale"]
    assert low < 0.004 < high
    assert high - low < 0.002


@pytest.mark.slow
def test_a_wrong_jitter_is_another_noise_and_moves_no_distance(tmp_path: Path) -> None:
    """300 ps stated, 380 true: the noise's shot grows with the time's sigma, 307 to 385 ps."""
    stated = photons()
    true = replace(stated, measurement=replace(stated.measurement, jitter=380e-12))
    found = Files.of(tmp_path, true, stated, TIMES["epfl64"]).diagnosed()
    (named,) = found["missing"]
    assert named["effect"] == "noise"
    width = 150e-12 / 2.354820
    expected = stated.noise.shot * np.hypot(width, 380e-12) / np.hypot(width, 300e-12)
    assert named["parameters"]["shot"] == pytest.approx(expected, rel=0.04)
    assert found["adjusted"] == []


@pytest.mark.slow
def test_a_wrong_dead_time_compresses_the_amplitude(tmp_path: Path) -> None:
    """A pixel that misses 5 cycles of 20 ns instead of 2 publishes S / (1 + 3 S / N) of N cycles."""
    stated = photons()
    stated = replace(
        stated,
        radiometry=replace(stated.radiometry, gain=1200.0),
        sensor=replace(stated.sensor, integration_time=20.0),
    )
    true = replace(stated, measurement=replace(stated.measurement, dead_time=100e-9))
    found = Files.of(tmp_path, true, stated, [20.0] * 14).diagnosed()
    (named,) = found["missing"]
    assert named["effect"] == "amplitude_nonlinearity"
    low, high = named["interval"]["compression"]
    assert low < 3 / (50e6 * 0.020) < high
    assert named["parameters"]["compression"] == pytest.approx(3e-6, rel=0.3)


# --- gates --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("late", "longer"), [(2e-10, 0.0), (0.0, 2e-10)])
def test_a_late_or_long_gate_is_a_wrong_parameter_and_is_recovered(
    late: float, longer: float, tmp_path: Path
) -> None:
    """How the error changes over the range: by delay 1 against where gate 0 closes."""
    files = Files.of(tmp_path, *gates(late=late, longer=longer), TIMES["gated"])
    found = files.diagnosed()
    assert (found["verdict"], found["missing"]) == ("wrong_parameters", [])
    (moved,) = found["adjusted"]
    assert moved["effect"] == "gate_timing"
    to = moved["to"]
    assert to["delay.1"] - to["delay.0"] - to["width.0"] == pytest.approx(late - longer, rel=0.25)
    made = files.calibrated()
    timing, key = made.effects["gate_timing"], "effects.gate_timing."
    error = sigma_of(made, {f"{key}delay.1": 1.0, f"{key}delay.0": -1.0, f"{key}width.0": -1.0})
    assert error < 5e-11
    assert timing.delay[1] - timing.delay[0] - timing.width[0] == pytest.approx(late - longer, abs=3 * error)
