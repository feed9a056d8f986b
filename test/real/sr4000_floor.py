"""What the frames of an SR4000 over a floor show that a calibration was not fitted to.

    sr4000_floor_to_bag.py DATA FOLDER given                    # the recording; see the page of recordings
    python -m test.real.sr4000_floor FOLDER --write even even_bag
    rim calibrate even_bag --camera FOLDER/camera.yaml --scene FOLDER/scene.yaml --out even.yaml
    python -m test.real.sr4000_floor FOLDER even.yaml           # judged on frames 1, 3, ...

The floor is flat, and nothing else is known of it: the truth of each frame is the plane through it as
corrected. Judged is what a plane cannot take on. Pixels are classed by the distance of that plane, not by the
one that they measured: in a class of *measured* distances those that read too far are nearer than the others
and so brighter, and noise alone makes a slope over the amplitude, some 15 mm per ln(A) at 2.2 m.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.pipeline.correct import Correction

Array = NDArray[Any]

#: First frame of every second one.
HALVES = {"even": 0, "odd": 1}
#: Distances [m] of the bins, and values that one needs; distances of the classes of slopes.
BINS = np.arange(0.9, 3.1, 0.2)
LEAST_VALUES = 5000
SLOPES = ((1.2, 1.6), (1.6, 2.0), (2.0, 2.4), (2.4, 2.8))
#: Distances of one cell, within which slopes are looked at [m], and looks of a pixel in either half.
_CELL, _LOOKS = 0.02, 5
_NOISE = (0.002, 0.17, 9.0)
#: Residuals count no more than this [m].
_WILD = 0.06


@dataclass(frozen=True)
class Judged:
    """Errors of corrected distances relative to the plane of each frame, lengths in m.

    ``rms`` of all; ``pattern`` of what pixels have of their own, and ``rough`` of what their neighbours do
    not have, both less their noise; ``bins`` the mean of each range of distances with its number of values;
    ``slopes`` the change per ln(A) by range of distance.
    """

    rms: float
    pattern: float
    rough: float
    bins: dict[float, tuple[float, int]]
    slopes: dict[tuple[float, float], float]

    @property
    def worst_bin(self) -> float:
        """The largest mean of a range of distances, in size."""
        return max((one for one, _ in self.bins.values()), key=abs)


def frames_of(half: str | None, folder: Path) -> Iterator[RawFrame]:
    """Yield the frames of one of `HALVES`, of the whole recording for None."""
    with Recording(folder / "recording") as bag:
        for number, frame in enumerate(bag.frames()):
            if half is None or number % 2 == HALVES[half]:
                yield frame


def write_half(half: str, path: Path, folder: Path) -> None:
    """Write one of `HALVES` as a recording. Raises `InputError` where ``path`` exists."""
    with RecordingWriter(path) as writer:
        for frame in frames_of(half, folder):
            writer.write_raw(frame)


def judged(camera: Camera, frames: Iterator[RawFrame]) -> Judged:
    """Correct frames by a camera and judge what planes through them leave."""
    correction = Correction(camera)
    parts = []
    for number, frame in enumerate(frames):
        distance = correction.correct(frame).distance.astype(float)
        seen = np.isfinite(distance) & (frame.amplitude > 0) & (frame.distance > 0)
        amplitude = frame.amplitude[seen].astype(float)
        truth = _on_plane(camera.rays[seen], distance[seen], amplitude)
        rest = np.clip(distance[seen] - truth, -_WILD, _WILD)
        parts.append(np.c_[np.full(rest.size, number), np.flatnonzero(seen), truth, amplitude, rest])
    return _judged(np.concatenate(parts), camera.shape)


def _on_plane(rays: Array, distance: Array, amplitude: Array) -> Array:
    """Return the distances along rays (N, 3) to the plane through the points, weighted by their noise."""
    floor, shot, dark = _NOISE
    weight = 1.0 / (floor**2 + shot**2 / amplitude + (dark / amplitude) ** 2)
    points, kept = rays * distance[:, None], np.ones(len(distance), bool)
    expected = distance
    for _ in range(5):
        centre = np.average(points[kept], axis=0, weights=weight[kept])
        axes = np.linalg.svd((points[kept] - centre) * np.sqrt(weight[kept])[:, None], full_matrices=False)[2]
        expected = (centre @ axes[2]) / (rays @ axes[2])
        rest = np.abs(distance - expected)
        kept = rest < 5 * 1.4826 * np.median(rest) + 0.005
    return np.asarray(expected)


def _judged(values: Array, shape: tuple[int, int]) -> Judged:
    frame, pixel, distance, _, rest = values.T
    pixel = pixel.astype(int)
    bins = {}
    for low in BINS.tolist():
        mine = (distance >= low) & (distance < low + 0.2)
        if mine.sum() >= LEAST_VALUES:
            bins[round(low, 1)] = (float(rest[mine].mean()), int(mine.sum()))
    halves = []
    for half in (0, 1):
        mine = frame % 2 == half
        count = np.bincount(pixel[mine], minlength=shape[0] * shape[1])
        total = np.bincount(pixel[mine], rest[mine], minlength=shape[0] * shape[1])
        halves.append(np.where(count >= _LOOKS, total / np.maximum(count, 1), np.nan).reshape(shape))
    return Judged(
        rms=float(np.sqrt(np.mean(rest**2))),
        pattern=_in_common(*halves),
        rough=_in_common(*(one - _smooth(one) for one in halves)),
        bins=bins,
        slopes={
            limits: _slope(values[(distance >= limits[0]) & (distance < limits[1])]) for limits in SLOPES
        },
    )


def _in_common(first: Array, second: Array) -> float:
    """Return the RMS of what two images have in common: their noise is not."""
    seen = np.isfinite(first) & np.isfinite(second)
    return float(np.sqrt(max(np.mean(first[seen] * second[seen]), 0.0)))


def _smooth(image: Array) -> Array:
    known = np.isfinite(image)
    weight = cv2.blur(known.astype(float), (7, 7))
    return np.asarray(cv2.blur(np.where(known, image, 0.0), (7, 7)) / np.maximum(weight, 1e-9))


def _slope(values: Array) -> float:
    """Return the change of the rest [m] per ln(A) within cells of one frame and one distance."""
    frame, _, distance, amplitude, rest = values.T
    cell = np.unique(frame * 1000 + np.floor(distance / _CELL), return_inverse=True)[1]
    number = np.bincount(cell)

    def within(one: Array) -> Array:
        return np.asarray(one - (np.bincount(cell, one) / number)[cell])

    x, y = within(np.log(amplitude)), within(rest)
    large = number[cell] >= 10
    return float((x[large] @ y[large]) / (x[large] @ x[large]))


def table(one: Judged) -> str:
    """Return the figures as lines of text, in mm."""
    bins = "  ".join(f"{low:.1f}: {mean * 1e3:+.1f}" for low, (mean, _) in one.bins.items())
    slopes = "  ".join(f"{low}-{high}: {value * 1e3:+.1f}" for (low, high), value in one.slopes.items())
    return (
        f"  RMS {one.rms * 1e3:.2f}, of pixels {one.pattern * 1e3:.2f}, "
        f"beside their neighbours {one.rough * 1e3:.2f}\n"
        f"  by distance [m]  {bins}\n  per ln(A)  {slopes}   [mm]"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path, help="folder of the recording with its camera.yaml")
    parser.add_argument("cameras", nargs="*", type=Path, help="camera files that are judged")
    parser.add_argument("--frames", choices=[*HALVES, "all"], default="odd", help="frames that judge")
    parser.add_argument("--write", nargs=2, metavar=("HALF", "BAG"), help="write a half as a recording")
    given = parser.parse_args(arguments)
    if given.write is not None:
        write_half(given.write[0], Path(given.write[1]), given.folder)
        return
    half = None if given.frames == "all" else given.frames
    for path in (given.folder / "camera.yaml", *given.cameras):
        print(path)
        print(table(judged(load_camera(path), frames_of(half, given.folder))))


if __name__ == "__main__":
    main()
