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
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.points import PointCloud
from mi_splat.sh import sh_to_colour

LOOKS = 24
"""Pictures from which points take their colours."""
SPARE, MOST_SPARE = 2, 12
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
        views: Pictures of it; `LOOKS` of them are used.
        count: Number of points wanted.
        seed: Seed.

    Raises:
        InvalidValueError: No picture shows any surface.
    """
    looks = [views[i] for i in sorted({round(i) for i in np.linspace(0, len(views) - 1, min(LOOKS, len(views)))})]
    seen = [tracer.surface(view.camera, seed=seed + number) for number, view in enumerate(looks)]
    if not any(bool((far > 0).any()) for _, far in seen):
        raise InvalidValueError(message("cameras", "a view of the scene", "nothing but sky", "move or turn them"))
    if not assets:
        places = torch.cat([points[far > 0] for points, far in seen])
        colours = torch.cat([view.image[far > 0] for view, (_, far) in zip(looks, seen, strict=True)])
        return _chosen(places, colours, np.random.default_rng([seed, 0x9C]).permutation(len(places))[:count])
    depths, (first, *others) = [far for _, far in seen], assets
    if not others:
        return _on(first, looks, depths, count, None, seed)
    rest = Asset("rest", tuple(mesh for asset in others for mesh in asset.meshes))
    near = nearness([view.camera for view in looks])
    halves = [
        _on(first, looks, depths, count // 2, None, seed),
        _on(rest, looks, depths, count - count // 2, near, seed),
    ]
    return PointCloud(*(torch.cat([getattr(half, name) for half in halves]) for name in ("points", "colours")))


def _on(
    asset: Asset,
    looks: Sequence[View],
    depths: Sequence[Tensor],
    count: int,
    density: Callable[[Floats], Floats] | None,
    seed: int,
) -> PointCloud:
    """At most `count` points on an asset that the pictures show."""
    laid = SPARE * max(count, 1)
    while True:
        samples = surface_samples(asset, laid, density=density, seed=seed)
        sh, shown = fit_colours(samples, looks, depths, DiscConfig(degree=0))
        rows = np.flatnonzero(shown.numpy() > 0)
        if len(rows) >= count or laid >= MOST_SPARE * count:
            break
        laid = min(MOST_SPARE * count, round(1.1 * laid * count / max(len(rows), 1)) + 1)
    # Samples follow the surface, so leaving out every so manieth keeps them even.
    kept = np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(np.int64)
    points = torch.from_numpy(samples.points)
    # Colours of degree 0 are the same from everywhere.
    return _chosen(points, sh_to_colour(sh, torch.zeros_like(points)), rows[kept])


def _chosen(places: Tensor, colours: Tensor, rows: NDArray[np.int64]) -> PointCloud:
    """The points in some rows."""
    chosen = torch.from_numpy(rows)
    return PointCloud(places[chosen], colours[chosen].clamp(0, 1))
