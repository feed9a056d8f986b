"""Rows by integration time: those that hold at a setting, interpolated in metres."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

from rim_camera_ros.effects.signal import Context, Image


def row_weights(
    rows: Mapping[float, Any], integration_time: Callable[[], float]
) -> list[tuple[float, float]]:
    """Return (key, weight) of the rows that hold at an integration time.

    An exact key is used; between two keys the terms in metres are interpolated linearly; outside them
    the nearest row is used; a single row serves every setting (and needs no integration time).
    """
    keys = sorted(rows)
    if len(keys) == 1:
        return [(keys[0], 1.0)]
    t = integration_time()
    if t <= keys[0]:
        return [(keys[0], 1.0)]
    if t >= keys[-1]:
        return [(keys[-1], 1.0)]
    upper = next(i for i, key in enumerate(keys) if key >= t)
    if keys[upper] == t:
        return [(t, 1.0)]
    share = (t - keys[upper - 1]) / (keys[upper] - keys[upper - 1])
    return [(keys[upper - 1], 1.0 - share), (keys[upper], share)]


def outside_rows(rows: Collection[float], integration_time: float | None) -> bool:
    """Return whether an integration time lies outside the rows (flag 8), never for a single row."""
    if len(rows) < 2 or integration_time is None:
        return False
    return not min(rows) <= integration_time <= max(rows)


def combine_rows(
    rows: Mapping[float, Any], context: Context, term: Callable[[Any], Image | float]
) -> Image | float:
    """Return the interpolated term in metres of the rows that hold at the frame's integration time."""
    weights = row_weights(rows, lambda: context.integration_time)
    total: Image | float = 0.0
    for key, weight in weights:
        total = total + weight * term(rows[key])
    return total


def row_name(key: float) -> str:
    """Return a row's key as it stands in a dotted path."""
    return str(int(key)) if key == int(key) else str(key)


def need_rows(rows: Mapping[float, Any], name: str) -> None:
    """Raise ValueError for an empty group of rows."""
    if not rows:
        raise ValueError(f"{name} is empty: give one row, by integration time")
