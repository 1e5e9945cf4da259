"""The nearest neighbours of points."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor


def nearest_neighbours(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Distances to the nearest other points of each point, in order, and which points these are."""
    size = len(points)
    count = min(count, size - 1)
    if count < 1:
        return torch.zeros(size, 0, dtype=torch.float64), torch.zeros(size, 0, dtype=torch.int64)
    positions = points.detach().cpu().double().numpy()
    distances, rows = cKDTree(positions).query(positions, count + 1)
    others = rows != np.arange(size)[:, None]
    others[others.all(axis=1), -1] = False  # so many points in one place that the point itself is not among the nearest
    return (
        torch.from_numpy(distances[others].reshape(size, count)),
        torch.from_numpy(rows[others].reshape(size, count).astype(np.int64)),
    )


def nearest_of(points: Tensor, every: int) -> Tensor:
    """Index of the nearest of every so many-th point to each point."""
    positions = points.detach().cpu().double().numpy()
    _, rows = cKDTree(positions[::every]).query(positions)
    return torch.from_numpy(rows.astype(np.int64) * every)
