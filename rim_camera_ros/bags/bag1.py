"""ROS 1 bags, read by rosbags."""

from __future__ import annotations

import bz2
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
from rosbags.rosbag1 import Reader as Bag1Reader

from rim_camera_ros.bags.compress import decompress
from rim_camera_ros.bags.mcap import Message, TopicInfo, guarded
from rim_camera_ros.errors import InputError

BAG1_MAGIC = b"#ROSBAG V"

#: Functions that decompress the chunks of a ROS 1 bag, with the names of their formats in this package.
_COMPRESSIONS: dict[object, str] = {bz2.decompress: "bz2", lz4.frame.decompress: "lz4"}


class Bag1File:
    """A ROS 1 bag, read by rosbags. Raises InputError for one that cannot be opened."""

    kind = "ROS 1 bag"
    ros1 = True
    damage: str | None = None

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[str, TopicInfo] = {}
        self.start: int | None = None
        self.end: int | None = None
        with closing(self._open()) as reader:
            try:
                for name, info in reader.topics.items():
                    self.topics[name] = TopicInfo(info.msgtype or "of several types", info.msgcount)
                if reader.chunk_infos and any(info.count for info in self.topics.values()):
                    self.start, self.end = reader.start_time, reader.end_time - 1
            except Exception as error:
                raise self._error(error) from error

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Iterate over the messages of some topics by time."""
        return guarded(self._read(topics), self._error)

    def close(self) -> None:
        """Do nothing: no file stays open between calls."""

    def _open(self) -> Bag1Reader:
        reader = Bag1Reader(self.path)
        try:
            reader.open()
        except Exception as error:
            with suppress(Exception):
                reader.close()
            raise self._error(error) from error
        # the reader's own functions would unpack 700 bytes of bz2 to a gigabyte
        for position, chunk in reader.chunks.items():
            kind = _COMPRESSIONS.get(chunk.decompressor)
            if kind is not None:
                reader.chunks[position] = chunk._replace(decompressor=partial(_unpacked, compression=kind))
        return reader

    def _read(self, topics: Collection[str]) -> Iterator[Message]:
        with closing(self._open()) as reader:
            connections = [one for one in reader.connections if one.topic in topics]
            if connections:
                for connection, time, data in reader.messages(connections):
                    yield Message(connection.topic, time, data)

    def _error(self, error: Exception) -> InputError:
        reason = " ".join(str(error).split()) or type(error).__name__
        return InputError(
            f"the bag is cut off or damaged: {reason}", file=self.path, remedy="'rosbag reindex' repairs it"
        )


def _unpacked(data: bytes, *, compression: str) -> bytes:
    return bytes(decompress(data, compression))
