"""The improved camera file in use: simulated and corrected with it, and diagnosed again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.bags import Recording
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.geometry import see
from rim_camera_ros.scene import load_scene

from .helpers import AMBIGUITY, CAMERA, CYCLIC, run, scene_text


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, the camera file that lacks its cyclic error, and the diagnosis' folder ``out``."""
    path = tmp_path_factory.mktemp("in a folder: of two words")
    (path / "known.yaml").write_text(CAMERA)
    (path / "true.yaml").write_text(CAMERA + CYCLIC)
    (path / "scene.yaml").write_text(scene_text())
    run("simulate", path / "scene.yaml", camera=path / "true.yaml", out=path / "bag")
    run("diagnose", path / "bag", camera=path / "known.yaml", scene=path / "scene.yaml", out=path / "out")
    return path


def difference(folder: Path, name: str) -> np.ndarray:
    """Mean distances (stations, H, W) [m] of the recording less those of a simulation of its poses."""
    bag = folder / f"{name}_bag"
    file = folder / "out" / "camera.yaml" if name == "improved" else folder / f"{name}.yaml"
    run("simulate", folder / "scene.yaml", camera=file, poses=folder / "bag", out=bag, seed=5)
    camera = load_camera(folder / "true.yaml")
    real, simulated = (reduce_recording(one, camera).stations for one in (folder / "bag", bag))
    assert len(real) == 18
    result = np.array([a.distance - b.distance for a, b in zip(real, simulated, strict=True)], float)
    return result - AMBIGUITY * np.round(result / AMBIGUITY)


def test_simulating_with_it_is_the_better_simulation(folder: Path) -> None:
    """A wave of 9 mm is in the difference with the file as it was, noise with the improved one."""
    squares = {name: np.mean(difference(folder, name) ** 2) for name in ("known", "true", "improved")}
    assert np.sqrt(squares["known"] - squares["true"]) == pytest.approx(9e-3 / np.sqrt(2), rel=0.15)
    # with the noise of both: no more than a tenth of the wave's square is left
    assert squares["improved"] - squares["true"] < 0.1 * (squares["known"] - squares["true"])


def errors(folder: Path, file: Path) -> np.ndarray:
    """Mean errors of corrected distances [m] of each of the 18 poses, against the wall where it was."""
    bag = folder / f"corrected by {file.parent.name} {file.stem}"
    run("correct", folder / "bag", camera=file, out=bag)
    scene = load_scene(folder / "scene.yaml")
    rays = load_camera(file).rays
    with Recording(folder / "bag") as raw, Recording(bag) as corrected:
        pairs = list(zip(raw.frames(), corrected.corrected_frames(), strict=True))
    assert len(pairs) == 18 * 4
    means = [
        np.nanmean(two.distance - see(scene, scene.poses_for(one.truth), rays).distance) for one, two in pairs
    ]
    return np.reshape(means, (18, 4)).mean(axis=1)


def test_correcting_with_it_is_the_better_correction(folder: Path) -> None:
    before, after = (errors(folder, one) for one in (folder / "known.yaml", folder / "out" / "camera.yaml"))
    # 18 poses in 3.4 m look at the wave of 0.94 m evenly; offsets of all distances are the pattern's
    assert np.std(before) == pytest.approx(9e-3 / np.sqrt(2), rel=0.15)
    assert np.std(after) < 0.1 * np.std(before)


@pytest.mark.long
@pytest.mark.parametrize(("name", "verdict"), [("true", "consistent"), ("known", "missing_physics")])
def test_against_a_simulation_that_is_a_recording(folder: Path, name: str, verdict: str) -> None:
    """Both scatter: the noise of their difference is that of the two."""
    camera, bag, out = folder / f"{name}.yaml", folder / f"{name} simulated", folder / f"against {name}"
    scene = folder / "scene.yaml"
    run("simulate", scene, camera=camera, poses=folder / "bag", out=bag, seed=11)
    run("diagnose", folder / "bag", camera=camera, scene=scene, out=out, against=bag)
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == verdict
    assert [one["effect"] for one in report["missing"]] == ["cyclic_error"] * (name == "known")
    assert 0.8 < report["fit"]["chi2_after"] < 1.06
    alone = json.loads((folder / "out" / "report.json").read_text())["fit"]["noise_floor"]
    assert report["fit"]["noise_floor"] == pytest.approx(np.sqrt(2) * alone, rel=0.01)
    assert report["variance_ratio"] == pytest.approx(1.0, abs=0.06)


def test_nothing_is_missing_in_it(folder: Path) -> None:
    again = folder / "again"
    run(
        "diagnose",
        folder / "bag",
        camera=folder / "out" / "camera.yaml",
        scene=folder / "scene.yaml",
        out=again,
    )
    assert json.loads((again / "report.json").read_text())["verdict"] == "consistent"


def test_it_says_where_it_comes_from(folder: Path) -> None:
    first = (folder / "out" / "camera.yaml").read_text().splitlines()[0]
    assert first.startswith(f"# Diagnosis of {folder / 'bag'} with camera {folder / 'known.yaml'}")
