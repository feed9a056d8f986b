"""The accuracy of corrected distances in poses that took no part in the fit.

The stations' mean frames are corrected by the correction that a user runs, with a camera that was fitted
without their fold of poses, and are compared with the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.views import View, Views
from rim_camera_ros.frame import INVALID, RawFrame
from rim_camera_ros.phasor import wrap_residual
from rim_camera_ros.pipeline.correct import Correction

Array = NDArray[Any]
Key = tuple[int, int]

#: Values kept for figures over covariates.
MOST_SAMPLES = 400_000


@dataclass(frozen=True)
class ErrorClass:
    """Values of one range of a covariate: RMS error [m] before and after, expected noise, number."""

    low: float
    high: float
    before: float
    after: float
    expected: float
    values: int


@dataclass
class Accuracy:
    """Errors of corrected mean frames against the scene, RMS in m.

    ``raw`` is that of the distances as measured, ``before`` corrected by the given camera file, ``after`` by
    the new one. ``noise`` is the part by the noise of the mean frames, from the predicted sigma;
    ``reference`` the part by the stated errors of the reference instrument. ``systematic`` is the RMS in
    excess of both (0: none), with weights by the accuracy of each value, so that noise of dark pixels does
    not hide it. ``single`` is the median of the predicted noise of one frame. ``held_out`` is false where
    there were too few poses to hold any out. ``rigid_before`` and ``rigid_after`` are ``before`` and
    ``after`` without offset and tilts of each pose: they contain no error of the reference instrument.
    ``samples`` are covariates and both errors of some of the values, by name; ``maps`` are mean errors over
    the array (H, W).
    """

    raw: float
    before: float
    after: float
    noise: float
    reference: float
    systematic: float
    single: float
    values: int
    poses: int
    held_out: bool
    rigid_before: float
    rigid_after: float
    samples: dict[str, Array] = field(default_factory=dict)
    maps: dict[str, Array] = field(default_factory=dict)

    def classes(self, name: str, edges: Sequence[float]) -> list[ErrorClass]:
        """Return the errors by ranges of a covariate of the samples."""
        x, before, after = self.samples[name], self.samples["before"], self.samples["after"]
        expected = self.samples["expected"]
        result = []
        for low, high in pairwise(edges):
            mine = (x >= low) & (x < high)
            if mine.sum() >= 50:
                a, b, c = (float(np.sqrt(np.mean(v[mine] ** 2))) for v in (before, after, expected))
                result.append(ErrorClass(float(low), float(high), a, b, c, int(mine.sum())))
        return result


def evaluate(
    dataset: Dataset,
    views: Views,
    cameras: Mapping[int, Camera],
    folds: Mapping[Key, int],
    before: Camera,
    masks: Sequence[Array],
    *,
    held_out: bool = True,
    tick: Callable[[], None] | None = None,
) -> Accuracy:
    """Correct every station by the camera that was fitted without its fold, and compare with the scene.

    ``views`` are those of the scene, ``cameras`` are by fold. ``masks`` (H, W) are the pixels of each station
    that count (clean geometry, enough light); ``tick`` is called for each station and may raise to end the
    work.
    """
    corrections = {fold: Correction(camera) for fold, camera in cameras.items()}
    old = Correction(before)
    everyone = any(
        effect.follows_frames for camera in (*cameras.values(), before) for effect in camera.effects.values()
    )
    sums = _Sums(before.shape, per_station=max(1, MOST_SAMPLES // max(len(dataset.stations), 1)))
    poses: set[Key] = set()
    recording = None
    for station, mask in zip(dataset.stations, masks, strict=True):
        if tick is not None:
            tick()
        if station.recording != recording:
            recording = station.recording
            corrections = {fold: Correction(camera) for fold, camera in cameras.items()}
            old = Correction(before)
        key = (station.recording, station.pose)
        frame = _mean_frame(station)
        number = folds.get(key, 0)
        if everyone:
            for fold, correction in corrections.items():
                if fold != number:
                    correction.correct(frame)
        elif not mask.any():
            continue
        new = corrections[number].correct(frame)
        first = old.correct(frame)
        valid = mask & ((new.flags & np.uint8(INVALID.value)) == 0) & np.isfinite(new.distance)
        if not valid.any():
            continue
        poses.add(key)
        camera = cameras[number]
        view = views.view(station, dataset.measured[station.recording, station.placed])
        sums.add(station, view, valid, new.distance, first.distance, new.sigma, camera)
    return sums.accuracy(len(poses), held_out=held_out)


def _mean_frame(station: Station) -> RawFrame:
    saturated = station.saturated > 0
    distance = np.where(saturated, np.nan, station.distance)
    return RawFrame(
        stamp=station.stamp,
        distance=distance,
        amplitude=station.amplitude.astype(np.float64),
        settings=station.settings,
    )


class _Sums:
    def __init__(self, shape: tuple[int, int], *, per_station: int) -> None:
        self._per_station = per_station
        self._squares = np.zeros(5)
        self._rigid = np.zeros(2)
        self._beyond = np.zeros(2)
        self._single: list[float] = []
        self._count = 0
        self._old_count = 0
        self._maps = {
            name: np.zeros(shape) for name in ("before", "after", "after_square", "old_count", "count")
        }
        self._samples: dict[str, list[Array]] = {}

    def add(
        self,
        station: Station,
        view: View,
        valid: Array,
        new: Array,
        old: Array,
        sigma: Array,
        camera: Camera,
    ) -> None:
        truth = view.geometry.distance
        errors = [wrapped(distance - truth, camera) for distance in (station.distance, old, new)]
        with np.errstate(invalid="ignore"):
            expected = sigma / np.sqrt(np.maximum(station.count, 1))
        reference = np.zeros(truth.shape)
        for column in view.pose_columns:
            if not column.path.startswith("scene."):
                reference += (column.prior * column.distance) ** 2
        raw, before, after = errors
        known = valid & np.isfinite(before)
        self._squares += [
            np.sum(raw[valid] ** 2),
            np.sum(before[known] ** 2),
            np.sum(after[valid] ** 2),
            np.sum(expected[valid] ** 2),
            np.sum(reference[valid]),
        ]
        columns = [
            pose_column.distance
            for pose_column in view.pose_columns
            if not pose_column.path.startswith("scene.")
        ]
        rigid = [_without(error, columns, expected, known) for error in (before, after)]
        self._rigid += [float(np.sum(error**2)) for error in rigid]
        known_variance = expected[valid].astype(float) ** 2 + reference[valid]
        weight = known_variance**-2
        self._beyond += [np.sum(weight * (after[valid] ** 2 - known_variance)), np.sum(weight)]
        self._single.append(float(np.median(sigma[valid])))
        self._count += int(valid.sum())
        self._old_count += int(known.sum())
        maps = self._maps
        maps["before"][known] += before[known]
        maps["old_count"][known] += 1
        maps["after"][valid] += after[valid]
        maps["after_square"][valid] += after[valid] ** 2
        maps["count"][valid] += 1
        self._sample(station, view, known, before, after, expected)

    def _sample(
        self, station: Station, view: View, known: Array, before: Array, after: Array, expected: Array
    ) -> None:
        pixels = np.flatnonzero(known.ravel())
        if not pixels.size:
            return
        step = max(1, -(-pixels.size // self._per_station))
        # a changing start, so that no column of the array is preferred
        pixels = pixels[(station.pose * 7919) % step :: step]
        rows, columns = np.unravel_index(pixels, known.shape)
        settings = station.settings
        images = {
            "distance": view.geometry.distance,
            "amplitude": station.amplitude,
            "incidence": view.geometry.incidence,
            "before": before,
            "after": after,
            "expected": expected,
        }
        values: dict[str, Any] = {name: image.ravel()[pixels] for name, image in images.items()}
        values |= {"row": rows, "column": columns}
        values |= {
            "time": station.time,
            "uptime": settings.uptime,
            "temperature": settings.body_temperature,
            "ambient_temperature": settings.ambient_temperature,
            "integration_time": settings.integration_time,
            "pose": station.pose,
            "recording": station.recording,
        }
        for name, value in values.items():
            filled = np.full(pixels.size, np.nan if value is None else value, np.float32)
            self._samples.setdefault(name, []).append(filled)

    def accuracy(self, poses: int, *, held_out: bool) -> Accuracy:
        n = max(self._count, 1)
        counts = np.array([n, max(self._old_count, 1), n, n, n])
        raw, before, after, noise, reference = np.sqrt(self._squares / counts)
        beyond = self._beyond[0] / self._beyond[1] if self._beyond[1] > 0 else 0.0
        with np.errstate(invalid="ignore", divide="ignore"):
            maps = {
                "before": self._maps["before"] / self._maps["old_count"],
                "after": self._maps["after"] / self._maps["count"],
                "rms": np.sqrt(self._maps["after_square"] / self._maps["count"]),
            }
        return Accuracy(
            raw=float(raw),
            before=float(before),
            after=float(after),
            noise=float(noise),
            reference=float(reference),
            systematic=float(np.sqrt(max(beyond, 0.0))),
            single=float(np.median(self._single)) if self._single else float("nan"),
            values=self._count,
            poses=poses,
            held_out=held_out,
            rigid_before=float(np.sqrt(self._rigid[0] / counts[1])),
            rigid_after=float(np.sqrt(self._rigid[1] / counts[1])),
            samples={name: np.concatenate(parts) for name, parts in self._samples.items()},
            maps=maps,
        )


def _without(error: Array, columns: Sequence[Array], sigma: Array, pixels: Array) -> Array:
    """Return the residuals of errors [m] at some pixels after a weighted fit of ``columns``, all (H, W)."""
    rest = error[pixels]
    if not columns or not rest.size:
        return rest
    design = np.nan_to_num(np.stack([column[pixels] for column in columns], axis=1))
    root = 1.0 / np.maximum(sigma[pixels], 1e-6)
    found = np.linalg.lstsq(design * root[:, None], rest * root, rcond=None)[0]
    return np.asarray(rest - design @ found)


def wrapped(difference: Array, camera: Camera) -> Array:
    """Return differences of distances [m], modulo the ambiguity range where the camera wraps."""
    return wrap_residual(difference, camera.sensor.ambiguity) if camera.sensor.wraps else difference
