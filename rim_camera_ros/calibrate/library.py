"""Every effect that a camera lacks as candidates: the vocabulary says which there are."""

from __future__ import annotations

from collections.abc import Sequence

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import OPTICS, vocabulary
from rim_camera_ros.effects.candidate import Candidate, Facts


def candidates(camera: Camera, facts: Facts, *, effects: Sequence[str] | None = None) -> list[Candidate]:
    """Return the variants of every effect that the camera lacks and the recordings could contain."""
    known = vocabulary()
    # those of the optics last, whose columns need no light
    names = [*(name for name in known if name not in OPTICS), *OPTICS]
    return [
        one
        for name in names
        if name not in camera.effects and (effects is None or name in effects)
        for one in known[name].candidates(camera, facts)
    ]
