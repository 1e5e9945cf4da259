"""Do faces that look different ways change from the same directions?

Gloss moves with the normal, and chance in the coefficients of single Gaussians has no common direction. A hidden look
has one for all of the surface. Two numbers of a set of directions say so, both less a multiple of what chance would
make of them, by how cells of surface differ:

- *shift*: how far the mean colour of what faces along one normal changes from inside to outside (sRGB): the geometric
  mean of that over all of the surface, and of that without the face, of the six main ones, that has most of it.
- *fade*: the share of its contrast that is gone inside, without the face that speaks most for it. Gloss adds to the
  colours of surface with one normal and leaves their contrast; a look replaces them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.surfaces import lattice

NORMALS = 40
"""Groups of normals, about 15 degrees around."""
_SHIFT_ERRORS, _FADE_ERRORS = 3.0, 4.0
"""Standard errors, between cells of surface, that are taken off."""
_ROUNDS = 6
"""Rounds in which colours of pieces and what is common to a group of normals are fitted in turn."""
_LEAST_LOOKS, _LEAST_CELLS, _LEAST_FADE_CELLS = 6, 2.5, 8.0
"""Looks at a cell on each side, and cells by weight, of a group of normals and of all: of fewer nothing is said."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Profiles:
    """How pieces of surface change with the camera.

    Attributes:
        cell: (E,) int64 cell of each piece.
        normals: (C, 3) mean unit normals of the cells.
        pieces: (C,) pieces of each.
        looks: (E, K, 6): what a camera sees of a piece less its own mean colour, 0 where it does not see it; how much
            more of its own contrast to its group of normals that has, times the square of the contrast; that square;
            whether it is seen.
    """

    cell: Tensor
    normals: Tensor
    pieces: Tensor
    looks: Tensor

    @classmethod
    def of(cls, moments: Tensor, normals: Tensor, cell: Tensor) -> Profiles:
        """Profiles of pieces."""
        seen, colours = moments[..., :1], moments[..., 1:4]
        group, looks = _group_of(normals), moments[..., 0].sum(1, keepdim=True)
        count = torch.zeros(NORMALS, moments.shape[1], 1).index_add_(0, group, seen).clamp(min=1)
        common = torch.zeros(NORMALS, moments.shape[1], 3)
        own = (colours * seen).sum(1) / looks
        for _ in range(_ROUNDS):
            common = torch.zeros_like(common).index_add_(0, group, (colours - own[:, None]) * seen) / count
            own = ((colours - common[group]) * seen).sum(1) / looks
        members = torch.bincount(group, minlength=NORMALS)[:, None].clamp(min=1)
        contrast = own - (torch.zeros(NORMALS, 3).index_add_(0, group, own) / members)[group]
        change = (colours - own[:, None]) * seen
        fade = ((change - common[group] * seen) * contrast[:, None]).sum(-1, keepdim=True)
        energy = contrast.square().sum(-1)[:, None, None] * seen
        cells = int(cell.max()) + 1
        return cls(
            cell=cell,
            normals=functional.normalize(torch.zeros(cells, 3).index_add_(0, cell, normals), dim=1),
            pieces=torch.bincount(cell, minlength=cells).float(),
            looks=torch.cat([change, fade, energy, seen], -1),
        )

    def of_cells(self) -> Tensor:
        """(C, K, 6) sums of the looks at each cell."""
        return self._by_cell(self.looks)

    def parted(self, sides: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], rows: int) -> tuple[Tensor, Tensor]:
        """(C, T, 6) sums inside and outside of sets of cameras that differ from piece to piece, so many at a time."""
        parts = [sides(part, self.looks[part]) for part in torch.split(torch.arange(len(self.looks)), rows)]
        inside, outside = (self._by_cell(torch.cat(values)) for values in zip(*parts, strict=True))
        return inside, outside

    def _by_cell(self, values: Tensor) -> Tensor:
        return torch.zeros(len(self.pieces), *values.shape[1:]).index_add_(0, self.cell, values)

    def shifts(self, inside: Tensor, outside: Tensor) -> Tensor:
        """(T,) float64 shift of each set of cameras, sRGB."""
        first, second = inside[..., 5], outside[..., 5]
        able = (first >= _LEAST_LOOKS) & (second >= _LEAST_LOOKS)
        change = inside[..., :3] / first.clamp(min=1)[..., None] - outside[..., :3] / second.clamp(min=1)[..., None]
        weight = _weight(first, second) * able
        sums = torch.zeros(NORMALS, *weight.shape[1:], 9, dtype=torch.float64)
        sums.index_add_(0, _group_of(self.normals), _terms(weight, change))
        mean, error, cells = _estimate(sums)
        size = (mean.square().sum(-1) / 3).sqrt() - _SHIFT_ERRORS * (error / 3).sqrt()
        pieces = torch.zeros(NORMALS, weight.shape[1], dtype=torch.float64)
        pieces.index_add_(0, _group_of(self.normals), (able * self.pieces[:, None]).double())
        size = size.clamp(min=0) * (cells >= _LEAST_CELLS) * pieces
        faces = torch.zeros(6, weight.shape[1], dtype=torch.float64)
        faces.index_add_(0, face_of(lattice(NORMALS, -90.0, 90.0)), size)
        total = faces.sum(0)
        return (total * (total - faces.amax(0)).clamp(min=0)).sqrt() / pieces.sum(0).clamp(min=1)

    def fades(self, inside: Tensor, outside: Tensor) -> Tensor:
        """(T,) float64 share of the contrast that changes between the sides of each set of cameras, as in `shifts`."""
        first, second = inside[..., 4], outside[..., 4]
        able = (first > 0) & (second > 0)
        change = inside[..., 3] / first.clamp(min=1e-9) - outside[..., 3] / second.clamp(min=1e-9)
        sums = torch.zeros(6, *first.shape[1:], 5, dtype=torch.float64)
        sums.index_add_(0, face_of(self.normals), _terms(_weight(first, second) * able, change[..., None]))
        total = sums.sum(0)
        mean, error, cells = _estimate(total - sums)
        size = mean[..., 0] * total[..., 1].sign() - _FADE_ERRORS * error.sqrt()
        return (size.clamp(min=0) * (cells > _LEAST_FADE_CELLS)).amin(0)


def face_of(normals: Tensor) -> Tensor:
    """(E,) int64 which of six sides (E, 3) normals face along."""
    axis = normals.abs().argmax(1)
    return 2 * axis + (normals.gather(1, axis[:, None])[:, 0] > 0)


def _group_of(normals: Tensor) -> Tensor:
    return (normals @ lattice(NORMALS, -90.0, 90.0).float().T).argmax(1)


def _weight(first: Tensor, second: Tensor) -> Tensor:
    return first * second / (first + second).clamp(min=1e-9)


def _terms(weight: Tensor, value: Tensor) -> Tensor:
    """(C, T, 3 + 2 D) float64 terms of which sums over cells make a mean of (C, T, D) values and its error."""
    weight, value = weight.double()[..., None], value.double()
    squares = weight.square()
    terms = [weight, weight * value, squares, squares * value, squares * value.square().sum(-1, keepdim=True)]
    return torch.cat(terms, -1)


def _estimate(sums: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(..., D) mean, (...) the square of its standard error over all D, and (...) cells by weight."""
    size = (sums.shape[-1] - 3) // 2
    weight, squares = sums[..., 0].clamp(min=1e-12), sums[..., size + 1]
    mean = sums[..., 1 : size + 1] / weight[..., None]
    cross = (mean * sums[..., size + 2 : 2 * size + 2]).sum(-1)
    spread = (sums[..., -1] - 2 * cross + mean.square().sum(-1) * squares).clamp(min=0) / weight.square()
    cells = weight.square() / squares.clamp(min=1e-20)
    return mean, spread * cells / (cells - 1).clamp(min=0.5), cells
