"""What honest gloss explains: the angle of incidence, and a mirrored direction."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.surfaces import Sight, lattice

INSIDE, OUTSIDE = 3.0, 8.0
"""Degrees at the edge of a cone that count as neither: a look may change there as it likes."""
_COSINES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
ANGLES = len(_COSINES)
"""Sets of angles of incidence; they come before the mirrored directions."""
_MIRROR_AXES, _MIRROR_WIDTHS = 52, (30.0, 45.0, 60.0, 75.0, 90.0)


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


def incidence(cosines: Tensor) -> tuple[Tensor, Tensor]:
    """(E, ANGLES, K) float32 cameras inside and outside of each set of angles of incidence."""
    limits = torch.tensor(_COSINES)[:, None]
    return (cosines[:, None] > limits + 0.03).float(), (cosines[:, None] < limits - 0.06).float()


def sides(cosines: Tensor, mirrored: Tensor) -> tuple[Tensor, Tensor]:
    """(E, R, K) float32 cameras inside and outside of each set of angles of incidence, and of mirrored directions."""
    turned = (mirrored @ lattice(_MIRROR_AXES, -90.0, 90.0).float().T).transpose(1, 2)
    insides, outsides = ([side] for side in incidence(cosines))
    for width in _MIRROR_WIDTHS:
        insides.append((turned > math.cos(math.radians(width - INSIDE))).float())
        outsides.append((turned < math.cos(math.radians(width + OUTSIDE))).float())
    return torch.cat(insides, 1), torch.cat(outsides, 1)
