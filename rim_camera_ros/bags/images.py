"""Image messages as arrays and back, by plain arguments: for recordings and for nodes alike."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags.topics import FURTHER_IMAGES, SAMPLES
from rim_camera_ros.errors import InputError

_SAMPLES = {
    "16UC1": "u2",
    "mono16": "u2",
    "32FC1": "f4",
    "8UC1": "u1",
    "mono8": "u1",
}

#: Encodings of images of several values a pixel.
_SEVERAL = re.compile(r"(16U|32F)C([1-9][0-9]{0,3})")

#: Encodings that a role's image may have; for those of `SAMPLES` see `_SEVERAL`.
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
    """The fields of an image message except its header; ``data`` is flat uint8."""

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
    `ENCODINGS`; images of the roles `SAMPLES` are returned as (height, width, n). ``mono8_amplitude`` also
    allows a mono8 amplitude, which is returned as uint16 counts (256 each). ``place`` is stated in errors.

    Raises InputError for an encoding that is unknown or not the role's, a size of 0, a step shorter
    than a row and data whose length is not height x step.
    """
    widen = False
    if role in SAMPLES:
        if _layout(encoding)[0] is None:
            raise InputError(
                f"encoding '{encoding}' is not one for the role {role}",
                place=place,
                remedy="accepted: 16UCn and 32FCn, n values a pixel",
            )
    elif role is not None and encoding not in ENCODINGS[role]:
        widen = role == "amplitude" and mono8_amplitude and encoding in ("mono8", "8UC1")
        if not widen:
            raise _wrong_encoding(encoding, role, place)
    kind, channels = _layout(encoding)
    if kind is None:
        known = ", ".join(_SAMPLES)
        raise InputError(f"encoding '{encoding}' is not supported", place=place, remedy=f"known: {known}")
    sample = np.dtype(kind).newbyteorder(">" if is_bigendian else "<")
    row = width * channels * sample.itemsize
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
    if role in SAMPLES:
        image = image.reshape(height, width, channels)
    if widen:
        return image.astype(np.uint16) * np.uint16(MONO8_COUNTS)
    if not sample.isnative:
        return image.astype(sample.newbyteorder("="))
    return image if image.flags.aligned else image.copy()


def _layout(encoding: str) -> tuple[str | None, int]:
    """Return the type of the values, None for an unknown one, and how many a pixel has."""
    if encoding in _SAMPLES:
        return _SAMPLES[encoding], 1
    found = _SEVERAL.fullmatch(encoding)
    if found is None:
        return None, 0
    return {"16U": "u2", "32F": "f4"}[found[1]], int(found[2])


def encode_image(array: NDArray[Any]) -> ImageData:
    """Return the message fields of an array of uint8, uint16 or float32.

    (height, width), or (height, width, n) for n values a pixel.

    The data are a view of the array when it is contiguous and little-endian.
    Raises InputError for another type or number of dimensions.
    """
    kind = {"u1": "8U", "u2": "16U", "f4": "32F"}.get(array.dtype.str[1:])
    if kind is None or array.ndim not in (2, 3) or array.size == 0:
        raise InputError(
            f"an array of type {array.dtype} and shape {array.shape} is no image",
            remedy="uint8, uint16 or float32, (height, width) or (height, width, values)",
        )
    height, width, channels = (*array.shape, 1)[:3]
    plain = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    step = width * channels * plain.itemsize
    return ImageData(f"{kind}C{channels}", height, width, step, False, plain.reshape(-1).view(np.uint8))


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
