"""Few values in the place of many: 256 numbers for a column, at most 65,536 rows for a table of SH."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_splat.io.formats.encoded import Array

ENTRIES = 256
"""Numbers in a codebook."""

PALETTE = 65_536
"""Rows in a palette of SH."""


def codebook(values: Array) -> tuple[Array, NDArray[np.uint8]]:
    """At most 256 float32 numbers, and for each value the index of the nearest one.

    Up to 256 different values are kept as they are. Of more, half of the numbers are evenly spaced over the range, so
    that no value is off by more than 1/254 of it, and half follow the distribution (its quantiles).
    """
    plain = values.astype(np.float32).astype(np.float64)
    book = np.unique(plain)
    if len(book) > ENTRIES:
        half = ENTRIES // 2
        even = np.linspace(book[0], book[-1], half)
        often = np.quantile(plain, (np.arange(half) + 0.5) / half, method="nearest")
        book = np.unique(np.concatenate([even, often]).astype(np.float32).astype(np.float64))
    if not len(book):
        book = np.zeros(1)
    after = np.searchsorted(book, plain).clip(1, max(1, len(book) - 1))
    nearest = (
        after - 1 if len(book) == 1 else np.where(plain - book[after - 1] <= book[after] - plain, after - 1, after)
    )
    return book, np.asarray(nearest).astype(np.uint8)


def palette(rows: Array) -> tuple[Array, NDArray[np.int64]]:
    """At most 65,536 rows, and for each row of a table (N, C) the index of the one that stands for it.

    Up to that many different rows are kept as they are. More are split in two again and again, at the mean of the
    column in which a group spreads most (Heckbert 1982, median cut), and each group is replaced by its mean.
    """
    if len(rows) <= PALETTE:
        return rows, np.arange(len(rows))
    different, labels = np.unique(rows, axis=0, return_inverse=True)
    if len(different) <= PALETTE:
        return different, labels.reshape(-1)
    labels = np.zeros(len(rows), np.int64)
    for _ in range(PALETTE.bit_length() - 1):
        groups = int(labels.max()) + 1
        means, spread = _group_means(rows, labels, groups), np.empty((groups, rows.shape[1]))
        for column in range(rows.shape[1]):
            away = rows[:, column] - means[labels, column]
            spread[:, column] = np.bincount(labels, away**2, groups)
        widest = spread.argmax(axis=1)[labels]
        value = np.take_along_axis(rows, widest[:, None], 1)[:, 0]
        upper = value > means[labels, widest]
        labels = np.unique(2 * labels + upper, return_inverse=True)[1].reshape(-1)
    return _group_means(rows, labels, int(labels.max()) + 1), labels


def _group_means(rows: Array, labels: NDArray[np.int64], groups: int) -> Array:
    counts = np.bincount(labels, minlength=groups)
    return np.stack([np.bincount(labels, column, groups) / counts for column in rows.T], axis=1)
