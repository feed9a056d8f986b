"""Recordings of shipped cameras cut small, whose devices evaluate their samples as a file states."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.files import find_camera
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.reduction import reduce_frames
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.scene import Scene, load_scene


def small(name: str, *effects: Effect, width: int = 32, height: int = 24) -> Camera:
    """Return the middle of a shipped camera, seen at the same angles by fewer pixels, with these effects."""
    whole = load_camera(find_camera(name))
    less = width / whole.sensor.width
    optics = replace(
        whole.optics,
        fx=whole.optics.fx * less,
        fy=whole.optics.fy * less,
        cx=(width - 1) / 2 + 0.3,
        cy=(height - 1) / 2 - 0.2,
    )
    pitch = (whole.sensor.pixel_pitch[0] / less, whole.sensor.pixel_pitch[1] / less)
    sensor = replace(whole.sensor, width=width, height=height, pixel_pitch=pitch)
    return with_effects(
        replace(whole, sensor=sensor, optics=optics, covariance=None), {one.name: one for one in effects}
    )


def board(
    path: Path,
    distances: Sequence[float],
    times: Sequence[float],
    *,
    frames: int = 6,
    pose_sigma: tuple[float, float] = (0.0005, 0.0003),
) -> Scene:
    """Write a scene: a board of patches at these distances [m], with these integration times."""
    lines = [
        "format: rim_scene/1",
        "surfaces:",
        "- {name: board, type: rectangle, size: [4.0, 3.2], pose: truth, reflectivity_sigma: 0.02,",
        f"   pose_sigma: [{pose_sigma[0]}, {pose_sigma[1]}],",
        "   texture: {cell: [0.23, 0.19], values: [[0.2, 0.8, 0.45], [0.6, 0.35, 0.9]]}}",
        "schedule:",
    ]
    for i, (z, time) in enumerate(zip(distances, times, strict=True)):
        half = 0.125 * math.sin(2.1 * i)
        orientation = f"[0, {math.sin(half):.9f}, 0, {math.cos(half):.9f}]"
        lines.append(
            f"- {{frames: {frames}, rate: 10, integration_time: {time:g}, uptime: {1000 + 20 * i}, "
            f"ambient: 20.0, poses: {{board: {{position: [0, 0, {z:.4f}], orientation: {orientation}}}}}}}"
        )
    path.write_text("\n".join(lines) + "\n")
    return load_scene(path)


def frames(true: Camera, stated: Camera, scene: Scene, *, seed: int) -> Iterator[RawFrame]:
    """Yield frames of the true camera, whose device evaluates the samples as the stated one's does."""
    simulation = measurement_of(true).simulation(true, scene, seed=seed)
    bare = replace(with_effects(stated, {}), minimum_amplitude=0.0)
    device = measurement_of(bare).correction(bare)
    for exposure in Timeline(scene, true, start=10**9):
        frame = simulation.frame(exposure)
        found = device.correct(frame)
        counts = np.rint(np.nan_to_num(found.distance) / stated.sensor.lsb).clip(0, 65535)
        amplitude = np.rint(np.nan_to_num(found.amplitude)).clip(0, 65535).astype(np.uint16)
        saturated = frame.amplitude >= true.sensor.saturation
        yield replace(
            frame,
            distance=counts.astype(np.uint16),
            amplitude=np.where(saturated, frame.amplitude, amplitude),
        )


def record(path: Path, true: Camera, stated: Camera, scene: Scene, *, seed: int) -> Path:
    """Write such frames as a recording, without their samples."""
    with RecordingWriter(path) as writer:
        for frame in frames(true, stated, scene, seed=seed):
            writer.write_raw(replace(frame, images={}))
    return path


def dataset(true: Camera, stated: Camera, scene: Scene, *, seed: int) -> Dataset:
    """Return such frames as the stations of a fit."""
    recorded = list(frames(true, stated, scene, seed=seed))
    return Dataset(list(reduce_frames(recorded, stated)), ["simulated"], [], len(recorded))
