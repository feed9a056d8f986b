"""Whether the noise of a running camera is still that of its camera file; no ROS in here."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import FULL_SCALE, Camera
from rim_camera_ros.frame import NANOSECONDS, RawFrame
from rim_camera_ros.noise import sigma_amplitude as noise_of_amplitude

#: Frames further apart than this [ns] are not compared: the scene may have moved far in between.
_NEIGHBOURS = NANOSECONDS
#: Least pixel pairs for a comparison, least comparisons for a verdict, and most that are kept for it.
_ENOUGH_PIXELS, _ENOUGH, _REMEMBERED = 500, 5, 20
#: Rows of larger sensors are skipped, so that no more pixels than this are compared.
_MOST_PIXELS = 40_000
#: A pixel is at rest where its amplitude changed by less than so many standard deviations; a comparison
#: requires this share of such pixels. Error of amplitudes by rounding to counts.
_AT_REST, _SHARE_AT_REST, _ROUNDING = 2.5, 0.3, 0.5
#: Median of the absolute value of a standard normal variable.
_NORMAL_MEDIAN = 0.67449
#: Ratio of observed and predicted noise within which a camera matches its calibration. Simulated cameras
#: keep within 1.00 +- 0.02 at rest and in motion (test/ros/test_consistency.py).
LEAST, GREATEST = 0.8, 1.25


@dataclass(frozen=True, slots=True)
class Verdict:
    """Ratios of observed to predicted noise of one distance: all pixels, the darker and the brighter half.

    The halves are divided at ``amplitude`` [counts]. ``matches``: all three ratios are within the limits.
    """

    ratio: float
    dark: float
    bright: float
    amplitude: float
    comparisons: int

    @property
    def matches(self) -> bool:
        return all(LEAST <= one <= GREATEST for one in (self.ratio, self.dark, self.bright))

    @property
    def departure(self) -> float:
        """The greatest departure of the three ratios from 1, as the absolute value of the logarithm [-]."""
        ratios = (self.ratio, self.dark, self.bright)
        return max(abs(math.log(ratio)) if ratio > 0 else math.inf for ratio in ratios)


class NoiseWatch:
    """Compares consecutive raw frames with the noise model of a camera file.

    Pixels whose amplitude did not change beyond its noise see something at rest. The second difference along
    the row of their change of distance is divided by its predicted standard deviation. The difference also
    removes slow and even motion. Where the camera matches its file the median of the absolute ratios is that
    of a standard normal variable. Frames are not compared while most of the image moves.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._last: RawFrame | None = None
        self._found: deque[tuple[float, float, float, float]] = deque(maxlen=_REMEMBERED)

    def take(self, frame: RawFrame) -> bool:
        """Take a frame, and compare it with the previous frame; True where it could be compared.

        Images of another size than the camera's are not used.
        """
        last, self._last = self._last, frame
        if (
            last is None
            or frame.shape != self._camera.shape
            or last.shape != frame.shape
            or frame.distance.dtype != last.distance.dtype
            or not 0 < frame.stamp - last.stamp <= _NEIGHBOURS
            or frame.settings.integration_time != last.settings.integration_time
        ):
            return False
        found = self._compare(last, frame)
        if found is not None:
            self._found.append(found)
        return found is not None

    def forget_last(self) -> None:
        """Do not compare the next frame with the last one."""
        self._last = None

    @property
    def verdict(self) -> Verdict | None:
        """The median of the last comparisons, None before there are enough."""
        if len(self._found) < _ENOUGH:
            return None
        ratio, dark, bright, amplitude = np.median(np.array(self._found), axis=0).tolist()
        return Verdict(ratio, dark, bright, amplitude, len(self._found))

    def _compare(self, last: RawFrame, frame: RawFrame) -> tuple[float, float, float, float] | None:
        camera = self._camera
        rows = slice(None, None, -(-frame.distance.size // _MOST_PIXELS))
        last, frame = (
            replace(raw_frame, distance=raw_frame.distance[rows], amplitude=raw_frame.amplitude[rows])
            for raw_frame in (last, frame)
        )
        amplitude = (last.amplitude.astype(np.float32) + frame.amplitude) / 2
        usable = (last.distance > 0) & (frame.distance > 0)
        usable &= np.maximum(last.amplitude, frame.amplitude) < camera.sensor.saturation
        # where the noise of the amplitude is not small, the mean of two does not determine the noise
        light = camera.light_of(amplitude)
        usable &= camera.noise.sigma_distance(light) < camera.sensor.ambiguity / 40
        change = self._metres(frame.distance) - self._metres(last.distance)
        if camera.sensor.wraps:
            span = np.float32(FULL_SCALE * camera.sensor.lsb)
            change -= span * np.rint(change / span)
        sigma = camera.sigma_distance(light)
        # noise is circular, so this choice does not change the noise of the distance
        brighter = np.abs(last.amplitude.astype(np.float32) - frame.amplitude)
        sigma_amplitude = noise_of_amplitude(sigma, amplitude, ambiguity=camera.noise_range)
        sigma = camera.sigma_distance(light, distance=self._metres(frame.distance), settings=frame.settings)
        at_rest = brighter <= _AT_REST * math.sqrt(2) * np.maximum(sigma_amplitude, _ROUNDING)
        pixels = np.count_nonzero(usable)
        usable &= at_rest & (sigma > 0)
        if np.count_nonzero(usable) < max(_ENOUGH_PIXELS, _SHARE_AT_REST * pixels):
            return None
        three = usable[:, 2:] & usable[:, 1:-1] & usable[:, :-2]
        if np.count_nonzero(three) < _ENOUGH_PIXELS:
            return None
        bend = np.abs(change[:, 2:] - 2 * change[:, 1:-1] + change[:, :-2])[three]
        variance = 2 * sigma * sigma
        bend /= np.sqrt(variance[:, 2:][three] + 4 * variance[:, 1:-1][three] + variance[:, :-2][three])
        bright = amplitude[:, 1:-1][three]
        middle = float(np.median(bright))
        halves = [bend[bright < middle], bend[bright >= middle]]
        ratios = [float(np.median(one)) / _NORMAL_MEDIAN if one.size else 1.0 for one in (bend, *halves)]
        if not np.isfinite(ratios).all():
            return None
        return ratios[0], ratios[1], ratios[2], middle

    def _metres(self, raw: NDArray[Any]) -> NDArray[np.float32]:
        if raw.dtype.kind == "f":
            return raw.astype(np.float32)
        return raw.astype(np.float32) * np.float32(self._camera.sensor.lsb)
