"""What the form of an effect may do otherwise, in addition to the smooth factors that all effects share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.effects.discrepancy import SPREADS, Change
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.effects.warm_up_drift import Exponential, WarmUpDrift

from ..calibrate.helpers import camera as small_camera


def test_stray_light_may_come_back_mirrored_through_the_optical_axis(tmp_path: Path) -> None:
    """A bright patch off the axis, and the light that its ghost adds to a dark wall on the other side."""
    camera = small_camera(tmp_path)
    assert camera.shape == (36, 44)
    camera = replace(camera, optics=replace(camera.optics, cx=23.0, cy=16.0))
    amplitude = np.full((36, 44), 10.0)
    amplitude[4:7, 30:33] = 5000.0  # about row 5, column 31
    light = Signal(np.full((36, 44), 2.5), amplitude)
    relative: list[np.ndarray] = []

    def light_change(after: str, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert after == "scattering"
        relative.append(change)
        return change.imag, change.real

    reading: Any = SimpleNamespace(
        context=Context(camera), before_effect=lambda name: light, light_change=light_change
    )
    effect = Scattering((Kernel(0.1, (1.0, 1.0)),))
    nothing = np.zeros((36, 44))
    found = list(effect.discrepancy(Change(reading, nothing, nothing, np.zeros((9, 36, 44)))))
    assert len(relative) == 2
    assert found[-1][1] is not None
    for change, share in zip(relative, SPREADS, strict=False):
        row, column = np.unravel_index(np.argmax(change.real), change.shape)
        assert (row, column) == (2 * 16 - 5, 2 * 23 - 31)
        # three of its rows and three of its columns, by a Gaussian of that width
        gaussian = np.exp(-0.5 * (np.arange(-40, 41) / (share * 44)) ** 2)
        within = gaussian[39:42].sum() / gaussian.sum()
        assert 10.0 * change.real.max() == pytest.approx(4990.0 * within**2, rel=1e-3)
    # where the wall is as bright as its ghost nothing changes; light of the same phase moves no distance
    assert np.abs(relative[0][20:26, 32:40]).max() == pytest.approx(0.0, abs=1e-9)
    assert np.abs(np.angle(relative[0][25:29, 13:17])).max() == pytest.approx(0.0, abs=1e-6)


def test_a_drift_may_follow_several_rates() -> None:
    """Of a drift of two exponentials one leaves more than 2 %, with its changes of form less than 0.2 %."""
    uptimes = np.arange(5.0, 1500.0, 20.0)
    shape = (2, 3)

    def forms(time_constant: float, uptime: float | None) -> list[float]:
        context = SimpleNamespace(settings=SimpleNamespace(uptime=uptime))
        reading: Any = SimpleNamespace(context=context)
        effect = WarmUpDrift((Exponential(0.05, time_constant),))
        found = list(effect.discrepancy(Change(reading, np.zeros(shape), None, np.zeros((9, *shape)))))
        assert all(amplitude is None and distance.shape == shape for distance, amplitude in found)
        return [float(distance[0, 0]) for distance, _ in found]

    drift = 0.3 * np.exp(-uptimes / 60.0) + 0.7 * np.exp(-uptimes / 300.0)

    def left(rates: np.ndarray) -> float:
        fitted = rates @ np.linalg.lstsq(rates, drift, rcond=None)[0]
        return float(np.abs(fitted - drift).max())

    alone = {tau: np.exp(-uptimes / tau)[:, None] for tau in np.arange(120.0, 320.0, 10.0)}
    best = min(alone, key=lambda tau: left(alone[tau]))
    assert left(alone[best]) > 0.02
    assert left(np.column_stack([alone[best], [forms(best, one) for one in uptimes]])) < 2e-3
    assert forms(best, None) == [0.0] * 4
