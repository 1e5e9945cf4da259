"""What a writer of splat files hands over: the bytes, and what of the scene is not in them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_splat.io.loaded import Arrays
from mi_splat.sh import dc_to_colour, degree_of

Array = NDArray[np.floating]
"""Decoded values; float64 unless said otherwise."""


@dataclass(frozen=True, slots=True)
class Loss:
    """What a file does not hold of a scene, beyond the rounding of its format; `largest` is of the worst Gaussian."""

    what: str
    gaussians: int
    largest: float
    unit: str

    def __str__(self) -> str:
        return f"{self.what}: {self.gaussians:,} Gaussians, by up to {self.largest:.4g} {self.unit}"


@dataclass(frozen=True, slots=True, eq=False)
class Encoded:
    """A splat file in memory, what is not in it, and of which row of the scene each row is (None: the same one)."""

    data: bytes
    losses: tuple[Loss, ...]
    order: NDArray[np.int64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Values:
    """The arrays of a scene in float64, for packing: unit quaternions, and colours that are not clamped."""

    means: Array
    log_scales: Array
    rotations: Array
    opacities: Array
    colours: Array
    sh: Array

    @property
    def degree(self) -> int:
        """SH degree."""
        return degree_of(self.sh.shape[1])

    @classmethod
    def of(cls, arrays: Arrays, order: NDArray[np.int64] | None = None) -> Values:
        """The values of a scene, in another order of rows if one is given."""
        kept = [value.astype(np.float64)[slice(None) if order is None else order] for value in arrays.values()]
        means, scales, rotations, opacities, sh = kept
        logs = np.log(np.maximum(scales, np.finfo(np.float32).smallest_subnormal))
        rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
        return cls(means, logs, rotations, opacities, dc_to_colour(sh[:, 0]), sh)


def outside(what: str, values: Array, low: ArrayLike, high: ArrayLike, unit: str) -> list[Loss]:
    """The loss of clamping values to a range, as a list of one or none."""
    rows = values.reshape(len(values), math.prod(values.shape[1:]))
    excess = np.maximum(np.asarray(low) - rows, rows - np.asarray(high)).max(axis=1, initial=0.0)
    count = int((excess > 0).sum())
    return [Loss(what, count, float(excess.max()), unit)] if count else []


def vanished(opacities: Array, rounded: NDArray[np.uint8]) -> list[Loss]:
    """The loss where 8 bits of opacity make a Gaussian invisible that was not."""
    gone = (rounded == 0) & (opacities > 0)
    count = int(gone.sum())
    return [Loss("opacity rounded to 0", count, float(opacities[gone].max()), "of opacity")] if count else []


def bytes_of(values: Array) -> NDArray[np.uint8]:
    """Values rounded to whole numbers and clamped to a byte."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def dropped_bands(sh: Array, degree: int) -> list[Loss]:
    """The loss of the SH coefficients above a degree, as a list of one or none."""
    rest = sh[:, (degree + 1) ** 2 :]
    return outside(f"SH above degree {degree} dropped", rest, 0, 0, "of a coefficient")


# Unit quaternions by their three smallest components, in an order that each format chooses. The largest one is made
# positive and follows from the others, each of which lies within plus and minus `ROOT_HALF`.

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
