"""Unit quaternions by their three smallest components; the largest, made positive, follows from the others.

Used by the formats SPZ, SOG and compressed PLY, with the components in an order of theirs. A component that is not the
largest lies within plus and minus `ROOT_HALF`.
"""

import numpy as np
from numpy.typing import NDArray

from mi_splat.io.formats.encoded import Array

ROOT_HALF = 0.5**0.5
"""The square root of one half."""

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def drop_largest(quaternions: Array) -> tuple[NDArray[np.int64], Array]:
    """Index (N,) of the largest component in size, and the others (N, 3) in order, with the sign that makes it > 0."""
    largest = np.abs(quaternions).argmax(axis=1)[:, None]
    signs = np.where(np.take_along_axis(quaternions, largest, 1) < 0, -1.0, 1.0)
    return largest[:, 0], np.take_along_axis(quaternions * signs, _OTHERS[largest[:, 0]], 1)


def restore_largest(largest: NDArray[np.integer], others: Array) -> Array:
    """(N, 4) unit quaternions, the inverse of `drop_largest`."""
    quaternions = np.empty((len(others), 4))
    np.put_along_axis(quaternions, _OTHERS[largest], others, 1)
    missing = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=1)))
    np.put_along_axis(quaternions, np.asarray(largest, np.int64)[:, None], missing[:, None], 1)
    return quaternions
