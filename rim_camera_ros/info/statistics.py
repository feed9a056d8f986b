"""Statistics of a recording's frames, collected frame by frame in constant memory."""

from __future__ import annotations

from array import array
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import FULL_SCALE, Camera
from rim_camera_ros.frame import NANOSECONDS, RawFrame

#: Classes of amplitude in counts for the noise.
CLASSES = (0, 25, 50, 100, 200, 400, 800, 1600, 3200, 6400, 12800, 25600, 65536)
#: Width [m] of a bin for distances that come in metres.
METRES = 1e-3

#: Least number of values in a class to state its noise.
_LEAST = 200
#: A step between frames of more than so many periods is a gap.
_GAP = 1.5
#: Number of bins for differences between frames, and their width [m] where distances come in metres.
_BINS, _STEP = 8192, 1e-4
#: Differences beyond so many sigma are outliers: edges, flipped bits.
_CLIP = 4.0
#: Ratio of the noise over two frames to that over one above which there is motion or drift.
_MOVING = 1.3

_SETTINGS = (
    "modulation_frequency",
    "uptime",
    "body_temperature",
    "ambient_temperature",
    "reference_distance",
)


class SettingsSeen:
    """Least and greatest value of each setting, and the number of frames of each integration time."""

    def __init__(self) -> None:
        self._seen: dict[str, list[float]] = {}
        self._integration_times: dict[float, int] = {}

    def add(self, frame: RawFrame) -> None:
        """Add the settings of a frame."""
        settings = frame.settings
        if settings.integration_time is not None:
            time = settings.integration_time
            self._integration_times[time] = self._integration_times.get(time, 0) + 1
        for name in _SETTINGS:
            value = getattr(settings, name)
            if value is not None:
                seen = self._seen.setdefault(name, [value, value])
                seen[0], seen[1] = min(seen[0], value), max(seen[1], value)

    def facts(self) -> dict[str, Any]:
        """Return ``integration_times`` (setting: frames) and [least, greatest] of the others."""
        times = {f"{time:g}": count for time, count in sorted(self._integration_times.items())}
        return {"integration_times": times, **{name: list(seen) for name, seen in self._seen.items()}}


class Timing:
    """Rate, jitter and gaps; eight bytes are kept for each frame."""

    def __init__(self) -> None:
        self._stamps = array("q")

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp: int) -> None:
        """Take a frame's stamp in ns."""
        self._stamps.append(stamp)

    def facts(self) -> dict[str, Any]:
        """Return duration, rate, jitter and gaps in s and Hz."""
        stamps = np.array(self._stamps, np.int64)
        facts: dict[str, Any] = {
            "start_s": float(stamps[0]) / NANOSECONDS if len(stamps) else None,
            "duration_s": float(stamps[-1] - stamps[0]) / NANOSECONDS if len(stamps) else 0.0,
            "rate_hz": None,
            "jitter_s": None,
            "gaps": 0,
            "longest_gap_s": None,
            "missing_frames": 0,
        }
        steps = np.diff(stamps)
        period = int(np.median(steps)) if len(steps) else 0
        if period <= 0:
            return facts
        gaps = steps > _GAP * period
        # nanoseconds are whole numbers up to here, so that an exact rate has no jitter
        facts["rate_hz"] = NANOSECONDS / period
        facts["jitter_s"] = float(np.std(steps[~gaps] - period)) / NANOSECONDS
        facts["gaps"] = int(gaps.sum())
        facts["longest_gap_s"] = float(steps.max()) / NANOSECONDS if gaps.any() else None
        facts["missing_frames"] = int(np.rint(steps[gaps] / period - 1).sum())
        return facts


class Histogram:
    """Percentiles of the positive values of uint16 or float images; ``scale`` is the width of a bin."""

    def __init__(self, scale: float) -> None:
        self._scale = scale
        self._counts = np.zeros(FULL_SCALE, np.int64)

    def add(self, values: NDArray[Any]) -> None:
        """Take an image."""
        if values.dtype != np.uint16:
            bins = np.nan_to_num(values / self._scale, nan=0.0, posinf=FULL_SCALE, neginf=0.0)
            values = np.clip(np.rint(bins), 0, FULL_SCALE - 1).astype(np.uint16)
        self._counts += np.bincount(values.ravel(), minlength=FULL_SCALE)

    def percentiles(self, unit: float, shares: tuple[float, ...] = (0.01, 0.5, 0.99)) -> list[float] | None:
        """Return the values below which these shares lie, times ``unit``; None without values."""
        counts = self._counts.copy()
        counts[0] = 0
        total = counts.sum()
        if total == 0:
            return None
        cumulative = np.cumsum(counts) / total
        return [float(np.searchsorted(cumulative, share) * unit) for share in shares]


class Noise:
    """Noise of one distance by amplitude, from the differences of successive frames.

    Differences are taken within one station and setting and divided by sqrt(2), so that a slow drift only
    enters by its change from frame to frame. Outliers beyond 4 sigma are excluded. The unit is metres with a
    camera or for distances in metres, else counts.
    """

    def __init__(self, camera: Camera | None, *, in_metres: bool) -> None:
        sensor = camera.sensor if camera is not None else None
        self.unit = "m" if in_metres or sensor is not None else "counts"
        #: metres (or counts) of one count of the images, and of one bin
        self._lsb = 1.0 if in_metres or sensor is None else sensor.lsb
        self._bin = _STEP if in_metres else self._lsb
        self._period = sensor.ambiguity if sensor is not None and sensor.wraps else None
        self._saturation = sensor.saturation if sensor is not None else FULL_SCALE - 1
        self._before: deque[RawFrame] = deque(maxlen=2)
        self._steps = np.zeros((len(CLASSES) - 1, _BINS), np.int64)
        self._twice = np.zeros(_BINS, np.int64)
        self._once = np.zeros(_BINS, np.int64)
        self._model: NDArray[np.float64] | None = None
        if camera is not None:
            amplitudes = camera.light_of(np.maximum(np.arange(float(FULL_SCALE)), 1.0))
            self._model = camera.noise.sigma_distance(amplitudes, background=camera.background) ** 2
        self._variance = np.zeros(len(CLASSES) - 1)

    def add(self, frame: RawFrame) -> None:
        """Take a frame."""
        if self._before and not _alike(self._before[-1], frame):
            self._before.clear()
        if self._before:
            size, amplitude = self._step(self._before[-1], frame)
            kind = np.searchsorted(CLASSES, amplitude, side="right") - 1
            index = kind * _BINS + size
            self._steps += np.bincount(index, minlength=self._steps.size).reshape(self._steps.shape)
            if self._model is not None:
                self._variance += np.bincount(kind, self._model[amplitude], len(self._variance))
        if len(self._before) == 2:
            # over the same three frames, so that both use the same pixels
            self._twice += np.bincount(self._step(self._before[0], frame)[0], minlength=_BINS)
            self._once += np.bincount(self._step(self._before[1], frame)[0], minlength=_BINS)
        self._before.append(frame)

    def _step(self, before: RawFrame, frame: RawFrame) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the size of the step in bins and the mean amplitude of the usable pixels."""
        step = (frame.distance.astype(np.float64) - before.distance) * self._lsb
        if self._period is not None:
            step -= self._period * np.rint(step / self._period)
        amplitude = (frame.amplitude.astype(np.float64) + before.amplitude) / 2
        size = np.rint(np.abs(step) / self._bin)
        usable = (frame.distance > 0) & (before.distance > 0) & (size < _BINS)
        usable &= np.minimum(frame.amplitude, before.amplitude) >= 1
        usable &= np.maximum(frame.amplitude, before.amplitude) < self._saturation
        whole = np.minimum(np.rint(amplitude[usable]), FULL_SCALE - 1)
        return size[usable].astype(np.intp), whole.astype(np.intp)

    def facts(self) -> dict[str, Any]:
        """Return ``unit``, ``classes`` by amplitude, and whether the scene or the camera seems to move."""
        rows = []
        for i, counts in enumerate(self._steps):
            values = int(counts.sum())
            sigma = _clipped(counts) * self._bin / np.sqrt(2.0)
            if values < _LEAST or sigma <= 0:
                continue
            row = {"amplitude_counts": list(CLASSES[i : i + 2]), "values": values, "sigma": float(sigma)}
            if self._model is not None:
                row["model"] = float(np.sqrt(self._variance[i] / values))
            rows.append(row)
        once, twice = _clipped(self._once), _clipped(self._twice)
        return {"unit": self.unit, "classes": rows, "moving": bool(twice > _MOVING * once > 0)}


def _alike(before: RawFrame, frame: RawFrame) -> bool:
    """Whether two frames belong to one station and setting."""
    return (
        before.settings.integration_time == frame.settings.integration_time
        and before.settings.modulation_frequency == frame.settings.modulation_frequency
        and dict(before.pose_stamps) == dict(frame.pose_stamps)
    )


def _clipped(counts: NDArray[np.int64]) -> float:
    """Return the root mean square of a histogram of sizes, in bins, without outliers."""
    sizes = np.arange(len(counts), dtype=float)
    total = counts.sum()
    if total == 0:
        return 0.0
    median = float(np.searchsorted(np.cumsum(counts), total / 2))
    sigma = max((median + 0.5) / 0.6745, 1.0)
    for _ in range(30):
        kept = counts[: int(_CLIP * sigma) + 1]
        again = float(np.sqrt(kept @ sizes[: len(kept)] ** 2 / kept.sum()))
        if abs(again - sigma) < 1e-4 * sigma:
            break
        sigma = max(again, 0.25)
    return again
