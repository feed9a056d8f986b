"""Facts on a recording, gathered in one pass and bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags import Recording, Topics
from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import NANOSECONDS, RawFrame
from rim_camera_ros.info.text import number, section, span, table

#: Classes of amplitude in counts for the noise.
_CLASSES = (0, 100, 200, 400, 800, 1600, 3200, 6400, 12800, 25600, 65536)
#: Pixels of a class below which its noise is not stated.
_LEAST = 200
#: A step between frames above so many periods is a gap.
_GAP = 1.5


class _Settings:
    """Least and greatest value of each setting."""

    def __init__(self) -> None:
        self._seen: dict[str, list[float]] = {}
        self.integration_times: dict[float, int] = {}

    def add(self, frame: RawFrame) -> None:
        settings = frame.settings
        if settings.integration_time is not None:
            time = settings.integration_time
            self.integration_times[time] = self.integration_times.get(time, 0) + 1
        for name in (
            "modulation_frequency",
            "uptime",
            "body_temperature",
            "ambient_temperature",
            "reference_distance",
        ):
            value = getattr(settings, name)
            if value is not None:
                seen = self._seen.setdefault(name, [value, value])
                seen[0], seen[1] = min(seen[0], value), max(seen[1], value)

    def facts(self) -> dict[str, Any]:
        return {
            "integration_times": {
                f"{time:g}": count for time, count in sorted(self.integration_times.items())
            },
            **{name: list(seen) for name, seen in self._seen.items()},
        }


class _Noise:
    """Noise by amplitude, from the differences of successive frames of one station and setting.

    Sum of squared differences over 2 is unbiased while the scene rests; a drift enters by its step only.
    """

    def __init__(self, lsb: float, period: float | None) -> None:
        self._lsb, self._period = lsb, period
        self._before: RawFrame | None = None
        classes = len(_CLASSES) - 1
        self._sums, self._counts, self._amplitudes = np.zeros(classes), np.zeros(classes), np.zeros(classes)

    def add(self, frame: RawFrame) -> None:
        before, self._before = self._before, frame
        if before is None or before.settings.integration_time != frame.settings.integration_time:
            return
        if dict(before.pose_stamps) != dict(frame.pose_stamps):
            return
        step = _metres(frame, self._lsb) - _metres(before, self._lsb)
        if self._period is not None:
            step -= self._period * np.rint(step / self._period)
        amplitude = (frame.amplitude.astype(float) + before.amplitude) / 2
        # a scene that moves would pass for noise
        usable = np.isfinite(step) & (np.abs(step) < 0.5)
        if not usable.any():
            return
        index = np.digitize(amplitude[usable], _CLASSES) - 1
        classes = len(self._sums)
        self._sums += np.bincount(index, step[usable] ** 2 / 2, classes)[:classes]
        self._counts += np.bincount(index, minlength=classes)[:classes]
        self._amplitudes += np.bincount(index, amplitude[usable], classes)[:classes]

    def facts(self, camera: Camera | None) -> list[dict[str, Any]]:
        rows = []
        for i in np.flatnonzero(self._counts >= _LEAST):
            mean = float(self._amplitudes[i] / self._counts[i])
            row: dict[str, Any] = {
                "amplitude_counts": [_CLASSES[i], _CLASSES[i + 1]],
                "values": int(self._counts[i]),
                "sigma_m": float(np.sqrt(self._sums[i] / self._counts[i])),
            }
            if camera is not None:
                model = camera.noise.sigma_distance(np.array([mean]), background=camera.background)
                row["model_m"] = float(model[0])
            rows.append(row)
        return rows


class _Histogram:
    """Percentiles of uint16 or float images without keeping them."""

    def __init__(self, scale: float) -> None:
        self._scale = scale
        self._counts = np.zeros(65536, np.int64)

    def add(self, values: NDArray[Any]) -> None:
        index = (
            values if values.dtype == np.uint16 else np.clip(values / self._scale, 0, 65535).astype(np.uint16)
        )
        self._counts += np.bincount(index.ravel(), minlength=65536)

    def percentiles(self, shares: tuple[float, ...]) -> list[float] | None:
        counts = self._counts.copy()
        counts[0] = 0
        total = counts.sum()
        if total == 0:
            return None
        cumulative = np.cumsum(counts) / total
        return [float(np.searchsorted(cumulative, share) * self._scale) for share in shares]


def recording_facts(
    path: Path,
    topics: Topics,
    camera: Camera | None = None,
    count: Callable[[int], Any] = lambda done: None,
) -> dict[str, Any]:
    """Return plain facts on a recording; ``camera`` gives counts their metres and the noise its model."""
    with Recording(path, topics=topics) as bag:
        summary = bag.summary()
        lsb = camera.sensor.lsb if camera is not None else None
        period = camera.sensor.ambiguity if camera is not None and camera.sensor.wraps else None
        distances = _Histogram(lsb or 1.0)
        amplitudes = _Histogram(1.0)
        settings = _Settings()
        noise = _Noise(lsb, period) if lsb is not None else None
        stamps: list[int] = []
        stations: set[tuple[tuple[str, int], ...]] = set()
        missing = saturated = pixels = 0
        shape, device, intrinsics = (0, 0), "", False
        for frame in bag.frames(on_backwards="count"):
            stamps.append(frame.stamp)
            shape, device = frame.shape, frame.device or device
            intrinsics = intrinsics or frame.intrinsics is not None
            if frame.distance.dtype.kind == "f":
                lsb_here = 1e-4
                distances = distances if distances._scale == lsb_here else _Histogram(lsb_here)
                distances.add(np.nan_to_num(frame.distance))
            else:
                distances.add(frame.distance)
            amplitudes.add(np.nan_to_num(frame.amplitude))
            settings.add(frame)
            if noise is not None:
                noise.add(frame)
            missing += int((~(frame.distance > 0)).sum())
            limit = camera.sensor.saturation if camera is not None else 65535
            saturated += int((frame.amplitude >= limit).sum())
            pixels += frame.distance.size
            if frame.pose_stamps:
                stations.add(tuple(sorted(frame.pose_stamps.items())))
            count(len(stamps))
        return {
            "path": str(path),
            "storage": summary.storage,
            "topics": {
                one.name: {"type": one.msgtype, "messages": one.count, "role": one.role}
                for one in summary.topics
            },
            "frames": len(stamps),
            **_timing(stamps),
            "device": device,
            "width": shape[1],
            "height": shape[0],
            "has_camera_info": intrinsics,
            "settings": settings.facts(),
            "distance_unit": "m" if lsb is not None else "counts",
            "distance_percentiles_1_50_99": distances.percentiles((0.01, 0.5, 0.99)),
            "amplitude_percentiles_1_50_99": amplitudes.percentiles((0.01, 0.5, 0.99)),
            "no_measurement_share": missing / pixels if pixels else None,
            "saturated_share": saturated / pixels if pixels else None,
            "noise": noise.facts(camera) if noise is not None else [],
            "truth_surfaces": list(summary.truth_surfaces),
            "poses": len(stations),
            "assumptions": list(bag.assumptions),
            "skipped": dict(bag.skipped),
            "damage": summary.damage,
        }


def _metres(frame: RawFrame, lsb: float) -> NDArray[np.float64]:
    metres = frame.distance.astype(float) * (1.0 if frame.distance.dtype.kind == "f" else lsb)
    metres[~(metres > 0)] = np.nan
    return metres


def _timing(stamps: list[int]) -> dict[str, Any]:
    if len(stamps) < 2:
        return {"duration_s": 0.0, "rate_hz": None, "jitter_s": None, "gaps": 0, "missing_frames": 0}
    steps = np.diff(np.array(stamps, np.int64)).astype(np.int64) / NANOSECONDS
    period = float(np.median(steps))
    gaps = np.asarray(steps > _GAP * period)
    return {
        "start_s": stamps[0] / NANOSECONDS,
        "duration_s": (stamps[-1] - stamps[0]) / NANOSECONDS,
        "rate_hz": 1.0 / period if period > 0 else None,
        "jitter_s": float(np.std(steps[~gaps])) if (~gaps).any() else None,
        "gaps": int(gaps.sum()),
        "longest_gap_s": float(steps.max()) if gaps.any() else None,
        "missing_frames": int(np.rint(steps[gaps] / period - 1).sum()) if period > 0 else 0,
    }


def recording_text(facts: dict[str, Any]) -> str:
    """Return the facts for a person."""
    settings = facts["settings"]
    rate = "-" if facts["rate_hz"] is None else f"{facts['rate_hz']:.4g} Hz"
    lines = [
        ("recording", f"{facts['path']} ({facts['storage']})"),
        ("device", facts["device"] or "not stated"),
        ("frames", f"{facts['frames']} of {facts['width']} x {facts['height']} px"),
        ("time", f"{facts['duration_s']:.4g} s at {rate}" + _jitter(facts)),
    ]
    if facts["gaps"]:
        lines.append(
            (
                "gaps",
                f"{facts['gaps']}, the longest {facts['longest_gap_s']:.4g} s; at this rate "
                f"{facts['missing_frames']} frames are missing",
            )
        )
    times = settings["integration_times"]
    if times:
        lines.append(
            ("integration time", ", ".join(f"{time} ({count} frames)" for time, count in times.items()))
        )
    for name, label, unit, scale in (
        ("modulation_frequency", "modulation", "MHz", 1e-6),
        ("uptime", "uptime", "s", 1.0),
        ("body_temperature", "body temperature", "degC", 1.0),
        ("ambient_temperature", "ambient temperature", "degC", 1.0),
        ("reference_distance", "reference path", "m", 1.0),
    ):
        if name in settings:
            low, high = (value * scale for value in settings[name])
            lines.append((label, span(low, high, unit)))
    for name, label, unit in (
        ("distance", "distances", facts["distance_unit"]),
        ("amplitude", "amplitudes", "counts"),
    ):
        values = facts[f"{name}_percentiles_1_50_99"]
        if values:
            least, median, most = map(number, values)
            lines.append((label, f"{least} .. {most} {unit} (1 .. 99 %), median {median}"))
    if facts["no_measurement_share"] is not None:
        lines.append(("no measurement", f"{facts['no_measurement_share']:.2%} of the pixels"))
        lines.append(("saturated", f"{facts['saturated_share']:.2%} of the pixels"))
    if facts["truth_surfaces"]:
        names = ", ".join(facts["truth_surfaces"])
        lines.append(("true poses", f"{facts['poses']} of {names}"))
    parts = [section("", lines)]
    if facts["noise"]:
        rows = [
            [
                f"{row['amplitude_counts'][0]} .. {row['amplitude_counts'][1]}",
                row["values"],
                f"{row['sigma_m'] * 1e3:.2f}",
                f"{row['model_m'] * 1e3:.2f}",
                f"{row['sigma_m'] / row['model_m']:.2f}",
            ]
            for row in facts["noise"]
        ]
        headings = ["amplitude [counts]", "values", "measured [mm]", "camera file [mm]", "ratio"]
        parts.append("noise of one distance, from successive frames\n" + table(headings, rows))
    notes = [*facts["assumptions"], *(f"left out: {n} {why}" for why, n in facts["skipped"].items() if n)]
    if facts["damage"]:
        notes.append(f"damage: {facts['damage']}")
    if facts["distance_unit"] == "counts":
        notes.append("give --camera for distances in metres and the noise against its model")
    if notes:
        parts.append("notes\n" + "\n".join(f"  {note}" for note in notes))
    topics = [[name, one["messages"], one["role"] or "-"] for name, one in facts["topics"].items()]
    parts.append("topics\n" + table(["topic", "messages", "role"], topics))
    return "\n\n".join(parts)


def _jitter(facts: dict[str, Any]) -> str:
    return "" if facts["jitter_s"] is None else f", jitter {facts['jitter_s'] * 1e3:.2g} ms"
