"""Styles of scenes, drawn at random: surfaces, poses of twenty stations, sensor and lens that suit them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .geometry import Placement, Surface, turn

STATIONS = 20
SETTINGS = (16, 60, 100)


@dataclass(frozen=True)
class Scene:
    """Surfaces, their true places per station, and what belongs to a style.

    `shape` (height, width), `focal` length [px], `counts` of amplitude of a white surface at 1 m with
    integration time 60, `settings` in use, `pose_sigma` ([m], [rad]), `falloff` of the lamp's power.
    """

    style: str
    surfaces: list[Surface]
    places: list[dict[str, Placement]]
    shape: tuple[int, int]
    focal: float
    counts: float
    settings: tuple[int, ...]
    pose_sigma: tuple[float, float]
    falloff: tuple[float, float]


def draw_scene(style: str, rng: np.random.Generator, stations: int = STATIONS) -> Scene:
    """A scene of `STYLES`."""
    return STYLES[style](rng, stations)


def _tiles(rng: np.random.Generator, rows: int, columns: int, levels: tuple[float, ...]) -> np.ndarray:
    return rng.choice(levels, size=(rows, columns))


def _asymmetric(rng: np.random.Generator, rows: int, columns: int, levels: tuple[float, ...]) -> np.ndarray:
    """Tiles that differ well from their turned, mirrored, inverted selves and hold every level."""
    while True:
        values = _tiles(rng, rows, columns, levels)
        others = values[::-1, ::-1], values[:, ::-1], values[::-1], swapped(values)
        different = all(np.mean(np.abs(values - other) > 0.1) > 0.5 for other in others)
        if different and len(np.unique(values)) == len(levels):
            return values


def swapped(values: np.ndarray) -> np.ndarray:
    """Reflectivities with bright and dark exchanged: the brightest level becomes the darkest and so on."""
    levels, index = np.unique(values, return_inverse=True)
    return levels[::-1][index].reshape(values.shape)


def _facing(rng: np.random.Generator, tilt: float) -> np.ndarray:
    """A rotation whose normal leaves the viewing direction by up to `tilt` [rad]."""
    heading = rng.uniform(0, 2 * np.pi)
    lean = turn((np.cos(heading), np.sin(heading), 0.0), tilt * np.sqrt(rng.uniform(0.02, 1)))
    return lean @ turn((0, 0, 1), rng.uniform(-0.3, 0.3))


def _board(rng: np.random.Generator, stations: int) -> Scene:
    levels = (0.1, 0.3, 0.55, 0.85)
    cell = rng.uniform(0.2, 0.26)
    size = (4 * cell, 4 * cell * 0.75)
    board = Surface("board", "rectangle", _asymmetric(rng, 5, 5, levels), (cell, cell), size)
    wall = Surface("wall", "plane", _tiles(rng, 6, 6, (0.3, 0.5, 0.75)), (0.9, 0.9))
    lean = turn((0.3, 1.0, 0.0), rng.uniform(-0.12, 0.12))
    back = Placement(np.array([0.0, 0.0, rng.uniform(3.3, 3.9)]), lean)
    places = []
    for number in range(stations):
        z = rng.permutation(np.linspace(1.1, 2.7, 9))[number % 9] + rng.uniform(-0.08, 0.08)
        aside = rng.uniform(-0.12, 0.12, 2) * z
        front = Placement(np.array([*aside, z]), _facing(rng, 0.75))
        places.append({"wall": back, "board": front})
    return Scene(
        "board",
        [wall, board],
        places,
        (72, 88),
        rng.uniform(98, 106),
        4600.0,
        SETTINGS,
        (0.0012, 0.0007),
        (-1.5, 0.8),
    )


def _sweep(rng: np.random.Generator, stations: int) -> Scene:
    levels = (0.12, 0.35, 0.6, 0.9)
    target = Surface("target", "plane", _asymmetric(rng, 9, 9, levels), (0.2, 0.2))
    z = rng.permutation(np.geomspace(0.9, 4.2, stations))
    places = [
        {"target": Placement(np.array([*rng.uniform(-0.3, 0.3, 2), far]), _facing(rng, 0.7))} for far in z
    ]
    return Scene(
        "sweep",
        [target],
        places,
        (90, 120),
        rng.uniform(290, 320),
        6400.0,
        SETTINGS,
        (0.0012, 0.0007),
        (-1.5, 0.8),
    )


def _plain(rng: np.random.Generator, stations: int) -> Scene:
    """A nearly white plane at nearly one distance, turned far: amplitude and incidence go together."""
    values = _tiles(rng, 6, 6, (0.72, 0.8, 0.85))
    values[rng.integers(6, size=2), rng.integers(6, size=2)] = 0.35
    target = Surface("target", "plane", values, (0.3, 0.3))
    places = [
        {
            "target": Placement(
                np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(1.95, 2.1)]), _facing(rng, 1.05)
            )
        }
        for _ in range(stations)
    ]
    return Scene(
        "plain",
        [target],
        places,
        (72, 88),
        rng.uniform(330, 360),
        1500.0,
        (60,),
        (0.0012, 0.0007),
        (-1.5, 0.8),
    )


def _moved(
    rng: np.random.Generator,
    fixed: dict[str, Placement],
    stations: int,
    *,
    shift: np.ndarray,
    angle: float,
    centre: np.ndarray,
) -> list[dict[str, Placement]]:
    """Places of a rigid scene as a camera sees it that moves by `shift` and turns about `centre`."""
    places = []
    for _ in range(stations):
        camera = rng.uniform(-1, 1, 3) * shift
        towards = turn((1, 0, 0), rng.uniform(-angle, angle)) @ turn((0, 1, 0), rng.uniform(-angle, angle))
        towards = towards @ turn((0, 0, 1), rng.uniform(-angle, angle))
        # the camera keeps looking near the centre of the scene
        aim = centre - camera
        view = turn((0, 1, 0), -np.arctan2(aim[0], aim[2])) @ turn((1, 0, 0), np.arctan2(aim[1], aim[2]))
        world = towards @ view
        places.append(
            {
                name: Placement(world @ (place.position - camera), world @ place.rotation)
                for name, place in fixed.items()
            }
        )
    return places


def _room(rng: np.random.Generator, stations: int) -> Scene:
    bright, full = (0.35, 0.5, 0.8), (0.12, 0.35, 0.6, 0.9)
    surfaces = [
        Surface("floor", "plane", _tiles(rng, 5, 5, (0.25, 0.4, 0.6)), (1.2, 1.2)),
        Surface("back", "plane", _tiles(rng, 5, 5, bright), (1.5, 1.5)),
        Surface("front", "rectangle", _asymmetric(rng, 4, 4, full), (0.45, 0.45), (0.8, 0.9)),
        Surface("side", "rectangle", _asymmetric(rng, 4, 4, full), (0.6, 0.6), (0.7, 1.0)),
        Surface("ball", "sphere", np.array([[0.7]]), radius=rng.uniform(0.28, 0.36)),
    ]
    fixed = {
        "floor": Placement(np.array([0.0, 1.15, 2.4]), turn((1, 0, 0), -np.pi / 2)),
        "back": Placement(np.array([0.0, 0.0, rng.uniform(3.4, 3.9)]), np.eye(3)),
        "front": Placement(
            np.array([-0.75, 0.25, rng.uniform(1.8, 2.2)]), turn((0, 1, 0), rng.uniform(-0.6, -0.2))
        ),
        "side": Placement(
            np.array([1.0, -0.1, rng.uniform(2.2, 2.6)]), turn((0, 1, 0), rng.uniform(0.3, 0.7))
        ),
        "ball": Placement(np.array([rng.uniform(0.0, 0.3), 0.6, rng.uniform(2.2, 2.6)]), np.eye(3)),
    }
    places = _moved(
        rng, fixed, stations, shift=np.array([0.45, 0.3, 0.7]), angle=0.18, centre=np.array([0.1, 0.1, 2.6])
    )
    return Scene(
        "room", surfaces, places, (50, 64), rng.uniform(41, 44), 24000.0, (60,), (0.002, 0.001), (-0.9, 0.3)
    )


def _boxes(rng: np.random.Generator, stations: int) -> Scene:
    levels = (0.12, 0.35, 0.6, 0.9)
    surfaces = [
        Surface("left", "rectangle", _asymmetric(rng, 6, 6, levels), (0.45, 0.45), (1.3, 1.4)),
        Surface("right", "rectangle", _asymmetric(rng, 6, 6, levels), (0.45, 0.45), (1.3, 1.4)),
        Surface("plate", "rectangle", np.array([[0.85]]), (0.3, 0.3), (0.34, 0.28)),
        Surface("lid", "rectangle", _tiles(rng, 4, 4, levels), (0.35, 0.35), (1.1, 0.7)),
    ]
    fixed = {
        "left": Placement(np.array([-0.55, 0.0, 2.2]), turn((0, 1, 0), rng.uniform(-0.7, -0.4))),
        "right": Placement(np.array([0.6, 0.05, 2.3]), turn((0, 1, 0), rng.uniform(0.4, 0.7))),
        "plate": Placement(
            np.array([0.1, -0.1, rng.uniform(1.35, 1.6)]), turn((1, 1, 0), rng.uniform(-0.3, 0.3))
        ),
        "lid": Placement(np.array([0.0, 0.75, 1.9]), turn((1, 0, 0), rng.uniform(-1.2, -0.9))),
    }
    places = _moved(
        rng, fixed, stations, shift=np.array([0.35, 0.25, 0.6]), angle=0.15, centre=np.array([0.0, 0.1, 2.1])
    )
    return Scene(
        "boxes",
        surfaces,
        places,
        (72, 88),
        rng.uniform(72, 78),
        4800.0,
        SETTINGS,
        (0.0012, 0.0007),
        (-1.5, 0.8),
    )


def _corner(rng: np.random.Generator, stations: int) -> Scene:
    bright = (0.55, 0.7, 0.8, 0.9)
    surfaces = [
        Surface("left", "rectangle", _tiles(rng, 4, 4, bright), (0.6, 0.6), (1.6, 1.5)),
        Surface("right", "rectangle", _tiles(rng, 4, 4, bright), (0.6, 0.6), (1.6, 1.5)),
        Surface("floor", "rectangle", _tiles(rng, 4, 4, (0.3, 0.6, 0.9)), (0.8, 0.8), (2.2, 1.6)),
    ]
    half, depth = 0.8 * np.sqrt(0.5), rng.uniform(2.1, 2.5)
    fixed = {
        "left": Placement(np.array([-half, 0.0, depth - half]), turn((0, 1, 0), -np.pi / 4)),
        "right": Placement(np.array([half, 0.0, depth - half]), turn((0, 1, 0), np.pi / 4)),
        "floor": Placement(np.array([0.0, 0.75, depth - 0.8]), turn((1, 0, 0), -np.pi / 2)),
    }
    places = _moved(
        rng,
        fixed,
        stations,
        shift=np.array([0.35, 0.25, 0.5]),
        angle=0.12,
        centre=np.array([0.0, 0.15, depth - 0.4]),
    )
    return Scene(
        "corner",
        surfaces,
        places,
        (72, 88),
        rng.uniform(72, 78),
        7000.0,
        (60,),
        (0.0012, 0.0007),
        (-0.9, 0.3),
    )


STYLES = {
    "board": _board,
    "plain": _plain,
    "room": _room,
    "boxes": _boxes,
    "corner": _corner,
    "sweep": _sweep,
}
