"""Decompression with bounds: damaged lengths in a recording must not take gigabytes of memory."""

from __future__ import annotations

import bz2
import errno
import importlib
import os
import shutil
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, cast

import lz4.frame  # type: ignore[import-untyped]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

#: Largest block (chunk, message) that is accepted, in bytes.
LARGEST_BLOCK = 1 << 30


#: Up to this size data may have any compression ratio; larger data may not have a thousand to one.
_ANY_RATIO = 64 << 20
_LARGEST_RATIO = 1000
#: Largest file that may be unpacked at any ratio, and bytes that must stay free on the disk.
_ANY_RATIO_OF_FILES = 1 << 30
_LEFT_FREE = 256 << 20
_STEP = 1 << 20


class CompressionError(ValueError):
    """Compressed data are damaged, too large or of an unknown format."""


@cache
def _zstd() -> tuple[Any, bool]:
    """Return the zstd module that rosbags uses, and whether it is that of the standard library."""
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return importlib.import_module(name), True
        except ImportError:
            continue
    return importlib.import_module("zstandard"), False


def _unzstd(data: bytes | memoryview, limit: int) -> bytes:
    zstd, standard = _zstd()
    try:
        if standard:
            return bytes(zstd.ZstdDecompressor().decompress(data, max_length=limit))
        declared = zstd.frame_content_size(data)
        size = min(limit, declared) if declared >= 0 else limit
        return bytes(zstd.ZstdDecompressor().stream_reader(data).read(size))
    except (zstd.ZstdError, MemoryError) as error:
        raise CompressionError(f"zstd: {error}") from None


def _unlz4(data: bytes | memoryview, limit: int) -> bytes:
    try:
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit))
    except (RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise CompressionError(f"lz4: {error}") from None


def _unbz2(data: bytes | memoryview, limit: int) -> bytes:
    try:
        return bz2.BZ2Decompressor().decompress(data, max_length=limit)
    except (OSError, ValueError, EOFError, MemoryError) as error:
        raise CompressionError(f"bz2: {error}") from None


def decompress(data: bytes | memoryview, compression: str, limit: int = LARGEST_BLOCK) -> bytes | memoryview:
    """Return at most ``limit`` bytes of decompressed data; of truncated data as much as there is.

    ``compression`` is 'zstd', 'lz4', 'bz2' or '' (none: a view, not a copy). Raises CompressionError, also
    for data larger than 64 MiB that unpack to more than a thousand times their size.
    """
    if limit > LARGEST_BLOCK:
        raise CompressionError(f"a block of {limit} bytes is implausible")
    if compression == "":
        return memoryview(data)[:limit]
    unpack = {"zstd": _unzstd, "lz4": _unlz4, "bz2": _unbz2}.get(compression)
    if unpack is None:
        raise CompressionError(f"unknown compression '{compression}'")
    most = max(_ANY_RATIO, _LARGEST_RATIO * len(data))
    result = unpack(data, min(limit, most + 1))
    if len(result) > most:
        raise CompressionError(f"{len(data)} bytes unpack to more than {_LARGEST_RATIO} times as many")
    return result


def decompress_file(source: Path, target: Path) -> None:
    """Decompress a zstd file; data before a fault are kept in ``target``.

    Raises CompressionError for damaged data and for a file that unpacks to more than a thousand times its
    size, OSError for files, among them ENOSPC before the disk is full.
    """
    zstd, _ = _zstd()
    most = max(_ANY_RATIO_OF_FILES, _LARGEST_RATIO * source.stat().st_size)
    size = 0
    try:
        with cast(BinaryIO, zstd.open(source, "rb")) as stream, target.open("wb") as out:
            while part := stream.read(_STEP):
                size += len(part)
                if size > most:
                    raise CompressionError(f"it unpacks to more than {_LARGEST_RATIO} times its size")
                if shutil.disk_usage(target.parent).free < _LEFT_FREE + len(part):
                    raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)} (TMPDIR names another folder)")
                out.write(part)
    except (zstd.ZstdError, EOFError) as error:
        raise CompressionError(f"zstd: {error or 'the data end early'}") from None
    if size == 0:
        raise CompressionError("zstd: no data in it")
