"""Images in the formats of image_transport's plug-ins ``compressed`` and ``compressedDepth``; no ROS in here.

Python nodes cannot load those plug-ins. Here their formats are written with OpenCV's codecs. Subscribers that
use image_transport, and RViz, rqt and Foxglove, receive them like those of the plug-ins.
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags.images import encode_image
from rim_camera_ros.errors import RimError

#: Formats of amplitude/image_raw/compressed: without loss, and for looking at it over a slow network.
PNG, JPEG = "png", "jpeg"
#: Quantisation of inverse depths, and the greatest depth [m]: the plug-in's own defaults.
QUANTIZATION, GREATEST_DEPTH = 100.0, 10.0
#: First field of the header of a compressed depth: inverse depth.
_INVERSE_DEPTH = 0
#: Level of PNG's compression: higher ones save few bytes and take much longer.
_LEVEL = 1
#: Counts of a step of 8 bits in JPEG, and its quality: image_transport's own.
_JPEG_STEP, _QUALITY = 256, 95


def compressed(pixels: NDArray[Any]) -> tuple[str, bytes]:
    """Return format and data of a CompressedImage that holds uint8 or uint16 pixels (H, W) without loss."""
    encoding = encode_image(pixels).encoding
    return f"{encoding}; png compressed ", _png(pixels)


def compressed_for_looking(pixels: NDArray[np.uint16]) -> tuple[str, bytes]:
    """Return format and data of a CompressedImage that holds uint16 pixels (H, W) as JPEG of 8 bits.

    One step is 256 counts, rounded, as in image_transport, whose subscribers multiply by 256 again.
    """
    steps = np.minimum((pixels.astype(np.uint32) + _JPEG_STEP // 2) // _JPEG_STEP, 255).astype(np.uint8)
    encoding = encode_image(pixels).encoding
    return f"{encoding}; jpeg compressed mono8", _encoded(".jpg", steps, cv2.IMWRITE_JPEG_QUALITY, _QUALITY)


def compressed_depth(depth: NDArray[np.float32]) -> tuple[str, bytes]:
    """Return format and data of a CompressedImage that holds a depth (H, W) [m] as quantised inverse depth.

    12 bytes precede the PNG: int32 0 (inverse depth), float32 A, float32 B, little-endian. A pixel n has the
    depth A / (n - B); 0 means no depth. The step is depth^2 / A: 0.9 mm at 3 m. Depths that do not fit in 16
    bits, from 10 m on and below 0.152 m, become 0.
    """
    a = QUANTIZATION * (QUANTIZATION + 1.0)
    b = 1.0 - a / GREATEST_DEPTH
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        steps = (
            a / np.asarray(depth, np.float32) + b + 0.5
        )  # rounded: the plug-in cuts off, half a step nearer
        held = (depth > 0) & (depth < GREATEST_DEPTH) & (steps < 65536.0)
    pixels = np.where(held, steps, 0.0).astype(np.uint16)
    return "32FC1; compressedDepth png", struct.pack("<iff", _INVERSE_DEPTH, a, b) + _png(pixels)


def _png(pixels: NDArray[Any]) -> bytes:
    return _encoded(".png", pixels, cv2.IMWRITE_PNG_COMPRESSION, _LEVEL)


def _encoded(kind: str, pixels: NDArray[Any], option: int, value: int) -> bytes:
    done, data = cv2.imencode(kind, pixels, [option, value])
    if not done:
        raise RimError(f"OpenCV cannot write {kind}", remedy="install an OpenCV with that codec")
    return bytes(data)
