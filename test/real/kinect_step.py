"""Black-to-white steps of the Kinect v2's checkerboard on the poses that a camera file was not fitted to.

    python -m test.real.kinect_step --write even even_bag       # frames 0, 2, ... as a recording of their own
    rim calibrate even_bag --camera .../camera.yaml --scene .../scene.yaml --out even.yaml --effects ...
    python -m test.real.kinect_step even.yaml                   # judged on frames 1, 3, ...

A step is the median distance of the interior of a black square beyond the plane through the interiors of the
white ones of its frame, all corrected by the camera file; classes are by the amplitude of the black square.

Within 3 px of the edge to a white square, black pixels of this camera are measured up to 18 mm too far.
Squares are 8 px wide where the board is far, and dark, so that the inner 0.56 of them has such pixels: it is
judged with and without (``--margin``).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.pipeline.correct import Correction

from .analysis import BLACK_STEPS, black_squares

Array = NDArray[Any]

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "recordings" / "kinect2_checkerboard"
#: First frame of every second one.
HALVES = {"even": 0, "odd": 1}
#: Squares that a class needs to be judged, and the step [m] that it may show.
LEAST_SQUARES = 100
LIMIT = 0.0015
#: Width of the zone beside edges [px], and pixels that a square needs inside it.
MARGIN = 3.0
LEAST_PIXELS = 4
_DRAWS = 400


@dataclass(frozen=True)
class Class:
    """Steps of the black squares of one range of amplitudes [counts].

    ``median`` and ``sigma`` [m]: the latter of the median, by drawing whole poses anew, because squares of
    one pose share its errors. ``squares`` and ``poses`` in the class.
    """

    low: float
    high: float
    median: float
    sigma: float
    squares: int
    poses: int


def frames_of(half: str | None, folder: Path = FOLDER) -> Iterator[RawFrame]:
    """Yield the frames of one of `HALVES`, of the whole recording for None."""
    with Recording(folder / "recording") as bag:
        for number, frame in enumerate(bag.frames()):
            if half is None or number % 2 == HALVES[half]:
                yield frame


def write_half(half: str, path: Path, folder: Path = FOLDER) -> None:
    """Write one of `HALVES` as a recording. Raises `InputError` where ``path`` exists."""
    with RecordingWriter(path) as writer:
        for frame in frames_of(half, folder):
            writer.write_raw(frame)


def steps(camera: Camera, frames: Iterator[RawFrame], *, margin: float = 0.0) -> tuple[Array, Array, Array]:
    """Return amplitude [counts], step [m] and pose number of each black square (N,), corrected by a camera.

    Pixels are ``margin`` [px] from edges of squares at least. Amplitudes are those measured, so that every
    camera is judged by the same classes.
    """
    correction = Correction(camera)
    amplitudes, found, poses = [], [], []
    for number, frame in enumerate(frames):
        pose = frame.truth["board"]
        corrected = correction.cloud(correction.correct(frame)).copy()
        corrected[..., 3] = frame.amplitude
        board = (corrected, np.array(pose.position), np.array(pose.orientation))
        amplitude, step = black_squares([board], margin=margin, least=6 if margin == 0 else LEAST_PIXELS)
        amplitudes.append(amplitude)
        found.append(step)
        poses.append(np.full(len(step), number))
    return np.concatenate(amplitudes), np.concatenate(found), np.concatenate(poses)


def classes(amplitude: Array, step: Array, pose: Array, *, seed: int = 0) -> list[Class]:
    """Return the steps by class of amplitude: squares (N,) with amplitude [counts], step [m], pose number."""
    random = np.random.default_rng(seed)
    result = []
    for low, high, _ in BLACK_STEPS:
        mine = (amplitude >= low) & (amplitude < high)
        if not mine.any():
            continue
        groups = [step[mine & (pose == one)] for one in np.unique(pose[mine])]
        drawn = [
            np.median(np.concatenate([groups[i] for i in random.integers(0, len(groups), len(groups))]))
            for _ in range(_DRAWS)
        ]
        result.append(
            Class(low, high, float(np.median(step[mine])), float(np.std(drawn)), int(mine.sum()), len(groups))
        )
    return result


def table(found: Sequence[Class]) -> str:
    """Return the classes as lines of text, those that are judged with their verdict."""
    lines = ["  counts          step   +- of poses  squares  poses   [mm]"]
    for one in found:
        verdict = ""
        if one.squares >= LEAST_SQUARES:
            verdict = "met" if abs(one.median) < LIMIT else "MISSED"
        lines.append(
            f"  {one.low:4.0f}-{one.high:4.0f}  {one.median * 1e3:+10.1f}  {one.sigma * 1e3:10.1f}"
            f"  {one.squares:8d} {one.poses:6d}   {verdict}"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("camera", nargs="?", type=Path, help="camera file that is judged (default: the raw)")
    parser.add_argument("--poses", choices=[*HALVES, "all"], default="odd", help="poses that judge")
    parser.add_argument("--margin", type=float, help=f"distance from edges [px] (default: 0 and {MARGIN:g})")
    parser.add_argument("--write", nargs=2, metavar=("HALF", "BAG"), help="write a half as a recording")
    given = parser.parse_args(arguments)
    if given.write is not None:
        write_half(given.write[0], Path(given.write[1]))
        return
    camera = load_camera(given.camera if given.camera is not None else FOLDER / "camera.yaml")
    half = None if given.poses == "all" else given.poses
    for margin in (0.0, MARGIN) if given.margin is None else (given.margin,):
        print(f"pixels at least {margin:g} px from edges of squares:")
        print(table(classes(*steps(camera, frames_of(half), margin=margin))))


if __name__ == "__main__":
    main()
