"""Facts on a scene file, and on the view of a camera on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.info.text import listed_short, number, percent, section, several, span, table
from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.scene import Scene, Surface


def scene_facts(scene: Scene, camera: Camera | None = None) -> dict[str, Any]:
    """Return plain facts: surfaces, schedule, motion, and with a camera the first view of its pixels."""
    stations = scene.schedule
    facts: dict[str, Any] = {
        "surfaces": [_surface(surface) for surface in scene.surfaces],
        "needs_truth": list(scene.needs_truth),
        "stations": len(stations),
        "frames": sum(station.frames for station in stations) or None,
        "duration_s": sum(station.frames / station.rate for station in stations) or None,
        "integration_times": sorted(
            {t for station in stations if (t := station.integration_time) is not None}
        ),
        "ambient_degc": sorted({t for station in stations if (t := station.ambient) is not None}),
        "moving_camera": scene.camera_motion.moves,
    }
    if camera is not None and not scene.needs_truth:
        facts["seen"] = _seen(scene, camera)
    return facts


def _surface(plane: Surface) -> dict[str, Any]:
    size: list[float] | None = list(plane.size) if plane.size else None
    if plane.radius is not None:
        size = [plane.radius]
    reflectivity = [plane.nominal_reflectivity] * 2 if plane.is_described else None
    if plane.texture is not None:
        values = plane.texture.values.values
        reflectivity = [float(values.min()), float(values.max())]
    return {
        "name": plane.name,
        "type": plane.type,
        "size_m": size,
        "position_m": None if isinstance(plane.pose, str) else list(plane.pose.position),
        "free": [] if isinstance(plane.pose, str) else list(plane.pose.free),
        "reflectivity": reflectivity,
        "pose_sigma": list(plane.pose_sigma),
    }


def _seen(scene: Scene, camera: Camera) -> dict[str, Any]:
    simulation = Simulation(camera, scene, noise=False)
    exposure = Timeline(scene, camera).next()
    assert exposure is not None
    context = simulation.context(exposure)
    signal = simulation.signal(context)
    geometry = simulation.geometry(exposure.poses)
    lit = geometry.hit & (signal.amplitude > 0)
    dark = not lit.any()
    shares = {surface.name: float((geometry.surface == i).mean()) for i, surface in enumerate(scene.surfaces)}
    return {
        "integration_time": context.integration_time,
        "share_of_pixels": shares,
        "nothing": float((~geometry.hit).mean()),
        "distance_m": None if dark else [float(f(geometry.distance[lit])) for f in (np.min, np.max)],
        "amplitude_counts": None
        if dark
        else [float(x) for x in np.percentile(signal.amplitude[lit], [1, 50, 99])],
        "saturated": float((signal.published_amplitude >= camera.sensor.saturation).mean()),
    }


def scene_text(facts: dict[str, Any]) -> str:
    """Return the facts for a person."""
    rows = []
    shares = facts.get("seen", {}).get("share_of_pixels", {})
    for fact in facts["surfaces"]:
        size = "-" if fact["size_m"] is None else " x ".join(f"{x:g}" for x in fact["size_m"])
        if fact["type"] in ("disc", "sphere"):
            size = f"r {size}"
        position = "truth" if fact["position_m"] is None else " ".join(map(number, fact["position_m"]))
        row = [
            fact["name"],
            fact["type"],
            size,
            position,
            span(*fact["reflectivity"]) if fact["reflectivity"] else "unknown",
        ]
        if shares:
            row.append(percent(shares[fact["name"]]))
        rows.append(row)
    headings = ["surface", "type", "size [m]", "position [m]", "reflectivity"] + (
        ["of the image"] if shares else []
    )
    parts = ["surfaces\n" + table(headings, rows, left=2)]
    lines = []
    if facts["stations"]:
        lines.append(
            (
                "schedule",
                f"{several(facts['stations'], 'station')}, {several(facts['frames'], 'frame')}, "
                f"{number(facts['duration_s'], 's')}",
            )
        )
        if facts["integration_times"]:
            lines.append(("integration times", listed_short(list(map(number, facts["integration_times"])))))
        if facts["ambient_degc"]:
            lines.append(("ambient", span(min(facts["ambient_degc"]), max(facts["ambient_degc"]), "degC")))
    else:
        lines.append(("schedule", "none: 100 frames at 25 Hz"))
    if facts["moving_camera"]:
        lines.append(("camera", "moves"))
    if facts["needs_truth"]:
        lines.append(("poses from a recording", f"{', '.join(facts['needs_truth'])} (--poses BAG)"))
    seen = facts.get("seen")
    if seen:
        low, median, high = seen["amplitude_counts"] or (0.0, 0.0, 0.0)
        nearest, farthest = seen["distance_m"] or (None, None)
        lines += [
            ("seen first", f"at setting {number(seen['integration_time'])}"),
            ("distances", span(nearest, farthest, "m")),
            ("amplitudes", f"{number(low)} .. {number(high)} counts (1 .. 99 %), median {number(median)}"),
            ("saturated", f"{percent(seen['saturated'])} of the pixels"),
            ("nothing seen", f"{percent(seen['nothing'])} of the pixels"),
        ]
    parts.append(section("", lines))
    return "\n\n".join(parts)
