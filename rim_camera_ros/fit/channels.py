"""Weighted designs of one channel of a station, distances or amplitudes, and their products."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from rim_camera_ros.effects.candidate import Groups

Array = NDArray[Any]


@dataclass(frozen=True)
class Places:
    """Where ``pixels`` (N,) are: flat in images of the whole array, which have ``size`` pixels.

    In images of a window of it they are at ``within`` (N,); None: there are none.
    """

    pixels: Array
    size: int
    within: Array | None = None

    def take(self, image: Array, out: Array | None = None) -> Array:
        """Return the pixels of an image of either kind, or of one number."""
        place = self.pixels if self.within is None or image.size == self.size else self.within
        return np.asarray(np.take(image, place, out=out, mode="clip"))


@dataclass(frozen=True)
class GroupValues:
    """A group of regressors, ``first`` on, of which each pixel has at most one; in units of the noise.

    ``number`` (N,) is the number of each pixel's own regressor in the group (-1: none), with the derivative
    ``value`` (N,). In addition all of them share the row ``common`` (N,) (None: there is none), each with the
    factor ``share`` (G,).
    """

    first: int
    number: Array
    value: Array
    share: Array
    common: Array | None


@dataclass(frozen=True)
class Channel:
    """The weighted design of one channel at its ``pixels`` (N,), flat.

    ``index`` (K,) are the numbers of the ``dense`` rows (K, N) among all columns of the design. Rows are in
    units of the noise; ``root`` (N,) is the inverse of its standard deviation.
    """

    pixels: Array
    root: Array
    index: Array
    dense: Array
    groups: GroupValues | None

    def add_to(self, gram: Array) -> None:
        """Add the products of all columns with each other to the normal matrix."""
        gram[np.ix_(self.index, self.index)] += self.dense @ self.dense.T
        if self.groups is None:
            return
        groups, count = self.groups, len(self.groups.share)
        mine = np.flatnonzero(groups.number >= 0)
        value, place = groups.value[mine], groups.number[mine]
        sparse = csr_matrix((value, (np.arange(mine.size), place)), (mine.size, count))
        rows = self.dense if mine.size == groups.number.size else self.dense[:, mine]
        cross = np.asarray((sparse.T @ rows.T).T)
        own = np.diag(np.bincount(place, value**2, minlength=count).astype(float))
        if groups.common is not None:
            cross = cross + np.outer(self.dense @ groups.common, groups.share)
            both = np.outer(sparse.T @ groups.common[mine], groups.share)
            own += both + both.T + (groups.common @ groups.common) * np.outer(groups.share, groups.share)
        at = slice(groups.first, groups.first + count)
        gram[self.index, at] += cross
        gram[at, self.index] += cross.T
        gram[at, at] += own

    def times(self, factor: Array) -> Products:
        """Return the products of all columns with a column that is ``factor`` (N,) at each pixel."""
        return Products(self, factor * self.root)


@dataclass(frozen=True)
class Products:
    """Products of the columns of a ``channel`` with a column of each pixel's own: columns times ``factor``.

    ``factor`` (N,) is the weighted value of the pixel's column.
    """

    channel: Channel
    factor: Array


def channel_of(
    places: Places,
    weight: Array,
    columns: Sequence[tuple[int, Array]],
    groups: tuple[int, Groups] | None,
    *,
    light: bool,
) -> Channel:
    """Return the design at some pixels (N,) of ``weight`` (N,), from numbered ``columns`` (H, W).

    ``groups`` of regressors come with the number of the first; ``light``: their columns are those of the
    amplitude.
    """
    root = np.sqrt(weight)
    dense = _rows([image for _, image in columns], places)
    dense *= root
    index = np.array([i for i, _ in columns])
    if groups is None:
        return Channel(places.pixels, root, index, dense, None)
    first, grouped = groups

    def values(column: tuple[Array, Array]) -> Array:
        return np.asarray(_rows([column[1] if light else column[0]], places)[0] * root)

    return Channel(
        places.pixels,
        root,
        index,
        dense,
        GroupValues(
            first,
            places.take(grouped.number),
            values(grouped.own),
            grouped.share,
            None if grouped.common is None else values(grouped.common),
        ),
    )


def _rows(images: Sequence[Array], places: Places) -> Array:
    """Return the chosen pixels of images (H, W) as rows (len(images), N), 0 where not finite."""
    rows = np.empty((len(images), places.pixels.size))
    for row, image in zip(rows, images, strict=True):
        places.take(image, out=row)
    if not np.isfinite(rows.sum()):
        np.nan_to_num(rows, copy=False, posinf=0.0, neginf=0.0)
    return rows
