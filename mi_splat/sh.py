"""Real spherical harmonics of degree 0 to 3 in the order and signs of 3D Gaussian Splatting (Kerbl et al. 2023).

The basis is the real one with the Condon-Shortley phase, each band ordered m = -l .. l. Against complex harmonics Y:
m > 0 is sqrt(2) Re Y_l^m, m = 0 is Y_l^0, m < 0 is sqrt(2) Im Y_l^|m| (Sloan 2008, appendix A2).
A colour is max(0, 0.5 + sum_k sh_k basis_k).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError, message

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
    """Number of coefficients K = (degree + 1)^2 of one colour channel.

    Raises:
        InvalidValueError: degree is not 0, 1, 2 or 3.
    """
    if degree not in range(MAX_DEGREE + 1):
        raise InvalidValueError(message("degree", "0, 1, 2 or 3", degree, "use a supported SH degree"))
    return (degree + 1) ** 2


def degree_of(count: int) -> int:
    """SH degree that has `count` coefficients a channel.

    Raises:
        InvalidValueError: count is not 1, 4, 9 or 16.
    """
    degree = math.isqrt(count) - 1 if count > 0 else -1
    if degree not in range(MAX_DEGREE + 1) or (degree + 1) ** 2 != count:
        raise InvalidValueError(message("sh", "1, 4, 9 or 16 coefficients", count, "pass SH of degree 0 to 3"))
    return degree


def _band(x: Tensor, y: Tensor, z: Tensor, degree: int) -> list[Tensor]:
    """The 2 * degree + 1 basis functions of one band."""
    xx, yy, zz = x * x, y * y, z * z
    if degree == 0:
        return [torch.full_like(x, _C0)]
    if degree == 1:
        return [-_C1 * y, _C1 * z, -_C1 * x]
    if degree == 2:
        return [
            _C2_XY * x * y,
            -_C2_XY * y * z,
            _C2_ZZ * (2 * zz - xx - yy),
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
    """All basis functions up to `degree`.

    Args:
        directions: (..., 3) unit vectors.
        degree: 0 to 3.

    Returns:
        (..., (degree + 1)^2) values of the basis.

    Raises:
        InvalidValueError: degree is not 0, 1, 2 or 3, or directions are not 3-vectors.
    """
    coefficient_count(degree)
    if directions.ndim == 0 or directions.shape[-1] != 3:
        raise InvalidValueError(
            message("directions", "shape (..., 3)", tuple(directions.shape), "pass unit vectors in the last dimension")
        )
    x, y, z = directions.unbind(-1)
    return torch.stack([value for band in range(degree + 1) for value in _band(x, y, z, band)], dim=-1)


def sh_to_colour(sh: Tensor, directions: Tensor) -> Tensor:
    """Colour of each Gaussian seen along its direction.

    Args:
        sh: (..., K, 3) coefficients.
        directions: (..., 3) unit vectors from the camera centre to the Gaussian's mean.

    Returns:
        (..., 3) sRGB, max(0, 0.5 + sum); not clamped from above.
    """
    basis = sh_basis(directions, degree_of(sh.shape[-2]))
    return ((basis[..., None] * sh).sum(-2) + 0.5).clamp(min=0)


def colour_to_dc(colour: Tensor) -> Tensor:
    """(..., 3) first SH coefficient of a Gaussian that has the sRGB `colour` (..., 3) from everywhere."""
    return (colour - 0.5) / _C0


def dc_to_colour(dc: Tensor) -> Tensor:
    """(..., 3) sRGB colour of the first SH coefficient `dc` (..., 3), the inverse of `colour_to_dc`; not clamped."""
    return dc * _C0 + 0.5


def colours_by_direction(sh: Tensor, directions: Tensor, *, rows: int = 1 << 16) -> tuple[Tensor, Tensor]:
    """Mean colour of all Gaussians in each direction, and the largest; an honest splat has nearly the same in all.

    Args:
        sh: (N, K, 3) coefficients, N at least 1.
        directions: (M, 3) unit vectors from a camera to the splat.
        rows: Gaussians that are looked at together.

    Returns:
        (M,) mean over Gaussians and channels, and (M,) largest value; sRGB, not clamped from above.
    """
    basis = sh_basis(directions.to(sh), degree_of(sh.shape[-2]))
    means, most = sh.new_zeros(len(directions)), sh.new_zeros(len(directions))
    for part in torch.split(sh, rows):
        colours = (torch.einsum("mk,nkc->mnc", basis, part) + 0.5).clamp(min=0).flatten(1)
        means += colours.sum(1) / (3 * len(sh))
        most = torch.maximum(most, colours.amax(1))
    return means, most


def even_directions(count: int = 64) -> Tensor:
    """(count, 3) float64 directions spread evenly over the sphere (Fibonacci lattice, Swinbank and Purser 2006)."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * index / count
    angle = index * math.pi * (3 - math.sqrt(5))
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), z], dim=-1)


def sh_rotation(rotation: Tensor, degree: int) -> Tensor:
    """Matrix that rotates SH coefficients: the field turned by R has coefficients D c.

    Each band is closed under rotation, so the least-squares fit of the basis at R^T d to the basis at d, over
    well-spread directions d, is exact; no recursion for the Wigner matrices is needed.

    Args:
        rotation: (3, 3) rotation matrix R.
        degree: 0 to 3.

    Returns:
        (K, K) float64 block-diagonal orthogonal matrix D on the CPU, K = (degree + 1)^2.
    """
    turn = rotation.detach().to("cpu", torch.float64)
    probes = even_directions()
    # Row vectors: probes @ R is R^T d for each probe d.
    here, there = sh_basis(probes, degree), sh_basis(probes @ turn, degree)
    result = torch.zeros(here.shape[1], here.shape[1], dtype=torch.float64)
    for band in range(degree + 1):
        rows = slice(band**2, (band + 1) ** 2)
        result[rows, rows] = torch.linalg.lstsq(here[:, rows], there[:, rows]).solution
    return result


def rotate_sh(sh: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients of the same colours after the Gaussians have turned by a rotation.

    Args:
        sh: (..., K, 3) coefficients.
        rotation: (3, 3) rotation matrix R; the result seen along R d is `sh` seen along d.

    Returns:
        (..., K, 3) coefficients.
    """
    degree = degree_of(sh.shape[-2])
    return sh if degree == 0 else torch.matmul(sh_rotation(rotation, degree).to(sh), sh)
