"""Recordings that are cut off or damaged: the frames before the fault, then one clear error."""

from __future__ import annotations

import re
import resource
import shutil
import sqlite3
import struct
import time
import zlib
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from rim_camera_ros.bags import Recording
from rim_camera_ros.bags.compress import LARGEST_BLOCK, CompressionError, decompress
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.frame import RawFrame

from .helpers_bags import (
    JAZZY,
    POSE_A,
    START,
    Line,
    exposure,
    flat,
    pair,
    pixels,
    pose,
    stamp_at,
    write_bag,
    write_bag1,
)

LARGE = (72, 88)
FRAMES = 120  # of 25 KB: three chunks of 1 MiB


def read_all(path: Path) -> tuple[list[RawFrame], RimError | None]:
    """Return the frames and the error they ended with."""
    frames: list[RawFrame] = []
    try:
        with Recording(path) as recording:
            recording.summary()
            for frame in recording.frames():
                frames.append(frame)
    except RimError as error:
        return frames, error
    return frames, None


def record(op: int, content: bytes) -> bytes:
    return struct.pack("<BQ", op, len(content)) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def mcap_records(lines: list[Line]) -> tuple[bytes, bytes]:
    """Return the records that declare the topics and those of the messages."""
    topics = {line.topic: line.msgtype for line in lines}
    keys = {topic: key for key, topic in enumerate(topics, 1)}
    head = b""
    for topic, key in keys.items():
        head += record(3, struct.pack("<H", key) + text(topics[topic]) + text("ros2msg") + text(""))
        head += record(4, struct.pack("<HH", key, key) + text(topic) + text("cdr") + text(""))
    body = b""
    for line in lines:
        data = bytes(JAZZY.serialize_cdr(line.message, line.msgtype))
        body += record(5, struct.pack("<HIQQ", keys[line.topic], 0, line.time, line.time) + data)
    return head, body


def mcap_file(path: Path, *blocks: bytes, end: bool = True) -> Path:
    """Write an mcap without index."""
    tail = record(15, b"\0" * 4) + record(2, b"\0" * 20) + b"\x89MCAP0\r\n" if end else b""
    path.write_bytes(b"\x89MCAP0\r\n" + record(1, text("ros2") + text("test")) + b"".join(blocks) + tail)
    return path


def chunk(data: bytes, compression: str = "", crc: int | None = None) -> bytes:
    packed = {"": bytes, "lz4": lz4.frame.compress}[compression](data)
    head = struct.pack("<QQQI", 0, 0, len(data), zlib.crc32(data) if crc is None else crc)
    return record(6, head + text(compression) + struct.pack("<Q", len(packed)) + packed)


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bare mcap of three chunks and more."""
    lines = flat([pose(stamp_at(i), POSE_A), *exposure(i, LARGE)] for i in range(FRAMES))
    return write_bag(tmp_path_factory.mktemp("large") / "rec", lines) / "rec.mcap"


@pytest.mark.parametrize("compression", ["", "lz4"])
def test_files_without_index_are_read(tmp_path: Path, compression: str) -> None:
    head, body = mcap_records(flat(pair(i) for i in range(3)))
    path = mcap_file(tmp_path / "a.mcap", chunk(head + body, compression))
    frames, error = read_all(path)
    assert error is None
    assert [frame.stamp for frame in frames] == [stamp_at(i) for i in range(3)]
    with Recording(path) as recording:
        summary = recording.summary()
    assert (summary.frame_count, summary.duration, summary.damage) == (3, pytest.approx(0.08), None)


def test_files_without_chunks_are_read(tmp_path: Path) -> None:
    head, body = mcap_records(flat(pair(i) for i in range(3)))
    frames, error = read_all(mcap_file(tmp_path / "a.mcap", head, record(0x42, b"unknown"), body))
    assert error is None
    assert np.array_equal(frames[2].amplitude, pixels(502))


def test_an_unfinished_recording_is_read(tmp_path: Path) -> None:
    head, body = mcap_records(flat(pair(i) for i in range(3)))
    folder = tmp_path / "rec"
    folder.mkdir()
    mcap_file(folder / "rec_0.mcap", chunk(head + body), end=False)
    frames, error = read_all(folder)
    assert len(frames) == 3
    assert "rec_0.mcap: byte" in str(error)
    assert "it was interrupted or cut off; frames read before it: 3" in str(error)
    assert "ros2 bag reindex" in str(error)
    with Recording(folder) as recording:
        assert "ends in the middle" in str(recording.summary().damage)


@pytest.mark.parametrize("compression", ["", "lz4"])
@pytest.mark.parametrize("share", [0.35, 0.65, 0.999])
def test_a_cut_chunk_gives_what_is_whole(tmp_path: Path, compression: str, share: float) -> None:
    head, body = mcap_records(flat(pair(i, size=LARGE) for i in range(10)))
    block = chunk(head + body, compression)
    path = mcap_file(tmp_path / "a.mcap", block[: int(len(block) * share)], end=False)
    frames, error = read_all(path)
    assert isinstance(error, InputError)
    assert len(frames) <= 10 * share + 1
    if not compression:
        assert len(frames) == int(10 * share)
    assert all(np.array_equal(frame.distance, pixels(i, LARGE)) for i, frame in enumerate(frames))


@pytest.mark.parametrize("share", [0.1, 0.35, 0.5, 0.9, 0.99])
def test_a_cut_mcap_gives_the_frames_before_the_cut(tmp_path: Path, large: Path, share: float) -> None:
    whole = large.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: int(len(whole) * share)])
    frames, error = read_all(path)
    assert abs(len(frames) - FRAMES * share) <= 2
    assert all(np.array_equal(frame.distance, pixels(i, LARGE)) for i, frame in enumerate(frames))
    assert all(frame.truth["board"] == POSE_A for frame in frames)
    assert isinstance(error, InputError)
    assert f"cut off; frames read before it: {len(frames)} ('ros2 bag reindex'" in str(error)


def test_a_cut_end_costs_nothing_but_the_index(tmp_path: Path, large: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(large.read_bytes()[:-1])
    frames, error = read_all(tmp_path / "cut.mcap")
    assert len(frames) == FRAMES
    assert error is None


def test_a_cut_mcap_beside_its_metadata(tmp_path: Path, large: Path) -> None:
    shutil.copytree(large.parent, tmp_path / "rec")
    file = tmp_path / "rec/rec.mcap"
    file.write_bytes(file.read_bytes()[: 1 << 20])
    frames, error = read_all(tmp_path / "rec")
    assert 35 < len(frames) < 45
    assert re.search(r"rec\.mcap: byte \d\d: the recording ends in the middle", str(error))


def test_a_wrong_checksum_is_seen(tmp_path: Path) -> None:
    head, body = mcap_records(pair(0))
    more = mcap_records(pair(1))[1]
    path = mcap_file(tmp_path / "a.mcap", chunk(head + body), chunk(more, crc=1))
    frames, error = read_all(path)
    assert len(frames) == 1
    assert "a chunk is damaged: its size or checksum is wrong; frames read before it: 1" in str(error)


def test_implausible_lengths_cost_no_memory(tmp_path: Path) -> None:
    head, _ = mcap_records(pair(0))
    block = bytearray(chunk(head))
    struct.pack_into("<Q", block, 9 + 16, 1 << 60)
    _, error = read_all(mcap_file(tmp_path / "a.mcap", bytes(block)))
    assert "a block of 1152921504606846976 bytes is implausible" in str(error)
    with pytest.raises(CompressionError, match="implausible"):
        decompress(b"", "zstd", LARGEST_BLOCK + 1)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "bz2"])
def test_damaged_blocks_are_refused(compression: str) -> None:
    with pytest.raises(CompressionError, match=compression):
        decompress(b"nothing that is compressed", compression)


def test_another_compression_is_named(tmp_path: Path) -> None:
    block = record(6, b"\0" * 28 + text("snappy") + struct.pack("<Q", 0))
    _, error = read_all(mcap_file(tmp_path / "a.mcap", block))
    assert "unknown compression 'snappy'" in str(error)


def test_messages_of_undeclared_channels_are_damage(tmp_path: Path) -> None:
    head, body = mcap_records(pair(0))
    stray = record(5, struct.pack("<HIQQ", 9, 0, 0, 0))
    frames, error = read_all(mcap_file(tmp_path / "a.mcap", head, body, stray))
    assert len(frames) == 1
    assert "a message is of the channel 9, which nothing declares" in str(error)


def test_an_index_that_points_nowhere_is_not_used(tmp_path: Path, large: Path) -> None:
    whole = bytearray(large.read_bytes())
    (start,) = struct.unpack_from("<Q", whole, len(whole) - 8 - 20)
    position = start
    while whole[position] != 8:
        position += 9 + struct.unpack_from("<Q", whole, position + 1)[0]
    (chunk,) = struct.unpack_from("<Q", whole, position + 9 + 16)
    struct.pack_into("<Q", whole, position + 9 + 16, 1 << 40)  # chunk_start_offset
    (tmp_path / "a.mcap").write_bytes(whole)
    frames, error = read_all(tmp_path / "a.mcap")
    assert (len(frames), error) == (FRAMES, None)
    struct.pack_into("<Q", whole, position + 9 + 16, chunk + 23)  # inside a chunk
    (tmp_path / "a.mcap").write_bytes(whole)
    frames, error = read_all(tmp_path / "a.mcap")
    # rosbags before 0.11 writes a checksum of the index, by which the damage is seen and the index not used
    if error is None:
        assert len(frames) == FRAMES
    else:
        assert "the index points to something that is no chunk; frames read before it: 0" in str(error)


@pytest.mark.parametrize("share", [0.2, 0.6, 0.95])
def test_a_cut_database_is_refused_after_what_can_be_read(tmp_path: Path, share: float) -> None:
    lines = flat(exposure(i, LARGE) for i in range(20))
    path = write_bag(tmp_path / "rec", lines, StoragePlugin.SQLITE3) / "rec.db3"
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    for one in (path, path.parent):
        frames, error = read_all(one)
        assert isinstance(error, InputError)
        assert len(frames) < 20
        assert "rec.db3: the database is cut off, damaged or no recording" in str(error)
        assert "'sqlite3 FILE .recover'" in str(error)
        assert all(np.array_equal(frame.distance, pixels(i, LARGE)) for i, frame in enumerate(frames))


def test_rows_of_other_types_are_damage(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "rec", flat(exposure(i) for i in range(3)), StoragePlugin.SQLITE3) / "rec.db3"
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET data = 'text' WHERE id = 9")
    database.close()
    frames, error = read_all(path)
    assert len(frames) == 2
    assert "a row of its table messages is damaged; frames read before it: 2" in str(error)


@pytest.mark.parametrize("compression", [None, "LZ4"])
@pytest.mark.parametrize("share", [0.01, 0.5, 0.99])
def test_a_cut_bag_is_refused(tmp_path: Path, share: float, compression: str | None) -> None:
    path = write_bag1(tmp_path / "a.bag", flat(exposure(i, LARGE) for i in range(20)), compression)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    _, error = read_all(path)
    assert "a.bag: the bag is cut off or damaged: " in str(error)
    assert "'rosbag reindex' repairs it" in str(error)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_cut_compressed_file_is_refused(tmp_path: Path, storage: StoragePlugin) -> None:
    lines = flat(exposure(i, LARGE) for i in range(FRAMES))
    path = write_bag(tmp_path / "rec", lines, storage, CompressionMode.FILE)
    (file,) = path.glob("*.zstd")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    frames, error = read_all(path)
    assert isinstance(error, InputError)
    assert str(error).startswith(str(file))
    assert len(frames) < FRAMES
    assert all(np.array_equal(frame.distance, pixels(i, LARGE)) for i, frame in enumerate(frames))


def test_a_damaged_compressed_message_is_named(tmp_path: Path) -> None:
    path = write_bag(
        tmp_path / "rec", flat(pair(i) for i in range(2)), StoragePlugin.SQLITE3, CompressionMode.MESSAGE
    )
    with sqlite3.connect(path / "rec.db3") as database:
        database.execute("UPDATE messages SET data = x'28b52ffd0800000000000000' WHERE id = 3")
    database.close()
    frames, error = read_all(path)
    assert len(frames) == 1
    assert "topic /camera/distance/image_raw: a compressed message is damaged: zstd" in str(error)


def test_a_message_that_is_cut_is_named_with_its_place(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "rec", flat(pair(i) for i in range(2)), StoragePlugin.SQLITE3)
    with sqlite3.connect(path / "rec.db3") as database:
        database.execute("UPDATE messages SET data = substr(data, 1, 40) WHERE id = 4")
    database.close()
    frames, error = read_all(path)
    assert len(frames) == 1
    place = "rec: topic /camera/amplitude/image_raw, recorded at 1700000000.163456789 s: a message of type"
    assert place in str(error)


def small_mcap(path: Path) -> Path:
    return write_bag(path / "rec", flat([pose(START, POSE_A), *exposure(i)] for i in range(3))) / "rec.mcap"


def small_zstd_mcap(path: Path) -> Path:
    lines = flat(exposure(i) for i in range(3))
    return write_bag(path / "rec", lines, StoragePlugin.MCAP, CompressionMode.STORAGE) / "rec.mcap"


def small_plain_mcap(path: Path) -> Path:
    return mcap_file(path / "a.mcap", *mcap_records(flat(exposure(i) for i in range(3))))


def small_lz4_mcap(path: Path) -> Path:
    return mcap_file(
        path / "a.mcap", chunk(b"".join(mcap_records(flat(exposure(i) for i in range(3)))), "lz4", 0)
    )


def small_packed_mcap(path: Path) -> Path:
    folder = write_bag(
        path / "rec", flat(exposure(i) for i in range(3)), StoragePlugin.MCAP, CompressionMode.FILE
    )
    return folder / "rec.mcap.zstd"


def small_db3(path: Path) -> Path:
    return write_bag(path / "rec", flat(exposure(i) for i in range(3)), StoragePlugin.SQLITE3) / "rec.db3"


def small_bag(path: Path) -> Path:
    return write_bag1(path / "a.bag", flat(exposure(i) for i in range(3)))


FUZZED: dict[str, Callable[[Path], Path]] = {
    make.__name__: make
    for make in (
        small_mcap,
        small_zstd_mcap,
        small_plain_mcap,
        small_lz4_mcap,
        small_packed_mcap,
        small_db3,
        small_bag,
    )
}


@pytest.fixture(scope="module", params=FUZZED)
def fuzzed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Path]:
    path = FUZZED[request.param](tmp_path_factory.mktemp("fuzz"))
    return path.read_bytes(), path


POSITION = st.floats(0, 1, exclude_max=True)
BYTES = st.one_of(
    st.binary(min_size=1, max_size=1),
    st.sampled_from([b"\xff" * 4, b"\xff" * 8, b"\0" * 8, b"\xff\xff\xff\x7f", b"\0\0\0\0\0\0\0\x80"]),
)


@settings(
    max_examples=150, derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck)
)
@given(
    changes=st.lists(st.tuples(POSITION, BYTES), max_size=4),
    cut=st.one_of(st.none(), POSITION),
    near_end=st.booleans(),
)
def test_any_damage_ends_in_an_error_of_the_package(
    fuzzed: tuple[bytes, Path], changes: list[tuple[float, bytes]], cut: float | None, near_end: bool
) -> None:
    whole, path = fuzzed
    data = bytearray(whole)
    span = min(len(data), 600) if near_end else len(data)  # index and footer are at the end
    for share, new in changes:
        begin = len(whole) - span + int(share * span)
        data[begin : begin + len(new)] = new
    if cut is not None:
        del data[int(cut * len(data)) :]
    path.write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin_time = time.perf_counter()
    frames, error = read_all(path)
    assert time.perf_counter() - begin_time < 5
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # KiB
    assert error is None or ("\n" not in str(error) and str(path.parent) in str(error))
    assert all(a.stamp < b.stamp for a, b in pairwise(frames))
