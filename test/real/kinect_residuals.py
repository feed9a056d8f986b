"""What is in the distances of the Kinect v2's checkerboard: terms added one by one, judged on other frames.

    python -m test.real.kinect_residuals [--picture FILE]

Terms are fitted to frames 0, 2, ... and judged on frames 1, 3, ...: chi-square per value by the noise of
one pixel and RMS, after offset and tilts of each board (a rigid fit). What a term says of each pose alone
is fitted to the pose that is judged, as its offset and tilts are. Pixels are 1.1 px from the edges of
squares at least and 4 px from saturated ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rim_camera_ros.camera_file import load_camera

from .analysis import SQUARE, board_frame, edge_distance, plane_fit
from .kinect_step import FOLDER, frames_of

Array = NDArray[Any]

#: Distance from edges of squares [px] and from saturated pixels [px] of what is judged.
EDGE, _SATURATED = 1.1, 4
#: Neighbours whose light arrives early or late: columns and rows away, to either side alike.
NEIGHBOURS = ((1, 0), (2, 0), (3, 0), (0, 1), (0, 2), (0, 3), (0, 4), (1, 1), (2, 2))
#: Weight of residuals beyond so many standard deviations falls.
_ROBUST = 4.0
#: Pixels inside white squares [px from their edges], which a plane is fitted to, and how many it takes.
_INSIDE, _LEAST = 2.0, 300
#: Points farther from a plane [m] are no part of it.
_FLAT = 0.006


@dataclass(frozen=True)
class Board:
    """One frame, all (H, W): distance beyond the pose that was given [m], amplitude [counts], noise [m].

    ``x``, ``y`` on the board [m]; ``cosine`` of the incidence; ``used`` pixels; ``white`` squares; ``edge``
    [px] from the edge of the square. ``tilt`` [rad] about the image's x and y of the plane through white
    squares against the pose that was given; NaN where too few are seen.
    """

    rest: Array
    distance: Array
    amplitude: Array
    sigma: Array
    x: Array
    y: Array
    cosine: Array
    used: Array
    white: Array
    edge: Array
    tilt: Array


def boards() -> list[Board]:
    """Return all frames of the recording."""
    camera = load_camera(FOLDER / "camera.yaml")
    result = []
    for frame in frames_of(None):
        pose = frame.truth["board"]
        turn = Rotation.from_quat(pose.orientation).as_matrix()
        cosine = np.asarray(camera.rays @ turn[:, 2])
        expected = (np.array(pose.position) @ turn[:, 2]) / cosine
        measured = frame.distance * camera.sensor.lsb
        amplitude = frame.amplitude.astype(float)
        local = board_frame(camera.rays, np.array(pose.position), np.array(pose.orientation))
        edge = edge_distance(local / SQUARE)
        seen = (frame.distance > 0) & (amplitude > 0)
        saturated = (amplitude >= camera.sensor.saturation) | ((frame.distance == 0) & (amplitude > 0))
        size = 2 * _SATURATED + 1
        beside = cv2.dilate(saturated.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        inner = cv2.erode((amplitude > 0).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        white = np.floor(local / SQUARE).sum(axis=-1) % 2 == 0
        shot = np.maximum(amplitude, 1.0)
        inside = seen & white & ~beside & (edge > _INSIDE)
        tilt = np.full(2, np.nan)
        if inside.sum() > _LEAST:
            points = camera.rays[inside] * measured[inside][:, None]
            normal, offset = plane_fit(points)
            normal, _ = plane_fit(points[np.abs(points @ normal - offset) < _FLAT])
            tilt = np.cross(turn[:, 2], normal)[:2]
        result.append(
            Board(
                rest=np.where(seen, measured - expected, np.nan),
                distance=expected,
                amplitude=amplitude,
                sigma=np.sqrt(camera.noise.floor**2 + camera.noise.shot**2 / shot),
                x=local[..., 0] - 2 * SQUARE,
                y=local[..., 1] - 3 * SQUARE,
                cosine=cosine,
                used=seen & ~beside & inner & (edge > EDGE),
                white=white,
                edge=edge,
                tilt=tilt,
            )
        )
    return result


def _neighbours(board: Board, columns: int, rows: int) -> Array:
    """Return the light of the neighbours so far away, in all four directions, over a pixel's own."""
    total = np.zeros(board.amplitude.shape)
    for u, v in {(i * columns, j * rows) for i in (-1, 1) for j in (-1, 1)}:
        total += np.roll(board.amplitude, (v, u), axis=(0, 1))
    return np.asarray(total / np.maximum(board.amplitude, 1))


@dataclass(frozen=True)
class Terms:
    """Which terms there are: offsets of rows, light of neighbours that arrives late, light of each pose."""

    hyperbola: bool = False
    rows: bool = False
    neighbours: bool = False
    stray: bool = False


@dataclass(frozen=True)
class Judged:
    """Chi-square per value and RMS [m] of frames that were not fitted; ``rest`` (H, W) of each of them [m].

    ``weights`` of the light of neighbours [m]; ``rows`` (H,) their offsets [m], 0 where none was seen.
    """

    chi_square: float
    rms: float
    weights: Array
    rows: Array
    rest: list[Array]


def judged(all_boards: Sequence[Board], terms: Terms) -> Judged:
    """Fit terms to even frames and judge them on odd ones."""
    parts = [_design(one, terms) for one in all_boards]
    rows = np.zeros(all_boards[0].rest.shape[0])
    common = np.zeros(parts[0][2].shape[1])
    for _ in range(4 if terms.rows else 1):
        common = _common(parts[::2], [rows[np.nonzero(one.used)[0]] for one in all_boards[::2]], common)
        if not terms.rows:
            break
        total, weight = np.zeros((2, rows.size))
        for one, part in zip(all_boards[::2], parts[::2], strict=True):
            number = np.nonzero(one.used)[0]
            rest = _rest(part, common, rows[number]) + rows[number]
            mine = one.white[one.used]
            total += np.bincount(number[mine], rest[mine] * part[1][mine] ** 2, rows.size)
            weight += np.bincount(number[mine], part[1][mine] ** 2, rows.size)
        rows = total / np.maximum(weight, 1e-9)
    squares, values, images = [], [], []
    for one, part in zip(all_boards[1::2], parts[1::2], strict=True):
        rest = _rest(part, common, rows[np.nonzero(one.used)[0]])
        squares.append(float(np.mean((rest * part[1]) ** 2)))
        values.append(float(np.mean(rest**2)))
        image = np.full(one.rest.shape, np.nan)
        image[one.used] = rest
        images.append(image)
    return Judged(float(np.mean(squares)), float(np.sqrt(np.mean(values))), common, rows, images)


def _design(board: Board, terms: Terms) -> tuple[Array, Array, Array, Array]:
    """Return residuals, roots of weights, columns in common and columns of the pose."""
    used = board.used
    x, y, cosine, amplitude = (one[used] for one in (board.x, board.y, board.cosine, board.amplitude))
    own = [1 / cosine, x / cosine, y / cosine]
    if terms.stray:
        own += [1 / amplitude, x / amplitude, y / amplitude]
    common = [1 / amplitude] if terms.hyperbola else []
    if terms.neighbours:
        common += [_neighbours(board, *one)[used] for one in NEIGHBOURS]
    shape = (int(used.sum()), -1)
    columns = np.stack(common, axis=1) if common else np.zeros((shape[0], 0))
    return board.rest[used], 1 / board.sigma[used], columns, np.stack(own, axis=1).reshape(shape)


def _common(parts: Sequence[Any], offsets: Sequence[Array], before: Array) -> Array:
    """Return the least-squares values of the columns in common, those of poses eliminated."""
    size = before.size
    if size == 0:
        return before
    gram, right = np.zeros((size, size)), np.zeros(size)
    for (rest, root, common, own), offset in zip(parts, offsets, strict=True):
        basis, _ = np.linalg.qr(own * root[:, None])
        seen, columns = (rest - offset) * root, common * root[:, None]
        seen, columns = seen - basis @ (basis.T @ seen), columns - basis @ (basis.T @ columns)
        weight = 1 / np.maximum(np.abs(seen) / _ROBUST, 1.0)
        gram += columns.T @ (columns * weight[:, None])
        right += columns.T @ (seen * weight)
    return np.asarray(np.linalg.solve(gram, right))


def _rest(part: Any, common: Array, offset: Array) -> Array:
    rest, root, columns, own = part
    rest = rest - columns @ common - offset
    return np.asarray(rest - own @ np.linalg.lstsq(own * root[:, None], rest * root, rcond=None)[0])


STEPS = {
    "offset and tilts of each board": Terms(),
    "a / A, the same in all frames": Terms(hyperbola=True),
    "offsets of rows": Terms(rows=True),
    "rows, a / A": Terms(hyperbola=True, rows=True),
    "rows, a / A, late light of neighbours": Terms(hyperbola=True, rows=True, neighbours=True),
    "rows, light of each pose": Terms(rows=True, stray=True),
    "rows, light of each pose, late light of neighbours": Terms(rows=True, neighbours=True, stray=True),
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--picture", type=Path, help="write residual images of four frames")
    given = parser.parse_args(arguments)
    found = boards()
    tilts = np.array([one.tilt for one in found if np.isfinite(one.tilt).all()])
    print(
        f"tilt of planes against poses [mrad]: median {np.median(tilts, axis=0) * 1e3}, {len(tilts)} boards"
    )
    results = {}
    for name, terms in STEPS.items():
        results[name] = one = judged(found, terms)
        weights = np.round(one.weights * 1e3, 2)
        print(f"  {name:52s} chi-square {one.chi_square:5.2f}  RMS {one.rms * 1e3:5.2f} mm  {weights}")
    if given.picture is not None:
        picture(found, results, given.picture)


def picture(found: Sequence[Board], results: dict[str, Judged], path: Path) -> None:
    """Draw the residual images of four judged frames, after the first step and after the last."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    first, last = (list(results.values())[k].rest for k in (0, -1))
    figure, axes = plt.subplots(2, 4, figsize=(12, 6.4), layout="constrained")
    for column, number in enumerate((13, 49, 29, 57)):
        lit = found[number].amplitude > 0
        rows, columns = np.nonzero(lit)
        part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
        for axis, image in zip(axes[:, column], (first, last), strict=True):
            shown = axis.imshow(image[number // 2][part] * 1e3, vmin=-20, vmax=20, cmap="RdBu_r")
            axis.set_xticks([])
            axis.set_yticks([])
        axes[0, column].set_title(f"frame {number}")
    axes[0, 0].set_ylabel("offset and tilts")
    axes[1, 0].set_ylabel("all terms")
    figure.colorbar(shown, ax=axes, label="mm")
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    main()
