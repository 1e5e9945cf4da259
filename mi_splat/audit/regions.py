"""The simplest set of directions that holds the cameras which see a look: a cone, a sector, or all but these."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.surfaces import basis
from mi_splat.audit.switches import angles_between

_SIMPLER = {"cone": 0.0, "complement": 0.02, "sector": 0.05}
"""Overlap that a form has to gain over a simpler one."""
_WIDTHS = torch.arange(6, 91, 2, dtype=torch.float64)
_SECTOR_WIDTHS = torch.arange(10, 171, 8, dtype=torch.float64)
_ELEVATIONS = torch.arange(0, 91, 6, dtype=torch.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shape:
    """A set of directions in the frame of the splat; see `mi_splat.audit.results.Region`."""

    axis: Tensor
    half_width: float
    elevation: tuple[float, float] | None
    complement: bool
    overlap: float


def shape_of(directions: Tensor, shown: Tensor, up: Tensor | None) -> Shape:
    """The form that overlaps most with the cameras that see a look."""
    shapes = [_cone(directions, shown, complement=False), _cone(directions, ~shown, complement=True)]
    gains = [shapes[0].overlap, shapes[1].overlap - _SIMPLER["complement"]]
    if up is not None:
        shapes.append(_sector(directions, shown, up))
        gains.append(shapes[2].overlap - _SIMPLER["sector"])
    return shapes[max(range(len(gains)), key=gains.__getitem__)]


def overlaps(sets: Tensor, shown: Tensor) -> Tensor:
    """(T,) intersection over union of (T, K) sets of cameras with one."""
    return (sets & shown).sum(1) / (sets | shown).sum(1).clamp(min=1)


def _cone(directions: Tensor, inside: Tensor, *, complement: bool) -> Shape:
    axis = functional.normalize(directions[inside].sum(0), dim=0)
    holds = angles_between(axis[None], directions) <= _WIDTHS[:, None]
    overlap = overlaps(~holds if complement else holds, ~inside if complement else inside)
    best = int(overlap.argmax())
    return Shape(
        axis=axis,
        half_width=float(_WIDTHS[best]),
        elevation=None,
        complement=complement,
        overlap=float(overlap[best]),
    )


def _sector(directions: Tensor, shown: Tensor, up: Tensor) -> Shape:
    local = directions @ basis(up)
    elevation = local[:, 2].clamp(-1, 1).asin().rad2deg()
    azimuth = torch.atan2(local[:, 1], local[:, 0]).rad2deg()
    middle = local[shown, :2].sum(0)
    middle = middle / middle.norm().clamp(min=1e-12)
    turn = (azimuth - torch.atan2(middle[1], middle[0]).rad2deg() + 180) % 360 - 180
    wedges = turn.abs() <= _SECTOR_WIDTHS[:, None]
    low, high = torch.combinations(_ELEVATIONS, 2).unbind(1)
    bands = (elevation >= low[:, None]) & (elevation <= high[:, None])
    overlap = overlaps((wedges[:, None] & bands[None]).flatten(0, 1), shown)
    best = int(overlap.argmax())
    wedge, band = divmod(best, len(low))
    return Shape(
        axis=basis(up)[:, :2] @ middle,
        half_width=float(_SECTOR_WIDTHS[wedge]),
        elevation=(float(low[band]), float(high[band])),
        complement=False,
        overlap=float(overlap[best]),
    )
