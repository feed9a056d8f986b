"""Ordinary imperfections put into a recording of a board: what does a diagnosis say of them?

`python -m test.blind.ordinary FOLDER --surface board --out DIR` takes FOLDER/recording with camera.yaml and
scene.yaml, puts one imperfection at a time into it, diagnoses each, and prints one line each: nothing of this
is physics of the camera. The recording itself should be one in which nothing is missing.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects.base import DistanceTerm
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.frame import Pose, RawFrame
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import Surface, load_scene

from .imperfect.__main__ import ROOT, diagnose

Array = NDArray[Any]
_SEED = 20261129


@dataclass(frozen=True)
class View:
    """One frame with what it sees of the board: coordinates from -1 to 1 (H, W), cosines of incidence.

    ``on`` marks the pixels that see the board. ``pose`` numbers the poses, ``in_pose`` the frames of a pose;
    ``rng`` is of this frame, ``surface`` the name of the board.
    """

    frame: RawFrame
    camera: Camera
    x: Array
    y: Array
    on: NDArray[np.bool_]
    along: Array
    pose: int
    in_pose: int
    rng: np.random.Generator
    surface: str

    @property
    def away(self) -> NDArray[np.bool_]:
        """The pixels that are more than one pixel away from the board."""
        return np.asarray(cv2.dilate(self.on.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)

    def moved(self, metres: Array) -> RawFrame:
        """Return the frame with distances changed [m]; whole counts are rounded with a dither."""
        counts = self.frame.distance.astype(float) + np.nan_to_num(metres) / self.camera.sensor.lsb
        dithered = np.round(counts + self.rng.uniform(-0.5, 0.5, counts.shape))
        seen = (self.frame.distance > 0) & (metres != 0)
        kept = np.where(seen, np.clip(dithered, 1, 65535), self.frame.distance)
        return replace(self.frame, distance=kept.astype(self.frame.distance.dtype))

    def displaced(self, metres: Array) -> RawFrame:
        """Return the frame with surfaces moved along the rays [m]: their light follows the distance."""
        distance = np.maximum(self.frame.distance * self.camera.sensor.lsb, 0.1)
        return replace(self, frame=self.dimmed((distance / (distance + metres)) ** 2)).moved(metres)

    def dimmed(self, share: Array) -> RawFrame:
        """Return the frame with a share of its light (H, W): its noise and its terms over the amplitude."""
        before = np.maximum(self.frame.amplitude.astype(float), 1.0)
        distance = self.frame.distance * self.camera.sensor.lsb
        context = Context(replace(self.camera, effects={}), self.frame.settings, stamp=self.frame.stamp)
        change = np.zeros(before.shape)
        for effect in self.camera.effects.values():
            if isinstance(effect, DistanceTerm) and "amplitude" in effect.own_covariates():
                dim, bright = (
                    effect.simulate(Signal(distance, light), context) for light in (before * share, before)
                )
                change += np.nan_to_num(dim.measured - bright.measured)
        sigma = self.camera.noise.sigma_distance
        more = np.maximum(sigma(before * share) ** 2 - sigma(before) ** 2, 0.0)
        noisier = self.moved(change + np.sqrt(more) * self.rng.standard_normal(before.shape))
        return replace(noisier, amplitude=np.round(before * share).astype(self.frame.amplitude.dtype))


def _bow(metres: float) -> Callable[[View], RawFrame]:
    def changed(view: View) -> RawFrame:
        height = metres * (1 - (view.x**2 + view.y**2) / 2)
        return view.displaced(np.where(view.on, height / view.along, 0.0))

    return changed


def _stuck(view: View) -> RawFrame:
    rng = np.random.default_rng(_SEED)
    stuck = rng.random(view.on.shape) < 0.002
    distance = view.frame.distance.copy()
    distance[stuck] = rng.integers(500, 4000, int(stuck.sum()))
    return replace(view.frame, distance=distance)


def _noisy(view: View) -> RawFrame:
    noisy = np.random.default_rng(_SEED + 1).random(view.on.shape) < 0.002
    return view.moved(np.where(noisy, 0.3 * view.rng.standard_normal(noisy.shape), 0.0))


def _hand(share: float) -> Callable[[View], RawFrame]:
    """A hand 0.1 m before an edge of the board, over a share of it, elsewhere in each pose."""

    def changed(view: View) -> RawFrame:
        rng = np.random.default_rng([_SEED, view.pose])
        side, at, width = rng.integers(4), rng.uniform(-0.6, 0.6), 2 * np.sqrt(share)
        across, beside = [(view.x, view.y), (view.y, view.x), (-view.x, view.y), (-view.y, view.x)][side]
        covered = view.on & (across > 1 - width) & (np.abs(beside - at) < width / 2)
        moved = view.moved(np.where(covered, -0.1, 0.0))
        skin = (
            0.8
            * np.median(view.frame.amplitude[view.on])
            * (1 + 0.05 * view.rng.standard_normal(view.on.shape))
        )
        amplitude = np.where(covered, np.round(skin), moved.amplitude)
        return replace(moved, amplitude=amplitude.astype(moved.amplitude.dtype))

    return changed


def _dust(view: View) -> RawFrame:
    height, width = view.on.shape
    v, u = np.mgrid[:height, :width]
    radius = width / 15
    return view.dimmed(
        1 - 0.15 * np.exp(-((u - 0.35 * width) ** 2 + (v - 0.6 * height) ** 2) / 2 / radius**2)
    )


def _power(view: View) -> RawFrame:
    gain = 1 + 0.03 * np.random.default_rng([_SEED, view.pose]).standard_normal()
    amplitude = np.round(view.frame.amplitude * gain)
    return replace(view.frame, amplitude=amplitude.astype(view.frame.amplitude.dtype))


def _cable(view: View) -> RawFrame:
    """A dark cable, 2.5 px wide, 0.15 m before the board, across the image; elsewhere in each pose."""
    rng = np.random.default_rng([_SEED, 7, view.pose])
    height, width = view.on.shape
    v, u = np.mgrid[:height, :width]
    slope = rng.uniform(-0.4, 0.4)
    from_cable = np.abs(u - rng.uniform(0.3, 0.7) * width - slope * (v - height / 2)) / np.hypot(1, slope)
    covered = view.on & (from_cable < 1.25)
    moved = view.moved(np.where(covered, -0.15, 0.0))
    dark = np.round(0.3 * np.median(view.frame.amplitude[view.on]))
    return replace(moved, amplitude=np.where(covered, dark, moved.amplitude).astype(moved.amplitude.dtype))


def _label(view: View) -> RawFrame:
    """A label of half the reflectivity on the board."""
    label = view.on & (np.abs(view.x - 0.3) < 0.15) & (np.abs(view.y + 0.2) < 0.12)
    return view.dimmed(np.where(label, 0.5, 1.0))


def _rim(view: View) -> RawFrame:
    """A frame around the board, 15 mm wide of 500, 4 mm high and bright."""
    rim = view.on & ((np.abs(view.x) > 0.97) | (np.abs(view.y) > 0.96))
    brighter = replace(view, frame=view.dimmed(np.where(rim, 1.3, 1.0)))
    return brighter.displaced(np.where(rim, -0.004 / view.along, 0.0))


def _millimetres(view: View) -> RawFrame:
    count = view.camera.sensor.lsb
    whole = np.round(np.round(view.frame.distance * count, 3) / count)
    return replace(view.frame, distance=whole.astype(view.frame.distance.dtype))


def _eight_bits(view: View) -> RawFrame:
    step = 3000.0 / 255
    whole = np.round(np.round(view.frame.amplitude / step) * step)
    return replace(view.frame, amplitude=whole.astype(view.frame.amplitude.dtype))


def _dropouts(view: View) -> RawFrame:
    lost = view.rng.random(view.on.shape) < 0.01
    distance, amplitude = (np.where(lost, 0, x) for x in (view.frame.distance, view.frame.amplitude))
    return replace(
        view.frame,
        distance=distance.astype(view.frame.distance.dtype),
        amplitude=amplitude.astype(view.frame.amplitude.dtype),
    )


def _median_filter(view: View) -> RawFrame:
    """The driver's median of 3 x 3 distances."""
    filtered = cv2.medianBlur(view.frame.distance.astype(np.uint16), 3)
    return replace(view.frame, distance=filtered.astype(view.frame.distance.dtype))


def _pose_off(view: View) -> RawFrame:
    """The board of one pose stands 10 mm nearer than it was measured."""
    return view.displaced(np.where(view.on & (view.pose == 6), -0.01 / view.along, 0.0))


def _moved_within(view: View) -> RawFrame:
    """The board of two poses moves by 4 mm before the last frame."""
    late = view.pose in (4, 11) and view.in_pose >= 2
    return view.displaced(np.where(view.on & late, 0.004 / view.along, 0.0))


def _passer_by(view: View) -> RawFrame:
    """Somebody before the wall in a quarter of the poses, 0.5 m nearer."""
    height, width = view.on.shape
    rng = np.random.default_rng([_SEED, 8, view.pose])
    left = rng.uniform(0.0, 0.85) * width
    u = np.broadcast_to(np.arange(width), (height, width))
    person = view.away & (u > left) & (u < left + 0.12 * width) & (view.pose % 4 == 1)
    moved = view.moved(np.where(person, -0.5, 0.0))
    cloth = np.round(0.4 * np.median(view.frame.amplitude) * (1 + 0.1 * view.rng.standard_normal(u.shape)))
    return replace(moved, amplitude=np.where(person, cloth, moved.amplitude).astype(moved.amplitude.dtype))


def _furniture(view: View) -> RawFrame:
    """A box before the wall in all poses, 0.4 m deep, that the scene file does not have."""
    height, width = view.on.shape
    v, u = np.mgrid[:height, :width]
    box = view.away & (u > 0.05 * width) & (u < 0.2 * width) & (v > 0.7 * height)
    moved = view.moved(np.where(box, -0.4, 0.0))
    wood = np.round(0.8 * np.median(view.frame.amplitude) * np.ones(u.shape))
    return replace(moved, amplitude=np.where(box, wood, moved.amplitude).astype(moved.amplitude.dtype))


def _shade(view: View) -> RawFrame:
    """The housing shades a corner: 40 % less light, over a tenth of the array."""
    height, width = view.on.shape
    v, u = np.mgrid[:height, :width]
    from_corner = np.hypot(u / width, v / height)
    return view.dimmed(1 - 0.4 / (1 + np.exp((from_corner - 0.35) / 0.04)))


def _poses_err(view: View) -> RawFrame:
    """The poses of the board err by 3 mm and 1.8 mrad (1-sigma), whatever is stated."""
    rng = np.random.default_rng([_SEED, 9, view.pose])
    name, placed = view.surface, view.frame.truth[view.surface]
    turn = Rotation.from_quat(placed.orientation) * Rotation.from_rotvec(0.0018 * rng.standard_normal(3))
    moved = Pose(
        tuple((np.array(placed.position) + 0.003 * rng.standard_normal(3)).tolist()),
        tuple(turn.as_quat().tolist()),
    )
    return replace(view.frame, truth={**view.frame.truth, name: moved})


IMPERFECTIONS: Mapping[str, Callable[[View], RawFrame]] = {
    "a board that bows by 2 mm": _bow(0.002),
    "a board that bows by 5 mm": _bow(0.005),
    "0.2 % of the pixels stuck": _stuck,
    "0.2 % of the pixels noisy (0.3 m)": _noisy,
    "a hand over 1 % of the board": _hand(0.01),
    "a hand over 3 % of the board": _hand(0.03),
    "a hand over 8 % of the board": _hand(0.08),
    "dust that takes 15 % of the light": _dust,
    "power that differs by 3 % from pose to pose": _power,
    "a cable of 2.5 px before the board": _cable,
    "a label on the board, of half the light": _label,
    "a frame around the board, 4 mm high": _rim,
    "distances in whole millimetres": _millimetres,
    "amplitudes of 8 bits": _eight_bits,
    "1 % of the pixels of each frame drop out": _dropouts,
    "a median of 3 x 3 distances in the driver": _median_filter,
    "the board of one pose 10 mm nearer": _pose_off,
    "the board of two poses moves by 4 mm": _moved_within,
    "a passer-by before the wall in 5 poses": _passer_by,
    "furniture before the wall in all poses": _furniture,
    "a corner that the housing shades by 40 %": _shade,
    "poses that err by 3 mm and 1.8 mrad": _poses_err,
}


def views(frames: Sequence[RawFrame], surface: Surface, camera: Camera) -> list[View]:
    """Return the frames with what they see of a rectangle, whatever stands before it."""
    assert surface.half_extent is not None
    result: list[View] = []
    pose, in_pose, last = -1, 0, None
    for number, frame in enumerate(frames):
        placed = frame.truth[surface.name]
        if placed != last:
            pose, in_pose, last = pose + 1, 0, placed
        else:
            in_pose += 1
        rotation, position = rotation_matrix(placed.orientation), np.array(placed.position)
        along = camera.rays @ rotation[:, 2]
        length = (position @ rotation[:, 2]) / along
        local = (length[..., None] * camera.rays - position) @ rotation
        x, y = (local[..., axis] / surface.half_extent[axis] for axis in (0, 1))
        on = (np.abs(x) < 1) & (np.abs(y) < 1) & (length > 0) & (frame.distance > 0)
        rng = np.random.default_rng([_SEED, number])
        result.append(View(frame, camera, x, y, on, np.abs(along), pose, in_pose, rng, surface.name))
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Put imperfections in, diagnose, and print what is said."""
    parser = argparse.ArgumentParser(
        prog="python -m test.blind.ordinary", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("folder", type=Path, help="folder with recording, camera.yaml and scene.yaml")
    parser.add_argument("--surface", default="board", help="name of a rectangle of the scene (board)")
    parser.add_argument("--out", type=Path, required=True, help="folder for recordings and reports")
    parser.add_argument("--only", help="numbers of imperfections, comma-separated (all)")
    parser.add_argument("--package", type=Path, default=ROOT, help="checkout whose rim is run (this one)")
    given = parser.parse_args(arguments)
    camera = load_camera(given.folder / "camera.yaml")
    scene = load_scene(given.folder / "scene.yaml")
    surface = next(one for one in scene.surfaces if one.name == given.surface)
    with Recording(given.folder / "recording") as bag:
        frames = list(bag.frames())
    only = {int(word) for word in given.only.split(",")} if given.only else range(len(IMPERFECTIONS))
    for number, (name, change) in enumerate(IMPERFECTIONS.items()):
        if number not in only:
            continue
        folder = given.out / f"{number}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for one in (given.folder / "camera.yaml", given.folder / "scene.yaml", *given.folder.glob("*.npy")):
            shutil.copy(one, folder)
        with RecordingWriter(folder / "recording") as writer:
            for view in views(frames, surface, camera):
                writer.write_raw(change(view))
        report, error, seconds = diagnose(folder, folder / "diagnosis", given.package)
        said = str(error) if report is None else report["verdict"]
        if report is not None:
            said += "".join(f", {one['effect']}" for one in report["missing"])
        print(f"{name:45s} {said:40s} {seconds:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
