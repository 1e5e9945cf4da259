"""Points on surfaces, in the colours that images show there: what a training of a splat
starts from.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.cameras.camera import Camera, View, project_points
from mi_splat.capture.mesh import Asset, Doubles, Floats
from mi_splat.capture.path_tracer import PathTracer
from mi_splat.errors import InvalidValueError
from mi_splat.io.points import PointCloud
from mi_splat.maths.sh import sh_basis, sh_to_colour

Density = Callable[[Floats], Floats]
"""Wanted samples per area, up to a factor, at (N, 3) points."""
Rows = NDArray[np.int64]

COLOUR_VIEWS = 24
"""Images from which points take their colours."""
OVERSAMPLING = 2
MAX_OVERSAMPLING = 12
"""How many samples are laid for each point wanted at first, and at most: some of a
surface is hidden.
"""
_R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence in both coordinates."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSamples:
    """Points on a surface."""

    points: Floats  # (N, 3) float32, metres
    normals: Floats  # (N, 3) float32 unit vectors
    # (N,) float32 distance to the neighbours that the local density means, metres
    spacing: Floats


def nearness(cameras: Sequence[Camera], *, closest: float = 1.5) -> Density:
    """A density for `surface_samples`: the mean over cameras of one over the squared
    distance.
    """
    eyes = [camera.position.numpy() for camera in cameras]

    def density(points: Floats) -> Floats:
        total = np.zeros(len(points))
        for eye in eyes:
            squared = ((points - eye) ** 2).sum(1)
            total += 1 / np.maximum(squared, closest**2)
        return (total / len(eyes)).astype(np.float32)

    return density


def _split(corners: Doubles, density: Density) -> Doubles:
    """Halve triangles (F, 3, 3) across their longest edge until that is short for the
    density at their centre.
    """
    done = []
    while len(corners):
        edges = np.linalg.norm(corners - np.roll(corners, -1, 1), axis=2)
        centres = corners.mean(1).astype(np.float32)
        longest = (0.5 / np.sqrt(density(centres))).astype(np.float32)
        large = edges.max(1) > longest
        done.append(corners[~large])
        corners = corners[large]
        side = edges[large].argmax(1)
        row = np.arange(len(corners))
        a, b, c = (corners[row, (side + k) % 3] for k in range(3))
        middle = (a + b) / 2
        first = np.stack([a, middle, c], 1)
        second = np.stack([middle, b, c], 1)
        corners = np.concatenate([first, second])
    return np.concatenate(done)


def surface_samples(
    asset: Asset,
    count: int,
    *,
    density: Density | None = None,
    seed: int = 0,
) -> SurfaceSamples:
    """About evenly spread points on the surface of an object.

    Triangles get points in proportion to area and density by systematic sampling (Madow
    and Madow 1944). Inside them, points follow the R2 sequence (Roberts 2018, "The
    unreasonable effectiveness of quasirandom sequences"), whose steps are 1 / p and 1 /
    p^2 with p^3 = p + 1, folded from the square onto the triangle.
    """
    if count < 1:
        expected = "a positive number of samples"
        raise InvalidValueError.of("count", expected, count, "ask for more")
    corners = np.concatenate(
        [mesh.vertices[mesh.faces].astype(np.float64) for mesh in asset.meshes]
    )
    if density is not None:
        corners = _split(corners, density)
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    cross = np.cross(first, second)
    area = np.linalg.norm(cross, axis=1) / 2
    local = np.ones(len(area))
    if density is not None:
        centres = corners.mean(1).astype(np.float32)
        local = density(centres).astype(np.float64)
    total = np.cumsum(area * local)
    if not total[-1] > 0:
        got = f"no area in {asset.name!r}"
        raise InvalidValueError.of("asset", "a surface", got, "add meshes to it")
    rng = np.random.default_rng([seed, 0x5A])
    order = np.arange(count)
    step = total[-1] / count
    face = np.searchsorted(total, (order + rng.random()) * step)
    face = face.clip(max=len(area) - 1)
    u = (rng.random() + order * _R2[0]) % 1
    v = (rng.random() + order * _R2[1]) % 1
    beyond = u + v > 1  # the other half of the square
    u = np.where(beyond, 1 - u, u)[:, None]
    v = np.where(beyond, 1 - v, v)[:, None]
    a, b, c = (corners[face, k] for k in range(3))
    points = a + u * (b - a) + v * (c - a)
    normals = cross[face] / (2 * area[face])[:, None]
    spacing = np.sqrt(total[-1] / count / local[face])
    return SurfaceSamples(
        points.astype(np.float32),
        normals.astype(np.float32),
        spacing.astype(np.float32),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Samples as one view shows them."""

    weight: Tensor  # (N,), 0 where hidden
    colour: Tensor  # (N, 3)
    direction: Tensor  # (N, 3) from the camera


def _observed(
    samples: SurfaceSamples, view: View, depth: Tensor, tolerance: float
) -> Observation:
    points = torch.from_numpy(samples.points)
    normals = torch.from_numpy(samples.normals)
    camera = view.camera
    pixels, forward = project_points(points, camera)
    offset = points - camera.position.to(points)
    distance = offset.norm(dim=1)
    direction = offset / distance[:, None]
    column = pixels[:, 0].floor().long()
    row = pixels[:, 1].floor().long()
    in_columns = (column >= 0) & (column < camera.width)
    in_rows = (row >= 0) & (row < camera.height)
    inside = (forward > 0.05) & in_columns & in_rows
    column = column.clamp(0, camera.width - 1)
    row = row.clamp(0, camera.height - 1)
    surface = depth[row, column]
    facing = (direction * normals).sum(1).abs()
    # a pixel covers more depth the more the surface is turned away
    of_pixel = 0.5 * distance / camera.fx / facing.clamp(min=0.08)
    slack = tolerance * distance + 0.02 + of_pixel
    is_first = (distance - surface).abs() < slack
    # nothing else there: only what lies beyond every surface, the dome, can be seen
    sky = surface <= 0
    visible = inside & torch.where(sky, distance > 60, is_first)
    weight = visible * facing.clamp(min=0.05)
    return Observation(weight, view.image[row, column], direction)


def fit_colours(
    samples: SurfaceSamples,
    views: Sequence[View],
    depths: Sequence[Tensor],
    *,
    degree: int = 0,
    damping: float = 2.0,
    tolerance: float = 0.015,
) -> tuple[Tensor, Tensor]:
    """Least-squares SH of each sample over the views that see it, by ridge regression
    (Hoerl and Kennard 1970), and how many these are.
    """
    count = len(samples.points)
    size = (degree + 1) ** 2
    left = torch.zeros(count, size, size)
    right = torch.zeros(count, size, 3)
    seen = torch.zeros(count)
    for view, depth in zip(views, depths, strict=True):
        observed = _observed(samples, view, depth, tolerance)
        basis = sh_basis(observed.direction, degree)
        weighted = (observed.weight[:, None] * basis)[:, :, None]
        centred = (observed.colour - 0.5)[:, None]
        left += weighted * basis[:, None]
        right += weighted * centred
        seen += observed.weight > 0
    ridge = torch.full((size,), damping)
    ridge[0] = 1e-4
    return torch.linalg.solve(left + torch.diag(ridge), right), seen


def surface_points(
    tracer: PathTracer,
    assets: Sequence[Asset],
    views: Sequence[View],
    *,
    count: int = 20_000,
    seed: int = 0,
) -> PointCloud:
    """At most `count` points that the images show, in the colours that they show.

    Without objects, the points are where rays through the images' pixels meet the
    scene. Of one object, they lie evenly on it. Of more, half of them do so on the
    first, and the rest is spread over the others, denser near the cameras.
    """
    numbers = np.linspace(0, len(views) - 1, min(COLOUR_VIEWS, len(views)))
    chosen = [views[i] for i in sorted({round(number) for number in numbers})]
    points = []
    depths = []
    for number, view in enumerate(chosen):
        met, distance = tracer.surface(view.camera, seed=seed + number)
        points.append(met)
        depths.append(distance)
    if not any(bool((distance > 0).any()) for distance in depths):
        expected = "a view of the scene"
        do = "move or turn them"
        raise InvalidValueError.of("cameras", expected, "nothing but sky", do)
    if not assets:
        hit = [distance > 0 for distance in depths]
        colours = [view.image for view in chosen]
        every = torch.cat([each[here] for each, here in zip(points, hit, strict=True)])
        shown = torch.cat([each[here] for each, here in zip(colours, hit, strict=True)])
        order = np.random.default_rng([seed, 0x9C]).permutation(len(every))
        return _rows_of(every, shown, order[:count])
    first, *others = assets
    if not others:
        return _visible_points(first, chosen, depths, count, seed=seed)
    rest = Asset("rest", tuple(mesh for asset in others for mesh in asset.meshes))
    near = nearness([view.camera for view in chosen])
    half = count // 2
    on_first = _visible_points(first, chosen, depths, half, seed=seed)
    on_rest = _visible_points(
        rest, chosen, depths, count - half, density=near, seed=seed
    )
    return PointCloud(
        torch.cat([on_first.points, on_rest.points]),
        torch.cat([on_first.colours, on_rest.colours]),
    )


def _visible_points(
    asset: Asset,
    views: Sequence[View],
    depths: Sequence[Tensor],
    count: int,
    *,
    density: Density | None = None,
    seed: int,
) -> PointCloud:
    """At most `count` points on an object that the images show."""
    most = MAX_OVERSAMPLING * count
    laid = OVERSAMPLING * max(count, 1)
    while True:
        samples = surface_samples(asset, laid, density=density, seed=seed)
        sh, times_seen = fit_colours(samples, views, depths)
        rows = np.flatnonzero(times_seen.numpy() > 0)
        if len(rows) >= count or laid >= most:
            break
        wanted = round(1.1 * laid * count / max(len(rows), 1)) + 1
        laid = min(most, wanted)
    # Samples follow the surface, so leaving them out at equal steps keeps the rest
    # even.
    steps = np.linspace(0, len(rows) - 1, min(count, len(rows)))
    kept = rows[steps.round().astype(np.int64)]
    points = torch.from_numpy(samples.points)
    # Colours of degree 0 are the same from everywhere.
    colours = sh_to_colour(sh, torch.zeros_like(points))
    return _rows_of(points, colours, kept)


def _rows_of(points: Tensor, colours: Tensor, rows: Rows) -> PointCloud:
    """The cloud of some rows of (P, 3) points and colours."""
    index = torch.from_numpy(rows)
    return PointCloud(points[index], colours[index].clamp(0, 1))
