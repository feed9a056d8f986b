"""Depth images as a camera without lens distortion would see them; no ROS in here."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import Intrinsics

#: Relative difference of a pixel from the interpolated value beyond which an edge lies between pixels.
_EDGE = 0.02


class Rectifier:
    """Resamples depth images of one camera from the distorted grid to that of its pinhole model.

    The grid is that of the camera matrix K, which camera_info repeats in P, so that depth_image_proc and nav2
    can use the result with the same camera_info. Between pixels the inverse depth is interpolated, which is
    linear on a plane. At edges, where interpolated points would be more than 2 % away from any pixel, the
    nearest pixel is used. Pixels whose ray lies outside the camera's image are NaN.
    """

    def __init__(self, intrinsics: Intrinsics) -> None:
        matrix = np.array(
            [[intrinsics.fx, 0.0, intrinsics.cx], [0.0, intrinsics.fy, intrinsics.cy], [0.0, 0.0, 1.0]]
        )
        self._u, self._v = cv2.initUndistortRectifyMap(
            matrix,
            np.array(intrinsics.d),
            np.eye(3),
            matrix,
            (intrinsics.width, intrinsics.height),
            cv2.CV_32FC1,
        )

    def depth(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the rectified depth (H, W) float32 [m] of a depth along z (H, W) [m], NaN where unknown."""
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.reciprocal(np.asarray(image, np.float32))
            nearest = self._resampled(inverse, cv2.INTER_NEAREST)
            between = self._resampled(inverse, cv2.INTER_LINEAR)
            smooth = np.abs(between - nearest) <= _EDGE * nearest  # False next to NaN
            result: NDArray[np.float32] = np.reciprocal(np.where(smooth, between, nearest))
        return result

    def _resampled(self, image: NDArray[np.float32], interpolation: int) -> NDArray[np.float32]:
        done = cv2.remap(
            image, self._u, self._v, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
        )
        return np.asarray(done, np.float32)


@lru_cache(maxsize=2)
def rectifier(intrinsics: Intrinsics) -> Rectifier:
    """Return the rectifier of a camera; the last ones are cached."""
    return Rectifier(intrinsics)
