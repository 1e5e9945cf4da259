"""Real spherical harmonics of degree 0 to 3 in the order and signs of 3D Gaussian
Splatting (Kerbl et al. 2023).

The basis is the real one with the Condon-Shortley phase, each band ordered m = -l .. l.
Against complex harmonics Y: m > 0 is sqrt(2) Re Y_l^m, m = 0 is Y_l^0, m < 0 is sqrt(2)
Im Y_l^|m| (Sloan 2008, appendix A2). A colour is max(0, 0.5 + sum_k sh_k basis_k).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from mi_splat.errors import InvalidValueError

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray
    from torch import Tensor

_Values = TypeVar("_Values", bound="Any")
"""A tensor or a NumPy array."""

MAX_DEGREE = 3

_C0 = 0.5 / math.sqrt(math.pi)
_C1 = 0.5 * math.sqrt(3 / math.pi)
_C2_XY = 0.5 * math.sqrt(15 / math.pi)
_C2_ZZ = 0.25 * math.sqrt(5 / math.pi)
_C3_XXX = 0.25 * math.sqrt(17.5 / math.pi)
_C3_XYZ = 0.5 * math.sqrt(105 / math.pi)
_C3_XZZ = 0.25 * math.sqrt(10.5 / math.pi)
_C3_ZZZ = 0.25 * math.sqrt(7 / math.pi)


def coefficient_count(degree: int) -> int:
    """Number of coefficients K = (degree + 1)^2 of one colour channel."""
    if degree not in range(MAX_DEGREE + 1):
        raise InvalidValueError.of(
            "degree", "0, 1, 2 or 3", degree, "use a supported SH degree"
        )
    return (degree + 1) ** 2


def degree_of(count: int) -> int:
    """SH degree that has `count` coefficients a channel."""
    degree = math.isqrt(count) - 1 if count > 0 else -1
    if degree not in range(MAX_DEGREE + 1) or (degree + 1) ** 2 != count:
        raise InvalidValueError.of(
            "sh", "1, 4, 9 or 16 coefficients", count, "pass SH of degree 0 to 3"
        )
    return degree


def band(directions: tuple[_Values, _Values, _Values], degree: int) -> list[_Values]:
    """The 2 * degree + 1 basis functions of one band at unit vectors x, y, z, which are
    tensors or arrays.
    """
    x: Any
    y: Any
    z: Any
    x, y, z = directions
    xx = x * x
    yy = y * y
    zz = z * z
    if degree == 0:
        return [x * 0 + _C0]
    if degree == 1:
        return [-_C1 * y, _C1 * z, -_C1 * x]
    if degree == 2:
        zonal = _C2_ZZ * (2 * zz - xx - yy)
        return [
            _C2_XY * x * y,
            -_C2_XY * y * z,
            zonal,
            -_C2_XY * x * z,
            0.5 * _C2_XY * (xx - yy),
        ]
    return [
        -_C3_XXX * y * (3 * xx - yy),
        _C3_XYZ * x * y * z,
        -_C3_XZZ * y * (4 * zz - xx - yy),
        _C3_ZZZ * z * (2 * zz - 3 * xx - 3 * yy),
        -_C3_XZZ * x * (4 * zz - xx - yy),
        0.5 * _C3_XYZ * z * (xx - yy),
        -_C3_XXX * x * (xx - 3 * yy),
    ]


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """All basis functions up to `degree`."""
    coefficient_count(degree)
    if directions.ndim == 0 or directions.shape[-1] != 3:
        do = "pass unit vectors in the last dimension"
        raise InvalidValueError.of(
            "directions", "shape (..., 3)", tuple(directions.shape), do
        )
    import torch  # not for those who only count coefficients

    x, y, z = directions.unbind(-1)
    return torch.stack(
        [value for number in range(degree + 1) for value in band((x, y, z), number)],
        dim=-1,
    )


def sh_to_colour(sh: Tensor, directions: Tensor) -> Tensor:
    """Colour of each Gaussian seen along its direction."""
    basis = sh_basis(directions, degree_of(sh.shape[-2]))
    return ((basis[..., None] * sh).sum(-2) + 0.5).clamp(min=0)


def colour_to_dc(colour: _Values) -> _Values:
    """(..., 3) first SH coefficient of a Gaussian that has the sRGB `colour` (..., 3)
    from everywhere.
    """
    result: _Values = (colour - 0.5) / _C0
    return result


def dc_to_colour(dc: _Values) -> _Values:
    """(..., 3) sRGB colour of the first SH coefficient `dc` (..., 3), the inverse of
    `colour_to_dc`; not clamped.
    """
    result: _Values = dc * _C0 + 0.5
    return result


def colours_by_direction(
    sh: NDArray[np.floating[Any]],
    directions: NDArray[np.float64],
    *,
    rows: int = 1 << 14,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean colour of all Gaussians in each direction, and the largest; an honest splat
    has nearly the same in all.
    """
    degree, (x, y, z) = degree_of(sh.shape[-2]), directions.T
    values = [
        value for number in range(degree + 1) for value in band((x, y, z), number)
    ]
    basis = np.stack(values, axis=1).astype(sh.dtype)
    means = np.zeros(len(directions))
    most = np.zeros(len(directions))
    for first in range(0, len(sh), rows):
        part = sh[first : first + rows].transpose(1, 0, 2).reshape(sh.shape[1], -1)
        colours = np.maximum(basis @ part + sh.dtype.type(0.5), 0)
        means += colours.sum(axis=1, dtype=np.float64) / (3 * len(sh))
        most = np.maximum(most, colours.max(axis=1))
    return means, most


def even_directions(count: int = 64) -> NDArray[np.float64]:
    """(count, 3) directions spread evenly over the sphere (Fibonacci lattice, Swinbank
    and Purser 2006).
    """
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = index * math.pi * (3 - math.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)


def sh_rotation(rotation: Tensor, degree: int) -> Tensor:
    """Matrix that rotates SH coefficients: the field turned by R has coefficients D c.

    Each band is closed under rotation, so the least-squares fit of the basis at R^T d
    to the basis at d, over well-spread directions d, is exact; no recursion for the
    Wigner matrices is needed. It is differentiable in the rotation.
    """
    import torch

    turn = rotation.to("cpu", torch.float64)
    probes = torch.from_numpy(even_directions())
    # Row vectors: probes @ R is R^T d for each probe d.
    before = sh_basis(probes, degree)
    after = sh_basis(probes @ turn, degree)
    result = torch.zeros(before.shape[1], before.shape[1], dtype=torch.float64)
    for number in range(degree + 1):
        rows = slice(number**2, (number + 1) ** 2)
        result[rows, rows] = torch.linalg.lstsq(
            before[:, rows], after[:, rows]
        ).solution
    return result


def rotate_sh(sh: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients of the same colours after the Gaussians have turned by a
    rotation.
    """
    import torch

    degree = degree_of(sh.shape[-2])
    if degree == 0:
        return sh
    return torch.matmul(sh_rotation(rotation, degree).to(sh), sh)
