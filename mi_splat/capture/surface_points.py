"""Points spread over the surfaces of a scene, in the colours that pictures show of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.assets.mesh import Asset, Floats
from mi_splat.cameras import Camera, View, project_points
from mi_splat.capture.path_tracer import PathTracer
from mi_splat.errors import InvalidValueError
from mi_splat.io.points import PointCloud
from mi_splat.sh import sh_basis, sh_to_colour

COLOUR_VIEWS = 24
"""Pictures from which points take their colours."""
OVERSAMPLING, MAX_OVERSAMPLING = 2, 12
"""How many samples are laid for each point wanted at first, and at most: some of a surface is hidden."""
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


def _observe(samples: SurfaceSamples, view: View, depth: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Samples in one view: (N,) weight of each (0 where hidden), (N, 3) its colour, (N, 3) direction to it."""
    points, normals = torch.from_numpy(samples.points), torch.from_numpy(samples.normals)
    camera = view.camera
    pixels, forward = project_points(points, camera)
    offset = points - camera.position.to(points)
    distance = offset.norm(dim=1)
    direction = offset / distance[:, None]
    column, row = pixels[:, 0].floor().long(), pixels[:, 1].floor().long()
    inside = (forward > 0.05) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    column, row = column.clamp(0, camera.width - 1), row.clamp(0, camera.height - 1)
    surface = depth[row, column]
    facing = (direction * normals).sum(1).abs()
    slack = tolerance * distance + 0.02 + 0.5 * distance / camera.fx / facing.clamp(min=0.08)
    sky = surface <= 0  # nothing else there: only what lies beyond every surface, the dome, can be seen
    visible = inside & torch.where(sky, distance > 60, (distance - surface).abs() < slack)
    return visible * facing.clamp(min=0.05), view.image[row, column], direction


def fit_colours(
    samples: SurfaceSamples,
    views: Sequence[View],
    depths: Sequence[Tensor],
    *,
    degree: int = 0,
    damping: float = 2.0,
    tolerance: float = 0.015,
) -> tuple[Tensor, Tensor]:
    """Least-squares SH of each sample over the views that see it, by ridge regression (Hoerl and Kennard 1970)."""
    count, size = len(samples.points), (degree + 1) ** 2
    left = torch.zeros(count, size, size)
    right = torch.zeros(count, size, 3)
    seen = torch.zeros(count)
    for view, depth in zip(views, depths, strict=True):
        weight, colour, direction = _observe(samples, view, depth, tolerance)
        basis = sh_basis(direction, degree)
        left += (weight[:, None] * basis)[:, :, None] * basis[:, None]
        right += (weight[:, None] * basis)[:, :, None] * (colour - 0.5)[:, None]
        seen += weight > 0
    ridge = torch.full((size,), damping)
    ridge[0] = 1e-4
    return torch.linalg.solve(left + torch.diag(ridge), right), seen


def surface_points(
    tracer: PathTracer, assets: Sequence[Asset], views: Sequence[View], *, count: int = 20_000, seed: int = 0
) -> PointCloud:
    """At most `count` points that the pictures show, in the colours that they show.

    Without assets, the points are where rays through the pictures' pixels meet the scene. Of one asset, they lie evenly
    on it. Of more, half of them do so on the first, and the rest is spread over the others, denser near the cameras.
    """
    rows = np.linspace(0, len(views) - 1, min(COLOUR_VIEWS, len(views)))
    chosen = [views[i] for i in sorted({round(row) for row in rows})]
    hits = [tracer.surface(view.camera, seed=seed + number) for number, view in enumerate(chosen)]
    if not any(bool((distance > 0).any()) for _, distance in hits):
        raise InvalidValueError.of("cameras", "a view of the scene", "nothing but sky", "move or turn them")
    if not assets:
        points = torch.cat([met[distance > 0] for met, distance in hits])
        colours = torch.cat([view.image[distance > 0] for view, (_, distance) in zip(chosen, hits, strict=True)])
        return _rows_of(points, colours, np.random.default_rng([seed, 0x9C]).permutation(len(points))[:count])
    depths, (first, *others) = [distance for _, distance in hits], assets
    if not others:
        return _visible_points(first, chosen, depths, count, seed=seed)
    rest = Asset("rest", tuple(mesh for asset in others for mesh in asset.meshes))
    near = nearness([view.camera for view in chosen])
    halves = [
        _visible_points(first, chosen, depths, count // 2, seed=seed),
        _visible_points(rest, chosen, depths, count - count // 2, density=near, seed=seed),
    ]
    return PointCloud(*(torch.cat([getattr(half, name) for half in halves]) for name in ("points", "colours")))


def _visible_points(
    asset: Asset,
    views: Sequence[View],
    depths: Sequence[Tensor],
    count: int,
    *,
    density: Callable[[Floats], Floats] | None = None,
    seed: int,
) -> PointCloud:
    """At most `count` points on an asset that the pictures show."""
    laid = OVERSAMPLING * max(count, 1)
    while True:
        samples = surface_samples(asset, laid, density=density, seed=seed)
        sh, times_seen = fit_colours(samples, views, depths)
        rows = np.flatnonzero(times_seen.numpy() > 0)
        if len(rows) >= count or laid >= MAX_OVERSAMPLING * count:
            break
        laid = min(MAX_OVERSAMPLING * count, round(1.1 * laid * count / max(len(rows), 1)) + 1)
    # Samples follow the surface, so leaving them out at equal steps keeps the rest even.
    kept = np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(np.int64)
    points = torch.from_numpy(samples.points)
    # Colours of degree 0 are the same from everywhere.
    return _rows_of(points, sh_to_colour(sh, torch.zeros_like(points)), rows[kept])


def _rows_of(points: Tensor, colours: Tensor, rows: NDArray[np.int64]) -> PointCloud:
    """The cloud of some rows of (P, 3) points and colours."""
    index = torch.from_numpy(rows)
    return PointCloud(points[index], colours[index].clamp(0, 1))
