"""Something in the air that covers an object from some directions only, and that others look straight through."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.frames import Target
from mi_splat.audit.surfaces import Sight, rays
from mi_splat.cameras import project_points
from mi_splat.scene import GaussianScene

BLOCKED, FREE = 0.3, 0.1
"""Share of the rays to the object that end before it, from which a camera is blocked, and up to which it is free."""
_CORE, AIR, FLOOR, _TOLERANCE = 0.5, 1.15, 0.15, 0.15
"""Radii: rays that pass so near the centre count; air begins so far from it, and so far above the ground; depths that
differ by less are the same."""
_POINTS, _LEAST_POINTS = 60, 200
"""Points that are kept of each blocked picture, and looks at them from free cameras without which nothing is said."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cover:
    """What covers an object, in the frame of the splat.

    Attributes:
        blocked: (K,) share of the rays to the object that end at something in the air, by camera.
        transparent: Share of that something that free cameras look through; 0 if they hardly look at it.
        points: (P, 3) points of it.
        air: Of each blocked camera its number, and the (H, W) bool pixels that show it.
    """

    blocked: Tensor
    transparent: float
    points: Tensor
    air: dict[int, Tensor]

    @property
    def score(self) -> float:
        """Share of blocked cameras times what others look through."""
        return float((self.blocked > BLOCKED).double().mean()) * self.transparent


def cover_of(scene: GaussianScene, view: Sight, target: Target) -> Cover:
    """What covers an object."""
    centre = target.centre.float()
    heights = scene.means[target.rows] @ (centre if target.up is None else target.up.float())
    floor = float(heights.kthvalue(max(1, len(heights) // 50)).values)
    blocked, points = torch.zeros(len(view.cameras)), [torch.zeros(0, 3)]
    shown: dict[int, Tensor] = {}
    for number, (camera, depth) in enumerate(zip(view.cameras, view.depths, strict=True)):
        eye, directions = camera.position.float(), rays(camera)
        unit = functional.normalize(directions, dim=-1)
        along = unit @ (centre - eye)
        miss = ((centre - eye).square().sum() - along.square()).clamp(min=0).sqrt()
        core = miss < _CORE * target.radius
        ends = depth.isfinite()
        surface = eye + directions * depth.masked_fill(~ends, 0)[..., None]
        air = core & ends & ((surface - centre).norm(dim=-1) > AIR * target.radius)
        air &= (surface - eye).norm(dim=-1) < along
        if target.up is not None:
            air &= surface @ target.up.float() > floor + FLOOR * target.radius
        blocked[number] = air.sum() / max(int(core.sum()), 1)
        if blocked[number] > BLOCKED:
            shown[number] = air
            points.append(surface[air][:: max(1, int(air.sum()) // _POINTS)])
    cover = torch.cat(points)
    through = _through(view, cover, (blocked < FREE).nonzero()[:, 0], target.radius) if len(cover) else 0.0
    return Cover(blocked=blocked, transparent=through, points=cover, air=shown)


def _through(view: Sight, points: Tensor, free: Tensor, radius: float) -> float:
    """Share of points that free cameras look through, of those that they look through or see."""
    beyond = seen = 0
    for number in free.tolist():
        camera, depths = view.cameras[number], view.depths[number]
        pixels, depth = project_points(points, camera)
        column, row = pixels.nan_to_num(-1.0, -1.0, -1.0).clamp(-1, 1 << 15).floor().long().unbind(-1)
        inside = (depth > 0.05 * radius) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        shown, depth = depths[row[inside], column[inside]], depth[inside]
        beyond += int((shown > depth + _TOLERANCE * radius).sum())
        seen += int(((shown - depth).abs() <= _TOLERANCE * radius).sum())
    return beyond / (beyond + seen) if beyond + seen >= _LEAST_POINTS else 0.0


def middle_of(directions: Tensor, blocked: Tensor) -> Tensor:
    """(3,) float64 unit vector: the middle of the directions that are covered."""
    middle = directions[blocked > BLOCKED].sum(0)
    return functional.normalize(middle, dim=0) if math.isfinite(float(middle.norm())) else middle
