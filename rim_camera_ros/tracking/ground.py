"""The floor below a mounted camera: optical frame <-> a frame on the floor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

#: Optical axes (x right, y down, z forward) in a body's (x forward, y left, z up): REP 103.
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
#: Least horizontal component of the viewing direction, without which "forward" on the floor is undefined.
_LEAST_HORIZONTAL = 0.05


@dataclass(frozen=True, kw_only=True)
class Ground:
    """A frame on the floor, right below the camera: x forward, y left, z up (REP 103).

    ``height`` of the projection centre above the floor [m]; ``roll`` about the viewing direction and
    ``pitch`` [rad], positive when looking down, as in URDF and the driver's ``mount.*``.

    Raises `InputError` for a height that is not positive, and for a camera that looks along the vertical.
    """

    height: float
    roll: float = 0.0
    pitch: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.height) and self.height > 0):
            raise InputError(f"{self.height:g} m above the floor", place="mount.z", remedy="give more than 0")
        if abs(math.cos(self.pitch)) < _LEAST_HORIZONTAL:
            raise InputError(
                f"with {self.pitch:g} rad the camera looks along the vertical",
                place="mount.pitch",
                remedy="give an inclination at which it looks along the room",
            )

    @classmethod
    def below(cls, rotation: Rotation, position: Array) -> Ground:
        """Return the floor below a camera, from the pose of its optical frame in a frame on the floor (z up).

        ``position`` (3,) in m. Raises `InputError` as the class does.
        """
        roll, pitch, _ = (rotation * _optical().inv()).as_euler("xyz")
        return cls(height=float(position[2]), roll=float(roll), pitch=float(pitch))

    @property
    def rotation(self) -> Rotation:
        """Rotation of the optical frame in the floor's frame."""
        optical = _optical()
        return type(optical).from_euler("xyz", [self.roll, self.pitch, 0.0]) * optical

    def from_optical(self, points: NDArray[Any]) -> Array:
        """Return points (N, 3) [m] of the optical frame in the floor's frame."""
        result: Array = np.asarray(points, float) @ self.rotation.as_matrix().T
        result[:, 2] += self.height
        return result

    def to_optical(self, points: NDArray[Any]) -> Array:
        """Return points (N, 3) [m] of the floor's frame in the optical frame."""
        shifted = np.array(points, float)
        shifted[:, 2] -= self.height
        result: Array = shifted @ self.rotation.as_matrix()
        return result


def _optical() -> Rotation:
    from scipy.spatial.transform import Rotation  # takes a good part of a node's start

    return Rotation.from_matrix(_OPTICAL)
