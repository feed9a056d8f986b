#!/usr/bin/env python3
"""Compare a camera of three frequencies with one of a single frequency, for docs/several_frequencies.md.

Prints the table of walls from 0.5 to 15 m and writes docs/several_frequencies.png: a corridor as each
sees it.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import Pose, Settings
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.phasor import wrap_residual
from rim_camera_ros.pipeline.simulate import Exposure
from rim_camera_ros.scene import Scene, load_scene

DOCS = Path(__file__).resolve().parent.parent
_WALL = "format: rim_scene/1\nsurfaces: [{name: wall, type: plane, pose: truth, reflectivity: 0.6}]\n"
_CORRIDOR = """
format: rim_scene/1
surfaces:
- {name: floor, type: plane, pose: {position: [0, 1.2, 0], orientation: [-0.7071068, 0, 0, 0.7071068]}, reflectivity: 0.4}
- {name: left, type: plane, pose: {position: [-1.6, 0, 0], orientation: [0, -0.7071068, 0, 0.7071068]},
   texture: {cell: [1.0, 1.0], values: [[0.7, 0.5], [0.5, 0.7]]}}
- {name: right, type: plane, pose: {position: [1.6, 0, 0], orientation: [0, 0.7071068, 0, 0.7071068]}, reflectivity: 0.6}
- {name: ceiling, type: plane, pose: {position: [0, -1.5, 0], orientation: [0.7071068, 0, 0, 0.7071068]}, reflectivity: 0.7}
- {name: end, type: plane, pose: {position: [0, 0, 16.0], orientation: [0, 0, 0, 1]}, reflectivity: 0.8}
- {name: box, type: rectangle, size: [0.7, 0.9], pose: {position: [-0.7, 0.75, 3.1], orientation: [0, 0, 0, 1]}, reflectivity: 0.5}
- {name: person, type: rectangle, size: [0.5, 1.7], pose: {position: [0.6, 0.35, 7.4], orientation: [0, 0, 0, 1]}, reflectivity: 0.5}
"""  # noqa: E501 -- one surface a line


def scene_of(text: str) -> Scene:
    """Return the scene of a text."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.yaml"
        path.write_text(text)
        return load_scene(path)


def small(camera: Camera) -> Camera:
    """Return the camera with a quarter of its rows and columns, and no minimum amplitude."""

    def one(part: Camera) -> Camera:
        o, s = part.optics, part.sensor
        return replace(
            part,
            sensor=replace(s, width=s.width // 4, height=s.height // 4, amplitude_threshold=0.0),
            optics=replace(o, fx=o.fx / 4, fy=o.fy / 4, cx=o.cx / 4, cy=o.cy / 4),
            minimum_amplitude=0.0,
        )

    return camera.measurement.camera_of(tuple(one(part) for part in camera.channels))


def table(camera: Camera, *, times: float) -> None:
    """Print errors of a wall by distance, at amplitudes of ``times`` their own sigma at every frequency."""
    scene = scene_of(_WALL)
    periods = [one.sensor.ambiguity for one in camera.channels]
    # noise.amplitude = k sigma_d A: the amplitude is so many sigma where A = times * 2 pi / L * amplitude
    channels = tuple(replace(one, noise=replace(one.noise, floor=0.0)) for one in camera.channels)
    camera = camera.measurement.camera_of(channels)
    needed = max(times * 2 * np.pi / p * c.noise.amplitude for p, c in zip(periods, channels, strict=True))
    measurement = measurement_of(camera)
    correction, coarse = measurement.correction(camera), measurement.parts(camera)[1].camera
    alone = measurement_of(coarse).correction(coarse)
    simulation = measurement.simulation(camera, scene, seed=1)
    print("| distance | RMS | sigma stated | wrong wraps | flagged | 16 MHz alone: RMS | folded |")
    print("|---|---|---|---|---|---|---|")
    pixels = wrong_of_all = 0
    for z in (0.5, 1.0, 2.0, 3.0, 4.5, 6.0, 8.0, 10.0, 12.0, 15.0):
        time = needed * z**2 / camera.channels[0].radiometry.gain / 0.6 * 1.15  # the corners are darker
        settings = Settings(integration_time=time, uptime=5e4)
        counts, errors, sigmas, flagged, folded = [], [], [], [], []
        for number in range(10):
            poses = scene.poses_for({"wall": Pose((0.0, 0.0, z))})
            exposure = Exposure(10**9 + number, settings, poses)
            truth, frame = simulation.true_distance(exposure), simulation.frame(exposure)
            found = correction.correct(frame)
            single = alone.correct(
                replace(
                    frame,
                    distance=frame.images["distance_1"],
                    amplitude=frame.images["amplitude_1"],
                    images={},
                )
            )
            # a wall seen obliquely is farther away
            near = truth < 1.15 * z
            error = found.distance - truth
            valid = np.isfinite(error) & near
            wrong = np.abs(error) > min(periods) / 3
            errors.append(error[valid & ~wrong])
            sigmas.append(found.sigma[valid])
            counts.append((int((wrong & valid).sum()), int(valid.sum())))
            flagged.append(1 - valid.sum() / near.sum())
            folded.append((single.distance - truth)[np.isfinite(single.distance) & near])
        error, lone = np.concatenate(errors), np.concatenate(folded)
        modulo = wrap_residual(lone, periods[1])
        wrong_of_all += sum(one for one, _ in counts)
        pixels += sum(one for _, one in counts)
        wrongs, valids = (sum(one) for one in zip(*counts, strict=True))
        columns = [
            f"{z:g} m",
            f"{1e3 * np.sqrt(np.mean(error**2)):.1f} mm",
            f"{1e3 * np.median(np.concatenate(sigmas)):.1f} mm",
            f"{wrongs} of {valids}",
            f"{100 * np.mean(flagged):.3f} %",
            f"{1e3 * np.sqrt(np.mean(modulo**2)):.0f} mm",
            f"{100 * np.mean(np.abs(lone) > periods[1] / 2):.0f} %",
        ]
        print(f"| {' | '.join(columns)} |")
    print(f"wrong wraps in all: {wrong_of_all} of {pixels}")


def picture(path: Path) -> None:
    """Write the picture of the corridor."""
    camera = load_camera(find_camera("kinect_v2"))
    channels = (replace(one, sensor=replace(one.sensor, amplitude_threshold=0.0)) for one in camera.channels)
    camera = camera.measurement.camera_of(tuple(channels))
    measurement, scene = measurement_of(camera), scene_of(_CORRIDOR)
    settings = Settings(integration_time=150.0, uptime=5e4)
    exposure = Exposure(10**9, settings, scene.poses_for({}))
    simulation = measurement.simulation(camera, scene, seed=2)
    truth, frame = simulation.true_distance(exposure), simulation.frame(exposure)
    found = measurement.correction(camera, minimum_amplitude=30.0).correct(frame)
    periods = [one.sensor.ambiguity for one in camera.channels]
    raw = {
        f"{c.sensor.modulation_frequency / 1e6:g} MHz: folds at {p:.2f} m": (
            frame.by_role[f"distance_{i}"] * c.sensor.lsb,
            p,
        )
        for i, (c, p) in enumerate(zip(camera.channels, periods, strict=True))
    }
    figure, axes = plt.subplots(2, 3, figsize=(13, 7.4), constrained_layout=True)
    for axis, (title, (image, top)) in zip(axes[0], raw.items(), strict=True):
        shown = axis.imshow(np.where(image > 0, image, np.nan), cmap="viridis", vmin=0, vmax=top)
        axis.set_title(title, fontsize=11)
        figure.colorbar(shown, ax=axis, shrink=0.75, label="m")
    shown = axes[1, 0].imshow(found.distance, cmap="viridis", vmin=0, vmax=17)
    axes[1, 0].set_title(f"together: resolved to {camera.sensor.ambiguity:.1f} m", fontsize=11)
    figure.colorbar(shown, ax=axes[1, 0], shrink=0.75, label="m")
    error = 1e3 * (found.distance - truth)
    shown = axes[1, 1].imshow(error, cmap="RdBu", vmin=-60, vmax=60)
    axes[1, 1].set_title("error against the scene", fontsize=11)
    figure.colorbar(shown, ax=axes[1, 1], shrink=0.75, label="mm")
    shown = axes[1, 2].imshow(np.log10(np.maximum(found.wrong_wrap, 1e-16)), cmap="magma", vmin=-12, vmax=0)
    axes[1, 2].set_title("probability of wrong wraps, as stated", fontsize=11)
    figure.colorbar(shown, ax=axes[1, 2], shrink=0.75, label="power of ten")
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    figure.savefig(path, dpi=80)
    valid = np.isfinite(error)
    wrong = np.abs(error) > 400
    share, wrongs = 100 * valid.mean(), int((wrong & valid).sum())
    print(f"corridor: {share:.1f} % have a distance, {wrongs} pixels of them wrong wraps")


if __name__ == "__main__":
    table(small(load_camera(find_camera("kinect_v2"))), times=10.0)
    picture(DOCS / "several_frequencies.png")
    sys.exit(0)
