"""An object that is bent by a lattice of control points around it: free-form
deformation (Sederberg and Parry 1986) with trilinear weights.
"""

import itertools

import torch
from torch import Tensor

from attacks.search.parameters import Parameters

POINTS = 4
"""Control points along each axis."""


def lattice_start(clean: Parameters) -> Tensor:
    """No deformation: (4, 4, 4, 3) offsets of the control points, world units."""
    return clean["means"].new_zeros(POINTS, POINTS, POINTS, 3)


def apply_lattice(value: Tensor, tensors: Parameters) -> Parameters:
    """The object with its means moved by offsets (4, 4, 4, 3) of the control points,
    world units.
    """
    means = tensors["means"]
    cell, within = _cells(means)
    change = torch.zeros_like(means)
    for corner in itertools.product((0, 1), repeat=3):
        offset = torch.tensor(corner, device=means.device)
        weights = torch.where(offset.bool(), within, 1 - within).prod(1)
        x, y, z = (cell + offset).unbind(1)
        change = change + weights[:, None] * value[x, y, z]
    return {"means": means + change}


def _cells(means: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 3) cell of the lattice in which each mean lies, and where in it, in
    [0, 1].
    """
    points = means.detach()
    low = points.amin(0)
    side = (points.amax(0) - low).clamp(min=1e-9)
    place = (points - low) / side * (POINTS - 1)
    cell = place.floor().clamp(max=POINTS - 2)
    return cell.long(), place - cell
