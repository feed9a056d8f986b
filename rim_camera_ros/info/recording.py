"""Facts on a recording, collected in one pass and in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rim_camera_ros.bags import Recording, Topics
from rim_camera_ros.bags.topics import listed
from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.frame import Flag, RawFrame
from rim_camera_ros.info.statistics import METRES, Histogram, Noise, SettingsSeen, Timing
from rim_camera_ros.info.text import listed_short, number, percent, section, span, table, wrapped
from rim_camera_ros.measurement import measurement_of

#: Relative difference of two modulation frequencies above which there is a note.
_DETUNED = 1e-3


class _Raw:
    """Facts that are collected from raw frames."""

    def __init__(self, camera: Camera | None) -> None:
        self._camera = camera
        self._timing, self._settings = Timing(), SettingsSeen()
        self._distances, self._amplitudes = Histogram(METRES), Histogram(1.0)
        self._noise: Noise | None = None
        self._in_metres = False
        self._shape, self._device, self._has_intrinsics = (0, 0), "", False
        self._missing = self._saturated = self._pixels = 0
        self._poses = 0
        self._pose: dict[str, int] = {}
        self.notes: list[str] = []

    def __len__(self) -> int:
        return len(self._timing)

    def add(self, frame: RawFrame) -> None:
        """Take a frame. Raises `InputError` where its size is not the camera's."""
        if self._noise is None:
            self._begin(frame)
        assert self._noise is not None
        self._timing.add(frame.stamp)
        self._settings.add(frame)
        self._device = frame.device or self._device
        self._has_intrinsics |= frame.intrinsics is not None
        self._distances.add(frame.distance)
        self._amplitudes.add(frame.amplitude)
        self._noise.add(frame)
        limit = self._camera.sensor.saturation if self._camera is not None else 65535
        self._missing += int((~(frame.distance > 0)).sum())
        self._saturated += int((frame.amplitude >= limit).sum())
        self._pixels += frame.distance.size
        pose = dict(frame.pose_stamps)
        if pose and pose != self._pose:
            self._poses, self._pose = self._poses + 1, pose

    def _begin(self, frame: RawFrame) -> None:
        if self._camera is not None:
            self._camera = measurement_of(self._camera).camera_of_frame(self._camera, frame)
        camera, self._shape = self._camera, frame.shape
        if "distance" not in frame.by_role:
            first, second, *_ = frame.by_role
            self.notes.append(f"distances, amplitudes and noise are those of {first} and {second}")
        self._in_metres = frame.distance.dtype.kind == "f"
        if camera is not None and frame.shape != camera.shape:
            raise InputError(
                f"images of {frame.shape[1]} x {frame.shape[0]} px, but the camera file is for "
                f"{camera.shape[1]} x {camera.shape[0]}",
                remedy="give the camera file of this sensor",
            )
        stated = frame.settings.modulation_frequency
        if camera is not None and stated is not None:
            expected = camera.sensor.modulation_frequency
            if abs(stated - expected) > _DETUNED * expected:
                self.notes.append(
                    f"modulation at {stated / 1e6:g} MHz, but the camera file is for {expected / 1e6:g} MHz: "
                    "distances and noise are those of the camera file"
                )
        self._noise = Noise(camera, in_metres=self._in_metres)

    def facts(self) -> dict[str, Any]:
        """Return plain facts."""
        unit, width = "counts", 1.0
        if self._in_metres:
            unit, width = "m", METRES
        elif self._camera is not None:
            unit, width = "m", self._camera.sensor.lsb
        pixels = self._pixels or None
        return {
            "frames": len(self._timing),
            "width": self._shape[1],
            "height": self._shape[0],
            "device": self._device,
            "has_camera_info": self._has_intrinsics,
            **self._timing.facts(),
            "settings": self._settings.facts(),
            "distance_unit": unit,
            "distance_percentiles_1_50_99": self._distances.percentiles(width),
            "amplitude_percentiles_1_50_99": self._amplitudes.percentiles(1.0),
            "no_measurement_share": self._missing / pixels if pixels else None,
            "saturated_share": self._saturated / pixels if pixels else None,
            "noise": self._noise.facts() if self._noise is not None else None,
            "poses": self._poses,
        }


def _until_fault[T](frames: Callable[[], Iterator[T]]) -> Iterator[tuple[T | None, RimError | None]]:
    """Yield (frame, None), and at the end (None, error) if reading ends with an error."""
    try:
        for frame in frames():
            yield frame, None
    except RimError as error:
        yield None, error


def recording_facts(
    path: Path,
    topics: Topics,
    camera: Camera | None = None,
    count: Callable[[int], Any] = lambda done: None,
) -> tuple[dict[str, Any], RimError | None]:
    """Return plain facts on a recording, and the error because of which it could not be read completely.

    ``camera`` states metres per count and the noise model. Raises `InputError` where the path is not a
    recording, or it is from another sensor than the camera's.
    """
    with Recording(path, topics=topics) as bag:
        summary = bag.summary()
        raw, corrected = _Raw(camera), None
        fault: RimError | None = None
        frames = _until_fault(lambda: bag.frames(on_backwards="count"))
        for frame, fault in frames:  # noqa: B007 -- the last one counts
            if frame is not None:
                try:
                    raw.add(frame)
                except InputError as error:
                    raise error.located(path) from None
                count(len(raw))
        if fault is not None and "corrected_distance" in summary.roles and not len(raw):
            corrected, fault = _corrected_facts(bag, count)
        facts = {
            "path": str(path),
            "storage": summary.storage,
            **raw.facts(),
            "corrected": corrected,
            "truth_surfaces": list(summary.truth_surfaces),
            "assumptions": list(bag.assumptions),
            "notes": raw.notes,
            "skipped": dict(bag.skipped),
            "damage": summary.damage,
            "fault": None if fault is None else str(fault),
            "topics": {
                topic.name: {"type": topic.msgtype, "messages": topic.count, "role": topic.role}
                for topic in summary.topics
            },
        }
        return facts, fault


def _corrected_facts(
    bag: Recording, count: Callable[[int], Any]
) -> tuple[dict[str, Any] | None, RimError | None]:
    """Return facts on a recording of corrected frames."""
    distances, sigmas, timing = Histogram(METRES), Histogram(METRES / 10), Timing()
    flags, pixels, shape = dict.fromkeys(Flag, 0), 0, (0, 0)
    fault: RimError | None = None
    for frame, fault in _until_fault(bag.corrected_frames):  # noqa: B007 -- the last one counts
        if frame is None:
            continue
        timing.add(frame.stamp)
        distances.add(frame.distance)
        sigmas.add(frame.sigma)
        for flag in flags:
            flags[flag] += int((frame.flags & flag.value != 0).sum())
        pixels, shape = pixels + frame.flags.size, frame.distance.shape
        count(len(timing))
    if not pixels:
        return None, fault
    facts = {
        "frames": len(timing),
        "width": shape[1],
        "height": shape[0],
        **timing.facts(),
        "distance_percentiles_1_50_99_m": distances.percentiles(METRES),
        "sigma_percentiles_1_50_99_m": sigmas.percentiles(METRES / 10),
        "flag_shares": {str(flag.name).lower(): value / pixels for flag, value in flags.items()},
    }
    return facts, fault


def recording_text(facts: dict[str, Any]) -> str:
    """Return the facts for a person."""
    lines = [("recording", f"{facts['path']} ({facts['storage']})")]
    if facts["frames"]:
        lines += _raw_lines(facts)
    elif facts["corrected"]:
        lines += _corrected_lines(facts["corrected"])
    if facts["truth_surfaces"]:
        lines.append(("true poses", _poses(facts)))
    parts = [section("", lines)]
    if facts["noise"] and facts["noise"]["classes"]:
        parts.append(_noise_text(facts["noise"]))
    notes = [*facts["assumptions"], *facts["notes"]]
    notes += [f"excluded: {n} {why}" for why, n in facts["skipped"].items() if n]
    if facts["damage"] and not facts["fault"]:  # a fault is reported as an error afterwards
        notes.append(f"damage: {facts['damage']}")
    if facts["frames"] and facts["distance_unit"] == "counts":
        notes.append("--camera CAMERA gives distances in metres and the noise of its model")
    if notes:
        parts.append("notes\n" + wrapped(notes))
    topics = [[name, fact["role"] or "-", fact["messages"]] for name, fact in facts["topics"].items()]
    if topics:
        parts.append("topics\n" + table(["topic", "role", "messages"], topics, left=2))
    return "\n\n".join(parts)


def _time_lines(facts: dict[str, Any]) -> list[tuple[str, str]]:
    lines = [("frames", f"{facts['frames']} of {facts['width']} x {facts['height']} px")]
    if facts["rate_hz"] is not None:
        jitter = facts["jitter_s"] * 1e3
        steady = f"jitter {jitter:.2g} ms" if jitter >= 1e-3 else "no jitter"
        lines.append(
            ("time", f"{number(facts['duration_s'], 's')} at {number(facts['rate_hz'], 'Hz')}, {steady}")
        )
    if facts["gaps"]:
        text = f"{facts['gaps']}, the longest {number(facts['longest_gap_s'], 's')}; "
        missing = f"at this rate {facts['missing_frames']} frames are missing"
        if facts["missing_frames"] > facts["frames"]:
            missing = "frames come in groups with pauses between them"
        lines.append(("gaps", text + missing))
    return lines


def _raw_lines(facts: dict[str, Any]) -> list[tuple[str, str]]:
    settings = facts["settings"]
    lines = [("device", facts["device"] or "not stated"), *_time_lines(facts)]
    times = settings["integration_times"]
    if times:
        stated = [f"{time} ({count} frames)" for time, count in times.items()]
        lines.append(("integration time", listed_short(stated)))
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
    for name, unit in (("distance", facts["distance_unit"]), ("amplitude", "counts")):
        values = facts[f"{name}_percentiles_1_50_99"]
        lines.append((f"{name}s", _percentiles(values, unit)))
    lines.append(("no measurement", f"{percent(facts['no_measurement_share'])} of the pixels"))
    lines.append(("saturated", f"{percent(facts['saturated_share'])} of the pixels"))
    if not facts["noise"]["classes"]:
        lines.append(("noise", "not known: no two successive frames of one pose and setting"))
    return lines


def _corrected_lines(facts: dict[str, Any]) -> list[tuple[str, str]]:
    sigma = facts["sigma_percentiles_1_50_99_m"]
    lines = [
        ("content", "corrected frames, no raw ones"),
        *_time_lines(facts),
        ("distances", _percentiles(facts["distance_percentiles_1_50_99_m"], "m")),
        ("sigma", _percentiles([s * 1e3 for s in sigma] if sigma else None, "mm")),
    ]
    for name, share in facts["flag_shares"].items():
        lines.append((name.replace("_", " "), f"{percent(share)} of the pixels"))
    return lines


def _percentiles(values: list[float] | None, unit: str) -> str:
    if values is None:
        return "none"
    least, median, most = map(number, values)
    return f"{least} .. {most} {unit} (1 .. 99 %), median {median}"


def _poses(facts: dict[str, Any]) -> str:
    names = listed(facts["truth_surfaces"])
    return f"{names}, {facts['poses']} different" if facts["poses"] > 1 else names


def _noise_text(noise: dict[str, Any]) -> str:
    scale, unit = (1e3, "mm") if noise["unit"] == "m" else (1.0, "counts")
    modelled = "model" in noise["classes"][0]
    rows = []
    for row in noise["classes"]:
        low, high = row["amplitude_counts"]
        cells = [f"{low} .. {high}", row["values"], f"{row['sigma'] * scale:.2f}"]
        if modelled:
            cells += [f"{row['model'] * scale:.2f}", f"{row['sigma'] / row['model']:.2f}"]
        rows.append(cells)
    headings = ["amplitude [counts]", "values", f"measured [{unit}]"]
    headings += [f"camera file [{unit}]", "ratio"] if modelled else []
    text = "noise of one distance, from successive frames\n" + table(headings, rows)
    if noise["moving"]:
        text += "\n  grows from frame to frame: the scene or the camera moves, or drifts; the noise is less"
    return text
