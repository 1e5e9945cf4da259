"""Coloured points on what a set of pictures shows, from which a training may start."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.assets.mesh import Asset, Floats
from mi_splat.cameras import View
from mi_splat.capture.mesh_splats import DiscConfig, fit_colours
from mi_splat.capture.path_tracer import PathTracer
from mi_splat.capture.surface_sampling import nearness, surface_samples
from mi_splat.errors import InvalidValueError
from mi_splat.io.points import PointCloud
from mi_splat.sh import sh_to_colour

COLOUR_VIEWS = 24
"""Pictures from which points take their colours."""
OVERSAMPLING, MAX_OVERSAMPLING = 2, 12
"""How many samples are laid for each point wanted at first, and at most: some of a surface is hidden."""


def surface_points(
    tracer: PathTracer, assets: Sequence[Asset], views: Sequence[View], *, count: int = 20_000, seed: int = 0
) -> PointCloud:
    """At most `count` points that the pictures show, in the colours that they show.

    Without assets, the points are where rays through the pictures' pixels meet the scene. Of one asset, they lie evenly
    on it. Of more, half of them do so on the first, and the rest is spread over the others, denser near the cameras.

    Args:
        tracer: The scene.
        assets: Its surfaces, where they are known.
        views: Pictures of it; `COLOUR_VIEWS` of them are used.
        count: Number of points wanted.
        seed: Seed.

    Raises:
        InvalidValueError: No picture shows any surface.
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
        sh, times_seen = fit_colours(samples, views, depths, DiscConfig(degree=0))
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
