"""Scenes that are seen from inside: rooms, and where cameras can stand in them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.objects import quantile
from mi_splat.audit.thresholds import LIMITS
from mi_splat.cameras.camera import orbit_pose
from mi_splat.cameras.directions import UP, Point
from mi_splat.maths.rotation import from_z, to_matrix
from mi_splat.maths.sh import even_directions
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid:
    """Voxels of a scene in its own frame."""

    low: Tensor  # (3,) float64 corner
    size: float  # side of a voxel
    filled: Tensor  # (X, Y, Z) bool, whether something is in each

    def ends(self, points: Tensor, directions: Tensor) -> Tensor:
        """(P, D) bool, whether the rays from (P, 3) points in (D, 3) directions meet
        something in the grid.
        """
        limit = torch.tensor(self.filled.shape)
        met = torch.zeros(len(points), len(directions), dtype=torch.bool)
        # of the rays that are in the grid and met nothing
        start, way = torch.ones_like(met).nonzero().unbind(1)
        for step in range(1, 4 * int(limit.max())):
            cell = (
                (
                    (points[start] + step / 2 * self.size * directions[way] - self.low)
                    / self.size
                )
                .floor()
                .long()
            )
            inside = ((cell >= 0) & (cell < limit)).all(-1)
            start, way, (x, y, z) = start[inside], way[inside], cell[inside].unbind(1)
            ends = self.filled[x, y, z]
            met[start[ends], way[ends]] = True
            start = start[~ends]
            way = way[~ends]
        return met


def grid_of(scene: GaussianScene) -> Grid:
    """The voxels that hold the middle of a solid Gaussian, or a point one standard
    deviation from it along an axis.
    """
    rows = (scene.opacities > LIMITS.solid).nonzero()[:, 0]
    solid = scene.select(rows[:: math.ceil(len(rows) / LIMITS.room_gaussians)])
    points = solid.means.double()
    axes = (to_matrix(solid.rotations) * solid.scales[:, None]).double()
    reach = torch.cat(
        [
            points,
            *(
                points + sign * axes[:, :, axis]
                for axis in range(3)
                for sign in (-1, 1)
            ),
        ]
    )
    sides = points.unbind(1)
    low = torch.stack(
        [torch.tensor(quantile(side, LIMITS.room_edge)) for side in sides]
    ).double()
    high = torch.stack(
        [torch.tensor(quantile(side, 1 - LIMITS.room_edge)) for side in sides]
    ).double()
    size = max(float((high - low).max()) / LIMITS.room_voxels, 1e-9)
    low = low - size
    shape = ((high - low) / size).ceil().long() + 1
    filled = torch.zeros(*shape.tolist(), dtype=torch.bool)
    cell = ((reach - low) / size).floor().long()
    x, y, z = cell[((cell >= 0) & (cell < shape)).all(1)].unbind(1)
    filled[x, y, z] = True
    return Grid(low=low, size=size, filled=filled)


def free_positions(scene: GaussianScene) -> Tensor | None:
    """(P, 3) float64 positions inside a room from which it is seen; None where the
    scene is seen from outside.
    """
    grid, free, positions, share = _enclosed(scene)
    within = (
        share >= LIMITS.enclosed_share
        and _between(grid, positions, free) > LIMITS.between
    )
    if within:
        return positions
    return None


AROUND = (30.0, 120.0, 210.0, 300.0)
"""Azimuths from which a room may be shown, degrees."""


_AHEAD = 0.9
"""Cosine of an angle to the middle of a picture, up to which it shows a Gaussian."""


class Inside(NamedTuple):
    """Where a camera may stand in a hollow scene."""

    centre: tuple[float, float, float]  # a free position amid the scene, to look at
    distance: float  # from there to the camera, world units
    azimuth: float  # of the camera, degrees
    is_room: bool  # rather than a hollow box, which has nothing in it


def place_inside(
    scene: GaussianScene,
    azimuths: Sequence[float] = AROUND,
    *,
    elevation: float = 20.0,
    up: Point = UP,
) -> Inside | None:
    """Where to stand in a hollow scene, at the azimuth from which most Gaussians are
    ahead.
    """
    if not bool((scene.opacities > LIMITS.solid).any()):
        return None
    grid, free, positions, share = _enclosed(scene)
    if share < LIMITS.enclosed_share:
        return None
    middle = positions[(positions - positions.mean(0)).norm(dim=1).argmin()]
    turn = from_z(torch.tensor(up, dtype=torch.float64))
    places = []
    for azimuth in azimuths:
        way = (
            turn
            @ orbit_pose((0, 0, 0), azimuth=azimuth, elevation=elevation, distance=1)[
                :3, 3
            ]
        )
        distance = _free_on(grid, free, middle, way)
        ahead = (
            functional.normalize(scene.means.double() - middle - distance * way, dim=1)
            @ -way
        )
        places.append((int((ahead > _AHEAD).sum()), distance, azimuth))
    _, distance, azimuth = max(places)
    x, y, z = middle.tolist()
    return Inside(
        (x, y, z), distance, azimuth, _between(grid, positions, free) > LIMITS.between
    )


def _free_on(grid: Grid, free: Tensor, start: Tensor, way: Tensor) -> float:
    """How far it is from a free position to the last free voxel on a way."""
    steps = torch.arange(4 * max(grid.filled.shape))[:, None] / 2 * grid.size
    cells = ((start + steps * way - grid.low) / grid.size).floor().long()
    kept = cells.clamp(min=0).minimum(torch.tensor(grid.filled.shape) - 1)
    ends = (cells != kept).any(1) | ~free[kept.unbind(1)]
    return float(steps[max(1, int(ends.nonzero()[0]) - 1)])


def _enclosed(scene: GaussianScene) -> tuple[Grid, Tensor, Tensor, float]:
    """The grid of a scene, its free voxels, and of those the middles of enclosed ones
    and their share.
    """
    grid = grid_of(scene)
    free = (
        functional.max_pool3d(grid.filled[None, None].float(), 3, stride=1, padding=1)[
            0, 0
        ]
        == 0
    )
    tried = free.nonzero()
    tried = tried[:: max(1, len(tried) // LIMITS.room_places)]
    positions = grid.low + (tried + 0.5) * grid.size
    ends = grid.ends(positions, torch.from_numpy(even_directions(LIMITS.room_rays)))
    enclosed = ends.double().mean(1) > LIMITS.enclosed
    return (
        grid,
        free,
        positions[enclosed],
        float(enclosed.double().sum() / max(1, len(tried))),
    )


def _between(grid: Grid, positions: Tensor, free: Tensor) -> float:
    """Share of the filled voxels that stand between two free places, along an axis of
    the grid.
    """
    marks = torch.zeros(grid.filled.shape)
    x, y, z = ((positions - grid.low) / grid.size).floor().long().unbind(1)
    marks[x, y, z] = 1
    near = functional.max_pool3d(marks[None, None], 5, stride=1, padding=2)[0, 0] > 0
    near &= free
    among = torch.zeros_like(grid.filled)
    for axis in (0, 1, 2):
        before = near.cumsum(axis) > 0
        after = near.flip(axis).cumsum(axis).flip(axis) > 0
        among |= before & after & grid.filled
    return float(among.sum()) / max(1.0, float(grid.filled.sum()))
