"""Rooms, which are seen from within: their free positions, and cameras there that look at the objects in the room."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.frames import SOLID, Target, quantile
from mi_splat.audit.surfaces import SIZE
from mi_splat.cameras import Camera, focal_of, look_at
from mi_splat.rotation import to_matrix
from mi_splat.scene import GaussianScene
from mi_splat.sh import even_directions

_VOXELS, _EDGE = 32, 0.01
"""Voxels along the longest side of a scene, and the share of its points beyond each side that do not count."""
_MOST = 100_000
"""Gaussians that fill voxels, evenly taken of all."""
_RAYS, _TRIED = 48, 500
"""Rays from each free place that is tried, and places that are."""
_ENCLOSED, _WITHIN, _BETWEEN = 0.85, 0.2, 0.005
"""Share of the rays from an enclosed place that end at something; least share of the free places that are enclosed, and
of the filled voxels that stand between two enclosed places: an empty shell, as that of a car, has none."""
_CLEAR, _ROOM, _LEAST, MOST_CAMERAS = 1.3, 1.2, 12, 120
"""Radii from the middle of an object to the nearest camera, half the field of view by the angle at which the object is
seen, and cameras that look at it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid:
    """Voxels of a scene in its own frame."""

    low: Tensor  # (3,) float64 corner
    size: float  # side of a voxel
    filled: Tensor  # (X, Y, Z) bool, whether something is in each

    def ends(self, points: Tensor, directions: Tensor) -> Tensor:
        """(P, D) bool, whether the rays from (P, 3) points in (D, 3) directions meet something in the grid."""
        limit, met = torch.tensor(self.filled.shape), torch.zeros(len(points), len(directions), dtype=torch.bool)
        for step in range(1, 4 * int(limit.max())):
            cell = ((points[:, None] + step / 2 * self.size * directions - self.low) / self.size).floor().long()
            inside = ((cell >= 0) & (cell < limit)).all(-1)
            if not bool(inside.any()):
                break
            x, y, z = torch.minimum(cell.clamp(min=0), limit - 1).unbind(-1)
            met |= self.filled[x, y, z] & inside
        return met


def grid_of(scene: GaussianScene) -> Grid:
    """The voxels that hold the middle of a solid Gaussian, or a point one standard deviation from it along an axis."""
    rows = (scene.opacities > SOLID).nonzero()[:, 0]
    solid = scene.select(rows[:: math.ceil(len(rows) / _MOST)])
    points = solid.means.double()
    axes = (to_matrix(solid.rotations) * solid.scales[:, None]).double()
    reach = torch.cat([points, *(points + sign * axes[:, :, axis] for axis in range(3) for sign in (-1, 1))])
    sides = points.unbind(1)
    low = torch.stack([torch.tensor(quantile(side, _EDGE)) for side in sides]).double()
    high = torch.stack([torch.tensor(quantile(side, 1 - _EDGE)) for side in sides]).double()
    size = max(float((high - low).max()) / _VOXELS, 1e-9)
    low = low - size
    shape = ((high - low) / size).ceil().long() + 1
    filled = torch.zeros(*shape.tolist(), dtype=torch.bool)
    cell = ((reach - low) / size).floor().long()
    x, y, z = cell[((cell >= 0) & (cell < shape)).all(1)].unbind(1)
    filled[x, y, z] = True
    return Grid(low=low, size=size, filled=filled)


def free_positions(scene: GaussianScene) -> Tensor | None:
    """(P, 3) float64 positions inside a room from which it is seen; None where the scene is seen from outside.

    A room has much free space from which nearly all rays end at something, and something that stands in it.
    """
    grid = grid_of(scene)
    close = functional.max_pool3d(grid.filled[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0
    free = (~close).nonzero()
    if not len(free):
        return None
    free = free[:: max(1, len(free) // _TRIED)]
    positions = grid.low + (free + 0.5) * grid.size
    enclosed = grid.ends(positions, torch.from_numpy(even_directions(_RAYS))).double().mean(1) > _ENCLOSED
    if float(enclosed.double().mean()) < _WITHIN:
        return None
    return positions[enclosed] if _between(grid, positions[enclosed], ~close) > _BETWEEN else None


def _between(grid: Grid, positions: Tensor, free: Tensor) -> float:
    """Share of the filled voxels that stand between two free places, along an axis of the grid."""
    marks = torch.zeros(grid.filled.shape)
    x, y, z = ((positions - grid.low) / grid.size).floor().long().unbind(1)
    marks[x, y, z] = 1
    near = functional.max_pool3d(marks[None, None], 5, stride=1, padding=2)[0, 0] > 0
    near &= free
    among = torch.zeros_like(grid.filled)
    for axis in (0, 1, 2):
        before, after = near.cumsum(axis) > 0, near.flip(axis).cumsum(axis).flip(axis) > 0
        among |= before & after & grid.filled
    return float(among.sum()) / max(1.0, float(grid.filled.sum()))


def cameras_within(target: Target, positions: Tensor) -> tuple[Camera, ...]:
    """Cameras at free positions in a room that show an object; none if hardly any position is outside of the object."""
    away = positions[(positions - target.centre).norm(dim=1) > _CLEAR * target.radius]
    if len(away) < _LEAST:
        return ()
    numbers = torch.linspace(0, len(away) - 1, min(MOST_CAMERAS, len(away))).round().long()
    return tuple(_camera(position, target) for position in away[numbers])


def _camera(position: Tensor, target: Target) -> Camera:
    """A camera at a place that shows an object whole."""
    distance = float((position - target.centre).norm())
    half = _ROOM * math.asin(target.radius / distance)
    ahead = (target.centre - position) / distance
    top = torch.eye(3, dtype=torch.float64)[int(ahead.abs().argmin())]
    return Camera(
        to_world=look_at(position.tolist(), target.centre.tolist(), up=tuple(top.tolist())),
        focal=focal_of(2 * half, SIZE),
        width=SIZE,
        height=SIZE,
    )
