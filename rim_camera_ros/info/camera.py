"""Facts on a camera file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import CovariateTable, Effect
from rim_camera_ros.frame import Settings
from rim_camera_ros.info.text import number, section, span, table, words
from rim_camera_ros.measurement import Part, measurement_of

#: Amplitudes in counts at which the noise is stated.
_AMPLITUDES = (100.0, 300.0, 1000.0, 3000.0, 10000.0)


def camera_facts(camera: Camera) -> dict[str, Any]:
    """Return plain numbers: sensor, optics, noise at amplitudes, minimum amplitudes, effects, validity."""
    sensor = camera.sensor
    rays = camera.rays
    middle = rays[sensor.height // 2], rays[:, sensor.width // 2]
    times = _integration_times(camera)
    sigma = camera.sigma_distance(np.array(_AMPLITUDES))
    measurement = measurement_of(camera)
    correction = measurement.correction(camera)
    effects = _effects(measurement.parts(camera))
    return {
        "device": camera.device,
        "width": sensor.width,
        "height": sensor.height,
        "pixels_without_ray": int(np.isnan(rays[..., 0]).sum()),
        "modulation_frequency_hz": sensor.modulation_frequency,
        "ambiguity_range_m": sensor.ambiguity,
        "distance_lsb_m": sensor.lsb,
        "wraps": sensor.wraps,
        "saturation_counts": sensor.saturation,
        "background_suppression_db": sensor.background_suppression,
        "amplitude_threshold_counts": sensor.amplitude_threshold,
        "field_of_view_deg": [_angle(middle[0]), _angle(middle[1])],
        "focal_length_px": [camera.optics.fx, camera.optics.fy],
        "principal_point_px": [camera.optics.cx, camera.optics.cy],
        "distortion": list(camera.optics.d),
        "gain": camera.radiometry.gain,
        "noise_m": dict(zip(map(str, _AMPLITUDES), sigma.tolist(), strict=True)),
        "minimum_amplitude_counts": {
            "any" if time is None else f"{time:g}": correction.minimum_for(Settings(integration_time=time))
            for time in times
        },
        "effects": {name: effect.sentence() for name, effect in effects.items()},
        "undone": {name: effect.undo for name, effect in effects.items()},
        "validity": {
            name: list(value)
            for name in ("distance", "amplitude", "integration_time", "temperature", "region")
            if (value := getattr(camera.validity, name)) is not None
        },
        "parameters_with_sigma": len(camera.covariance.parameters) if camera.covariance else 0,
        "provenance": dict(camera.provenance),
        "measurement": dict(measurement.rows(camera)),
    }


def camera_text(facts: dict[str, Any]) -> str:
    """Return the facts as text."""
    wide, high = facts["field_of_view_deg"]
    threshold = facts["amplitude_threshold_counts"]
    lines = [
        ("device", facts["device"]),
        ("sensor", f"{facts['width']} x {facts['height']} px, field of view {wide:.1f} x {high:.1f} deg"),
        (
            "distance",
            f"{facts['modulation_frequency_hz'] / 1e6:g} MHz: unambiguous to "
            f"{facts['ambiguity_range_m']:.4g} m, "
            f"{facts['distance_lsb_m'] * 1e3:.4g} mm per count, "
            + ("counts wrap there" if facts["wraps"] else "the camera resolves the ambiguity itself"),
        ),
        (
            "amplitude",
            f"saturates at {number(facts['saturation_counts'], 'counts')}"
            + (f", nothing delivered below {number(threshold, 'counts')}" if threshold else ""),
        ),
    ]
    lines = [*(dict(lines) | facts["measurement"]).items()]
    suppression = facts["background_suppression_db"]
    if suppression is not None:
        most = facts["saturation_counts"] * 10.0 ** (suppression / 20.0)
        text = f"fills a pixel by itself at {number(most, 'counts')}, suppressed by {suppression:g} dB"
        lines.append(("unmodulated light", text))
    if facts["pixels_without_ray"]:
        lines.append(
            (
                "lens",
                f"{facts['pixels_without_ray']} pixels see nothing: the distortion cannot be inverted there",
            )
        )
    parts = [section("", lines)]
    noise = facts["noise_m"]
    parts.append(
        "noise of one distance\n"
        + table(
            ["amplitude [counts]", *(f"{float(a):g}" for a in noise)],
            [["sigma [mm]", *(f"{s * 1e3:.1f}" for s in noise.values())]],
        )
    )
    minimum = facts["minimum_amplitude_counts"]
    parts.append(
        "minimum amplitude of the correction\n"
        + table(
            ["integration time", *minimum.keys()],
            [["counts", *(f"{value:.0f}" for value in minimum.values())]],
        )
    )
    if facts["effects"]:
        parts.append(
            section(
                "effects, in the order along the light",
                [(f"{_mark(facts['undone'][name])} {name}", text) for name, text in facts["effects"].items()],
            )
        )
        if any(undo != "exact" for undo in facts["undone"].values()):
            parts[-1] += "\n  (~ undone in part, - not undone: one frame does not determine it)"
    else:
        parts.append("effects\n  none: distances are taken as measured")
    units = {"distance": "m", "amplitude": "counts", "temperature": "degC", "region": "px"}
    validity = [
        (
            name.replace("_", " "),
            span(value[0], value[1], units.get(name, ""))
            if len(value) == 2
            else " ".join(map(number, value)),
        )
        for name, value in facts["validity"].items()
    ]
    if validity:
        parts.append(section("calibrated for", validity))
    if facts["parameters_with_sigma"]:
        parts.append(f"covariance of {facts['parameters_with_sigma']} parameters stated")
    if facts["provenance"]:
        parts.append(
            section(
                "provenance", [(words(k).replace("_", " "), words(v)) for k, v in facts["provenance"].items()]
            )
        )
    return "\n\n".join(parts)


def _effects(parts: Sequence[Part]) -> dict[str, Effect]:
    """Return the effects by name, with the name of the part where parts differ in an effect."""
    result: dict[str, Effect] = {}
    for name in dict.fromkeys(name for part in parts for name in part.camera.effects):
        found = [(part.camera.effects[name], part.name) for part in parts if name in part.camera.effects]
        same = len(found) == len(parts) and all(one == found[0][0] for one, _ in found)
        result |= {name: found[0][0]} if same else {f"{name}, {part}": one for one, part in found}
    return result


def _mark(undo: str) -> str:
    return {"exact": " ", "planes": "~", "partial": "~", "none": "-"}[undo]


def _angle(rays: Any) -> float:
    seen = rays[np.isfinite(rays[:, 0])]
    return float(np.degrees(np.arccos(np.clip(seen[0] @ seen[-1], -1, 1))))


def _integration_times(camera: Camera) -> list[float | None]:
    """Return the integration times with rows in the file, or that of the sensor, or None."""
    times: set[float] = set()
    for effect in camera.effects.values():
        times |= effect.rows()
        if isinstance(effect, CovariateTable):
            pairs = zip(effect.covariates, effect.knots, strict=True)
            times |= {knot for name, knots in pairs if name == "integration_time" for knot in knots}
    if times:
        return [*sorted(times)]
    return [camera.sensor.integration_time]
