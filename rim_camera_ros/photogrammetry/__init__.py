"""Photogrammetric calibration: targets in amplitude images, bundle adjustment, estimated optics.

Kahlmann 2007, sec. 3.2. `observe` reads targets from recorded frames, `estimate_optics` adjusts them.
"""

from __future__ import annotations

from rim_camera_ros.photogrammetry.checkerboards import Corner, find_checkerboard, refine_corners
from rim_camera_ros.photogrammetry.circles import Ellipse, find_circles
from rim_camera_ros.photogrammetry.estimate import estimate_optics
from rim_camera_ros.photogrammetry.observe import observe
from rim_camera_ros.photogrammetry.projection import OPTICS_PARAMETERS, ellipse_centre_offset
from rim_camera_ros.photogrammetry.report import (
    InsignificantParameters,
    OpticsCovariance,
    OpticsReport,
    RejectedPoint,
)
from rim_camera_ros.photogrammetry.targets import Distance, ImagePoint, Observations, Target, TargetField

__all__ = [
    "OPTICS_PARAMETERS",
    "Corner",
    "Distance",
    "Ellipse",
    "ImagePoint",
    "InsignificantParameters",
    "Observations",
    "OpticsCovariance",
    "OpticsReport",
    "RejectedPoint",
    "Target",
    "TargetField",
    "ellipse_centre_offset",
    "estimate_optics",
    "find_checkerboard",
    "find_circles",
    "observe",
    "refine_corners",
]
