"""The nearest neighbours of every Gaussian, quickly: batches of small groups that lie together."""

import math

import torch
from torch import Generator, Tensor

LEAF = 64
"""Points of a group within which neighbours are looked for."""
TREES = 6
"""Ways of cutting the scene into groups, each along other axes; what one way cuts apart another keeps together."""
_GROUPS = 4096
"""Groups whose distances are held at once."""
_EXACT = "donot_use_mm_for_euclid_dist"  # the matrix product loses the small distances of points far from the origin


def nearest_neighbours(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Distances to the nearest neighbours of each point, and which points these are.

    The points are cut in halves, and these again, until at most `LEAF` are in each (the leaves of a balanced k-d tree),
    and neighbours are looked for in the leaf. That is done `TREES` times, each time turned at random, and the best of
    all is kept. Some neighbours are missed where space is full of points; on surfaces, as splats are, hardly any.
    """
    size = len(points)
    count = min(count, size - 1, LEAF // 2 - 1)
    if count < 1:
        return torch.zeros(size, 0, dtype=torch.float64), torch.zeros(size, 0, dtype=torch.int64)
    points = points.detach().cpu().double()
    generator = Generator().manual_seed(0)
    distances, rows = torch.zeros(size, 0, dtype=torch.float64), torch.zeros(size, 0, dtype=torch.int64)
    for _ in range(TREES):
        turn = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
        nearest = _within(points, _leaves(points @ turn), count)
        distances, rows = _best(torch.cat([distances, nearest[0]], 1), torch.cat([rows, nearest[1]], 1), count)
    return distances, rows


def nearest_of(points: Tensor, every: int) -> Tensor:
    """The nearest of a few points to each of many, as far as both lie in the same leaf of a k-d tree."""
    result = torch.full((len(points),), -1)
    for members in torch.split(_leaves(points.double(), LEAF * every), max(1, _GROUPS // every)):
        few = members % every == 0
        width = int(few.sum(1).max())
        ours = few.byte().argsort(dim=1, descending=True, stable=True)[:, :width]
        ours, known = members.gather(1, ours), few.gather(1, ours)
        gaps = torch.cdist(points[members].double(), points[ours].double(), compute_mode=_EXACT)
        least, at = gaps.masked_fill(~known[:, None], math.inf).min(2)
        result[members] = torch.where(least.isfinite(), ours.gather(1, at), -1)
    return result


def _leaves(points: Tensor, size: int = LEAF) -> Tensor:
    """(G, L) rows of points that lie together; where N is not G L, some points stand twice."""
    levels = max(0, math.ceil(math.log2(len(points) / size)))
    width = math.ceil(len(points) / 2**levels)
    groups = (torch.arange(width * 2**levels) % len(points))[None]
    for _ in range(levels):
        placed = points[groups]
        axis = (placed.amax(1) - placed.amin(1)).argmax(1)  # the longest side of each group
        keys = placed.gather(2, axis[:, None, None].expand(-1, placed.shape[1], 1))[..., 0]
        order = keys.argsort(dim=1)
        groups = groups.gather(1, order).reshape(2 * len(groups), -1)
    return groups


def _within(points: Tensor, groups: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The nearest neighbours of each point within its group; infinitely far where the group has too few."""
    distances = torch.full((len(points), count), math.inf, dtype=torch.float64)
    rows = torch.zeros(len(points), count, dtype=torch.int64)
    for members in torch.split(groups, _GROUPS):
        placed = points[members]
        gaps = torch.cdist(placed, placed, compute_mode=_EXACT)
        gaps = gaps.masked_fill(members[:, :, None] == members[:, None, :], math.inf)
        least, at = gaps.topk(min(count, members.shape[1]), largest=False)
        width = least.shape[2]
        distances[members, :width] = least
        rows[members, :width] = members[:, None, :].expand(-1, members.shape[1], -1).gather(2, at)
    return distances, rows


def _best(distances: Tensor, rows: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The nearest of several finds, each neighbour once."""
    rows, order = rows.sort(dim=1)
    distances = distances.gather(1, order)
    repeated = rows[:, 1:] == rows[:, :-1]
    # Of a neighbour that was found twice, both distances are the same, unless one is that of an empty place.
    distances[:, 1:] = torch.where(repeated, torch.minimum(distances[:, 1:], distances[:, :-1]), distances[:, 1:])
    distances[:, :-1] = distances[:, :-1].masked_fill(repeated, math.inf)
    least, at = distances.topk(count, dim=1, largest=False)
    return least, rows.gather(1, at)
