"""Bounded decompression: damaged lengths in a recording must not cost gigabytes."""

from __future__ import annotations

import importlib
import os
import shutil
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, cast

import lz4.frame  # type: ignore[import-untyped]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

#: Largest block (chunk, message) that is believed, in bytes.
LARGEST_BLOCK = 1 << 30


class CompressionError(ValueError):
    """Compressed data are damaged, too large or of an unknown format."""


@cache
def _zstd() -> tuple[Any, bool]:
    """Return the zstd module that rosbags brings and whether it is the one of the standard library."""
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


def decompress(data: bytes | memoryview, compression: str, limit: int = LARGEST_BLOCK) -> bytes | memoryview:
    """Return at most ``limit`` bytes of decompressed data; of cut data what there is.

    ``compression`` is 'zstd', 'lz4' or '' (none: a view, not a copy). Raises CompressionError.
    """
    if limit > LARGEST_BLOCK:
        raise CompressionError(f"a block of {limit} bytes is implausible")
    if compression == "zstd":
        return _unzstd(data, limit)
    if compression == "lz4":
        return _unlz4(data, limit)
    if compression == "":
        return memoryview(data)[:limit]
    raise CompressionError(f"unknown compression '{compression}'")


def decompress_file(source: Path, target: Path) -> None:
    """Decompress a zstd file; what was there before a fault is kept in ``target``.

    Raises CompressionError for damaged data, OSError for files.
    """
    zstd, _ = _zstd()
    try:
        with cast(BinaryIO, zstd.open(source, "rb")) as stream, target.open("wb") as out:
            shutil.copyfileobj(stream, out, 1 << 20)
    except (zstd.ZstdError, EOFError) as error:
        raise CompressionError(f"zstd: {error or 'the data end early'}") from None
    if os.path.getsize(target) == 0:
        raise CompressionError("zstd: no data in it")
