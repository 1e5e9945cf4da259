"""What honest gloss explains: the angle of incidence, a mirrored direction, and mirrored surroundings as a whole."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.surfaces import Sight, lattice
from mi_splat.sh import sh_basis

INSIDE, OUTSIDE = 3.0, 8.0
"""Degrees at the edge of a cone that count as neither: a look may change there as it likes."""
_COSINES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
ANGLES = len(_COSINES)
"""Sets of angles of incidence; they come before the mirrored directions."""
_MIRROR_AXES, _MIRROR_WIDTHS = 52, (30.0, 45.0, 60.0, 75.0, 90.0)
_DEGREE, _POWERS = 3, (1, 2, 3, 5)
"""Degree of the spherical harmonics of the surroundings, and powers of the cosine of incidence beside them."""
_ROUNDS, _RIDGE, _MOST = 4, 1e-3, 5.0
"""Rounds in which surroundings and strengths are fitted in turn, how far both are held back, the largest strength."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rays:
    """How each camera sees each piece of surface.

    Attributes:
        cosines: (E, K) of the angle of incidence.
        mirrored: (E, K, 3) unit vectors in which a mirror would reflect the view.
    """

    cosines: Tensor
    mirrored: Tensor


def rays_of(view: Sight, positions: Tensor, normals: Tensor) -> Rays:
    """How the cameras see pieces of surface at (E, 3) positions with (E, 3) normals."""
    eyes = torch.stack([camera.position for camera in view.cameras]).float()
    views = functional.normalize(eyes - positions[:, None], dim=-1)
    cosines = (views * normals[:, None]).sum(-1)
    return Rays(cosines=cosines, mirrored=2 * cosines[..., None] * normals[:, None] - views)


def sides(cosines: Tensor, mirrored: Tensor) -> tuple[Tensor, Tensor]:
    """(E, R, K) float32 cameras inside and outside of each set of angles of incidence, and of mirrored directions."""
    limits = torch.tensor(_COSINES)[:, None]
    turned = (mirrored @ lattice(_MIRROR_AXES, -90.0, 90.0).float().T).transpose(1, 2)
    insides, outsides = [cosines[:, None] > limits + 0.03], [cosines[:, None] < limits - 0.06]
    for width in _MIRROR_WIDTHS:
        insides.append(turned > math.cos(math.radians(width - INSIDE)))
        outsides.append(turned < math.cos(math.radians(width + OUTSIDE)))
    return torch.cat(insides, 1).float(), torch.cat(outsides, 1).float()


def without_surroundings(moments: Tensor, rays: Rays, cell: Tensor) -> Tensor:
    """(E, K, 5) moments of what is left of the colours when mirrored surroundings are taken off.

    All of the surface mirrors the same surroundings, each cell of it as strongly as fits best: a box of metal on dull
    ground is explained, a look on surfaces that face many ways is not.

    Args:
        moments: (E, K, 5) of the pieces.
        rays: How they are seen.
        cell: (E,) int64 cell of each.
    """
    seen = moments[..., :1]
    count = seen.sum(1, keepdim=True).clamp(min=1)
    basis = sh_basis(rays.mirrored.reshape(-1, 3), _DEGREE)[:, 1:].reshape(*rays.mirrored.shape[:2], -1)
    powers = torch.stack([rays.cosines.clamp(0, 1) ** power for power in _POWERS], -1)
    shapes, colours = torch.cat([basis, powers], -1) * seen, moments[..., 1:4] * seen
    shapes = (shapes - shapes.sum(1, keepdim=True) / count) * seen
    colours = (colours - colours.sum(1, keepdim=True) / count) * seen
    terms, cells = shapes.shape[-1], int(cell.max()) + 1
    squares = torch.zeros(cells, terms, terms).index_add_(0, cell, shapes.transpose(1, 2) @ shapes)
    products = torch.zeros(cells, terms, 3).index_add_(0, cell, shapes.transpose(1, 2) @ colours)
    strength, fit = torch.ones(cells), torch.zeros(terms, 3)
    for _ in range(_ROUNDS):
        matrix = torch.einsum("c,cqr->qr", strength.square(), squares)
        held = (_RIDGE * matrix.diagonal().mean() + 1e-9) * torch.eye(terms)
        fit = torch.linalg.solve(matrix + held, torch.einsum("c,cqd->qd", strength, products))
        gain = torch.einsum("cqd,qd->c", products, fit)
        power = torch.einsum("qd,cqr,rd->c", fit, squares, fit)
        little = _RIDGE * power.mean()
        strength = ((gain + little) / (power + little).clamp(min=1e-9)).clamp(0, _MOST)
    left = (colours - strength[cell, None, None] * (shapes @ fit)) * seen
    return torch.cat([seen, left, left.square().sum(-1, keepdim=True)], -1)
