"""Grey values around a corner of a checkerboard: two crossing edges, blurred, linearly illuminated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.photogrammetry.edges import edge_coverage, edge_coverage_slopes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CornerModel:
    """Grey values at pixels (``x``, ``y``), (n,) in px, around a corner near ``start``.

    ``bend`` (2,) 1/px are the curvatures of the edges. The parameters are u and v of the corner [px], the
    angles of the two edges [rad], mean and half the step of the grey values, sigma of the blur [px], and the
    relative slopes of the illumination along columns and rows [1/px].
    """

    x: Array
    y: Array
    start: Array
    bend: Array

    def depths(self, parameters: Array) -> list[Array]:
        """Return how far the pixels lie beyond each edge [px]."""
        dx, dy = self.x - parameters[0], self.y - parameters[1]
        result = []
        for angle, curvature in zip(parameters[2:4], self.bend, strict=True):
            along, across = np.cos(angle), np.sin(angle)
            bow = curvature / 2 * (along * dx + across * dy) ** 2
            result.append(along * dy - across * dx - bow)
        return result

    def sides(self, parameters: Array) -> Array:
        """Return the pattern: 1 in two of the four fields, -1 in the others."""
        blur = parameters[6]
        first, second = (
            2 * edge_coverage(depth, np.sin(angle), np.cos(angle), blur) - 1
            for angle, depth in zip(parameters[2:4], self.depths(parameters), strict=True)
        )
        return np.asarray(first * second)

    def values(self, parameters: Array) -> Array:
        """Return the grey values (n,)."""
        level = parameters[4] + parameters[5] * self.sides(parameters)
        return np.asarray(level * self._trend(parameters))

    def slopes(self, parameters: Array) -> Array:
        """Return the derivatives of the grey values (n, 9)."""
        mean, step, blur = parameters[4:7]
        dx, dy = self.x - parameters[0], self.y - parameters[1]
        sides, changes = [], []
        for angle, curvature, depth in zip(parameters[2:4], self.bend, self.depths(parameters), strict=True):
            along, across = np.cos(angle), np.sin(angle)
            edge = edge_coverage_slopes(depth, across, along, blur)
            bow = curvature * (along * dx + across * dy)
            by_angle = -across * dy - along * dx - bow * (along * dy - across * dx)
            sides.append(2 * edge.covered - 1)
            changes.append(
                [
                    edge.by_depth * (across + bow * along),
                    edge.by_depth * (bow * across - along),
                    edge.by_depth * by_angle + edge.by_normal_u * along - edge.by_normal_v * across,
                    edge.by_blur,
                ]
            )
        first, second = sides
        (u1, v1, a1, b1), (u2, v2, a2, b2) = changes
        pattern, trend = first * second, self._trend(parameters)
        by_side = 2 * step * trend
        level = mean + step * pattern
        return np.stack(
            [
                by_side * (u1 * second + first * u2),
                by_side * (v1 * second + first * v2),
                by_side * a1 * second,
                by_side * first * a2,
                trend,
                pattern * trend,
                by_side * (b1 * second + first * b2),
                level * (self.x - self.start[0]),
                level * (self.y - self.start[1]),
            ],
            axis=-1,
        )

    def _trend(self, parameters: Array) -> Array:
        return np.asarray(
            1 + parameters[7] * (self.x - self.start[0]) + parameters[8] * (self.y - self.start[1])
        )
