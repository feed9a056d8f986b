"""A camera from a recording: values estimated from its frames, and values that had to be assumed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from rim_camera_ros.camera import Camera, Radiometry, Sensor
from rim_camera_ros.errors import InputError
from rim_camera_ros.first_camera.counts import Counts
from rim_camera_ros.first_camera.gain import ASSUMED, ASSUMED_SIGMA, Gain, gain_of
from rim_camera_ros.first_camera.noise_model import NoiseEstimate, fit_noise_model
from rim_camera_ros.first_camera.repeated import NoiseData, RepeatedFrames
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.optics import Optics
from rim_camera_ros.phasor import ambiguity_range

#: Modulation frequency where nothing states one [Hz].
ASSUMED_FREQUENCY = 20e6
#: Step of a camera whose distances come in metres [m]; it only states that they do not wrap.
_METRES = 0.001
_MOST_AMPLITUDE = 65535.0
#: Relative RMS of the noise classes about the model above which there is a note.
_POOR = 0.15
#: Share of an image's light that must be elsewhere for an image to show another scene.
_ELSEWHERE = 0.1


@dataclass(frozen=True)
class Stated:
    """Statements of the user; None: by the recording. ``region``: u0 v0 u1 v1, inclusive."""

    device: str | None = None
    modulation_frequency: float | None = None
    integration_time: float | None = None
    distance_lsb: float | None = None
    saturation: float | None = None
    reflectivity: float | None = None
    reflectivity_sigma: float = 0.1
    region: tuple[int, int, int, int] | None = None


@dataclass(frozen=True)
class FirstCamera:
    """The camera, the source of its values by dotted path, notes for the user, and the evidence."""

    camera: Camera
    why: dict[str, str]
    notes: list[str]
    noise: NoiseEstimate | None
    data: NoiseData
    gain: Gain


def first_camera(
    frames: Iterable[RawFrame], stated: Stated, *, provenance: dict[str, Any] | None = None
) -> FirstCamera:
    """Read all frames once and return the camera that is estimated from them.

    Raises `InputError` for a recording without frames or geometry, or a region without measurements.
    """
    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise InputError("no frame in it", remedy="record it again")
    why: dict[str, str] = {}
    notes: list[str] = []
    frequency = _frequency(first, stated, why, notes)
    lsb, wraps = _step(first, stated, frequency, why, notes)
    counts = Counts()
    limit = stated.saturation if stated.saturation is not None else _MOST_AMPLITUDE
    period = ambiguity_range(frequency) if wraps else None
    unit = lsb if lsb is not None else ambiguity_range(frequency) / 65536
    counted = first.distance.dtype == np.uint16
    repeated = RepeatedFrames(lsb=unit if counted else 1.0, period=period, saturation=limit)
    sums = _Means(unit if counted else 1.0)
    intrinsics, times = first.intrinsics, set()
    number = 0
    for frame in _chain(first, iterator):
        number += 1
        if frame.shape != first.shape:
            raise InputError("the size of the images changes", remedy="split the recording there")
        counts.add(frame)
        repeated.add(frame)
        sums.add(frame)
        intrinsics = intrinsics if intrinsics is not None else frame.intrinsics
        times.add(frame.settings.integration_time)
    if intrinsics is None:
        raise InputError(
            "no camera_info: the geometry is not known",
            remedy="record camera_info, or rim import BAG --camera-info FILE of a calibration",
        )
    sensor = Sensor(
        width=first.shape[1],
        height=first.shape[0],
        modulation_frequency=frequency,
        distance_lsb=lsb,
        saturation=_saturation(counts, stated, why),
        integration_time=_integration_time(times, stated, why, notes),
    )
    why |= {"sensor.width": "size of the images", "sensor.height": "size of the images"}
    why["sensor.pixel_pitch"] = "not known, and nothing needs it"
    why["sensor.exposure"] = "assumed; only the effect motion needs seconds"
    if lsb is None:
        notes.append(
            "metres per count are not known: 65536 counts are taken for c / (2 f); the greatest count is"
            f" {counts.greatest_distance}: if that is millimetres, --distance-lsb 0.001"
        )
    if counted and counts.grid > 1:
        why["sensor.distance_lsb"] += f"; all counts are multiples of {counts.grid}"
    d = tuple([*intrinsics.d, 0.0, 0.0, 0.0, 0.0, 0.0][:5])
    optics = Optics(fx=intrinsics.fx, fy=intrinsics.fy, cx=intrinsics.cx, cy=intrinsics.cy, d=d)  # type: ignore[arg-type]
    why |= dict.fromkeys(("optics.fx", "optics.fy", "optics.cx", "optics.cy", "optics.d"), "by camera_info")
    plain = Camera(sensor=sensor, optics=optics, device=stated.device or first.device or "unnamed")
    data = repeated.result()
    found = fit_noise_model(data.classes)
    _say_noise(found, data, why, notes)
    gain = _gain(plain, sums, stated, why, notes)
    camera = Camera(
        sensor=sensor,
        optics=optics,
        device=plain.device,
        radiometry=Radiometry(gain=gain.value),
        noise=found.noise if found is not None else plain.noise,
        provenance=MappingProxyType({**(provenance or {}), "frames": number}),
    )
    return FirstCamera(camera, why, notes, found, data, gain)


def _chain(first: RawFrame, rest: Iterable[RawFrame]) -> Iterable[RawFrame]:
    yield first
    yield from rest


class _Means:
    """Mean distance [m] and amplitude [counts] of each pixel over the first frames of one scene.

    Frames show one scene while poses, settings and the image stay the same; poses need not be recorded.
    """

    def __init__(self, unit: float) -> None:
        self._unit = unit
        self._distance: Any = None
        self._first: RawFrame | None = None

    def add(self, frame: RawFrame) -> None:
        amplitude = np.nan_to_num(frame.amplitude.astype(np.float64))
        if self._first is None:
            self._first, self._distance = frame, np.zeros(frame.shape)
            self._first_amplitude = amplitude
            self._amplitude, self._count = np.zeros(frame.shape), np.zeros(frame.shape)
        if dict(frame.pose_stamps) != dict(self._first.pose_stamps) or (
            frame.settings.integration_time != self._first.settings.integration_time
        ):
            return
        moved = np.abs(amplitude - self._first_amplitude).sum()
        if moved > _ELSEWHERE * self._first_amplitude.sum():
            return
        distance = np.nan_to_num(frame.distance.astype(np.float64)) * self._unit
        valid = (distance > 0) & (amplitude > 0)
        self._distance += np.where(valid, distance, 0.0)
        self._amplitude += np.where(valid, amplitude, 0.0)
        self._count += valid

    def images(self) -> tuple[Any, Any, float | None]:
        """Return distance, amplitude (0 where there is none) and the integration time."""
        assert self._first is not None
        n = np.maximum(self._count, 1)
        return self._distance / n, self._amplitude / n, self._first.settings.integration_time


def _frequency(first: RawFrame, stated: Stated, why: dict[str, str], notes: list[str]) -> float:
    key = "sensor.modulation_frequency"
    if stated.modulation_frequency is not None:
        why[key] = "as stated on the command line"
        return stated.modulation_frequency
    if first.settings.modulation_frequency is not None:
        why[key] = "by frame_info"
        return first.settings.modulation_frequency
    why[key] = "ASSUMED, nothing states it"
    notes.append(
        f"the modulation frequency is not known: {ASSUMED_FREQUENCY / 1e6:g} MHz is assumed;"
        " --modulation-frequency states it"
    )
    return ASSUMED_FREQUENCY


def _step(
    first: RawFrame, stated: Stated, frequency: float, why: dict[str, str], notes: list[str]
) -> tuple[float | None, bool]:
    """Return metres per count (None: ambiguity range / 65536) and whether distances wrap."""
    key = "sensor.distance_lsb"
    text = first.settings.extra.get("distance_lsb")
    lsb = stated.distance_lsb
    why[key] = "as stated on the command line"
    if lsb is None and text is not None:
        try:
            lsb = float(text)
        except ValueError:
            raise InputError(f"'{text}' is not a number", place="frame_info, distance_lsb") from None
        if not 0 < lsb < np.inf:
            raise InputError(f"{text} is not positive", place="frame_info, distance_lsb")
        why[key] = "by the driver's profile"
    if lsb is None and first.distance.dtype != np.uint16:
        lsb, why[key] = _METRES, "distances come in metres; this only says that they do not wrap"
    if lsb is None:
        why[key] = "ASSUMED: 65536 counts are the ambiguity range"
        notes.append(
            "metres per count are not known: 65536 counts are taken for c / (2 f); or --distance-lsb"
        )
        return None, True
    return lsb, 65536 * lsb <= ambiguity_range(frequency) * (1 + 1e-6)


def _saturation(counts: Counts, stated: Stated, why: dict[str, str]) -> float:
    key = "sensor.saturation"
    if stated.saturation is not None:
        why[key] = "as stated on the command line"
        return stated.saturation
    found = counts.saturation()
    if found is not None:
        why[key] = f"values pile up there ({int(counts.amplitudes[found])} of them)"
        return float(found)
    why[key] = f"not reached: the greatest amplitude is {counts.greatest_amplitude}; the end of the scale"
    return _MOST_AMPLITUDE


def _integration_time(
    times: set[float | None], stated: Stated, why: dict[str, str], notes: list[str]
) -> float | None:
    key = "sensor.integration_time"
    if stated.integration_time is not None:
        why[key] = "as stated on the command line"
        return stated.integration_time
    known = sorted(time for time in times if time is not None)
    if len(known) == 1:
        why[key] = "that of all frames"
        return known[0]
    if known:
        why[key] = f"frames state {len(known)} settings: each frame's own counts"
        return None
    why[key] = "ASSUMED to be 1: nothing states it; right as long as it never changes"
    notes.append("no integration time is stated: 1 is taken for all frames, and the gain is per that")
    return 1.0


def _say_noise(found: NoiseEstimate | None, data: NoiseData, why: dict[str, str], notes: list[str]) -> None:
    keys = ("floor", "shot", "amplitude")
    if found is None:
        why |= dict.fromkeys((f"noise.{key}" for key in keys), "ASSUMED: no repeated frames")
        notes.append("the noise is not known: no two frames of one scene; record 50 frames at rest")
        return
    for key in keys:
        fitted = found.whole or key == "amplitude"
        why[f"noise.{key}"] = (
            f"+- {getattr(found.sigma, key):.2g}, {data.frames} frames, {len(data.classes)} amplitudes"
            if fitted
            else "not separable: the amplitudes span less than a factor of 2"
        )
    if data.moving:
        notes.append(
            "the frames move: the noise is what neighbouring pixels do not share, too little where a driver"
            " smooths; record 50 frames at rest"
        )
    if found.misfit > _POOR:
        notes.append(f"the noise departs from the model's form by {found.misfit:.0%} (RMS over the classes)")


def _gain(camera: Camera, sums: _Means, stated: Stated, why: dict[str, str], notes: list[str]) -> Gain:
    distance, amplitude, time = sums.images()
    if stated.integration_time is not None or time is None:
        time = camera.sensor.integration_time or 1.0
    known = stated.reflectivity is not None
    gain = gain_of(
        distance,
        amplitude,
        camera.rays,
        integration_time=time,
        reflectivity=stated.reflectivity if known else ASSUMED,  # type: ignore[arg-type]
        reflectivity_sigma=stated.reflectivity_sigma if known else ASSUMED_SIGMA,
        region=stated.region,
    )
    where = f"{gain.pixels} pixels at {gain.distance:.3g} m, {np.degrees(gain.angle):.0f} degrees"
    basis = f"reflectivity {stated.reflectivity:g}" if known else f"an ASSUMED reflectivity of {ASSUMED:g}"
    why["radiometry.gain"] = f"+- {gain.relative_sigma:.0%}, by {basis}, {where}"
    if not known:
        notes.append(
            "the gain is by an assumed reflectivity of 0.5 in the middle of the image;"
            " --reflectivity and --region state a surface that is known"
        )
    return gain
