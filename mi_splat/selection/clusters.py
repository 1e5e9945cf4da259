"""Connected components of a splat by distance and colour: what belongs together without anybody having said so."""

import math

import torch
from torch import Tensor

from mi_splat.scene import GaussianScene
from mi_splat.selection.neighbours import nearest_neighbours
from mi_splat.selection.planes import find_plane
from mi_splat.sh import dc_to_colour

NEIGHBOURS, NEAREST = 12, 8
"""Neighbours that a Gaussian may be linked to, and the one whose distance is the measure of nearness."""
LEAST_SHARE = 0.05
"""A plane with a smaller share of the Gaussians is not taken for one."""


def clusters(
    scene: GaussianScene, *, link_distance: float = 1.5, link_colour: float | None = None, planes: int = 1
) -> Tensor:
    """The connected component of each Gaussian, numbered from the largest.

    Two Gaussians are linked if each lies within `link_distance` times the distance at which the other has its eighth
    neighbour: so the measure is that of the place, fine on a small object and coarse on a wide ground. Objects stand on
    something that would link them all: the Gaussians of the largest planes are linked among themselves only.
    """
    points = scene.means.detach().cpu().double()
    distances, rows = nearest_neighbours(points, NEIGHBOURS)
    if not rows.shape[1]:
        return torch.arange(len(scene))
    spacing = distances[:, min(NEAREST, distances.shape[1]) - 1]
    group = _planes(points, spacing, planes)
    ours = torch.arange(len(scene))[:, None].expand_as(rows)
    linked = distances <= link_distance * torch.minimum(spacing[ours], spacing[rows])
    linked &= group[ours] == group[rows]
    if link_colour is not None:
        colours = dc_to_colour(scene.sh[:, 0].detach().cpu())
        linked &= (colours[ours] - colours[rows]).abs().amax(-1) <= link_colour
    return _by_size(components(len(scene), ours[linked], rows[linked]))


def _planes(points: Tensor, spacing: Tensor, count: int) -> Tensor:
    """(N,) the number of the plane that each point lies on, -1 for all others."""
    group = torch.full((len(points),), -1)
    for number in range(count):
        rest = (group < 0).nonzero()[:, 0]
        inliers = find_plane(points[rest], spacing[rest], least=math.ceil(LEAST_SHARE * len(points)))
        if inliers is None:
            break
        group[rest[inliers]] = number
    return group


def components(count: int, first: Tensor, second: Tensor) -> Tensor:
    """The connected components of a graph.

    Every node points at one of its component with a smaller or equal number; edges join the trees that this makes, and
    paths are shortened, until all of a component point at its first node (Shiloach and Vishkin 1982).
    """
    root = torch.arange(count)
    while len(first):
        ends = torch.stack([root[first], root[second]])
        apart = ends[0] != ends[1]
        first, second, ends = first[apart], second[apart], ends[:, apart]
        root.scatter_reduce_(0, ends.amax(0), ends.amin(0), "amin")
        while not torch.equal(root[root], root):
            root = root[root]
    return root


def _by_size(root: Tensor) -> Tensor:
    """Components numbered from the largest."""
    _, label, sizes = torch.unique(root, return_inverse=True, return_counts=True)
    order = sizes.argsort(descending=True, stable=True)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order))
    return rank[label]
