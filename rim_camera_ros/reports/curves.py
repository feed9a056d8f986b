"""Each effect as a curve over its covariate, with the band by its covariance."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_numbers
from rim_camera_ros.effects.graph import Line
from rim_camera_ros.errors import InputError
from rim_camera_ros.reports.figures import Curve, Panel

Array = NDArray[Any]

_STEP = 1e-4


def effect_panels(
    camera: Camera, paths: Sequence[str], covariance: Array, *, before: Camera | None = None
) -> list[Panel]:
    """Return a panel for each effect that is a curve, in mm, with its 1-sigma by the covariance of ``paths``.

    The range is that of the camera's validity. ``before`` adds the curves of another camera, dashed.
    """
    result = []
    for name, effect in camera.effects.items():
        graph = effect.graph(camera)
        if graph is None:
            continue
        own = (
            [i for i, path in enumerate(paths) if path.startswith(f"effects.{name}.")] if graph.banded else []
        )
        bands = _Bands(camera, name, [paths[i] for i in own], covariance[np.ix_(own, own)] if own else None)
        old = before.effects.get(name) if graph.compared and before is not None else None
        curves = [bands.curve(line, "after" if old is not None else line.label) for line in graph.lines]
        if old is not None:
            curves += [
                Curve(line.x, line.value(old), None, "before", colour="#9aa5b1", dashed=True)
                for line in graph.lines
            ]
        result.append(Panel(graph.title, graph.x_label, graph.y_label, tuple(curves), log=graph.log))
    return result


class _Bands:
    """Curves of one effect with their 1-sigma by a covariance of its parameters (None: not known)."""

    def __init__(self, camera: Camera, name: str, paths: Sequence[str], covariance: Array | None) -> None:
        self._camera, self._name = camera, name
        self._paths, self._covariance = paths, covariance

    def curve(self, line: Line, label: str) -> Curve:
        y = line.value(self._camera.effects[self._name])
        if self._covariance is None:
            return Curve(line.x, y, None, label, points=line.points)
        numbers = camera_numbers(self._camera)
        sigmas = np.sqrt(np.diag(self._covariance))
        slopes = []
        for path, sigma in zip(self._paths, sigmas, strict=True):
            step = max(float(sigma), _STEP * abs(numbers[path]), 1e-15) * 0.1
            slopes.append(self._slope(path, numbers[path], step, line))
        jacobian = np.stack(slopes)
        variance = np.einsum("ix,ij,jx->x", jacobian, self._covariance, jacobian)
        return Curve(line.x, y, np.sqrt(np.maximum(variance, 0.0)), label, points=line.points)

    def _slope(self, path: str, value: float, step: float, line: Line) -> Array:
        """Return the change of a curve by a parameter, one-sided where the other side is no valid camera."""
        sides = []
        for at in (value + step, value - step, value):
            with contextlib.suppress(InputError, ValueError):
                moved = with_numbers(self._camera, {path: at})
                sides.append((at, line.value(moved.effects[self._name])))
        (a, upper), (b, lower) = sides[:2]
        return (upper - lower) / (a - b)
