"""Wrong set-ups: what is said of the scene or the poses is not as it was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .geometry import Lens, Placement, Surface, turn
from .imperfections import Stated
from .scenes import Scene, swapped


@dataclass(frozen=True)
class Told:
    """What the files and the recording of a wrong set-up say instead, and the right `hypothesis`.

    `surfaces` of the scene file, reported `places`, `lens` of the camera file; `along_z` where the
    recording holds depth instead of radial distance; `moved` stations; the `surface` that is wrong.
    """

    surfaces: list[Surface]
    places: list[dict[str, Placement]]
    lens: Lens
    hypothesis: str
    surface: str | None
    moved: tuple[int, ...] = ()
    along_z: bool = False
    detail: Any = None


#: Surface that a set-up has wrong, by style: the one whose tiles tell.
TARGETS = {"board": "board", "sweep": "target", "room": "front", "boxes": "left"}


def _on_surface(
    scene: Scene, stated: Stated, hypothesis: str, change: Callable[[Surface], Surface], detail: Any = None
) -> Told:
    target = TARGETS[scene.style]
    surfaces = [change(one) if one.name == target else one for one in scene.surfaces]
    return Told(surfaces, stated.places, stated.lens, hypothesis, target, detail=detail)


def _repainted(hypothesis: str) -> Callable[[Surface], Surface]:
    return lambda one: replace(one, values=PATTERNS[hypothesis](one.values))


def turned(scene: Scene, stated: Stated, rng: np.random.Generator) -> Told:
    """The board of the scene file is turned by 180 degrees about its normal."""
    return _on_surface(scene, stated, "turned_180", _repainted("turned_180"))


def mirrored(scene: Scene, stated: Stated, rng: np.random.Generator) -> Told:
    """Columns of tiles in reversed order."""
    return _on_surface(scene, stated, "mirrored", _repainted("mirrored"))


def inverted(scene: Scene, stated: Stated, rng: np.random.Generator) -> Told:
    """Bright and dark exchanged."""
    return _on_surface(scene, stated, "inverted", _repainted("inverted"))


#: What makes another pattern of the tiles, by hypothesis; two must differ somewhere by the factor below.
PATTERNS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "turned_180": lambda values: values[::-1, ::-1],
    "mirrored": lambda values: values[:, ::-1],
    "inverted": swapped,
}
_APART = 1.25


def decidable(scene: Scene, hypothesis: str) -> bool:
    """Whether the tiles that the target shows tell another pattern from the given one and all others."""
    if hypothesis not in PATTERNS:
        return True
    target = next(one for one in scene.surfaces if one.name == TARGETS[scene.style])
    shown = _shown(target)
    own = np.log(PATTERNS[hypothesis](target.values)[shown])
    others = [target.values, *(make(target.values) for name, make in PATTERNS.items() if name != hypothesis)]
    return all(float(np.max(np.abs(np.log(one[shown]) - own))) >= np.log(_APART) for one in others)


def _shown(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the texture that lie on a surface, whose frame has its origin in the middle."""
    axes = []
    for count, cell, size in zip(
        surface.values.shape[::-1], surface.cell, surface.size or (np.inf, np.inf), strict=True
    ):
        reach = min(size / 2, count * cell)
        first, last = int(np.floor(-reach / cell + 1e-9)), int(np.ceil(reach / cell - 1e-9))
        axes.append(np.unique(np.arange(first, last) % count))
    return np.ix_(axes[1], axes[0])


def scaled(scene: Scene, stated: Stated, rng: np.random.Generator) -> Told:
    """The side of a tile, and so the board, is said to be another."""
    factor = float(rng.choice([rng.uniform(0.82, 0.93), rng.uniform(1.08, 1.2)]))

    def change(s: Surface) -> Surface:
        size = None if s.size is None else (s.size[0] * factor, s.size[1] * factor)
        return replace(s, cell=(s.cell[0] * factor, s.cell[1] * factor), size=size)

    return _on_surface(scene, stated, "scale", change, detail=factor)


def moved_poses(scene: Scene, stated: Stated, rng: np.random.Generator) -> Told:
    """Two to four stations whose target stood elsewhere by 40 to 90 mm and 3 to 6 degrees."""
    target = TARGETS[scene.style]
    chosen = np.sort(rng.choice(len(scene.places), int(rng.integers(2, 5)), replace=False))
    places = [dict(station) for station in stated.places]
    for k in chosen:
        place = places[k][target]
        shift = rng.normal(size=3)
        shift *= rng.uniform(0.04, 0.09) / np.linalg.norm(shift)
        axis = (*rng.normal(size=2), 0.0)
        tilt = turn(axis, rng.uniform(0.05, 0.1))
        places[k][target] = Placement(place.position + shift, tilt @ place.rotation)
    return Told(scene.surfaces, places, stated.lens, "pose", target, moved=tuple(int(k) for k in chosen))


def depth(scene: Scene, stated: Stated, rng: np.random.Generator) -> Told:
    """The target is said to be 50 mm nearer or farther in every pose."""
    target, off = TARGETS[scene.style], float(rng.choice([-0.05, 0.05]))
    places = [
        {**one, target: replace(one[target], position=one[target].position + np.array([0, 0, off]))}
        for one in stated.places
    ]
    return Told(scene.surfaces, places, stated.lens, "depth", target, detail=off)


def sign_of_angle(scene: Scene, stated: Stated, rng: np.random.Generator) -> Told:
    """The angle about the vertical axis of every pose of the target has the wrong sign."""
    from scipy.spatial.transform import Rotation

    target, places = TARGETS[scene.style], []
    for one in stated.places:
        vector = Rotation.from_matrix(one[target].rotation).as_rotvec() * np.array([1.0, -1.0, 1.0])
        wrong = Rotation.from_rotvec(vector).as_matrix()
        places.append({**one, target: replace(one[target], rotation=wrong)})
    return Told(scene.surfaces, places, stated.lens, "pose", target)


def units(scene: Scene, stated: Stated, rng: np.random.Generator) -> Told:
    """Positions of all poses in millimetres."""
    places = [
        {name: replace(place, position=place.position * 1000) for name, place in one.items()}
        for one in stated.places
    ]
    return Told(scene.surfaces, places, stated.lens, "units", None)


def z_distance(scene: Scene, stated: Stated, rng: np.random.Generator) -> Told:
    """The recording holds depths along the axis."""
    return Told(scene.surfaces, stated.places, stated.lens, "z_distance", None, along_z=True)


def other_lens(scene: Scene, stated: Stated, rng: np.random.Generator) -> Told:
    """The camera file is that of another lens."""
    factor = float(rng.choice([rng.uniform(0.7, 0.85), rng.uniform(1.18, 1.4)]))
    lens = replace(stated.lens, fx=stated.lens.fx * factor, fy=stated.lens.fy * factor)
    return Told(scene.surfaces, stated.places, lens, "other_lens", None, detail=factor)


SETUPS: dict[str, Callable[[Scene, Stated, np.random.Generator], Told]] = {
    "turned_180": turned,
    "mirrored": mirrored,
    "inverted": inverted,
    "scale": scaled,
    "moved_poses": moved_poses,
    "depth": depth,
    "sign_of_angle": sign_of_angle,
    "units": units,
    "z_distance": z_distance,
    "other_lens": other_lens,
}
