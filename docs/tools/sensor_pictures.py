#!/usr/bin/env python3
"""Draw docs/single_photon.png and docs/gated.png: what these sensors measure of a simulated room."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import islice
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt
from pages import DOCS
from scipy.ndimage import minimum_filter

from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.files import find_camera
from rim_camera_ros.gated.gates import Gate
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.scene import Scene, ScenePose, Surface

SPEED_OF_LIGHT = 299_792_458.0


def scene() -> Scene:
    """Return a wall, a box and a ball before it, and a floor."""
    return Scene(
        (
            Surface(name="wall", type="plane", pose=ScenePose((0.0, 0.0, 2.4)), reflectivity=0.7),
            Surface(
                name="floor",
                type="plane",
                pose=ScenePose((0.0, 0.45, 2.0), (0.7071068, 0.0, 0.0, 0.7071068)),
                reflectivity=0.4,
            ),
            Surface(
                name="box",
                type="rectangle",
                size=(0.35, 0.5),
                pose=ScenePose((-0.28, 0.1, 1.25)),
                reflectivity=0.3,
            ),
            Surface(
                name="ball", type="sphere", radius=0.2, pose=ScenePose((0.3, 0.15, 1.6)), reflectivity=0.8
            ),
        )
    )


def shown(axis: Any, image: Any, title: str, unit: str, **options: Any) -> None:
    """Draw an image with its scale."""
    drawn = axis.imshow(image, **options)
    axis.set_title(title, fontsize=9)
    axis.set_xticks([])
    axis.set_yticks([])
    plt.colorbar(drawn, ax=axis, shrink=0.8, label=unit)


def single_photon() -> None:
    """Draw histograms, distances and averaging of EPFL's array."""
    camera = with_effects(load_camera(find_camera("epfl64")), {"mixed_pixels": MixedPixels(blur=0.6)})
    way, room = measurement_of(camera), scene()
    simulation, correction = way.simulation(camera, room, seed=1), way.correction(camera)
    exposures = list(islice(Timeline(room, camera, start=1, integration_time=200.0), 64))
    truth = simulation.true_distance(exposures[0])
    frames = [simulation.frame(one) for one in exposures]
    corrected = [correction.correct(one) for one in frames]
    figure, axes = plt.subplots(2, 2, figsize=(10, 7), constrained_layout=True)
    shown(axes[0, 0], corrected[0].distance, "distance, one exposure of 200 ms", "m", cmap="viridis")
    # the pixel that shares its light most evenly between the box and the wall
    histogram = frames[0].images["histogram"]
    at = (np.arange(histogram.shape[2]) + 0.5) * (camera.sensor.ambiguity / histogram.shape[2])
    both = [histogram[..., np.abs(at - d) < 0.12].sum(axis=2) for d in (1.28, 2.45)]
    row, column = np.unravel_index(np.minimum(*both).argmax(), truth.shape)
    axes[0, 0].plot(column, row, "s", mfc="none", mec="white", ms=8)
    axes[0, 1].step(at, histogram[row, column], where="mid", color="tab:blue", lw=1)
    found = float(corrected[0].distance[row, column])
    axes[0, 1].axvline(found, color="tab:red", lw=1, label=f"distance found: {found:.3f} m")
    axes[0, 1].set(xlabel="distance of the bin [m]", ylabel="photons")
    axes[0, 1].set_title(f"histogram of the marked pixel ({row}, {column}): box and wall", fontsize=9)
    axes[0, 1].legend(fontsize=8)
    shown(axes[1, 0], corrected[0].sigma * 1e3, "sigma of each pixel, from its histogram", "mm", cmap="magma")
    errors = np.array([one.distance - truth for one in corrected])
    # three pixels from an edge at least, where nothing of another surface is blurred in
    inner = minimum_filter(np.hypot(*np.gradient(truth)) < 0.03, 7)
    counts = [1, 2, 4, 8, 16, 32, 64]
    rms = [np.sqrt(np.mean(errors[:n].mean(axis=0)[inner] ** 2)) * 1e3 for n in counts]
    sigma = np.sqrt(np.mean(corrected[0].sigma[inner] ** 2)) * 1e3
    axes[1, 1].loglog(counts, rms, "o-", label="errors of the mean")
    axes[1, 1].loglog(counts, sigma / np.sqrt(counts), "k--", lw=1, label="stated sigma / sqrt(n)")
    axes[1, 1].set(xlabel="exposures of 200 ms averaged", ylabel="RMS [mm]")
    axes[1, 1].set_title("averaging, all pixels with one surface", fontsize=9)
    axes[1, 1].legend(fontsize=8)
    print("averaging", dict(zip(counts, np.round(rms, 3), strict=True)), f"sigma {sigma:.3f} mm")
    figure.savefig(DOCS / "single_photon.png", dpi=90)


def gated() -> None:
    """Draw gates, slices, distances and the residue of the reflectivity."""
    camera = with_effects(load_camera(find_camera("gated")), {})
    slices = replace(
        camera,
        measurement=replace(
            camera.measurement,
            pulse_width=3e-9,
            rise_time=0.3e-9,
            gates=tuple(Gate(delay=6e-9 + i * 3e-9, width=3e-9) for i in range(5)),
        ),
    )
    room = scene()
    figure, axes = plt.subplots(2, 3, figsize=(13, 6.6), constrained_layout=True)
    at = np.linspace(0.0, 3.4, 400)
    shares = camera.measurement.shutter(camera).shares(at)
    for i, share in enumerate(shares):
        axes[0, 0].plot(at, share, label=f"gate {i}")
    axes[0, 0].set(xlabel="distance [m]", ylabel="share of the pulse's light")
    axes[0, 0].set_title("what the gates of gated.yaml let through", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    way = measurement_of(camera)
    simulation = way.simulation(camera, room, seed=2)
    exposure = next(iter(Timeline(room, camera, start=1, integration_time=20.0)))
    frame = simulation.frame(exposure)
    corrected = way.correction(camera).correct(frame)
    truth = simulation.true_distance(exposure)
    shown(axes[0, 1], corrected.distance, "distance from the ratios", "m", cmap="viridis", vmin=1.0, vmax=3.0)
    error = (corrected.distance - truth) * 1e3
    shown(axes[0, 2], error, "error", "mm", cmap="RdBu", vmin=-60, vmax=60)
    print(
        f"gated: RMS {np.sqrt(np.nanmean(error**2)):.1f} mm, sigma "
        f"{np.sqrt(np.nanmean(corrected.sigma**2)) * 1e3:.1f} mm"
    )
    cut = measurement_of(slices).simulation(slices, room, seed=3).frame(exposure).images["gates"]
    shutter = slices.measurement.shutter(slices)
    for axis, i in ((axes[1, 0], 1), (axes[1, 1], 2)):
        near, far = shutter.slice_of(i)
        shown(
            axis,
            cut[..., i],
            f"slice from {near:.2f} to {far:.2f} m (pulse and gate 3 ns)",
            "counts",
            cmap="gray",
        )
    axis = axes[1, 2]
    for background in (0.0, 300.0, 1000.0):
        two = replace(camera.measurement, gates=camera.measurement.gates[:2])
        estimator = two.estimator(replace(camera, measurement=two))
        light = np.geomspace(1e3, 6e4, 40)
        share = two.shutter(camera).shares(np.array([0.9]))
        found = estimator.estimate(light * share + background).distance
        axis.semilogx(light, (found - 0.9) * 1e3, label=f"{background:.0f} counts of other light")
    axis.set(xlabel="light of the pulse [counts]", ylabel="error at 0.9 m [mm]")
    axis.set_title("residue of the reflectivity: two gates, nothing subtracted", fontsize=9)
    axis.legend(fontsize=8)
    figure.savefig(DOCS / "gated.png", dpi=85)


if __name__ == "__main__":
    single_photon()
    if len(sys.argv) < 2:
        gated()
    sys.exit(0)
