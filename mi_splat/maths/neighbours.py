"""Which points are nearest to each of many, by a k-d tree: the work grows as N log N,
the memory as N.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_ASKED = 8
_ASKED_IF_TIED = 64
"""Neighbours that the tree is asked for: more than are needed, since float32 orders
near ties otherwise than float64.

A regular grid has 6 at one distance, 26 with its diagonals.
"""
_TIE = 1e-5
"""Relative difference of two distances above which float32 orders them as float64
does.
"""


def nearest_neighbours(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The nearest other points of each point, in order.

    Args:
        points: (N, 3) finite, world units.
        count: How many; at most N - 1 are found.

    Returns:
        (N, count) float64 distances, world units, and (N, count) int64 rows of these
        points.
    """
    size = len(points)
    count = min(count, size - 1)
    if count < 1:
        return torch.zeros(size, 0, dtype=torch.float64), torch.zeros(
            size, 0, dtype=torch.int64
        )
    positions = points.detach().cpu().double().numpy()
    kept = _few_in_one_place(positions, count + 1)
    distances, found = _tree(positions[kept]).query(positions, count + 1)
    rows = kept[found]
    others = rows != np.arange(size)[:, None]
    # So many points in one place that the point itself is not among the nearest.
    others[others.all(axis=1), -1] = False
    return (
        torch.from_numpy(distances[others].reshape(size, count)),
        torch.from_numpy(rows[others].reshape(size, count)),
    )


def nearest_of(points: Tensor, every: int) -> Tensor:
    """(N,) int64 row of the nearest of every so many-th point to each of (N, 3)
    points.
    """
    positions = points.detach().cpu().double().numpy()
    some = positions[::every]
    kept = _few_in_one_place(some, 1)
    _, found = _tree(some[kept]).query(positions)
    return torch.from_numpy(kept[found] * every)


def nearest_distances(points: Tensor, count: int) -> Tensor:
    """Distances of each point to the nearest others, in order, as float32 has them.

    Args:
        points: (N, 3) float32, finite, world units.
        count: How many, at most N - 1.

    Returns:
        (N, count) float32, world units: what `torch.cdist` of all points with all would
        give, to the bit.
    """
    positions = points.double().numpy()
    kept = _few_in_one_place(positions, count + 1)
    tree = _tree(positions[kept])
    others = points[torch.from_numpy(kept)]
    asked = max(_ASKED, count + 1)
    rough, rows = tree.query(positions, min(asked, len(kept)))
    distances = _exact(points, others, rows)
    if asked >= len(kept):
        return distances[:, 1 : count + 1]
    # A point beyond those that were asked for may be as near as the last that is
    # needed.
    tied = rough[:, -1] <= (1 + _TIE) * rough[:, count]
    if tied.any():
        _, rows = tree.query(positions[tied], min(_ASKED_IF_TIED, len(kept)))
        mask = torch.from_numpy(tied)
        distances[mask] = _exact(points[mask], others, rows)[:, : distances.shape[1]]
    return distances[:, 1 : count + 1]  # the first is the point itself


def _tree(positions: NDArray[np.float64]) -> cKDTree:
    from scipy.spatial import cKDTree  # a third of a second

    return cKDTree(positions)


def _exact(points: Tensor, others: Tensor, rows: NDArray[np.int64]) -> Tensor:
    """(N, K) distances of (N, 3) points to K of some others each, sorted."""
    # Not by the matrix product: it would lose the small distances of points far from
    # the origin.
    mode = "donot_use_mm_for_euclid_dist"
    pairs = torch.cdist(
        points[:, None], others[torch.from_numpy(rows)], compute_mode=mode
    )
    return pairs[:, 0].sort(1).values


def _few_in_one_place(positions: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """(M,) rows of (N, 3) points, of which at most so many lie in one place: a tree
    goes through these one by one.
    """
    order = np.lexsort(positions.T)
    ordered = positions[order]
    surplus = np.zeros(len(order), np.bool_)
    surplus[most:] = (ordered[most:] == ordered[:-most]).all(1)
    if not surplus.any():
        return np.arange(len(order))
    return np.sort(order[~surplus])
