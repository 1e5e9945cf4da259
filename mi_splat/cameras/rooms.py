"""Scenes that are seen from inside: rooms, and where cameras can stand in them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.cameras.camera import orbit_pose
from mi_splat.cameras.directions import UP, Point
from mi_splat.maths.quantiles import quantile
from mi_splat.maths.rotation import from_z, to_matrix
from mi_splat.maths.sh import even_directions
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True)
class RoomLimits:
    """What a room is, and how closely a scene is looked through for one."""

    solid: float = 0.1  # Opacity of a Gaussian that says where things are.
    room_voxels: int = 32  # Along the longest side of a scene.
    room_edge: float = 0.01  # Share of its points beyond each side that do not count.
    room_gaussians: int = 100_000  # Gaussians that fill voxels, evenly taken of all.
    room_rays: int = 48  # From each free place that is tried.
    room_places: int = 500  # Free places that are tried.
    # Share of the rays from an enclosed place that end at something.
    enclosed: float = 0.85
    enclosed_share: float = 0.2  # Share of the free places of a room that are enclosed,
    # and of its filled voxels that stand between two of them: an empty shell has none.
    between: float = 0.005


ROOMS = RoomLimits()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid:
    """Voxels of a scene in its own frame."""

    low: Tensor  # (3,) float64 corner
    size: float  # side of a voxel
    filled: Tensor  # (X, Y, Z) bool, whether something is in each

    @property
    def limit(self) -> Tensor:
        """(3,) int64 number of voxels along each axis."""
        return torch.tensor(self.filled.shape)

    def cells(self, points: Tensor) -> Tensor:
        """(..., 3) int64 voxels in which (..., 3) points lie, also outside of the
        grid.
        """
        return ((points - self.low) / self.size).floor().long()

    def ends(self, points: Tensor, directions: Tensor) -> Tensor:
        """(P, D) bool, whether the rays from (P, 3) points in (D, 3) directions meet
        something in the grid.
        """
        limit = self.limit
        met = torch.zeros(len(points), len(directions), dtype=torch.bool)
        # of the rays that are in the grid and met nothing
        start, way = torch.ones_like(met).nonzero().unbind(1)
        for step in range(1, 4 * int(limit.max())):
            reached = points[start] + step / 2 * self.size * directions[way]
            cell = self.cells(reached)
            inside = ((cell >= 0) & (cell < limit)).all(-1)
            start = start[inside]
            way = way[inside]
            ends = self.filled[cell[inside].unbind(1)]
            met[start[ends], way[ends]] = True
            start = start[~ends]
            way = way[~ends]
        return met


def grid_of(scene: GaussianScene) -> Grid:
    """The voxels that hold the middle of a solid Gaussian, or a point one standard
    deviation from it along an axis.
    """
    rows = (scene.opacities > ROOMS.solid).nonzero()[:, 0]
    every = math.ceil(len(rows) / ROOMS.room_gaussians)
    solid = scene.select(rows[::every])
    points = solid.means.double()
    axes = (to_matrix(solid.rotations) * solid.scales[:, None]).double()
    reach = [points]
    for axis in range(3):
        for sign in (-1, 1):
            reach.append(points + sign * axes[:, :, axis])
    low = _edge(points, ROOMS.room_edge)
    high = _edge(points, 1 - ROOMS.room_edge)
    size = max(float((high - low).max()) / ROOMS.room_voxels, 1e-9)
    low = low - size
    shape = ((high - low) / size).ceil().long() + 1
    filled = torch.zeros(*shape.tolist(), dtype=torch.bool)
    grid = Grid(low=low, size=size, filled=filled)
    cell = grid.cells(torch.cat(reach))
    inside = ((cell >= 0) & (cell < shape)).all(1)
    filled[cell[inside].unbind(1)] = True
    return grid


def _edge(points: Tensor, share: float) -> Tensor:
    """(3,) float64 coordinates below which so large a share of the points lies."""
    sides = [torch.tensor(quantile(side, share)) for side in points.unbind(1)]
    return torch.stack(sides).double()


def free_positions(scene: GaussianScene) -> Tensor | None:
    """(P, 3) float64 positions inside a room from which it is seen; None where the
    scene is seen from outside.
    """
    hollow = _hollow(scene)
    if hollow.share < ROOMS.enclosed_share or not hollow.is_room:
        return None
    return hollow.positions


AROUND = (30.0, 120.0, 210.0, 300.0)
"""Azimuths from which a room may be shown, degrees."""


_AHEAD = 0.9
"""Cosine of an angle to the middle of an image, up to which it shows a Gaussian."""


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
    if not bool((scene.opacities > ROOMS.solid).any()):
        return None
    hollow = _hollow(scene)
    if hollow.share < ROOMS.enclosed_share:
        return None
    positions = hollow.positions
    gaps = (positions - positions.mean(0)).norm(dim=1)
    middle = positions[gaps.argmin()]
    turn = from_z(torch.tensor(up, dtype=torch.float64))
    places = []
    for azimuth in azimuths:
        pose = orbit_pose((0, 0, 0), azimuth=azimuth, elevation=elevation, distance=1)
        way = turn @ pose[:3, 3]
        distance = _free_on(hollow, middle, way)
        offsets = scene.means.double() - middle - distance * way
        ahead = functional.normalize(offsets, dim=1) @ -way
        places.append((int((ahead > _AHEAD).sum()), distance, azimuth))
    _, distance, azimuth = max(places)
    x, y, z = middle.tolist()
    return Inside((x, y, z), distance, azimuth, hollow.is_room)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Hollow:
    """The free space of a scene."""

    grid: Grid
    free: Tensor  # (X, Y, Z) bool, voxels without anything in them or beside them
    positions: Tensor  # (P, 3) float64 middles of free voxels that are enclosed
    share: float  # of the free voxels that were tried

    @property
    def is_room(self) -> bool:
        """Whether enough stands between its free places, unlike in an empty box."""
        return _between(self) > ROOMS.between


def _hollow(scene: GaussianScene) -> _Hollow:
    grid = grid_of(scene)
    filled = grid.filled[None, None].float()
    free = functional.max_pool3d(filled, 3, stride=1, padding=1)[0, 0] == 0
    tried = free.nonzero()
    tried = tried[:: max(1, len(tried) // ROOMS.room_places)]
    positions = grid.low + (tried + 0.5) * grid.size
    ends = grid.ends(positions, torch.from_numpy(even_directions(ROOMS.room_rays)))
    enclosed = ends.double().mean(1) > ROOMS.enclosed
    share = float(enclosed.double().sum() / max(1, len(tried)))
    return _Hollow(grid=grid, free=free, positions=positions[enclosed], share=share)


def _free_on(hollow: _Hollow, start: Tensor, way: Tensor) -> float:
    """How far it is from a free position to the last free voxel on a way."""
    grid = hollow.grid
    steps = torch.arange(4 * max(grid.filled.shape))[:, None] / 2 * grid.size
    cells = grid.cells(start + steps * way)
    kept = cells.clamp(min=0).minimum(grid.limit - 1)
    ends = (cells != kept).any(1) | ~hollow.free[kept.unbind(1)]
    last = int(ends.nonzero()[0]) - 1
    return float(steps[max(1, last)])


def _between(hollow: _Hollow) -> float:
    """Share of the filled voxels that stand between two free places, along an axis of
    the grid.
    """
    grid = hollow.grid
    marks = torch.zeros(grid.filled.shape)
    marks[grid.cells(hollow.positions).unbind(1)] = 1
    near = functional.max_pool3d(marks[None, None], 5, stride=1, padding=2)[0, 0] > 0
    near &= hollow.free
    among = torch.zeros_like(grid.filled)
    for axis in (0, 1, 2):
        before = near.cumsum(axis) > 0
        after = near.flip(axis).cumsum(axis).flip(axis) > 0
        among |= before & after & grid.filled
    return float(among.sum()) / max(1.0, float(grid.filled.sum()))
