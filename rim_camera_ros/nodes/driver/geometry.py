"""The service set_camera_info: writes the result of cameracalibrator to a camera file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, save_camera_apart
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera
from rim_camera_ros.nodes.common.folders import Folders
from rim_camera_ros.nodes.common.messages import intrinsics_from
from rim_camera_ros.optics import Optics


def with_geometry(camera: Camera, message: Any) -> Camera:
    """Return the camera with the geometry of a CameraInfo message.

    Raises `InputError` for another size or lens model, for numbers that are not finite, and for a lens model
    that cannot be inverted over the whole image.
    """
    stated, reason = intrinsics_from(message, "camera_info")
    if stated is None:
        raise InputError(reason, place="camera_info", remedy="calibrate with the plumb_bob model")
    if (stated.height, stated.width) != camera.shape:
        raise InputError(
            f"camera_info is of {stated.width} x {stated.height} px, the camera of "
            f"{camera.sensor.width} x {camera.sensor.height}",
            place="camera_info",
            remedy="calibrate with the images of this camera",
        )
    if not (stated.fx > 0 and stated.fy > 0):
        raise InputError(
            f"the focal lengths {stated.fx:g}, {stated.fy:g} px are not positive", place="camera_info"
        )
    if len(stated.d) > 5:
        raise InputError(f"D has {len(stated.d)} numbers, plumb_bob has 5", place="camera_info")
    k1, k2, p1, p2, k3 = (*stated.d, *(0.0,) * (5 - len(stated.d)))
    optics = Optics(fx=stated.fx, fy=stated.fy, cx=stated.cx, cy=stated.cy, d=(k1, k2, p1, p2, k3))
    changed = replace(camera, optics=optics, covariance=_without_optics(camera))
    try:
        changed.rays  # noqa: B018 -- the lens model must be invertible
    except ValueError as error:
        raise InputError(str(error), place="camera_info") from None
    return changed


def _without_optics(camera: Camera) -> Any:
    """Return the covariance of the camera file, or None where it is that of the replaced geometry."""
    covariance = camera.covariance
    if covariance is not None and any(parameter.startswith("optics.") for parameter in covariance.parameters):
        return None
    return covariance


def store_geometry(message: Any, *, base: str, folders: Folders) -> tuple[Path, Camera]:
    """Write the camera file ``base`` (path or shipped name) with another geometry into the folder for files.

    Returns its path, with the name of ``base`` or the next free one after it, and its camera.
    Raises `RimError`.
    """
    source = find_camera(base)
    camera = with_geometry(load_camera(source), message)
    path = folders.new(source.name, place="camera")
    provenance = {**camera.provenance, "geometry": f"set_camera_info, the rest from {source}"}
    camera = replace(camera, provenance=provenance)
    camera = save_camera_apart(camera, path, comment="The geometry was given by set_camera_info.")
    return path, camera
