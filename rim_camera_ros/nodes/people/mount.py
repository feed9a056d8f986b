"""The mount of the camera above the floor, by the transforms from a frame on the floor."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node

from rim_camera_ros.errors import RimError
from rim_camera_ros.nodes.common.findings import Finding, Level
from rim_camera_ros.nodes.people.transforms import Transforms
from rim_camera_ros.tracking.ground import Ground

#: Changes of height [m] and of angles [rad] below which a mount counts as the same: transforms of joints and
#: localisation are never constant, and a new floor loses all tracks. At 5 m the angle moves a point by 25 mm.
_SAME_HEIGHT, _SAME_ANGLE = 0.01, 0.005


class MountOf:
    """The mount of a camera from /tf and /tf_static; ``changed`` is called when it changes.

    ``ground``: the floor below the camera, None while there is no base frame or no transform from it.
    """

    def __init__(self, node: Node, changed: Callable[[], None]) -> None:
        self.ground: Ground | None = None
        self._node = node
        self._changed = changed
        self._base = ""
        self._frame = ""
        self._problem = ""
        self._transforms = Transforms(node, self._update)

    def use(self, base: str) -> None:
        """Use the mount by this base frame from now on; '': by none."""
        if base != self._base:
            self.ground, self._problem = None, ""
        self._base = base
        self._transforms.listen(bool(base))
        self._update()

    def seen_from(self, frame: str) -> None:
        """Take note of the camera's optical frame, which the headers of its messages name."""
        if frame != self._frame:
            self._frame = frame
            self._update()

    def look(self, used: Ground) -> Finding:
        """Return which mount is ``used`` and where it comes from."""
        finding = Finding()
        finding.values = {
            "height_m": f"{used.height:.4f}",
            "roll_rad": f"{used.roll:.4f}",
            "pitch_rad": f"{used.pitch:.4f}",
            "from": "mount.*" if self.ground is None else self._base,
        }
        if self._base and (self.ground is None or self._problem):
            reason = self._problem or f"no transform leads from {self._base} to {self._frame or 'the camera'}"
            finding.worse(Level.WARN, f"{reason}: the mount of {finding.values['from']} holds")
        finding.note(f"{used.height:.2f} m above the floor, by {finding.values['from']}")
        return finding

    def _update(self) -> None:
        if not self._base or not self._frame:
            return
        found = self._transforms.tree.lookup(self._base, self._frame)
        if found is None:
            return
        try:
            ground = Ground.below(*found)
            self._problem = ""
        except RimError as error:
            self._problem = f"the transform from {self._base} to {self._frame}: {error}"
            return
        if self.ground is None or _differ(ground, self.ground):
            self.ground = ground
            self._node.get_logger().info(
                f"mount by {self._base}: {ground.height:.3f} m above it, roll {ground.roll:.4f}, "
                f"pitch {ground.pitch:.4f} rad"
            )
            self._changed()


def _differ(ground: Ground, other: Ground) -> bool:
    return (
        abs(ground.height - other.height) > _SAME_HEIGHT
        or max(abs(ground.roll - other.roll), abs(ground.pitch - other.pitch)) > _SAME_ANGLE
    )
