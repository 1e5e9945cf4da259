"""What a reader of splat files hands over: arrays, and which of their Gaussians are not
valid; needs no torch.
"""

from __future__ import annotations

import io
import math
import os
import stat
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_splat.attributes import ATTRIBUTES, LARGEST, Attribute
from mi_splat.errors import message
from mi_splat.io.errors import LFS_ADVICE, LFS_POINTER, SplatFileError, SplatFileWarning
from mi_splat.maths.sh import dc_to_colour, degree_of

if TYPE_CHECKING:
    from mi_splat.scene import GaussianScene

Array = NDArray[np.floating]
"""Decoded values; float64 unless said otherwise."""


@dataclass(frozen=True, slots=True)
class Loss:
    """What a file does not hold of a scene, beyond the rounding of its format;
    `largest` is of the worst Gaussian.
    """

    what: str
    gaussians: int
    largest: float
    unit: str

    def __str__(self) -> str:
        return (
            f"{self.what}: {self.gaussians:,} Gaussians, by up to {self.largest:.4g}"
            f" {self.unit}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Encoded:
    """A splat file in memory.

    Attributes:
        data: What follows the head in the file.
        losses: What of the scene is not in it.
        order: Row of the scene that each row of the file is; None where they are the
            same.
        head: Bytes before the data, apart from it so that a large table is not copied.
    """

    data: bytes | memoryview
    losses: tuple[Loss, ...]
    order: NDArray[np.int64] | None = None
    head: bytes = b""


@dataclass(frozen=True, slots=True, eq=False)
class Values:
    """The arrays of a scene in float64, for packing: unit quaternions, and colours that
    are not clamped.
    """

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
        kept = [
            value.astype(np.float64)[slice(None) if order is None else order]
            for value in arrays.values()
        ]
        means, scales, rotations, opacities, sh = kept
        logs = np.log(np.maximum(scales, np.finfo(np.float32).smallest_subnormal))
        rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
        return cls(means, logs, rotations, opacities, dc_to_colour(sh[:, 0]), sh)


def outside(
    what: str, values: Array, low: ArrayLike, high: ArrayLike, unit: str
) -> list[Loss]:
    """The loss of clamping values to a range, as a list of one or none."""
    rows = values.reshape(len(values), math.prod(values.shape[1:]))
    excess = np.maximum(np.asarray(low) - rows, rows - np.asarray(high)).max(
        axis=1, initial=0.0
    )
    count = int((excess > 0).sum())
    if count:
        return [Loss(what, count, float(excess.max()), unit)]
    return []


def vanished(opacities: Array, rounded: NDArray[np.uint8]) -> list[Loss]:
    """The loss where 8 bits of opacity make a Gaussian invisible that was not."""
    gone = (rounded == 0) & (opacities > 0)
    count = int(gone.sum())
    if count:
        return [
            Loss(
                "opacity rounded to 0",
                count,
                float(opacities[gone].max()),
                "of opacity",
            )
        ]
    return []


def bytes_of(values: Array) -> NDArray[np.uint8]:
    """Values rounded to whole numbers and clamped to a byte."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def dropped_bands(sh: Array, degree: int) -> list[Loss]:
    """The loss of the SH coefficients above a degree, as a list of one or none."""
    rest = sh[:, (degree + 1) ** 2 :]
    return outside(f"SH above degree {degree} dropped", rest, 0, 0, "of a coefficient")


# Unit quaternions by their three smallest components, in an order that each format
# chooses. The largest one is made positive and follows from the others, each of which
# lies within plus and minus `ROOT_HALF`.

ROOT_HALF = 0.5**0.5
"""The square root of one half."""

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def drop_largest(quaternions: Array) -> tuple[NDArray[np.int64], Array]:
    """Index (N,) of the largest component in size, and the others (N, 3) in order, with
    the sign that makes it > 0.
    """
    largest = np.abs(quaternions).argmax(axis=1)[:, None]
    signs = np.where(np.take_along_axis(quaternions, largest, 1) < 0, -1.0, 1.0)
    return largest[:, 0], np.take_along_axis(
        quaternions * signs, _OTHERS[largest[:, 0]], 1
    )


def restore_largest(largest: NDArray[np.integer], others: Array) -> Array:
    """(N, 4) unit quaternions, the inverse of `drop_largest`."""
    quaternions = np.empty((len(others), 4))
    np.put_along_axis(quaternions, _OTHERS[largest], others, 1)
    missing = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=1)))
    np.put_along_axis(
        quaternions, np.asarray(largest, np.int64)[:, None], missing[:, None], 1
    )
    return quaternions


Arrays = dict[Attribute, NDArray[np.float32]]
"""The five tensors of a scene as float32 arrays, in the order of `ATTRIBUTES`."""
UNIT_SLACK = 1e-6
"""As in `mi_splat.maths.rotation`."""

SHOWN = 5
"""How many names or rows a message lists."""

FREE_GAUSSIANS = 65_536
"""So many Gaussians a compressed file may hold whatever its size; beyond them it needs
one byte for each.
"""


Notice = tuple[str, str, str]
"""What was expected of a file, what was found, and what was made of it."""
HIGHER_BANDS: Notice = ("SH of degree 0 to 3", "4", "the highest band was left out")


@dataclass(frozen=True, slots=True, eq=False)
class Loaded:
    """All Gaussians of a splat file, which are not valid (and why the first is not),
    and what else there is to say.

    `unread` names properties and elements that a scene cannot hold.
    """

    arrays: Arrays
    invalid: NDArray[np.int64]
    reason: str
    is_antialiased: bool = False
    # valid rows in which a stored logarithm or logit is infinite
    infinite: tuple[int, ...] = ()
    notices: tuple[Notice, ...] = ()
    unread: tuple[str, ...] = ()
    # direction that the file says is up
    stated_up: tuple[float, float, float] | None = None
    # direction that its format defines as up
    format_up: tuple[float, float, float] | None = None
    document: object = None  # of a glTF, for checks of its form

    @property
    def scene(self) -> GaussianScene:
        """All Gaussians as a scene, unchecked, whose memory is shared."""
        return as_scene(self.arrays)

    def settle(
        self, path: str, on_invalid: Literal["raise", "drop"], *, stacklevel: int
    ) -> Loaded:
        """The content after its notices, and after the Gaussians that are not valid
        were refused or dropped.
        """
        for expected, got, done in self.notices:
            warnings.warn(
                message(path, expected, got, done),
                SplatFileWarning,
                stacklevel=stacklevel + 1,
            )
        bad = self.invalid
        count = len(self.arrays["means"])
        if not len(bad):
            return self
        which = ", ".join(str(row) for row in bad[:SHOWN].tolist()) + (
            ", ..." if len(bad) > SHOWN else ""
        )
        got = (
            f"{len(bad)} of {count} that are not (rows {which}; in the first,"
            f" {self.reason})"
        )
        if on_invalid == "raise":
            error = SplatFileError.of(
                path, "valid Gaussians", got, "repair it, or drop them (on_invalid)"
            )
            raise error.hinted(f"mi-splat convert {path} VALID.ply --drop-invalid")
        text = message(path, "valid Gaussians", got, "they were left out")
        warnings.warn(text, SplatFileWarning, stacklevel=stacklevel + 1)
        keep = np.ones(count, np.bool_)
        keep[bad] = False
        valid: Arrays = {name: value[keep] for name, value in self.arrays.items()}
        return replace(self, arrays=valid, invalid=bad[:0], reason="", notices=())


def ranges(names: Sequence[str]) -> list[str]:
    """Names with a number at their end, which follow each other, as a range: a_0 to
    a_15.
    """
    groups = dict[str, list[str]]()
    for name in names:
        groups.setdefault(name.rstrip("0123456789"), []).append(name)
    return [
        group[0] if len(group) == 1 else f"{group[0]} to {group[-1]}"
        for group in groups.values()
    ]


def arrays_of(scene: GaussianScene) -> Arrays:
    """The tensors of a scene as float32 arrays, whose memory is shared where it can
    be.
    """
    import torch

    values = (
        value.detach().to("cpu", torch.float32).numpy() for value in scene.tensors()
    )
    return dict(zip(ATTRIBUTES, values, strict=True))


def as_scene(arrays: Arrays) -> GaussianScene:
    """The arrays as a scene, unchecked, whose memory is shared."""
    import torch  # only where a scene is wanted

    from mi_splat.scene import GaussianScene

    return GaussianScene.unchecked(
        *(torch.from_numpy(arrays[name]) for name in ATTRIBUTES)
    )


def unit(quaternions: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """`mi_splat.maths.rotation.normalise` of an array, to the bit."""
    wide = quaternions.astype(np.float64)
    with np.errstate(all="ignore"):
        factor = 1 / np.sqrt((wide * wide).sum(-1, keepdims=True))
        return (wide * np.where(np.abs(factor - 1) <= UNIT_SLACK, 1.0, factor)).astype(
            quaternions.dtype
        )


def validated(
    means: NDArray[np.floating],
    scales: NDArray[np.floating],
    rotations: NDArray[np.floating],
    opacities: NDArray[np.floating],
    sh: NDArray[np.floating],
) -> Loaded:
    """Decoded Gaussians in float32, with normalised quaternions, and which of them are
    valid.
    """
    arrays = [
        np.require(value, np.float32, ("C", "W", "O"))
        for value in (means, scales, rotations, opacities, sh)
    ]
    arrays[2] = unit(arrays[2])
    good = [
        _where(arrays[0], lambda value: np.abs(value) <= LARGEST),
        _where(arrays[1], lambda value: (value > 0) & (value <= LARGEST)),
        _where(arrays[2], np.isfinite),
        _where(arrays[3], lambda value: (value >= 0) & (value <= 1)),
        _where(arrays[4], lambda value: np.abs(value) <= LARGEST),
    ]
    valid = np.ones(len(arrays[0]), np.bool_)
    for value in good:
        if not value.all():
            valid &= value.reshape(len(valid), -1).all(1)
    bad = np.flatnonzero(~valid)
    return Loaded(
        dict(zip(ATTRIBUTES, arrays, strict=True)),
        bad,
        _reason(arrays, good, int(bad[0])) if len(bad) else "",
    )


def _where(values: Array, inside: Callable[[Array], Any]) -> Any:
    """Which values lie in an interval; where the extremes do, all do, and no array is
    made.
    """
    extremes = np.array([values.min(), values.max()]) if values.size else values
    if inside(extremes).all():
        return np.broadcast_to(np.True_, values.shape)
    return inside(values)


def _reason(
    arrays: list[NDArray[np.float32]], good: list[NDArray[np.bool_]], row: int
) -> str:
    names = (
        "a coordinate of the mean",
        "a scale",
        "",
        "the opacity",
        "an SH coefficient",
    )
    for name, value, fine in zip(names, arrays, good, strict=True):
        if value.ndim > 1:
            wrong = value[row][~fine[row]]
        else:
            wrong = value[row : row + 1][~fine[row : row + 1]]
        if wrong.size:
            if name:
                return f"{name} is {wrong.flat[0]:g}"
            return "the quaternion is zero or not finite"
    return ""


def open_regular(path: str) -> io.FileIO:
    """The file, if it is a regular one; not blocking, so that a pipe does not wait for
    its writer.
    """
    file = io.FileIO(
        path,
        opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0)),
    )
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        got = "a special file (pipe, socket or device)"
        raise SplatFileError.of(
            path, "a splat file", got, "pass the path of a regular file"
        )
    if os.pread(file.fileno(), len(LFS_POINTER), 0) == LFS_POINTER:
        file.close()
        raise SplatFileError.of(path, "a splat file", *LFS_ADVICE)
    return file


def read_whole(file: io.FileIO) -> bytes:
    """All bytes of a file from its start."""
    file.seek(0)
    return file.readall()


def check_count(count: int, size: int, path: str) -> None:
    """Raise unless `count` Gaussians may come out of a compressed file.

    The smallest real ones take some five bytes a Gaussian. A file that claims far more
    was made to fill the memory.
    """
    most = FREE_GAUSSIANS + size
    if count > most:
        got = f"{count}: this may be a decompression bomb"
        raise SplatFileError.of(
            path,
            f"at most {most} Gaussians in {size} bytes",
            got,
            "ask for the splat as a PLY",
        )
