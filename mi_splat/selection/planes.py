"""The plane that a scene stands on: the floor, the desk, the street."""

import torch
from torch import Generator, Tensor

TOLERANCE = 0.75
"""How far from a plane its Gaussians may lie, as a multiple of how far apart the Gaussians are there."""
_TRIALS, _SAMPLE, _ROUNDS = 4000, 4000, 5
_AT_ONCE = 250
"""Planes whose distances to the sample are held at once."""


def find_plane(points: Tensor, spacing: Tensor, *, least: int) -> Tensor | None:
    """Which points lie on the plane that holds the most of them.

    RANSAC (Fischler and Bolles 1981), made better by least squares. How far a point may lie off depends on how densely
    points lie around it, so that nothing need be known about the size of the scene.
    """
    if len(points) < 3:
        return None
    points, limit = points.detach().cpu().double(), TOLERANCE * spacing
    generator = Generator().manual_seed(0)
    sample = torch.randperm(len(points), generator=generator)[:_SAMPLE]
    corners = points[torch.randint(len(points), (_TRIALS, 3), generator=generator)]
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = across.norm(dim=1)
    corners, across, length = (value[length > 0] for value in (corners, across, length))  # three points make a plane
    if not len(corners):
        return None
    normals = across / length[:, None]
    placed, near = points[sample], limit[sample, None]
    counts = [
        ((placed @ part.T).sub_((part * on).sum(1)).abs_() < near).sum(0)
        for part, on in zip(normals.split(_AT_ONCE), corners[:, 0].split(_AT_ONCE), strict=True)
    ]
    best = int(torch.cat(counts).argmax())
    normal, on = normals[best], corners[best, 0]
    inside = _on_plane(points, normal, on, limit)
    for _ in range(_ROUNDS):
        if int(inside.sum()) < 3:
            break
        on, normal = _fit(points[inside], spacing[inside])
        inside = _on_plane(points, normal, on, limit)
    return inside if int(inside.sum()) >= least else None


def _on_plane(points: Tensor, normal: Tensor, on: Tensor, limit: Tensor) -> Tensor:
    """(N,) bool, which points are nearer to a plane than they may be far."""
    return ((points - on) @ normal).abs() < limit


def _fit(points: Tensor, spacing: Tensor) -> tuple[Tensor, Tensor]:
    """A point on the plane through points, and its normal; points that lie densely are placed better and count more."""
    weight = (1 / spacing.clamp(min=1e-9))[:, None].square()
    on = (weight * points).sum(0) / weight.sum()
    gaps = points - on
    return on, torch.linalg.eigh((weight * gaps).T @ gaps).eigenvectors[:, 0]
