"""Arrays from untrusted ``.npy`` files: no more memory is allocated than the file has data."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Bytes of the largest array that is read: 8192 x 8192 numbers of double precision, twice.
_LARGEST = 1 << 30


def read_npy(path: Path) -> NDArray[Any]:
    """Return the array of real numbers that a file holds.

    Raises ValueError, which says what is wrong with the file, or OSError where it cannot be read.
    """
    if not path.is_file():
        raise ValueError("is not a file") if path.exists() else FileNotFoundError(path)
    with path.open("rb") as stream:
        try:
            version = np.lib.format.read_magic(stream)
            read = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            shape, by_columns, dtype = read(stream)
        except Exception as error:  # the header is a Python expression: a malicious one may raise anything
            raise ValueError("cannot be read as .npy: its header is damaged or of another kind") from error
        if dtype.kind not in "fiu":
            raise ValueError("holds no real numbers")
        if any(size < 0 for size in shape):
            raise ValueError("cannot be read as .npy: it states a negative size")
        size = math.prod(shape) * dtype.itemsize
        held = path.stat().st_size - stream.tell()
        if size > held:
            raise ValueError(f"cannot be read as .npy: {size} bytes are stated, {held} are there")
        if size > _LARGEST:
            raise ValueError("is larger than 1 GiB")
        values = np.fromfile(stream, dtype, math.prod(shape))
    order = "F" if by_columns else "C"
    result: NDArray[Any] = values.reshape(shape, order=order)  # type: ignore[call-overload]
    return result
