"""Connected components of a splat by distance and colour: what belongs together without
anybody having said so.
"""

import math

import numpy as np
import torch
from torch import Generator, Tensor

from mi_splat.maths.neighbours import nearest_neighbours
from mi_splat.maths.sh import dc_to_colour
from mi_splat.scene import GaussianScene

NEIGHBOURS = 12
NEAREST = 8
"""Neighbours that a Gaussian may be linked to, and the one whose distance is the
measure of nearness.
"""
LEAST_SHARE = 0.05
"""A plane with a smaller share of the Gaussians is not taken for one."""
TOLERANCE = 0.75
"""How far from a plane its Gaussians may lie, as a multiple of how far apart the
Gaussians are there.
"""
_TRIALS = 4000
_SAMPLE = 4000
_ROUNDS = 5
_AT_ONCE = 250
"""Planes whose distances to the sample are held at once."""


def clusters(
    scene: GaussianScene,
    *,
    link_distance: float = 1.5,
    link_colour: float | None = None,
    planes: int = 1,
    group: Tensor | None = None,
) -> Tensor:
    """The connected component of each Gaussian, numbered from the largest.

    Two Gaussians are linked if each lies within `link_distance` times the distance at
    which the other has its eighth neighbour: so the measure is that of the place, fine
    on a small object and coarse on a wide ground. Objects stand on something that would
    link them all: the Gaussians of the largest planes are linked among themselves only,
    or those of each (N,) int64 `group`.
    """
    points = scene.means.detach().cpu().double()
    distances, rows = nearest_neighbours(points, NEIGHBOURS)
    if not rows.shape[1]:
        return torch.arange(len(scene))
    spacing = distances[:, min(NEAREST, distances.shape[1]) - 1]
    if group is None:
        group = _planes(points, spacing, planes)
    ours = torch.arange(len(scene))[:, None].expand_as(rows)
    linked = distances <= link_distance * torch.minimum(spacing[ours], spacing[rows])
    linked &= group[ours] == group[rows]
    if link_colour is not None:
        colours = dc_to_colour(scene.sh[:, 0].detach().cpu())
        linked &= (colours[ours] - colours[rows]).abs().amax(-1) <= link_colour
    label = components(len(scene), ours[linked], rows[linked])
    return label.bincount().argsort(descending=True, stable=True).argsort()[label]


def _planes(points: Tensor, spacing: Tensor, count: int) -> Tensor:
    """(N,) the number of the plane that each point lies on, -1 for all others."""
    group = torch.full((len(points),), -1)
    for number in range(count):
        rest = (group < 0).nonzero()[:, 0]
        inliers = find_plane(
            points[rest], spacing[rest], least=math.ceil(LEAST_SHARE * len(points))
        )
        if inliers is None:
            break
        group[rest[inliers]] = number
    return group


def components(count: int, first: Tensor, second: Tensor) -> Tensor:
    """The connected component of each node of a graph, numbered in the order of their
    first nodes.
    """
    edges = (np.ones(len(first), np.bool_), (first.numpy(), second.numpy()))
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    _, labels = connected_components(
        coo_array(edges, shape=(count, count)), directed=False
    )
    return torch.from_numpy(labels.astype(np.int64))


def find_plane(points: Tensor, spacing: Tensor, *, least: int) -> Tensor | None:
    """Which points lie on the plane that holds the most of them.

    RANSAC (Fischler and Bolles 1981), made better by least squares. How far a point may
    lie off depends on how densely points lie around it, so that nothing need be known
    about the size of the scene.
    """
    if len(points) < 3:
        return None
    points = points.detach().cpu().double()
    limit = TOLERANCE * spacing
    generator = Generator().manual_seed(0)
    sample = torch.randperm(len(points), generator=generator)[:_SAMPLE]
    corners = points[torch.randint(len(points), (_TRIALS, 3), generator=generator)]
    across = torch.linalg.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    )
    length = across.norm(dim=1)
    # three points make a plane
    corners, across, length = (value[length > 0] for value in (corners, across, length))
    if not len(corners):
        return None
    normals = across / length[:, None]
    placed = points[sample]
    near = limit[sample, None]
    counts = [
        ((placed @ part.T).sub_((part * on).sum(1)).abs_() < near).sum(0)
        for part, on in zip(
            normals.split(_AT_ONCE), corners[:, 0].split(_AT_ONCE), strict=True
        )
    ]
    best = int(torch.cat(counts).argmax())
    normal = normals[best]
    on = corners[best, 0]
    inside = _on_plane(points, normal, on, limit)
    for _ in range(_ROUNDS):
        if int(inside.sum()) < 3:
            break
        on, normal = _fit(points[inside], spacing[inside])
        inside = _on_plane(points, normal, on, limit)
    if int(inside.sum()) >= least:
        return inside
    return None


def _on_plane(points: Tensor, normal: Tensor, on: Tensor, limit: Tensor) -> Tensor:
    """(N,) bool, which points are nearer to a plane than they may be far."""
    return ((points - on) @ normal).abs() < limit


def _fit(points: Tensor, spacing: Tensor) -> tuple[Tensor, Tensor]:
    """A point on the plane through points, and its normal; points that lie densely are
    placed better and count more.
    """
    weight = (1 / spacing.clamp(min=1e-9))[:, None].square()
    on = (weight * points).sum(0) / weight.sum()
    gaps = points - on
    return on, torch.linalg.eigh((weight * gaps).T @ gaps).eigenvectors[:, 0]
