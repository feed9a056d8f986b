"""Images as image_transport packs them."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rim_camera_ros.errors import InputError
from rim_camera_ros.imports.images import decode_pixels, decode_rvl
from test.imports.drivers import encoded, image, packed, points_image

GREY = (np.arange(6 * 7, dtype=np.uint16).reshape(6, 7) * 991 + 3).astype(np.uint16)


def rvl(image: Any) -> bytes:
    """Return RVL as Wilson's paper describes it, nibble by nibble: an encoder of its own."""
    flat = [int(x) for x in image.ravel()]
    nibbles: list[int] = []

    def put(value: int) -> None:
        while True:
            low, value = value & 7, value >> 3
            nibbles.append(low | (8 if value else 0))
            if not value:
                return

    at, last = 0, 0
    while at < len(flat):
        start = at
        while at < len(flat) and flat[at] == 0:
            at += 1
        put(at - start)
        start = at
        while at < len(flat) and flat[at] != 0:
            at += 1
        put(at - start)
        for value in flat[start:at]:
            delta = value - last
            put(2 * delta if delta >= 0 else -2 * delta - 1)
            last = value
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{x:x}" for x in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)]
    return struct.pack(f"<II{len(words)}I", image.shape[1], image.shape[0], *words)


def decoded(line: Any, transport: Any, role: str = "distance") -> Any:
    return decode_pixels(line.message, transport, role=role, place="topic /x")


@settings(max_examples=60, deadline=None)
@given(arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 11)), elements=st.integers(0, 65535)))
def test_rvl_gives_back_every_image(image: Any) -> None:
    assert np.array_equal(decode_rvl(rvl(image)), image)


@settings(max_examples=60, deadline=None)
@given(arrays(np.uint16, (8, 9), elements=st.sampled_from([0, 0, 0, 1200, 1201, 1199])))
def test_rvl_with_runs_of_nothing(image: Any) -> None:
    assert np.array_equal(decode_rvl(rvl(image)), image)


@pytest.mark.parametrize("cut", [0, 7, 8, 12, 20])
def test_damaged_rvl_is_an_error(cut: int) -> None:
    with pytest.raises(InputError, match=r"the RVL data are damaged \(record it again\)"):
        decode_rvl(rvl(GREY)[:cut])


def test_rvl_of_absurd_size_is_an_error() -> None:
    with pytest.raises(InputError, match="the RVL data are damaged"):
        decode_rvl(struct.pack("<III", 100_000, 100_000, 0))


@pytest.mark.parametrize(
    ("form", "ending"), [("16UC1; png compressed", ".png"), ("16UC1; tiff compressed", ".tif")]
)
def test_lossless_images(form: str, ending: str) -> None:
    line = packed(encoded(GREY, ending), form, "/d/compressed", 1)
    assert np.array_equal(decoded(line, "compressed"), GREY)


def test_compressed_depth_of_counts() -> None:
    header = struct.pack("<iff", 0, 1.0, 2.0)
    png = packed(header + encoded(GREY, ".png"), "16UC1; compressedDepth png", "/d", 1)
    assert np.array_equal(decoded(png, "compressedDepth"), GREY)
    old = packed(header + encoded(GREY, ".png"), "16UC1; compressedDepth", "/d", 1)
    assert np.array_equal(decoded(old, "compressedDepth"), GREY)
    by_rvl = packed(header + rvl(GREY), "mono16; compressedDepth rvl", "/d", 1)
    assert np.array_equal(decoded(by_rvl, "compressedDepth"), GREY)


def test_compressed_depth_of_metres() -> None:
    """codec.cpp: inverse depth A / z + B as uint16, with A = z0 (z0 + 1), B = 1 - A / zmax."""
    depth = np.array([[0.5, 1.25, 3.7], [9.0, np.nan, 0.8]], np.float32)
    z0, farthest = 100.0, 10.0
    a = z0 * (z0 + 1)
    b = 1 - a / farthest
    with np.errstate(invalid="ignore"):
        inverse = np.where(depth < farthest, a / depth + b, 0).astype(np.uint16)
    data = struct.pack("<iff", 0, a, b) + encoded(inverse, ".png")
    found = decoded(packed(data, "32FC1; compressedDepth png", "/d", 1), "compressedDepth")
    assert found.dtype == np.float32
    assert np.isnan(found[1, 1])
    good = np.isfinite(depth)
    # one step of the inverse depth is z^2 / A
    assert np.all(np.abs(found - depth)[good] <= depth[good] ** 2 / a * 1.001)


def test_jpeg_is_an_amplitude_but_no_distance() -> None:
    smooth = np.tile(np.linspace(20, 200, 32).astype(np.uint8), (24, 1))
    data = encoded(smooth, ".jpg")
    line = packed(data, "mono8; jpeg compressed ", "/i/compressed", 1)
    assert np.abs(decoded(line, "compressed", "amplitude").astype(int) - smooth).max() <= 6
    with pytest.raises(InputError, match=r"topic /x: the distance went through JPEG, .*record the raw topic"):
        decoded(line, "compressed")
    sixteen = packed(data, "mono16; jpeg compressed ", "/i/compressed", 1)
    found = decoded(sixteen, "compressed", "amplitude")
    assert found.dtype == np.uint16
    assert np.array_equal(found // 256, cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))


def test_colour_is_refused() -> None:
    colour = encoded(np.zeros((4, 5, 3), np.uint8), ".png")
    with pytest.raises(InputError, match=r"has 3 channels \(--topic amplitude="):
        decoded(packed(colour, "bgr8; png compressed bgr8", "/c", 1), "compressed", "amplitude")
    with pytest.raises(InputError, match="encoding 'rgb8' is not supported"):
        decoded(image(np.zeros((3, 4), np.uint8), "/c", 1, "rgb8"), "raw", "amplitude")


@pytest.mark.parametrize("data", [b"", b"nonsense", b"\x89PNG\r\n\x1a\n" + b"\0" * 40])
def test_what_is_no_image_is_an_error(data: bytes) -> None:
    with pytest.raises(InputError, match="compressed image cannot be decoded"):
        decoded(packed(data, "16UC1; png compressed", "/d", 1), "compressed")


def test_a_png_of_absurd_size_is_not_unpacked() -> None:
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 60_000, 60_000) + b"\0" * 20
    with pytest.raises(InputError, match="60000 x 60000 pixels"):
        decoded(packed(head, "16UC1; png compressed", "/d", 1), "compressed")


def test_other_formats_of_compressed_depth_are_named() -> None:
    with pytest.raises(InputError, match="'16UC1; compressedDepth zstd' is not one of compressedDepth"):
        decoded(packed(b"x" * 30, "16UC1; compressedDepth zstd", "/d", 1), "compressedDepth")


def test_points() -> None:
    values = np.arange(4 * 5 * 3, dtype=np.float32).reshape(4, 5, 3)
    line = points_image(values, "/xyz", 1)
    assert np.array_equal(decoded(line, "raw"), values)
    line.message.step = 8
    with pytest.raises(InputError, match="do not hold 5 x 4 points"):
        decoded(line, "raw")
