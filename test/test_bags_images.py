"""Image messages: pixels by encoding, step and byte order, and messages against literal bytes."""

from __future__ import annotations

import math
import struct
from array import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags import decode_image, encode_image, messages
from rim_camera_ros.bags.topics import CAMERA_INFO, CLOUD, IMAGE, RANGE
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose, Settings

from .helpers_bags import INTRINSICS, JAZZY, POSE_A, START, pixels


@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
def test_little_endian_16_bit_is_a_view(encoding: str) -> None:
    data = np.frombuffer(bytes([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]), np.uint8)
    image = decode_image(encoding, 2, 3, 6, 0, data)
    assert image.tolist() == [[0x0201, 0x0403, 0x0605], [0x0807, 0x0A09, 0x0C0B]]
    assert image.dtype == np.uint16
    assert np.shares_memory(image, data)


def test_big_endian_16_bit() -> None:
    image = decode_image("16UC1", 2, 1, 2, True, b"\x01\x02\x03\x04")
    assert image.tolist() == [[0x0102], [0x0304]]
    assert image.dtype.isnative


@pytest.mark.parametrize(("order", "flag"), [("<", 0), (">", 1)])
def test_float_metres_in_both_byte_orders(order: str, flag: int) -> None:
    image = decode_image("32FC1", 1, 2, 8, flag, struct.pack(order + "2f", 1.5, -0.25))
    assert image.tolist() == [[1.5, -0.25]]
    assert image.dtype == np.float32


def test_padding_between_rows_is_skipped() -> None:
    image = decode_image("16UC1", 2, 2, 7, 0, b"\x01\0\x02\0\xff\xff\xff\x03\0\x04\0\xff\xff\xff")
    assert image.tolist() == [[1, 2], [3, 4]]
    assert image.flags.aligned


def test_even_padding_stays_a_view() -> None:
    data = np.arange(16, dtype=np.uint8)
    image = decode_image("16UC1", 2, 2, 8, 0, data)
    assert image.tolist() == [[0x0100, 0x0302], [0x0908, 0x0B0A]]
    assert np.shares_memory(image, data)


def test_any_buffer_does() -> None:
    raw = bytes(range(4))
    for data in (raw, bytearray(raw), memoryview(raw), array("B", raw), np.frombuffer(raw, np.uint8)):
        assert decode_image("8UC1", 2, 2, 2, 0, data).tolist() == [[0, 1], [2, 3]]


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (("16UC1", 2, 3, 6, 0, b"\0" * 11), "11 bytes of image data, height 2 x step 6 makes 12"),
        (("16UC1", 2, 3, 6, 0, b"\0" * 13), "13 bytes of image data"),
        (("16UC1", 2, 3, 5, 0, b"\0" * 10), "step 5 is shorter than a row of 3 pixels 16UC1, 6 bytes"),
        (("16UC1", 0, 3, 6, 0, b""), "an image of 3 x 0 pixels"),
        (("16UC1", 3, 0, 6, 0, b"\0" * 18), "an image of 0 x 3 pixels"),
        (("rgb8", 1, 1, 3, 0, b"\0" * 3), "encoding 'rgb8' is not supported.*known: 16UC1, mono16, 32FC1"),
        (("8UC1", 1, 1, 1, 0, "x"), "data are not bytes"),
    ],
)
def test_wrong_images_are_refused(arguments: tuple[Any, ...], match: str) -> None:
    with pytest.raises(InputError, match=match):
        decode_image(*arguments)


def test_place_is_in_the_error() -> None:
    with pytest.raises(InputError, match=r"^topic /a at 1\.0 s: an image of 0 x 1 pixels"):
        decode_image("8UC1", 1, 0, 1, 0, b"\0", place="topic /a at 1.0 s")


@pytest.mark.parametrize(
    ("role", "encoding", "match"),
    [
        ("distance", "mono8", "256 steps only.*distance/image_raw16"),
        ("distance", "8UC1", "accepted: 16UC1, mono16, 32FC1"),
        ("amplitude", "mono8", "not one for the role amplitude.*intensity/image_raw of a ROS 1 SwissRanger"),
        ("flags", "16UC1", "not one for the role flags.*accepted: 8UC1, mono8"),
        ("depth", "16UC1", "not one for the role depth.*accepted: 32FC1"),
    ],
)
def test_roles_limit_the_encodings(role: str, encoding: str, match: str) -> None:
    with pytest.raises(InputError, match=match):
        decode_image(encoding, 1, 2, 4, 0, b"\0" * 4, role=role)


def test_mono8_amplitude_counts_256() -> None:
    image = decode_image("mono8", 1, 3, 3, 0, b"\0\x01\xff", role="amplitude", mono8_amplitude=True)
    assert image.tolist() == [[0, 256, 65280]]
    assert image.dtype == np.uint16


@pytest.mark.parametrize(
    ("dtype", "encoding", "step"),
    [(np.uint8, "8UC1", 5), (np.uint16, "16UC1", 10), (np.float32, "32FC1", 20)],
)
def test_encoding_and_decoding_give_the_same_bits(dtype: Any, encoding: str, step: int) -> None:
    array = pixels(3, dtype=dtype)
    image = encode_image(array)
    assert (image.encoding, image.height, image.width, image.step) == (encoding, 3, 5, step)
    assert np.shares_memory(image.data, array)
    assert np.array_equal(decode_image(*image), array)


def test_foreign_layouts_are_encoded_little_endian() -> None:
    array = pixels(1)
    turned = np.asfortranarray(array.astype(">u2"))
    assert encode_image(turned).data.tobytes() == array.astype("<u2").tobytes()


@pytest.mark.parametrize(
    "array", [np.zeros((2, 2), np.int32), np.zeros(4, np.uint16), np.zeros((0, 3), np.uint8)]
)
def test_arrays_that_are_no_images_are_refused(array: Any) -> None:
    with pytest.raises(InputError, match="is no image"):
        encode_image(array)


def test_image_against_bytes_written_by_hand() -> None:
    body = struct.pack("<iI", 1700, 9)  # stamp
    body += struct.pack("<I", 4) + b"cam\0"  # frame_id
    body += struct.pack("<II", 2, 3)  # height, width
    body += struct.pack("<I", 6) + b"16UC1\0"  # encoding
    body += b"\0"  # is_bigendian
    body += b"\0" * (-len(body) % 4) + struct.pack("<I", 6)  # step, aligned
    body += struct.pack("<I", 12) + bytes([1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 255, 255])
    raw = b"\x00\x01\x00\x00" + body
    made = messages.image_message(np.array([[1, 2, 3], [4, 5, 65535]], np.uint16), 1_700_000_000_009, "cam")
    assert bytes(messages.encode(made, IMAGE)) == raw
    read = messages.decode(raw, IMAGE)
    assert messages.stamp_of(read) == 1_700_000_000_009
    assert messages.image_array(read).tolist() == [[1, 2, 3], [4, 5, 65535]]


def test_cloud_is_organised_in_16_bytes_a_point() -> None:
    points = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    points[1, 2, :3] = np.nan
    cloud = messages.points_message(points, START)
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (2, 3, 16, 48)
    assert not cloud.is_dense
    assert not cloud.is_bigendian
    assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
        ("intensity", 12, 7, 1),
    ]
    assert cloud.data[:16].tobytes() == struct.pack("<4f", 0, 1, 2, 3)
    assert cloud.data[48:64].tobytes() == struct.pack("<4f", 12, 13, 14, 15)
    back = messages.points_array(messages.decode(bytes(messages.encode(cloud, CLOUD)), CLOUD))
    assert back.tobytes() == points.tobytes()


def test_other_clouds_are_refused() -> None:
    with pytest.raises(InputError, match=r"points of shape \(2, 3\)"):
        messages.points_message(np.zeros((2, 3), np.float32), START)
    cloud = messages.points_message(np.zeros((2, 3, 4), np.float32), START)
    cloud.row_step = 64
    with pytest.raises(InputError, match="not packed in 16 bytes a point"):
        messages.points_array(cloud)
    cloud.fields[3].name = "rgb"
    with pytest.raises(InputError, match="fields are x y z rgb"):
        messages.points_array(cloud)


def test_camera_info_by_position() -> None:
    message = messages.camera_info_message(INTRINSICS, START)
    assert message.k.tolist() == [199.8875, 0, 2.25, 0, 201.5, 0.75, 0, 0, 1]
    assert message.p.tolist() == [199.8875, 0, 2.25, 0, 0, 201.5, 0.75, 0, 0, 0, 1, 0]
    assert message.r.tolist() == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert message.distortion_model == "plumb_bob"
    assert messages.intrinsics_from(
        messages.decode(bytes(messages.encode(message, CAMERA_INFO)), CAMERA_INFO)
    ) == (
        INTRINSICS,
        "",
    )


def test_camera_info_that_is_not_used() -> None:
    message = messages.camera_info_message(INTRINSICS, START)
    message.distortion_model = "equidistant"
    assert messages.intrinsics_from(message) == (
        None,
        "camera_info has the distortion model equidistant and is not used",
    )
    message.k[:] = 0
    intrinsics, reason = messages.intrinsics_from(message)
    assert intrinsics is None
    assert "uncalibrated" in reason
    message.k[0] = math.inf
    with pytest.raises(InputError, match="not finite"):
        messages.intrinsics_from(message)


def test_settings_of_a_message_of_any_library() -> None:
    pairs = [("integration_time", "16"), ("gain", "high"), ("uptime", "0.0"), ("uptime", "7")]
    values = [SimpleNamespace(key=key, value=value) for key, value in pairs]
    message = SimpleNamespace(status=[SimpleNamespace(hardware_id="SR-3000", values=values)])
    settings, device = messages.settings_from(message)
    assert settings == Settings(integration_time=16.0, uptime=0.0, extra={"gain": "high"})
    assert device == "SR-3000"


@pytest.mark.parametrize(
    ("key", "text", "match"),
    [
        ("integration_time", "long", "integration_time: 'long' is not a number"),
        ("integration_time", "0", "integration_time: 0 is not positive"),
        ("integration_time", "-3", "-3 is not positive"),
        ("modulation_frequency", "nan", "'nan' is not a number"),
        ("uptime", "-1", "-1 is not 0 or more"),
        ("uptime", "", "'' is not a number"),
    ],
)
def test_wrong_settings_are_refused(key: str, text: str, match: str) -> None:
    message = messages.frame_info_message(Settings(extra={key: text}), START)
    with pytest.raises(InputError, match=f"^topic /t, {match}" if match.startswith(key) else match):
        messages.settings_from(message, "topic /t")


@pytest.mark.parametrize("value", [16.0, 0.1, 1e-300, 123456789.123, 2e7, 1e22])
def test_settings_keep_every_bit(value: float) -> None:
    settings = Settings(integration_time=value, modulation_frequency=value / 3, uptime=value, extra={})
    assert messages.settings_from(messages.frame_info_message(settings, START, "d")) == (settings, "d")


def test_poses() -> None:
    assert messages.pose_from(messages.pose_message(POSE_A, START)) == POSE_A
    double = Pose((1, 2, 3), (0.0, 0.0, 1.2, 1.6))
    turn = messages.pose_from(messages.pose_message(double, START)).orientation
    assert turn == pytest.approx((0.0, 0.0, 0.6, 0.8), abs=1e-15)
    with pytest.raises(InputError, match="has no direction"):
        messages.pose_from(messages.pose_message(Pose((1, 2, 3), (0, 0, 0, 0)), START))
    with pytest.raises(InputError, match="not finite"):
        messages.pose_from(messages.pose_message(Pose((math.nan, 2, 3)), START))


def test_range_of_older_distributions_is_read() -> None:
    message = messages.range_message(0.375, START)
    raw = bytes(messages.encode(message, RANGE))
    assert messages.range_from(messages.decode(raw, RANGE)) == 0.375
    assert messages.range_from(messages.decode(raw[:-4], RANGE)) == 0.375  # without the field variance
    assert messages.range_from(messages.range_message(None, START)) is None


@pytest.mark.parametrize("raw", [b"", b"\0", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 60])
def test_bytes_that_are_no_message_are_refused(raw: bytes) -> None:
    with pytest.raises(
        InputError, match=r"^topic /x: a message of type sensor_msgs/msg/Image cannot be decoded"
    ):
        messages.decode(raw, IMAGE, place="topic /x")


@pytest.mark.parametrize("stamp", [-1, 2**31 * 10**9])
def test_stamps_outside_a_message_are_refused(stamp: int) -> None:
    with pytest.raises(InputError, match="outside what a ROS message holds"):
        messages.image_message(pixels(0), stamp)


def test_big_endian_serialisation_is_read() -> None:
    message = messages.image_message(pixels(4), START)
    raw = bytes(JAZZY.serialize_cdr(message, IMAGE, little_endian=False))
    read = messages.decode(raw, IMAGE)
    assert messages.stamp_of(read) == START
    assert np.array_equal(messages.image_array(read), pixels(4))
