"""What an adjustment comes by on its way."""

from __future__ import annotations

import pytest

from rim_camera_ros.fit.gauss_newton import GaussNewton
from rim_camera_ros.fit.linearised import Linearised


def points(monkeypatch: pytest.MonkeyPatch) -> list[Linearised]:
    """Return the list to which every point is added from which an adjustment takes a step."""
    seen: list[Linearised] = []
    honest = GaussNewton.advance

    def advance(self: GaussNewton, here: Linearised, count: int) -> None:
        seen.append(here)
        honest(self, here, count)

    monkeypatch.setattr(GaussNewton, "advance", advance)
    return seen
