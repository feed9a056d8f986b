"""Observations of a target field from recorded frames: targets of the scene file, found in the images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose, RawFrame
from rim_camera_ros.geometry import see
from rim_camera_ros.optics import project
from rim_camera_ros.photogrammetry.checkerboards import Corner, refine_corners
from rim_camera_ros.photogrammetry.circles import Ellipse, find_circles
from rim_camera_ros.photogrammetry.projection import ellipse_centre_offset
from rim_camera_ros.photogrammetry.sampling import (
    POINT_VARIANCE,
    SHORT_WAVES,
    sampling_variance,
    shifts_of_edges,
)
from rim_camera_ros.photogrammetry.scene_field import FieldOnSurfaces
from rim_camera_ros.photogrammetry.targets import ImagePoint, Observations
from rim_camera_ros.rotations import quaternion
from rim_camera_ros.scene import Scene

Array = NDArray[np.float64]

#: Targets must be found within this many px of where they are expected, and within this share of the
#: distance to the next target.
DEFAULT_GATE = 6.0
_GATE_SHARE = 0.4
#: A found ellipse may be larger or smaller than the expected one by this factor.
_SIZE_FACTOR = 1.6
#: Least long axis in px of a circle that is looked for.
_SMALLEST = 4.0
#: Largest departure in m of the recorded poses from one rigid field.
_RIGID = 0.02
#: Number of points on the rim of a circle at which it is looked whether it is in view.
_RIM = 8


def observe(
    frames: Iterable[RawFrame],
    camera: Camera,
    scene: Scene,
    *,
    gate: float = DEFAULT_GATE,
    reference: Array | None = None,
) -> Observations:
    """Find the targets of a scene in recorded frames.

    ``frames``: as of `Recording.frames`. Consecutive frames with the same truth poses are one station, and
    their amplitudes are averaged. ``scene`` describes the field, see `FieldOnSurfaces.from_scene`. Places of
    targets are predicted from the recorded poses and the optics of ``camera``; a target is the nearest that
    is found within ``gate`` px. ``reference``: amplitude image (H, W) of the empty background, see
    `circles.homogenise`. The recorded poses only serve as approximate values.

    Raises `InputError` where the scene has no targets, no frame has a pose of them, their poses do not
    belong to one rigid field, or the frames do not have the size of the camera's images.
    """
    if not gate > 0:
        raise InputError(f"gate is {gate:g} px", place="gate", remedy="it must be positive")
    field: FieldOnSurfaces | None = None
    seen: list[tuple[str, int, _Found]] = []
    poses: dict[int, Pose] = {}
    missed: Counter[str] = Counter()
    without = 0
    for view in _views(frames, camera):
        if any(name not in view.truth for name in scene.needs_truth):
            without += 1
            continue
        field = field or FieldOnSurfaces.from_scene(scene, view.truth)
        station = len(poses)
        # the recorded poses say where everything was, the scene file what it looks like
        there = scene.poses_for(view.truth)
        there |= {name: pose for name, pose in view.truth.items() if name in there}
        rotation, translation, misfit = field.pose(there)
        if misfit > _RIGID:
            raise InputError(
                f"the poses of the targets at station {station} depart by {misfit * 1000:.0f} mm "
                "from one rigid field",
                place="surfaces",
                remedy="only surfaces that move together may be targets",
            )
        poses[station] = Pose(
            (float(translation[0]), float(translation[1]), float(translation[2])), quaternion(rotation)
        )
        expected = _expected(field, rotation, translation, camera, scene, there)
        found = _circles(expected, view, gate, reference) | _corners(expected, view, gate)
        saturated = {name for name, one in found.items() if _near_saturated(view, one)}
        missed["not found"] += len(expected.names) - len(found)
        missed["saturated"] += len(saturated)
        seen += [(name, station, one) for name, one in found.items() if name not in saturated]
    if field is None:
        raise InputError(
            "no frame has the poses of the scene's targets",
            place="frames",
            remedy="record /ground_truth/<surface>/pose of each surface with pose: truth",
        )
    points, coarse = _with_sampling(seen)
    notes = coarse + [
        f"{count} targets in view {reason}" for reason, count in sorted(missed.items()) if count
    ]
    if without:
        notes.append(f"{without} stations without the poses of all targets excluded")
    return Observations(field.field, tuple(points), poses, tuple(notes))


# --- images ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _View:
    """One station: recorded poses, mean amplitude (H, W), NaN where there is none, and saturated pixels."""

    truth: Mapping[str, Pose]
    amplitude: Array
    saturated: NDArray[np.bool_]


def _views(frames: Iterable[RawFrame], camera: Camera) -> Iterator[_View]:
    """Yield the stations, each when its last frame is read."""
    gathered: list[RawFrame] = []
    total, number, saturated = (np.zeros(camera.shape) for _ in range(3))

    def view() -> _View:
        mean = np.where(number > 0, total / np.maximum(number, 1), np.nan)
        return _View(gathered[0].truth, mean, saturated > 0)

    for frame in frames:
        if frame.shape != camera.shape:
            raise InputError(
                f"the frames have {frame.shape[1]} x {frame.shape[0]} px, "
                f"the camera {camera.shape[1]} x {camera.shape[0]}",
                place="frames",
                remedy="give the camera file that belongs to the recording",
            )
        if gathered and frame.pose_stamps != gathered[0].pose_stamps:
            yield view()
            gathered = []
            total, number, saturated = (np.zeros(camera.shape) for _ in range(3))
        gathered = gathered or [frame]
        amplitude = np.asarray(frame.amplitude, dtype=np.float64)
        total += np.nan_to_num(amplitude)
        number += np.isfinite(amplitude)
        saturated += amplitude >= camera.sensor.saturation
    if gathered:
        yield view()


def _near_saturated(view: _View, found: _Found) -> bool:
    u, v, (reach_u, reach_v) = found.place.u, found.place.v, found.reach
    rows = slice(max(round(v - reach_v), 0), round(v + reach_v) + 1)
    columns = slice(max(round(u - reach_u), 0), round(u + reach_u) + 1)
    return bool(view.saturated[rows, columns].any())


def _with_sampling(seen: Sequence[tuple[str, int, _Found]]) -> tuple[list[ImagePoint], list[str]]:
    """Return the points with their errors by sampling, and notes.

    The size of these errors is estimated from edges that are seen jagged. There is a note where they are more
    than half of the variance of most corners.
    """
    variance = sampling_variance(
        [target.place.jagged for _, _, target in seen if isinstance(target.place, Corner)]
    )
    points, hidden = [], []
    for name, station, target in seen:
        place, shifts, sigma = target.place, None, target.place.sigma
        if isinstance(place, Corner):
            shifts = np.sqrt(variance) * shifts_of_edges(place.normals, place.length)
            together = float(np.sum(shifts**2)) / 4
            hidden.append(sigma**2 < together)
            sigma = float(np.sqrt(sigma**2 + SHORT_WAVES * together))
        points.append(ImagePoint(name, station, place.u, place.v, sigma, shifts))
    if not hidden or 2 * sum(hidden) <= len(hidden):
        return points, []
    side = max(1 - np.sqrt(variance / POINT_VARIANCE), 0.0)
    return points, [
        f"edges are jagged, as if pixels saw {100 * side**2:.0f} % of their area, and where they run along "
        f"rows or columns corners are off by {np.sqrt(variance):.2g} px: roll and tilt the board (a "
        "simulation of one ray a pixel: state footprint: 1.0 of mixed_pixels in its camera file)"
    ]


# --- prediction ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Expected:
    """Targets in view: ids, image points (n, 2), distances to the nearest of the others (n,), all px.

    Circles: ``axes`` (n, 2) long and short semi-axis in px, ``dark`` (n,): darker than the surroundings; NaN
    for corners. Corners: ``edges`` (n, 2, 2) px to the next corners, ``bends`` (n, 2) 1/px their curvature by
    the lens; NaN for circles.
    """

    names: list[str]
    image: Array
    spacing: Array
    axes: Array
    dark: NDArray[np.bool_]
    edges: Array
    bends: Array


def _expected(
    field: FieldOnSurfaces,
    rotation: Array,
    translation: Array,
    camera: Camera,
    scene: Scene,
    there: Mapping[str, Pose],
) -> _Expected:
    """Predict the targets that lie in the image with their surroundings and are not hidden."""
    targets = list(field.field.targets.items())
    index = {surface.name: i for i, surface in enumerate(scene.surfaces)}
    optics = camera.optics
    height, width = camera.shape
    names, image, axes, dark, edges, bends = [], [], [], [], [], []
    for name, target in targets:
        centre = rotation @ np.array(target.position) + translation
        if centre[2] <= 0:
            continue
        if target.radius > 0:
            normal = rotation @ np.array(target.normal)
            rim = _rim(normal, target.radius)
            slant = abs(float(normal @ centre)) / float(np.linalg.norm(centre))
            long = np.sqrt(optics.fx * optics.fy) * target.radius / centre[2]
            size = (float(long), float(long * slant))
            step, bend = np.full((2, 2), np.nan), np.full(2, np.nan)
            uv = project(optics, centre[None])[0]
            uv = uv + ellipse_centre_offset(optics, centre[None], normal[None], np.array([target.radius]))[0]
        else:
            sides = field.edges[name] @ rotation.T
            rim = np.concatenate([sides, -sides]) * 0.8
            size = (np.nan, np.nan)
            ends = project(optics, np.concatenate([centre + sides, centre - sides]))
            step = (ends[:2] - ends[2:]) / 2
            uv = project(optics, centre[None])[0]
            bend = _bends(step, ends[:2] + ends[2:] - 2 * uv)
        outline = project(optics, centre + rim)
        if not (np.isfinite(outline).all() and (outline >= 0).all()):
            continue
        if not (outline <= (width - 1, height - 1)).all():
            continue
        looked = np.concatenate([centre[None], centre + 0.95 * rim, centre + 1.2 * rim])
        rays = looked / np.linalg.norm(looked, axis=1, keepdims=True)
        seen = see(scene, there, rays[None])
        if (seen.surface[0, : len(rim) + 1] != index[field.of[name]]).any():
            continue
        around = np.nan_to_num(seen.reflectivity[0, len(rim) + 1 :])
        names.append(name)
        image.append(uv)
        axes.append(size)
        dark.append(bool(np.median(around) > seen.reflectivity[0, 0]))
        edges.append(step)
        bends.append(bend)
    points = np.array(image).reshape(-1, 2)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2) + np.diag(np.full(len(points), np.inf))
    return _Expected(
        names=names,
        image=points,
        spacing=apart.min(axis=1, initial=np.inf),
        axes=np.array(axes).reshape(-1, 2),
        dark=np.array(dark, dtype=bool),
        edges=np.array(edges).reshape(-1, 2, 2),
        bends=np.array(bends).reshape(-1, 2),
    )


def _bends(step: Array, second: Array) -> Array:
    """Return the curvature [1/px] of edges (2, 2) px towards their normals, by second differences [px]."""
    across = (step[:, 0] * second[:, 1] - step[:, 1] * second[:, 0]) / np.linalg.norm(step, axis=1)
    result: Array = across / np.sum(step**2, axis=1)
    return result


def _rim(normal: Array, radius: float) -> Array:
    """Return points on the rim of a circle (n, 3) m, relative to its centre."""
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    angle = 2 * np.pi * np.arange(_RIM)[:, None] / _RIM
    result: Array = radius * (np.cos(angle) * first + np.sin(angle) * np.cross(normal, first))
    return result


# --- identification --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Found:
    """A target where it was measured, and its half extent along u and v [px]."""

    place: Ellipse | Corner
    reach: tuple[float, float]


def _circles(expected: _Expected, view: _View, gate: float, reference: Array | None) -> dict[str, _Found]:
    found: dict[str, _Found] = {}
    for dark in (False, True):
        wanted = np.flatnonzero((expected.axes[:, 0] > 0) & (expected.dark == dark))
        if not wanted.size:
            continue
        long, short = expected.axes[wanted].T
        ellipses = find_circles(
            view.amplitude,
            smallest_diameter=max(_SMALLEST, 2 * float(short.min()) / _SIZE_FACTOR),
            largest_diameter=max(2 * float(long.max()) * _SIZE_FACTOR, 2 * _SMALLEST),
            reference=reference,
            dark=dark,
        )
        if not ellipses:
            continue
        apart = np.linalg.norm(
            expected.image[wanted][:, None]
            - np.array([(ellipse.u, ellipse.v) for ellipse in ellipses])[None],
            axis=2,
        )
        for row, i in enumerate(wanted):
            j = int(np.argmin(apart[row]))
            near = apart[row, j] <= min(gate, _GATE_SHARE * expected.spacing[i])
            if near and np.argmin(apart[:, j]) == row and _fits(ellipses[j], expected.axes[i]):
                one = ellipses[j]
                reach = (float(np.sqrt(one.shape[0])), float(np.sqrt(one.shape[2])))
                found[expected.names[i]] = _Found(one, reach)
    return found


def _fits(ellipse: Ellipse, axes: Array) -> bool:
    ratio = np.array(ellipse.axes) / axes
    return bool((ratio < _SIZE_FACTOR).all() and (ratio > 1 / _SIZE_FACTOR).all())


def _corners(expected: _Expected, view: _View, gate: float) -> dict[str, _Found]:
    wanted = np.flatnonzero(np.isfinite(expected.edges[:, 0, 0]))
    corners = refine_corners(
        view.amplitude, expected.image[wanted], axes=expected.edges[wanted], bends=expected.bends[wanted]
    )
    found: dict[str, _Found] = {}
    for i, corner in zip(wanted, corners, strict=True):
        if corner is None:
            continue
        away = np.hypot(corner.u - expected.image[i, 0], corner.v - expected.image[i, 1])
        # short edges, between markers, have other edges nearby
        short = float(np.linalg.norm(expected.edges[i], axis=1).min())
        if away <= min(gate, _GATE_SHARE * expected.spacing[i], _GATE_SHARE * short):
            reach = np.abs(expected.edges[i]).max(axis=0)
            found[expected.names[i]] = _Found(corner, (float(reach[0]), float(reach[1])))
    return found
