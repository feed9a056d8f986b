"""Transforms between frames from TF: the newest of each, and the pose of a frame in another; no ROS here."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


class TransformTree:
    """The newest transform of each frame to its parent; a frame has one parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Rotation, Array]] = {}

    def add(self, parent: str, child: str, *, position: Sequence[float], quaternion: Sequence[float]) -> bool:
        """Add a transform: ``position`` [m] and ``quaternion`` x y z w of the child in its parent.

        False for an invalid one: numbers that are not finite, a quaternion of length 0, a frame in itself.
        """
        numbers = np.array([*position, *quaternion], float)
        length = float(np.linalg.norm(numbers[3:]))
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if not np.isfinite(numbers).all() or length < 1e-6 or not parent or not child or parent == child:
            return False
        self._parents[child] = parent, Rotation.from_quat(numbers[3:] / length), numbers[:3]
        return True

    def lookup(self, base: str, frame: str) -> tuple[Rotation, Array] | None:
        """Return rotation and position [m] of a frame in another one, None if they are not connected."""
        of_base, of_frame = self._to_ancestors(base.lstrip("/")), self._to_ancestors(frame.lstrip("/"))
        for ancestor, (rotation, position) in of_frame.items():
            if ancestor in of_base:
                base_rotation, base_position = of_base[ancestor]
                back = base_rotation.inv()
                return back * rotation, back.apply(position - base_position)
        return None

    def _to_ancestors(self, frame: str) -> dict[str, tuple[Rotation, Array]]:
        """Return the pose of a frame in itself and in each of its ancestors, the nearest first."""
        found = {frame: (Rotation.identity(), np.zeros(3))}
        while frame in self._parents:
            rotation, position = found[frame]
            frame, turn, shift = self._parents[frame]
            if frame in found:  # a cycle
                break
            found[frame] = turn * rotation, turn.apply(position) + shift
        return found
