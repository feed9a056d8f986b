"""Images of drivers as arrays: raw messages and image_transport's ``compressed`` and ``compressedDepth``.

Formats: image_transport_plugins (github ros-perception/image_transport_plugins at 7404d77),
compressed_image_transport/src/compressed_subscriber.cpp and compressed_depth_image_transport/src/codec.cpp,
rvl_codec.cpp (A. D. Wilson, Fast Lossless Depth Image Compression, 2017).
"""

from __future__ import annotations

import struct
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags.images import decode_image
from rim_camera_ros.errors import InputError

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

#: Transport of an image, which is the ending of its topic.
Transport = Literal["raw", "compressed", "compressedDepth"]

#: Pixels beyond which a compressed image is refused.
_MOST_PIXELS = 8192 * 8192
#: Bytes before a compressedDepth image: format (int32), depth quantisation A and B (float32).
_HEADER = struct.Struct("<iff")
_SIXTEEN_BIT = ("mono16", "16UC1")
#: Bytes in which a PNG states its size: signature, chunk, width, height.
_PNG = struct.Struct(">8s4s4sII")


def decode_pixels(message: Any, transport: Transport, *, role: str, place: str) -> NDArray[Any]:
    """Return a message's pixels: (H, W) uint8, uint16 or float32, or (H, W, 3) float32 for 32FC3.

    ``role`` (distance or amplitude): a distance must not have been compressed as JPEG.
    Raises `InputError` for an encoding that holds no such image, or damaged data.
    """
    if transport == "raw":
        return _raw(message, place)
    data = bytes(message.data)
    encoding, _, how = (part.strip() for part in str(message.format).partition(";"))
    if transport == "compressedDepth":
        return _compressed_depth(data, encoding, how, place)
    if encoding in ("jpeg", "jpg", "png", "tiff"):  # some drivers only name the file format
        encoding, how = "", encoding
    lossy = "jpeg" in how or "jpg" in how or data[:2] == b"\xff\xd8"
    if lossy and role == "distance":
        raise InputError(
            "the distance went through JPEG, which destroys it",
            place=place,
            remedy="record the raw topic, compressedDepth, or compressed with format png",
        )
    image = _decoded(data, place)
    if image.ndim != 2:
        raise InputError(
            f"the compressed image has {image.shape[2]} channels",
            place=place,
            remedy=f"--topic {role}=an image of one channel",
        )
    if lossy and encoding in _SIXTEEN_BIT and image.dtype == np.uint8:
        return image.astype(np.uint16) * np.uint16(256)
    return image


def _raw(message: Any, place: str) -> NDArray[Any]:
    if message.encoding != "32FC3":
        return decode_image(
            message.encoding,
            message.height,
            message.width,
            message.step,
            message.is_bigendian,
            message.data,
            place=place,
        )
    height, width, step = int(message.height), int(message.width), int(message.step)
    flat = np.frombuffer(message.data, np.uint8)
    if height <= 0 or width <= 0 or step < 12 * width or flat.size != height * step:
        raise InputError(
            f"{flat.size} bytes do not hold {width} x {height} points of 12 bytes, step {step}", place=place
        )
    kind = ">f4" if message.is_bigendian else "<f4"
    rows = np.ascontiguousarray(flat.reshape(height, step)[:, : 12 * width])
    return rows.view(kind).reshape(height, width, 3).astype(np.float32, copy=False)


def _compressed_depth(data: bytes, encoding: str, how: str, place: str) -> NDArray[Any]:
    words = how.split()
    method = words[1] if len(words) > 1 else "png"
    if words[:1] not in ([], ["compressedDepth"]) or method not in ("png", "rvl"):
        raise InputError(
            f"the format '{encoding}; {how}' is not one of compressedDepth", place=place, remedy="png or rvl"
        )
    if encoding not in (*_SIXTEEN_BIT, "32FC1"):
        raise InputError(f"compressedDepth of '{encoding}'", place=place, remedy="16UC1 or 32FC1")
    if len(data) <= _HEADER.size:
        raise InputError("the compressed image is empty", place=place, remedy="record it again")
    _, a, b = _HEADER.unpack_from(data)
    body = data[_HEADER.size :]
    image = _decoded(body, place) if method == "png" else decode_rvl(body, place)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError("compressedDepth holds no 16-bit image", place=place, remedy="record it again")
    if encoding != "32FC1":
        return image
    with np.errstate(divide="ignore"):
        depth = a / (image.astype(np.float32) - np.float32(b))
    return np.where(image > 0, depth, np.nan).astype(np.float32)


def _decoded(data: bytes, place: str) -> NDArray[Any]:
    import cv2

    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= _PNG.size:
        _, _, _, width, height = _PNG.unpack_from(data)
        if width * height > _MOST_PIXELS:
            raise InputError(f"a compressed image of {width} x {height} pixels", place=place)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise InputError(
            "the compressed image cannot be decoded",
            place=place,
            remedy="known: PNG, TIFF, JPEG; record it again if it is one of these",
        )
    result: NDArray[Any] = image
    return result


def decode_rvl(data: bytes, place: str | None = None) -> NDArray[np.uint16]:
    """Return the (height, width) uint16 image of RVL data: width and height (uint32), then 32-bit words.

    Raises `InputError` for data that end early or hold another number of pixels.
    """
    broken = InputError("the RVL data are damaged", place=place, remedy="record it again")
    if len(data) < 8:
        raise broken
    width, height = struct.unpack_from("<II", data)
    pixels = width * height
    # RVL stores at most four pixels per byte for values, runs of zeros are shorter still
    if not 0 < pixels <= _MOST_PIXELS:
        raise broken
    words = np.frombuffer(data[8 : 8 + (len(data) - 8) // 4 * 4], "<u4")
    shifts = np.arange(28, -1, -4, dtype=np.uint32)
    nibbles = ((words[:, None] >> shifts) & np.uint32(0xF)).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    if not ends.size:
        raise broken
    starts = np.concatenate([[0], ends[:-1] + 1])
    nibbles = nibbles[: ends[-1] + 1]
    lengths = ends - starts + 1
    if lengths.max() > 11:
        raise broken
    position = np.arange(nibbles.size) - np.repeat(starts, lengths)
    values = np.add.reduceat((nibbles & 7) << (3 * position), starts)
    result = np.zeros(pixels, np.uint16)
    at, k, last = 0, 0, 0
    while at < pixels:
        if k + 1 >= values.size:
            raise broken
        zeros, filled = int(values[k]), int(values[k + 1])
        k, at = k + 2, at + zeros
        if at + filled > pixels or k + filled > values.size or zeros + filled == 0:
            raise broken
        steps = values[k : k + filled]
        steps = (steps >> 1) ^ -(steps & 1)
        row = last + np.cumsum(steps)
        result[at : at + filled] = (row & 0xFFFF).astype(np.uint16)
        if filled:
            last = int(row[-1])
        k, at = k + filled, at + filled
    return result.reshape(height, width)
