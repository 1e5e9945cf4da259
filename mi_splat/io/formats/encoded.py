"""What a writer of splat files hands over: the bytes, and what of the scene is not in them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from mi_splat.attributes import LARGEST
from mi_splat.errors import InvalidValueError
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc, dc_to_colour, degree_of

Array = NDArray[np.floating]
"""Decoded values; float64 unless said otherwise."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Something of a scene that its file does not hold, beyond the rounding that the table of formats states.

    Attributes:
        what: What is lost.
        gaussians: Of how many Gaussians.
        largest: How much in the worst of them.
        unit: What `largest` is measured in.
    """

    what: str
    gaussians: int
    largest: float
    unit: str

    def __str__(self) -> str:
        return f"{self.what}: {self.gaussians:,} Gaussians, by up to {self.largest:.4g} {self.unit}"


@dataclass(frozen=True, slots=True, eq=False)
class Encoded:
    """A splat file in memory.

    Attributes:
        data: Its bytes.
        losses: What is not in them.
        order: Row of the scene that each row of the file holds; None where the order is kept.
    """

    data: bytes
    losses: tuple[Loss, ...]
    order: NDArray[np.int64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Values:
    """A scene's tensors as float64 NumPy arrays, for packing.

    Attributes:
        means: (N, 3) world units.
        log_scales: (N, 3) natural logarithms of the standard deviations.
        rotations: (N, 4) unit quaternions (w, x, y, z).
        opacities: (N,).
        colours: (N, 3) sRGB of the first SH coefficient, not clamped.
        sh: (N, K, 3).
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
    def of(cls, scene: GaussianScene, order: NDArray[np.int64] | None = None) -> Values:
        """The values of a scene, in another order of rows if one is given."""
        kept = [value.detach().to("cpu", torch.float32).double() for value in scene.tensors()]
        if not all(bool((value.abs() <= LARGEST).all()) for value in kept):
            expected = f"values that are finite in float32, up to {LARGEST:g}"
            raise InvalidValueError.of("scene", expected, "others", "remove those Gaussians")
        if order is not None:
            kept = [value[torch.from_numpy(order)] for value in kept]
        means, scales, rotations, opacities, sh = kept
        logs = scales.clamp(min=float(np.finfo(np.float32).smallest_subnormal)).log()
        rotations = rotations / torch.linalg.vector_norm(rotations, dim=1, keepdim=True)
        colours = dc_to_colour(sh[:, 0])
        return cls(*(value.numpy() for value in (means, logs, rotations, opacities, colours, sh)))


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


def dc_of(colours: Array) -> Array:
    """(N, 3) first SH coefficients of sRGB colours."""
    dc: Array = colour_to_dc(torch.from_numpy(np.asarray(colours, np.float64))).numpy()
    return dc


def dropped_bands(values: Values, degree: int) -> list[Loss]:
    """The loss of the SH coefficients above a degree, as a list of one or none."""
    rest = values.sh[:, (degree + 1) ** 2 :]
    return outside(f"SH above degree {degree} dropped", rest, 0, 0, "of a coefficient")
