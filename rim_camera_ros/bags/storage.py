"""Storages of recordings: rosbag2 folders, single mcap, db3 and .bag files, compressed or not."""

from __future__ import annotations

import errno
import re
import sqlite3
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Protocol

from ruamel.yaml import YAML

from rim_camera_ros.bags import mcap
from rim_camera_ros.bags.bag1 import BAG1_MAGIC, Bag1File
from rim_camera_ros.bags.compress import ZSTD_MAGIC, CompressionError, decompress, decompress_file
from rim_camera_ros.bags.mcap import McapFile, Message, TopicInfo, guarded
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.temporary import Temporary, temporary_folder

METADATA = "metadata.yaml"
SQLITE_MAGIC = b"SQLite format 3\0"

_REINDEX = "'ros2 bag reindex' writes it anew"
_SUFFIXES = (".mcap", ".mcap.zstd", ".db3", ".db3.zstd")
_LARGEST_METADATA = 1 << 24


class Storage(Protocol):
    """Topics, times (ns; None without messages) and messages of a recording.

    ``damage`` says what is wrong with a recording that is only readable in part.
    """

    kind: str
    ros1: bool
    start: int | None
    end: int | None
    damage: str | None

    @property
    def topics(self) -> Mapping[str, TopicInfo]:
        """Topics by name."""
        ...

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Iterate over the messages of some topics; InputError where the recording is damaged."""
        ...

    def close(self) -> None:
        """Remove temporary files."""
        ...


class SqliteFile:
    """A db3 file of rosbag2. Raises InputError for one that cannot be opened."""

    kind = "sqlite3"
    ros1 = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.start: int | None = None
        self.end: int | None = None
        self.damage: str | None = None
        self.topics: dict[str, TopicInfo] = {}
        try:
            with closing(self._connect()) as database:
                rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
                self._ids = {int(row[0]): str(row[1]) for row in rows}
                for _, name, msgtype, encoding in rows:
                    kind = msgtype if encoding == "cdr" else f"{msgtype} serialised as {encoding}"
                    self.topics[str(name)] = TopicInfo(str(kind), 0)
                self._count(database)
        except (sqlite3.Error, OverflowError, TypeError, ValueError) as error:
            raise self._error(error) from error

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Iterate over the messages of some topics by time; in the order written if damaged."""
        return guarded(self._rows(topics), self._error)

    def close(self) -> None:
        """Nothing is held between calls."""

    def _connect(self) -> sqlite3.Connection:
        log = self.path.with_name(self.path.name + "-wal")
        live = log.exists() and log.stat().st_size > 0
        mode = "mode=ro" if live else "immutable=1"
        return sqlite3.connect(f"{self.path.absolute().as_uri()}?{mode}", uri=True)

    def _count(self, database: sqlite3.Connection) -> None:
        query = "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
        try:
            for key, count, first, last in database.execute(query):
                name = self._ids.get(key)
                if name is None:
                    continue
                info = self.topics[name]
                self.topics[name] = TopicInfo(info.msgtype, info.count + count)
                self.start = first if self.start is None else min(self.start, first)
                self.end = last if self.end is None else max(self.end, last)
        except (sqlite3.Error, TypeError) as error:
            self.damage = str(error)

    def _rows(self, topics: Collection[str]) -> Iterator[Message]:
        keys = [key for key, name in self._ids.items() if name in topics]
        marks = ",".join("?" * len(keys))
        order = "rowid" if self.damage else "timestamp, rowid"
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY {order}"
        with closing(self._connect()) as database:
            for key, time, data in database.execute(query, keys):
                if not isinstance(data, bytes) or not isinstance(time, int):
                    raise ValueError("a row of its table messages is damaged")
                yield Message(self._ids[key], time, data)

    def _error(self, error: Exception) -> InputError:
        return InputError(
            f"the database is cut off, damaged or no recording: {error}",
            file=self.path,
            remedy="'sqlite3 FILE .recover' saves what is left, then 'ros2 bag reindex'",
        )


class Unpacked:
    """A compressed recording file, unpacked into a temporary folder until it is closed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._folder: Temporary | None = None
        name = path.name.removesuffix(".zstd")
        self._fault: str | None = None
        try:
            self._folder = temporary_folder(Path(tempfile.gettempdir()), "rim_camera_ros")
            target = self._folder.path / (name if name != path.name else "recording")
            try:
                decompress_file(path, target)
            except CompressionError as error:
                self._fault = str(error)
            self._inner = _open_plain(target, path)
        except OSError as error:
            self.close()
            raise _unreadable(path, error, "while it was unpacked into the temporary folder") from error
        except InputError as error:
            self.close()
            raise InputError(self._fault or error.problem, file=path, remedy=error.remedy) from error
        except BaseException:
            self.close()
            raise
        self.kind = self._inner.kind
        self.ros1 = self._inner.ros1
        self.start, self.end = self._inner.start, self._inner.end
        self.damage = self._fault or self._inner.damage

    @property
    def topics(self) -> Mapping[str, TopicInfo]:
        """Topics by name."""
        return self._inner.topics

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Iterate over the messages of some topics."""
        try:
            yield from self._inner.messages(topics)
        except InputError as error:
            raise InputError(error.problem, file=self.path, place=error.place, remedy=error.remedy) from error
        if self._fault:
            raise InputError(self._fault, file=self.path, remedy="copy it again from where it was recorded")

    def close(self) -> None:
        """Remove the temporary folder."""
        if self._folder is not None:
            self._folder.close()
            self._folder = None


class Folder:
    """A rosbag2 folder: metadata.yaml and its files, or the files alone if recording was interrupted."""

    ros1 = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: str | None = None
        self.start: int | None = None
        self.end: int | None = None
        self.topics: dict[str, TopicInfo] = {}
        self.indexed = (path / METADATA).exists()
        self.files: list[Path] = []
        if self.indexed:
            self._read_metadata(path / METADATA)
        else:
            self._look_into_files()

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Iterate over the messages of some topics, file by file."""
        for file in self.files:
            with closing(open_file(file)) as storage:
                yield from storage.messages(topics)

    def close(self) -> None:
        """Nothing is held between calls."""

    def _read_metadata(self, path: Path) -> None:
        try:
            if path.stat().st_size > _LARGEST_METADATA:
                raise ValueError("it is too large")
            information = YAML(typ="safe").load(path.read_text("utf-8"))["rosbag2_bagfile_information"]
            files = [self.path / Path(str(name)).name for name in information["relative_file_paths"]]
            for entry in information["topics_with_message_count"]:
                topic = entry["topic_metadata"]
                msgtype, encoding = str(topic["type"]), str(topic["serialization_format"])
                kind = msgtype if encoding == "cdr" else f"{msgtype} serialised as {encoding}"
                self.topics[str(topic["name"])] = TopicInfo(kind, int(entry["message_count"]))
            if int(information["message_count"]) > 0:
                self.start = int(information["starting_time"]["nanoseconds_since_epoch"])
                self.end = self.start + int(information["duration"]["nanoseconds"])
            compression = str(information.get("compression_format") or "zstd")
            self.kind = str(information["storage_identifier"])
            mode = str(information.get("compression_mode") or "").lower()
        except OSError as error:
            raise _unreadable(path, error) from error
        except Exception as error:  # parser and look-ups may raise anything for a foreign or damaged document
            reason = " ".join(str(error).split())[:200]
            problem = f"is not the metadata of a recording: {type(error).__name__} {reason}"
            raise InputError(problem, file=path, remedy=_REINDEX) from error
        if compression != "zstd":
            raise InputError(
                f"compression format '{compression}' is not supported", file=path, remedy="use zstd"
            )
        for file in files:
            if not file.is_file():
                raise InputError(f"{file.name}, which it names, is missing", file=path, remedy=_REINDEX)
        if not files:
            raise InputError("it names no file", file=path, remedy=_REINDEX)
        self.files = files
        if mode and mode != "none":
            self.kind += f", zstd by {mode}"

    def _look_into_files(self) -> None:
        self.files = _storage_files(self.path)
        if not self.files:
            inner = sorted(path.parent for path in self.path.glob(f"*/{METADATA}"))
            raise InputError(
                f"the folder holds no recording: neither {METADATA} nor mcap or db3 files",
                file=self.path,
                remedy=f"did you mean {inner[0]}?" if inner else "give the folder that ros2 bag record made",
            )
        for file in self.files:
            with closing(open_file(file)) as storage:
                self.kind = storage.kind
                self.damage = self.damage or storage.damage
                for name, info in storage.topics.items():
                    before = self.topics.get(name, TopicInfo(info.msgtype, 0))
                    self.topics[name] = TopicInfo(before.msgtype, before.count + info.count)
                times = [one for one in (self.start, self.end, storage.start, storage.end) if one is not None]
                self.start, self.end = min(times, default=None), max(times, default=None)


def _storage_files(folder: Path) -> list[Path]:
    """Return the recording files of a folder in the order of their numbers, mcap before db3."""
    for kinds in (_SUFFIXES[:2], _SUFFIXES[2:]):
        found = [path for path in folder.iterdir() if path.name.endswith(kinds) and path.is_file()]
        if found:
            return sorted(
                found, key=lambda path: [int(x) if x.isdigit() else x for x in re.split(r"(\d+)", path.name)]
            )
    return []


def _unreadable(path: Path, error: OSError, when: str = "") -> RimError:
    kind = RimError if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) else InputError
    return kind(f"cannot be read {when}: {error.strerror or error}".replace(" :", ":"), file=path)


def _open_plain(path: Path, named: Path) -> Storage:
    """Open an uncompressed file by its first bytes; errors name ``named``."""
    with path.open("rb") as file:
        magic = file.read(16)
    if magic.startswith(mcap.MAGIC):
        return McapFile(path)
    if magic.startswith(SQLITE_MAGIC):
        return SqliteFile(path)
    if magic.startswith(BAG1_MAGIC):
        if not magic.startswith(BAG1_MAGIC + b"2.0\n"):
            raise InputError("is a bag of an old version", file=named, remedy="convert it: rosbag migrate")
        return Bag1File(path)
    if not magic:
        raise InputError("is empty: nothing was recorded", file=named, remedy="record it again")
    raise InputError(
        "is not a recording: neither mcap nor db3 nor .bag by its first bytes",
        file=named,
        remedy="give a rosbag2 folder, an .mcap, a .db3 or a ROS 1 .bag",
    )


def open_file(path: Path) -> Storage:
    """Open a recording file. Raises InputError."""
    try:
        with path.open("rb") as file:
            packed = file.read(len(ZSTD_MAGIC)) == ZSTD_MAGIC
        return Unpacked(path) if packed else _open_plain(path, path)
    except OSError as error:
        raise _unreadable(path, error) from error


def open_storage(path: Path) -> Storage:
    """Open a recording: a rosbag2 folder or a file. Raises InputError for anything else."""
    try:
        if path.is_dir():
            return Folder(path)
        if not path.exists():
            raise InputError("no such file or folder", file=path, remedy="give the path of a recording")
        if not path.is_file():
            raise InputError("is neither a file nor a folder", file=path)
    except OSError as error:
        raise _unreadable(path, error) from error
    return open_file(path)


def unpack_message(message: Message, path: Path) -> bytes:
    """Return a message's bytes, decompressed if the recording compresses each. Raises InputError."""
    if message.data[:4] != ZSTD_MAGIC:
        return message.data
    try:
        return bytes(decompress(message.data, "zstd"))
    except CompressionError as error:
        raise InputError(
            f"a compressed message is damaged: {error}", file=path, place=f"topic {message.topic}"
        ) from None
