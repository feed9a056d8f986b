"""A driver's pixels as radial distances and amplitudes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError
from rim_camera_ros.imports.profile import AmplitudeSource, DistanceSource


def radial_distance(
    image: NDArray[Any], source: DistanceSource, stretch: NDArray[np.float32] | None
) -> NDArray[Any]:
    """Return distances from the projection centre (H, W), 0 where there is none.

    Radial 16-bit counts without an offset stay uint16 counts; everything else becomes float32 metres.
    ``stretch`` (H, W): ratio of the distance to the depth along z, by the exact lens model; None where images
    are not depths along z. Raises `InputError` for an image that is not of the source's kind.
    """
    if (image.ndim == 3) != (source.kind == "points"):
        raise InputError(
            f"the image has {'three values' if image.ndim == 3 else 'one value'} a pixel",
            remedy="--distance-kind points for 32FC3, else z or radial",
        )
    if image.dtype == np.uint8:
        raise InputError("8 bits are too coarse for a distance", remedy="--topic distance=a 16-bit image")
    if image.dtype == np.uint16 and source.kind == "radial" and source.offset == 0.0:
        return image
    with np.errstate(invalid="ignore", over="ignore"):
        metres = _metres(image, source)
        if source.kind == "z" and stretch is not None:
            if metres.shape != stretch.shape:
                raise InputError("the size of the images changes", remedy="split the recording there")
            metres = metres * stretch
        good = np.isfinite(metres) & (metres > 0)
    return np.where(good, metres, 0.0).astype(np.float32)


def _metres(image: NDArray[Any], source: DistanceSource) -> NDArray[Any]:
    if source.kind == "points":
        distance: NDArray[Any] = np.linalg.norm(image, axis=-1)
        return distance
    if image.dtype != np.uint16:
        return image
    if source.unit is None:
        raise InputError("metres per count are not known", remedy="--distance-unit METRES")
    return np.where(image > 0, image * np.float64(source.unit) + source.offset, 0.0)


def amplitude_counts(image: NDArray[Any], source: AmplitudeSource) -> NDArray[Any]:
    """Return amplitudes (H, W) in counts, uint16 or float32; 0 where a float is not finite.

    Raises `InputError` for an image of several channels.
    """
    if image.ndim != 2:
        raise InputError("the amplitude has several values a pixel", remedy="--topic amplitude=NAME")
    if image.dtype == np.uint8:
        if source.counts == int(source.counts):
            return image.astype(np.uint16) * np.uint16(source.counts)
        return image.astype(np.float32) * np.float32(source.counts)
    if image.dtype == np.uint16:
        return image
    return np.where(np.isfinite(image) & (image > 0), image, 0.0).astype(np.float32)
