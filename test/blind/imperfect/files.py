"""Recording, camera file and scene file of a case, as `formats.md` describes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rim_camera_ros.bags import RecordingWriter, messages
from rim_camera_ros.frame import Intrinsics, Pose, RawFrame, Settings

from .electrons import Sensor
from .expert import FRAMES, published
from .geometry import Lens, Placement, Surface, quaternion
from .imperfections import Stated
from .setups import Told
from .world import World, illuminate

EPOCH = 1_000_000
PERIOD = 0.0403
THRESHOLD = 40
LEAST_POSE_LEAD = 1000  # nanoseconds by which a pose is known before its first frame


def write_recording(path: Path, world: World, stated: Stated, told: Told, rng: np.random.Generator) -> None:
    """Write three frames of every station, poses as told, and the thermometer."""
    times, values = stated.thermometer
    pending = [(_stamp(float(t)), float(value)) for t, value in zip(times, values, strict=True)]
    said = told.lens
    height, width = world.scene.shape
    intrinsics = Intrinsics(
        width=width, height=height, fx=said.fx, fy=said.fy, cx=said.cx, cy=said.cy, d=said.d
    )
    with RecordingWriter(path) as writer:
        before = None
        for station in range(len(world.settings)):
            light = illuminate(world, station)
            first = _stamp(float(world.uptime[station]))
            poses = {name: _pose(place) for name, place in told.places[station].items()}
            for number in range(FRAMES):
                stamp = first + int(number * PERIOD * 1e9)
                while pending and pending[0][0] <= stamp:
                    at, value = pending.pop(0)
                    message = messages.temperature_message(value, at, messages.FRAME_ID)
                    writer.write_message(
                        "/camera/ambient_temperature", "sensor_msgs/msg/Temperature", at, message
                    )
                distance, amplitude = published(world, station, light, rng, before=before)
                before = light
                if told.along_z:
                    distance = distance * _cosines(world)
                counts = to_counts(distance, amplitude, world.sensor)
                settings = Settings(
                    integration_time=float(world.settings[station]),
                    modulation_frequency=world.sensor.frequency,
                    uptime=(stamp - EPOCH * 10**9) / 1e9,
                )
                writer.write_raw(
                    RawFrame(
                        stamp=stamp,
                        distance=counts[0],
                        amplitude=counts[1],
                        settings=settings,
                        truth=poses,
                        pose_stamps=dict.fromkeys(poses, first - LEAST_POSE_LEAD),
                        intrinsics=intrinsics,
                        device="SR-3000",
                    )
                )


def to_counts(distance: np.ndarray, amplitude: np.ndarray, sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Counts of distance (wrapped, 0 only where nothing was measured) and amplitude."""
    nothing = ~np.isfinite(distance)
    far = np.where(nothing, 0.0, distance) % sensor.ambiguity
    counts = np.round(far / sensor.ambiguity * 65536).astype(int) % 65536
    counts[counts == 0] = 1
    strong = np.clip(np.round(np.nan_to_num(amplitude)), 0, 65535).astype(int)
    off = nothing | (strong < THRESHOLD)
    counts[off], strong[off] = 0, 0
    return counts.astype(np.uint16), strong.astype(np.uint16)


def camera_document(
    world: World,
    stated: Stated,
    told: Told,
    *,
    known: dict[str, dict[str, Any]],
    cyclic: dict[int, tuple[float, float]] | None,
    falloff: bool,
    blur: float | None,
) -> dict[str, Any]:
    """The camera file; `known` distance terms, `cyclic` amplitude and phase by order."""
    height, width = world.scene.shape
    effects: dict[str, Any] = {}
    if falloff:
        effects["emission_pattern"] = {"falloff": [float(one) for one in world.scene.falloff]}
    if blur is not None:
        effects["mixed_pixels"] = {"blur": round(float(blur), 4)}
    effects |= known
    if cyclic is not None:
        harmonics = [{"order": k, "amplitude": a, "phase": p} for k, (a, p) in cyclic.items()]
        effects["cyclic_error"] = {"harmonics": harmonics, "gradient": [0.0, 0.0]}
    return {
        "format": "rim_camera/1",
        "device": "SR-3000",
        "sensor": {
            "width": width,
            "height": height,
            "pixel_pitch": [4e-5, 4e-5],
            "modulation_frequency": world.sensor.frequency,
            "distance_lsb": None,
            "saturation": 65535,
            "amplitude_threshold": THRESHOLD,
        },
        "optics": {
            "fx": float(told.lens.fx),
            "fy": float(told.lens.fy),
            "cx": float(told.lens.cx),
            "cy": float(told.lens.cy),
            "d": [float(one) for one in told.lens.d],
        },
        "radiometry": {"gain": world.gain, "gain_sigma": stated.power_sigma},
        "noise": stated.noise,
        "effects": effects,
        "covariance": {"parameters": ["optics.fx", "optics.fy"], "matrix": "covariance.npy"},
    }


def scene_document(told: Told, pose_sigma: tuple[float, float]) -> dict[str, Any]:
    """The scene file: every surface's pose comes with the recording."""
    surfaces = []
    for surface in told.surfaces:
        entry: dict[str, Any] = {
            "name": surface.name,
            "type": surface.kind,
            "pose": "truth",
            "pose_sigma": list(pose_sigma),
        }
        if surface.values.size > 1:
            entry["texture"] = {"cell": [float(c) for c in surface.cell], "values": surface.values.tolist()}
        else:
            entry["reflectivity"] = float(surface.values[0, 0])
        if surface.size is not None:
            entry["size"] = [float(one) for one in surface.size]
        if surface.kind == "sphere":
            entry["radius"] = float(surface.radius)
        surfaces.append(entry)
    return {"format": "rim_scene/1", "surfaces": surfaces}


def write_yaml(path: Path, document: dict[str, Any]) -> None:
    """Write a YAML file."""
    path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")


def untold(surfaces: list[Surface], stated: Stated, lens: Lens) -> Told:
    """A set-up that is said as it is."""
    return Told(surfaces, stated.places, lens, "as_given", None)


def _stamp(uptime: float) -> int:
    return EPOCH * 10**9 + int(uptime * 1e9)


def _pose(place: Placement) -> Pose:
    x, y, z = (float(one) for one in place.position)
    return Pose((x, y, z), quaternion(place.rotation))


def _cosines(world: World) -> np.ndarray:
    height, width = world.scene.shape
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    rays = world.true_lens.directions(u.ravel(), v.ravel())
    cosines: np.ndarray = rays[:, 2].reshape(height, width)
    return cosines
