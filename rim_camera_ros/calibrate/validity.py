"""The ranges within which a calibration is valid: those that its data support."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Validity
from rim_camera_ros.fit.forward import Forward

Array = NDArray[Any]

#: Share of the values that may lie beyond each end of a range: too few to support it.
BEYOND = 0.002
#: Poses in which a pixel must be used to count as calibrated, and the share of such pixels that a row or
#: column of the region needs.
LEAST_POSES = 2
LEAST_SHARE = 0.5
#: Bins of the histograms by which the ends are computed, so that memory does not grow with the data.
_BINS = 4000
_DISTANCES = (0.0, 200.0)
_LOG_AMPLITUDES = (np.log(0.1), np.log(1e6))


def supported(forward: Forward) -> Validity:
    """Return the ranges of distance [m], amplitude [counts], settings, temperature and the image region.

    They are those of the pixels that the fit used: distance and amplitude between the quantiles `BEYOND` and
    1 - `BEYOND`, rounded outwards. The region is the largest frame of rows and columns of which at least half
    of the pixels were used in `LEAST_POSES` poses.
    """
    distances = np.zeros(_BINS, np.int64)
    amplitudes = np.zeros(_BINS, np.int64)
    poses: dict[tuple[int, int], Array] = {}
    times: list[float] = []
    temperatures: list[float] = []
    for prediction in forward.predictions(slopes=False):
        if not prediction.used.any():
            continue
        distances += _counted(prediction.delivered.distance[prediction.used], _DISTANCES)
        amplitudes += _counted(np.log(prediction.amplitude[prediction.used]), _LOG_AMPLITUDES)
        key = (prediction.station.recording, prediction.station.pose)
        poses[key] = prediction.used | poses.get(key, np.zeros_like(prediction.used))
        times.append(forward.camera.integration_time(prediction.station.settings))
        ambient = prediction.station.settings.ambient_temperature
        if ambient is not None:
            temperatures.append(ambient)
    if not times:
        return Validity()
    seen = np.zeros(forward.camera.shape, np.int32)
    for pixels in poses.values():
        seen += pixels
    low, high = _ends(distances, _DISTANCES)
    dark, bright = (float(np.exp(x)) for x in _ends(amplitudes, _LOG_AMPLITUDES))
    return Validity(
        distance=(_down(low, 0.01), _up(high, 0.01)),
        amplitude=(_down(dark, 1.0), _up(bright, 1.0)),
        integration_time=(min(times), max(times)),
        temperature=(_down(min(temperatures), 0.1), _up(max(temperatures), 0.1)) if temperatures else None,
        region=region(seen >= min(LEAST_POSES, len(poses))),
    )


def region(calibrated: NDArray[np.bool_]) -> tuple[float, float, float, float] | None:
    """Return u0 v0 u1 v1 [px], inclusive, of the rows and columns that are calibrated by half; None: nowhere.

    Shares of rows and columns are taken within the region of the others, until nothing changes.
    """
    rows = np.array([0, calibrated.shape[0] - 1])
    columns = np.array([0, calibrated.shape[1] - 1])
    for _ in range(10):
        inside = calibrated[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1]
        by_row = np.flatnonzero(inside.mean(axis=1) >= LEAST_SHARE)
        by_column = np.flatnonzero(inside.mean(axis=0) >= LEAST_SHARE)
        if not by_row.size or not by_column.size:
            # a band or a disc: its bounding box
            by_row, by_column = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
            if not by_row.size:
                return None
        before = (*rows, *columns)
        rows = rows[0] + by_row[[0, -1]]
        columns = columns[0] + by_column[[0, -1]]
        if before == (*rows, *columns):
            break
    return float(columns[0]), float(rows[0]), float(columns[1]), float(rows[1])


def _counted(values: Array, limits: tuple[float, float]) -> NDArray[np.int64]:
    place = (values - limits[0]) / (limits[1] - limits[0]) * _BINS
    return np.bincount(np.clip(place.astype(np.int64), 0, _BINS - 1), minlength=_BINS)


def _ends(counts: NDArray[np.int64], limits: tuple[float, float]) -> tuple[float, float]:
    total = np.cumsum(counts)
    low = int(np.searchsorted(total, BEYOND * total[-1], side="right"))
    high = int(np.searchsorted(total, (1 - BEYOND) * total[-1], side="left"))
    width = (limits[1] - limits[0]) / _BINS
    return limits[0] + low * width, limits[0] + (high + 1) * width


def _down(value: float, step: float) -> float:
    return round(float(np.floor(value / step + 1e-9)) * step, 6)


def _up(value: float, step: float) -> float:
    return round(float(np.ceil(value / step - 1e-9)) * step, 6)
