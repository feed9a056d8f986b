"""Storages: every format and compression gives the same frames; paths that are no recording."""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from rim_camera_ros.bags import Recording
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import RawFrame

from .helpers_bags import (
    POSE_A,
    POSE_B,
    START,
    exposure,
    flat,
    pair,
    pose,
    reference,
    same_frame,
    stamp_at,
    temperature,
    write_bag,
    write_bag1,
)

LINES = sorted(
    [
        *flat(exposure(i) for i in range(6)),
        pose(START - 7, POSE_A),
        pose(stamp_at(3), POSE_B),
        temperature(START, 30.5),
        reference(START, 0.25),
    ],
    key=lambda line: line.time,
)

Make = Callable[[Path], Path]


def folder(storage: StoragePlugin, compression: CompressionMode = CompressionMode.NONE) -> Make:
    def make(path: Path) -> Path:
        (path / "plain").mkdir()
        write_bag(path / "plain" / "rec", LINES, storage, compression)
        return (path / "plain").rename(path / "odd #1? %41") / "rec"

    return make


def bare(storage: StoragePlugin, suffix: str, compression: CompressionMode = CompressionMode.NONE) -> Make:
    def make(path: Path) -> Path:
        (file,) = write_bag(path / "rec", LINES, storage, compression).glob("*" + suffix)
        return file.rename(path / ("moved" + suffix))

    return make


def without_metadata(storage: StoragePlugin) -> Make:
    def make(path: Path) -> Path:
        recording = folder(storage)(path)
        (recording / "metadata.yaml").unlink()
        return recording

    return make


STORAGES: dict[str, tuple[str, Make]] = {
    "mcap": ("mcap", folder(StoragePlugin.MCAP)),
    "mcap in zstd chunks": ("mcap", folder(StoragePlugin.MCAP, CompressionMode.STORAGE)),
    "mcap, zstd by message": ("mcap, zstd by message", folder(StoragePlugin.MCAP, CompressionMode.MESSAGE)),
    "mcap, zstd by file": ("mcap, zstd by file", folder(StoragePlugin.MCAP, CompressionMode.FILE)),
    "sqlite3": ("sqlite3", folder(StoragePlugin.SQLITE3)),
    "sqlite3, zstd by message": (
        "sqlite3, zstd by message",
        folder(StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    ),
    "sqlite3, zstd by file": ("sqlite3, zstd by file", folder(StoragePlugin.SQLITE3, CompressionMode.FILE)),
    "bare mcap": ("mcap", bare(StoragePlugin.MCAP, ".mcap")),
    "bare db3": ("sqlite3", bare(StoragePlugin.SQLITE3, ".db3")),
    "bare db3, zstd by message": ("sqlite3", bare(StoragePlugin.SQLITE3, ".db3", CompressionMode.MESSAGE)),
    "bare mcap.zstd": ("mcap", bare(StoragePlugin.MCAP, ".zstd", CompressionMode.FILE)),
    "bare db3.zstd": ("sqlite3", bare(StoragePlugin.SQLITE3, ".zstd", CompressionMode.FILE)),
    "mcap folder without metadata": ("mcap", without_metadata(StoragePlugin.MCAP)),
    "db3 folder without metadata": ("sqlite3", without_metadata(StoragePlugin.SQLITE3)),
    "ROS 1": ("ROS 1 bag", lambda path: write_bag1(path / "rec.bag", LINES)),
    "ROS 1, bz2": ("ROS 1 bag", lambda path: write_bag1(path / "rec.bag", LINES, "BZ2")),
    "ROS 1, lz4": ("ROS 1 bag", lambda path: write_bag1(path / "rec.bag", LINES, "LZ4")),
    "ROS 1 of another suffix": ("ROS 1 bag", lambda path: write_bag1(path / "rec.dat", LINES)),
}


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> list[RawFrame]:
    with Recording(folder(StoragePlugin.MCAP)(tmp_path_factory.mktemp("plain"))) as recording:
        return list(recording.frames())


@pytest.mark.parametrize("name", STORAGES)
def test_every_storage_gives_the_same_frames(name: str, tmp_path: Path, expected: list[RawFrame]) -> None:
    kind, make = STORAGES[name]
    path = make(tmp_path)
    with Recording(path) as recording:
        frames = list(recording.frames())
        summary = recording.summary()
        assert not recording.skipped
        assert not recording.assumptions
    assert len(frames) == 6
    assert all(map(same_frame, frames, expected))
    assert frames[3].truth["board"] == POSE_B
    assert frames[2].settings.body_temperature == 30.5
    assert summary.storage == kind
    assert (summary.frame_count, summary.message_count) == (6, len(LINES))
    assert (summary.start, summary.duration) == (START - 7, pytest.approx(0.200000007, abs=1e-12))
    assert summary.damage is None


def test_temporary_files_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bare(StoragePlugin.MCAP, ".zstd", CompressionMode.FILE)(tmp_path)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    with Recording(path) as recording:
        assert len(list(scratch.iterdir())) == 1
        assert next(recording.frames())
    assert list(scratch.iterdir()) == []


def test_split_recordings_are_read_in_order(tmp_path: Path) -> None:
    path = tmp_path / "rec"
    path.mkdir()
    for i in range(12):
        part = write_bag(tmp_path / f"part{i}", exposure(i))
        (part / f"part{i}.mcap").rename(path / f"rec_{i}.mcap")
    with Recording(path) as recording:
        assert recording.frame_count == 12
        assert [frame.stamp for frame in recording.frames()] == [stamp_at(i) for i in range(12)]


def test_a_live_database_is_read(tmp_path: Path) -> None:
    path = bare(StoragePlugin.SQLITE3, ".db3")(tmp_path)
    with sqlite3.connect(path) as database:
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("DELETE FROM messages WHERE timestamp > ?", (stamp_at(3),))
        database.commit()
        with Recording(path) as recording:
            assert len(list(recording.frames())) == 4
    database.close()


def test_recordings_are_left_as_they_are(tmp_path: Path) -> None:
    path = folder(StoragePlugin.SQLITE3)(tmp_path)
    before = {one.name: one.read_bytes() for one in path.iterdir()}
    with Recording(path) as recording:
        assert len(list(recording.frames())) == 6
    assert {one.name: one.read_bytes() for one in path.iterdir()} == before


def empty_folder(path: Path) -> Path:
    (path / "rec").mkdir()
    return path / "rec"


def folder_around(path: Path) -> Path:
    return folder(StoragePlugin.MCAP)(path).parent


def file_with(name: str, content: bytes) -> Make:
    def make(path: Path) -> Path:
        (path / name).write_bytes(content)
        return path / name

    return make


def metadata_with(old: str, new: str) -> Make:
    def make(path: Path) -> Path:
        recording = write_bag(path / "rec", LINES)
        file = recording / "metadata.yaml"
        text = file.read_text()
        assert re.search(old, text)
        file.write_text(re.sub(old, new, text))
        return recording

    return make


def pipe(path: Path) -> Path:
    os.mkfifo(path / "pipe.mcap")
    return path / "pipe.mcap"


def only_metadata(path: Path) -> Path:
    recording = write_bag(path / "rec", LINES)
    (recording / "rec.mcap").unlink()
    return recording


BAD: dict[str, tuple[Make, str]] = {
    "absent": (
        lambda path: path / "nothing",
        r"nothing: no such file or folder \(give the path of a recording\)",
    ),
    "empty folder": (
        empty_folder,
        "rec: the folder holds no recording: neither metadata.yaml nor mcap or db3",
    ),
    "folder around": (folder_around, r"the folder holds no recording.*\(did you mean .*rec\?\)"),
    "empty file": (file_with("a.mcap", b""), "a.mcap: is empty: nothing was recorded"),
    "text": (file_with("a.mcap", b"hello, this is no recording"), "a.mcap: is not a recording: neither mcap"),
    "text called bag": (file_with("a.bag", b"hello"), "a.bag: is not a recording"),
    "yaml": (
        file_with("scene.yaml", b"format: rim_scene/1\n"),
        "scene.yaml: is not a recording.*give a rosbag2 folder",
    ),
    "old bag": (file_with("a.bag", b"#ROSBAG V1.2\n"), "is a bag of an old version.*rosbag migrate"),
    "pipe": (pipe, "is neither a file nor a folder"),
    "magic only": (
        file_with("a.mcap", b"\x89MCAP0\r\n"),
        "byte 8: the recording ends in the middle.*ros2 bag reindex",
    ),
    "sqlite magic only": (
        file_with("a.db3", b"SQLite format 3\0"),
        "a.db3: the database is cut off, damaged or no recording.*recover",
    ),
    "bag magic only": (
        file_with("a.bag", b"#ROSBAG V2.0\n"),
        "the bag is cut off or damaged.*rosbag reindex",
    ),
    "zstd magic only": (file_with("a.mcap.zstd", b"\x28\xb5\x2f\xfd"), "a.mcap.zstd: zstd: "),
    "metadata only": (only_metadata, "metadata.yaml: rec.mcap, which it names, is missing.*ros2 bag reindex"),
    "no yaml": (
        metadata_with(r"(?s)^.*$", "{"),
        "metadata.yaml: is not the metadata of a recording.*reindex",
    ),
    "empty yaml": (metadata_with(r"(?s)^.*$", ""), "is not the metadata of a recording: TypeError"),
    "other yaml": (
        metadata_with("rosbag2_bagfile_information", "other"),
        "KeyError 'rosbag2_bagfile_information'",
    ),
    "word as count": (
        metadata_with("message_count: 6", "message_count: six"),
        "is not the metadata.*ValueError",
    ),
    "no files": (
        metadata_with(r"relative_file_paths:\n  - rec.mcap", "relative_file_paths: []"),
        "it names no file",
    ),
    "lz4 format": (
        metadata_with("compression_format: ''", "compression_format: lz4"),
        "'lz4' is not supported",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_recording_is_refused(name: str, tmp_path: Path) -> None:
    make, match = BAD[name]
    path = make(tmp_path)
    with pytest.raises(InputError, match=match), Recording(path):
        pass


def test_a_database_of_something_else_is_refused(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute("CREATE TABLE songs (name TEXT)")
        database.execute("INSERT INTO songs VALUES ('a')")
    database.close()
    with (
        pytest.raises(InputError, match="damaged or no recording: no such table: topics"),
        Recording(tmp_path / "a.db3"),
    ):
        pass


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_files_are_named(tmp_path: Path) -> None:
    path = bare(StoragePlugin.MCAP, ".mcap")(tmp_path)
    path.chmod(0)
    with pytest.raises(InputError, match=r"moved.mcap: cannot be read: Permission denied"), Recording(path):
        pass


def test_a_full_temporary_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bare(StoragePlugin.MCAP, ".zstd", CompressionMode.FILE)(tmp_path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "disk_usage", full)
    with (
        pytest.raises(Exception, match="temporary folder: No space left on device") as caught,
        Recording(path),
    ):
        pass
    assert type(caught.value).__name__ == "RimError"


def test_serialisations_other_than_cdr_are_named(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "rec", pair(0))
    file = path / "metadata.yaml"
    file.write_text(file.read_text().replace("serialization_format: cdr", "serialization_format: json"))
    with (
        Recording(path) as recording,
        pytest.raises(InputError, match="Image serialised as json, the role distance"),
    ):
        recording.frames()


def test_recordings_without_frames(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "rec", LINES)
    (path / "rec.mcap").unlink()
    other = write_bag(tmp_path / "other", [pose(START, POSE_A)])
    (other / "other.mcap").rename(path / "rec.mcap")
    with (
        Recording(path) as recording,
        pytest.raises(InputError, match="rec: no frame in it: no message on /camera/distance/image_raw"),
    ):
        list(recording.frames())
