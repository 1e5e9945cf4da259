"""Points spread over the surfaces of an asset, evenly or denser where cameras are near."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_splat.assets.mesh import Asset, Floats
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError

_R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence in both coordinates."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSamples:
    """Points on a surface.

    Attributes:
        points: (N, 3) float32, metres.
        normals: (N, 3) float32 unit vectors.
        spacing: (N,) float32 distance to the neighbours that the local density means, metres.
    """

    points: Floats
    normals: Floats
    spacing: Floats


def nearness(cameras: Sequence[Camera], *, closest: float = 1.5) -> Callable[[Floats], Floats]:
    """A density for `surface_samples`: the mean over cameras of one over the squared distance."""
    eyes = np.stack([camera.position.numpy() for camera in cameras])

    def density(points: Floats) -> Floats:
        total = np.zeros(len(points))
        for eye in eyes:
            total += 1 / np.maximum(((points - eye) ** 2).sum(1), closest**2)
        return (total / len(eyes)).astype(np.float32)

    return density


def _split(corners: NDArray[np.float64], longest: Callable[[Floats], Floats]) -> NDArray[np.float64]:
    """Halve triangles (F, 3, 3) across their longest edge until that is no longer than `longest` at their centre."""
    done = []
    while len(corners):
        edges = np.linalg.norm(corners - np.roll(corners, -1, 1), axis=2)
        large = edges.max(1) > longest(corners.mean(1).astype(np.float32))
        done.append(corners[~large])
        corners, side = corners[large], edges[large].argmax(1)
        row = np.arange(len(corners))
        a, b, c = (corners[row, (side + k) % 3] for k in range(3))
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return np.concatenate(done)


def surface_samples(
    asset: Asset, count: int, *, density: Callable[[Floats], Floats] | None = None, seed: int = 0
) -> SurfaceSamples:
    """About evenly spread points on the surface of an asset.

    Triangles get points in proportion to area and density by systematic sampling (Madow and Madow 1944). Inside them,
    points follow the R2 sequence (Roberts 2018, "The unreasonable effectiveness of quasirandom sequences"), whose
    steps are 1 / p and 1 / p^2 with p^3 = p + 1, folded from the square onto the triangle.
    """
    if count < 1:
        raise InvalidValueError.of("count", "a positive number of samples", count, "ask for more")
    corners = np.concatenate([mesh.vertices[mesh.faces].astype(np.float64) for mesh in asset.meshes])
    if density is not None:
        at = density
        corners = _split(corners, lambda points: (0.5 / np.sqrt(at(points))).astype(np.float32))
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    local = np.ones(len(area)) if density is None else density(corners.mean(1).astype(np.float32)).astype(np.float64)
    total = np.cumsum(area * local)
    if not total[-1] > 0:
        raise InvalidValueError.of("asset", "a surface", f"no area in {asset.name!r}", "add meshes to it")
    rng = np.random.default_rng([seed, 0x5A])
    face = np.searchsorted(total, (np.arange(count) + rng.random()) * (total[-1] / count)).clip(max=len(area) - 1)
    order = np.arange(count)
    u, v = (rng.random() + order * _R2[0]) % 1, (rng.random() + order * _R2[1]) % 1
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    a, b, c = (corners[face, k] for k in range(3))
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    normals = cross[face] / (2 * area[face])[:, None]
    spacing = np.sqrt(total[-1] / count / local[face])
    return SurfaceSamples(points.astype(np.float32), normals.astype(np.float32), spacing.astype(np.float32))
