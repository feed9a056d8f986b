"""Walking figures as a scene file, to test the tracking with known positions.

``python -m rim_camera_ros.tracking.figures > config/walking_people.yaml`` writes the shipped scene.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.rotations import quaternion
from rim_camera_ros.scene import Scene, ScenePose, Station, Surface
from rim_camera_ros.tracking.ground import Ground

Array = NDArray[np.float64]

#: Mount of the camera in the shipped scene: 2.2 m above the floor, looking 20 degrees down.
GROUND = Ground(height=2.2, pitch=math.radians(20.0))
#: Spheres of a figure 1.75 m tall: height of the centre [m], radius [m].
_TRUNK = {"head": (1.63, 0.12), "chest": (1.30, 0.20), "belly": (1.06, 0.18), "hips": (0.87, 0.17)}
#: Parts of a leg: distance from the hip joint along the leg [m], radius [m].
_LEG = {"thigh": (0.17, 0.10), "knee": (0.40, 0.08), "shin": (0.58, 0.07), "foot": (0.75, 0.07)}
_HIP_HEIGHT, _HIP_ASIDE = 0.82, 0.09
#: A leg swings by this angle [rad]; a double step takes this many metres.
_SWING, _STRIDE = 0.42, 1.4
#: Tangent of the bearing up to which a person is in view; difference of bearings [rad] at which one person
#: hides another.
_IN_VIEW, _HIDES = 0.35, 0.03


@dataclass(frozen=True, kw_only=True)
class Walk:
    """A straight walk of a person: ``start`` and ``end`` [m] x y on the floor, ``speed`` [m/s].

    ``wait`` [s] before the first step; at the end the person stands still. ``reflectivity`` [-] of the
    clothes.
    """

    name: str
    start: tuple[float, float]
    end: tuple[float, float]
    speed: float = 1.1
    wait: float = 0.0
    reflectivity: float = 0.5

    def walked(self, time: float) -> float:
        """Return the metres walked by ``time`` [s]."""
        return float(np.clip((time - self.wait) * self.speed, 0.0, math.dist(self.start, self.end)))

    def position(self, time: float) -> Array:
        """Return the position (2,) [m] on the floor at ``time`` [s]."""
        start = np.array(self.start)
        return start + self.walked(time) * self._direction

    @property
    def _direction(self) -> Array:
        way = np.subtract(self.end, self.start)
        result: Array = way / np.linalg.norm(way)
        return result

    def spheres(self, time: float) -> dict[str, Array]:
        """Return the centre (3,) [m] of each part in the floor's frame at ``time`` [s]."""
        place, ahead = self.position(time), self._direction
        aside = np.array([-ahead[1], ahead[0]])
        result = {part: np.array([*place, height]) for part, (height, _) in _TRUNK.items()}
        angle = _SWING * math.sin(2 * math.pi * self.walked(time) / _STRIDE)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            for part, (along, _) in _LEG.items():
                level = place + sign * _HIP_ASIDE * aside + along * math.sin(sign * angle) * ahead
                result[f"{side}_{part}"] = np.array([*level, _HIP_HEIGHT - along * math.cos(angle)])
        return result

    def surfaces(self, ground: Ground) -> list[Surface]:
        """Return the figure's spheres at the start of the walk."""
        radii = {part: radius for part, (_, radius) in _TRUNK.items()}
        radii |= {f"{side}_{part}": r for side in ("left", "right") for part, (_, r) in _LEG.items()}
        return [
            Surface(
                name=f"{self.name}_{part}",
                type="sphere",
                pose=_pose(centre, ground),
                radius=radii[part],
                reflectivity=self.reflectivity,
            )
            for part, centre in self.spheres(0.0).items()
        ]


#: The shipped scene: the paths cross on the floor, and Bert is hidden behind Anna for a moment.
SHIPPED = (
    Walk(name="anna", start=(3.9, 2.4), end=(2.6, -2.4), speed=1.12, reflectivity=0.55),
    Walk(name="bert", start=(4.7, -2.5), end=(2.6, 2.3), speed=0.93, wait=0.6, reflectivity=0.4),
)
SHIPPED_FRAMES = 65


def crossing(seed: int) -> tuple[Walk, Walk]:
    """Return two walks drawn at random whose paths cross, so that one person hides the other in view.

    They begin and end outside of the view. The persons are never nearer than 0.6 m to each other (shoulders
    would touch), and where one hides the other they are less than 1 m apart.
    """
    rng = np.random.default_rng(seed)
    while True:
        walks = (_walk("anna", rng, side=1.0), _walk("bert", rng, side=float(rng.choice([1.0, -1.0]))))
        a, b, apart, hides = _together(*walks)
        cross = np.min(np.linalg.norm(a[:, None] - b[None], axis=2)) < 0.1
        if cross and hides.any() and apart.min() >= 0.6 and apart[hides].min() < 1.0:
            return walks


def overtaking(seed: int) -> tuple[Walk, Walk]:
    """Return two walks drawn at random; one person overtakes the other behind it, as seen by the camera."""
    rng = np.random.default_rng(seed)
    while True:
        near, far = rng.uniform(2.8, 3.2, 2), rng.uniform(3.8, 4.4, 2)
        slow = Walk(
            name="anna", start=(near[0], 2.3), end=(near[1], -2.6), speed=float(rng.uniform(0.7, 0.9))
        )
        fast = Walk(
            name="bert",
            start=(far[0], 2.6),
            end=(far[1], -2.6),
            speed=float(rng.uniform(1.2, 1.5)),
            wait=float(rng.uniform(0.8, 1.4)),
            reflectivity=0.4,
        )
        if _together(slow, fast)[3].any():
            return slow, fast


def _walk(name: str, rng: np.random.Generator, *, side: float) -> Walk:
    return Walk(
        name=name,
        start=(float(rng.uniform(2.6, 4.8)), side * 2.6),
        end=(float(rng.uniform(2.6, 4.8)), -side * 2.6),
        speed=float(rng.uniform(0.8, 1.4)),
        wait=float(rng.uniform(0.0, 1.5)),
        reflectivity=float(rng.uniform(0.3, 0.7)),
    )


def _together(one: Walk, other: Walk) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return both paths (T, 2), the distance between the two (T,) and whether one hides the other in view."""
    times = np.arange(0.0, 8.0, 0.05)
    a, b = (np.array([walk.position(float(time)) for time in times]) for walk in (one, other))
    bearing = np.abs(np.arctan2(a[:, 1], a[:, 0]) - np.arctan2(b[:, 1], b[:, 0]))
    in_view = (np.abs(a[:, 1] / a[:, 0]) < _IN_VIEW) & (np.abs(b[:, 1] / b[:, 0]) < _IN_VIEW)
    return a, b, np.linalg.norm(a - b, axis=1), in_view & (bearing < _HIDES)


def room(ground: Ground) -> list[Surface]:
    """Return the surfaces at rest: a floor, a back wall 5.5 m away and a cupboard in front of it."""
    turn = ground.rotation.as_matrix().T
    upwards = _turned(turn @ np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]))
    facing = _turned(turn @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    cupboard = np.array([4.9, 1.2, 0.6])
    return [
        Surface(
            name="floor",
            type="plane",
            pose=_pose(np.array([3.0, 0.0, 0.0]), ground, upwards),
            reflectivity=0.5,
        ),
        Surface(
            name="back_wall",
            type="plane",
            pose=_pose(np.array([5.5, 0.0, 1.5]), ground, facing),
            reflectivity=0.75,
        ),
        Surface(
            name="cupboard",
            type="rectangle",
            pose=_pose(cupboard, ground, facing),
            size=(0.9, 1.2),
            reflectivity=0.6,
        ),
    ]


def walking_scene(
    walks: Sequence[Walk], ground: Ground = GROUND, *, frames: int, rate: float = 10.0, still: int = 25
) -> Scene:
    """Return a room with people: ``still`` frames in which they wait, then ``frames`` of walking.

    The stations of a schedule have fixed poses, so each frame of walking is a station of its own. Time 0 of
    the walks is the first of these frames; ``rate`` in Hz.
    """
    figures = [surface for walk in walks for surface in walk.surfaces(ground)]
    schedule = [Station(frames=still, rate=rate, integration_time=100.0, uptime=1800.0, ambient=20.0)]
    for i in range(frames):
        poses = {
            f"{walk.name}_{part}": _pose(centre, ground)
            for walk in walks
            for part, centre in walk.spheres(i / rate).items()
        }
        schedule.append(Station(frames=1, rate=rate, poses=poses))
    return Scene(surfaces=(*room(ground), *figures), schedule=tuple(schedule))


def scene_text(scene: Scene, heading: str) -> str:
    """Return a scene with spheres that move as the text of a scene file; ``heading`` becomes comments."""
    lines = [f"# {line}".rstrip() for line in heading.splitlines()] + ["format: rim_scene/1", "surfaces:"]
    for surface in scene.surfaces:
        assert isinstance(surface.pose, ScenePose)
        parts = [f"name: {surface.name}", f"type: {surface.type}"]
        if surface.size is not None:
            parts.append(f"size: {_numbers(surface.size)}")
        if surface.radius is not None:
            parts.append(f"radius: {surface.radius:g}")
        parts.append(f"reflectivity: {surface.reflectivity:g}")
        pose = f"position: {_numbers(surface.pose.position)}"
        if surface.type != "sphere":
            pose += f", orientation: {_numbers(surface.pose.orientation, digits=9)}"
        lines.append(f"- {{{', '.join(parts)}, pose: {{{pose}}}}}")
    lines.append("schedule:")
    for station in scene.schedule:
        head = f"frames: {station.frames}, rate: {station.rate:g}"
        if station.integration_time is not None:
            head += f", integration_time: {station.integration_time:g}, uptime: {station.uptime:g}"
            head += f", ambient: {station.ambient:g}"
        if not station.poses:
            lines.append(f"- {{{head}}}")
            continue
        lines.append(f"- {{{head}, poses: {{")
        lines += [
            f"    {name}: {{position: {_numbers(pose.position)}}}," for name, pose in station.poses.items()
        ]
        lines.append("  }}")
    return "\n".join(lines) + "\n"


def _numbers(values: Sequence[float], *, digits: int = 4) -> str:
    return "[" + ", ".join(f"{round(one, digits) + 0.0:.9g}" for one in values) + "]"


def _pose(
    centre: Array, ground: Ground, orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
) -> ScenePose:
    x, y, z = ground.to_optical(centre[None])[0]
    return ScenePose(position=(float(x), float(y), float(z)), orientation=orientation)


def _turned(rotation: Array) -> tuple[float, float, float, float]:
    return quaternion(rotation)


_HEADING = """\
Two people of 1.75 m whose ways cross, seen from 2.2 m above the floor, 20 degrees down; see
docs/moving_people.md. 25 frames of the empty view, then 65 at 10 Hz. A schedule holds poses for a stretch of
frames, so that a walk is one station for each frame.
Written by python -m rim_camera_ros.tracking.figures. Metres, camera optical frame.\
"""


def shipped_text() -> str:
    """Return the text of the shipped scene file ``walking_people``."""
    return scene_text(walking_scene(SHIPPED, frames=SHIPPED_FRAMES), _HEADING)


if __name__ == "__main__":
    sys.stdout.write(shipped_text())
