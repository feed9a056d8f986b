"""Image messages as arrays and back, by plain arguments: for recordings and for nodes alike."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags.topics import FURTHER_IMAGES
from rim_camera_ros.errors import InputError

_SAMPLES = {
    "16UC1": "u2",
    "mono16": "u2",
    "32FC1": "f4",
    "8UC1": "u1",
    "mono8": "u1",
}

#: Encodings that a role's image may have.
ENCODINGS = {
    "distance": ("16UC1", "mono16", "32FC1"),
    "amplitude": ("16UC1", "mono16", "32FC1"),
    "sigma": ("32FC1",),
    "flags": ("8UC1", "mono8"),
    "corrected_distance": ("32FC1",),
    "depth": ("32FC1",),
    **dict.fromkeys(FURTHER_IMAGES, ("16UC1", "mono16", "32FC1")),
}

#: Counts of one step of a mono8 amplitude image (ROS 1 SwissRanger: the upper eight bits).
MONO8_COUNTS = 256


class ImageData(NamedTuple):
    """The fields of an image message beside its header; ``data`` is flat uint8."""

    encoding: str
    height: int
    width: int
    step: int
    is_bigendian: bool
    data: NDArray[np.uint8]


def decode_image(
    encoding: str,
    height: int,
    width: int,
    step: int,
    is_bigendian: int | bool,
    data: Any,
    *,
    role: str | None = None,
    place: str | None = None,
    mono8_amplitude: bool = False,
) -> NDArray[Any]:
    """Return an image message's pixels as an array (height, width) in native byte order.

    ``data`` is anything with the buffer protocol. The array is a view of it (padding between the
    rows included, so it need not be contiguous) unless the byte order is foreign or a sample is
    not aligned; a view of immutable data is read-only. ``role`` limits the encodings to those of
    `ENCODINGS`; ``mono8_amplitude`` allows a mono8 amplitude as well, returned as uint16 counts
    (256 each). ``place`` is put into the error.

    Raises InputError for an encoding that is unknown or not the role's, a size of 0, a step shorter
    than a row and data whose length is not height x step.
    """
    widen = False
    if role is not None and encoding not in ENCODINGS[role]:
        widen = role == "amplitude" and mono8_amplitude and encoding in ("mono8", "8UC1")
        if not widen:
            raise _wrong_encoding(encoding, role, place)
    if encoding not in _SAMPLES:
        known = ", ".join(_SAMPLES)
        raise InputError(f"encoding '{encoding}' is not supported", place=place, remedy=f"known: {known}")
    sample = np.dtype(_SAMPLES[encoding]).newbyteorder(">" if is_bigendian else "<")
    row = width * sample.itemsize
    if height <= 0 or width <= 0:
        raise InputError(f"an image of {width} x {height} pixels", place=place)
    if step < row:
        raise InputError(
            f"step {step} is shorter than a row of {width} pixels {encoding}, {row} bytes", place=place
        )
    try:
        flat = np.frombuffer(data, np.uint8)
    except (TypeError, ValueError, BufferError) as error:
        raise InputError(f"the image's data are not bytes: {error}", place=place) from None
    if flat.size != height * step:
        raise InputError(
            f"{flat.size} bytes of image data, height {height} x step {step} makes {height * step}",
            place=place,
        )
    image: NDArray[Any] = flat.reshape(height, step)[:, :row].view(sample)
    if widen:
        return image.astype(np.uint16) * np.uint16(MONO8_COUNTS)
    if not sample.isnative:
        return image.astype(sample.newbyteorder("="))
    return image if image.flags.aligned else image.copy()


def encode_image(array: NDArray[Any]) -> ImageData:
    """Return the message fields of a (height, width) array of uint8, uint16 or float32.

    The data are a view of the array when it is contiguous and little-endian.
    Raises InputError for another type or number of dimensions.
    """
    encoding = {"u1": "8UC1", "u2": "16UC1", "f4": "32FC1"}.get(array.dtype.str[1:])
    if encoding is None or array.ndim != 2 or array.size == 0:
        raise InputError(
            f"an array of type {array.dtype} and shape {array.shape} is no image",
            remedy="uint8, uint16 or float32, (height, width)",
        )
    height, width = array.shape
    plain = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    step = width * plain.itemsize
    return ImageData(encoding, height, width, step, False, plain.reshape(-1).view(np.uint8))


def _wrong_encoding(encoding: str, role: str, place: str | None) -> InputError:
    remedy = "accepted: " + ", ".join(ENCODINGS[role])
    if role == "distance" and encoding in ("mono8", "8UC1"):
        return InputError(
            f"encoding '{encoding}' holds 256 steps only, too coarse for a distance",
            place=place,
            remedy=f"{remedy}; SwissRanger drivers publish all 16 bits on distance/image_raw16",
        )
    if role == "amplitude" and encoding in ("mono8", "8UC1"):
        remedy += "; mono8 only from intensity/image_raw of a ROS 1 SwissRanger driver"
    return InputError(f"encoding '{encoding}' is not one for the role {role}", place=place, remedy=remedy)
