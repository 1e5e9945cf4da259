"""What is behind an object: a splat of its surroundings, which other photographs show.

The object's Gaussians are taken out of a splat, and the rest is trained further on the
same photographs, in which the pixels of the object do not count. So each point of the
background looks as those photographs show it that do see it, and renderings of
different cameras agree. What no photograph shows, the ground under the object, is
filled with Gaussians beforehand, in the colours of the ground around it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import functional

from attacks.cloak.appearances import grown
from attacks.poisons.base import OnStep
from mi_splat.cameras.camera import (
    Camera,
    RenderFn,
    View,
    ViewSet,
    cameras_of,
    project_points,
)
from mi_splat.cameras.directions import Point
from mi_splat.maths.rotation import from_z
from mi_splat.maths.sh import colour_to_dc, dc_to_colour
from mi_splat.scene import GaussianScene, merge
from mi_splat.training.config import FitConfig
from mi_splat.training.evaluation import loss_mask_of
from mi_splat.training.loop import fit
from mi_splat.training.strategies import FixedConfig

STEPS = 600
"""Steps of training; each looks at one photograph."""
HULL = 0.9
"""Share of the photographs that show a Gaussian, in which it has to lie in the object's
outline to be taken for a part of it.
"""
_SIDE = 500
"""Longer side of the images for which lengths in pixels are meant; in larger ones they
are longer.
"""
RING = 6
"""Pixels around what is replaced, whose colours the rendering is matched to."""
_BLURS = (64.0, 24.0, 8.0, 3.0)
_ENOUGH = 0.05
_ALIKE = 0.15
"""Standard deviations in pixels, from wide to narrow; the weight of a ring from which
on the narrower one counts alone; the difference of a channel from which on a rendering
shows something else than the image.
"""
_BESIDE = 0.25
"""How far above or below an object's foot its ground is looked for, in its sizes."""
_TOLERANCES = (0.1, 0.07, 0.05, 0.035, 0.025, 0.02)
"""Distances to the ground, in sizes of the object, of what is taken for a part of it,
round by round.
"""
_FEWEST = 30
"""Gaussians beside an object from which on they are taken for its ground."""
_MOST_FILLED = 4000
_NEIGHBOURS = 8
"""Gaussians that fill the ground, at most; those around whose colours each has."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Surroundings(ViewSet):
    """Views in which an object does not count."""

    views: Sequence[View]
    hidden: Sequence[Tensor]  # (H, W) bool of each view, what does not count

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera of each view."""
        return cameras_of(self.views)

    def loss_mask(self, index: int) -> Tensor:
        """(H, W) in [0, 1], 1 where the image of a view counts."""
        shown = (~self.hidden[index]).to(torch.float32)
        mask = loss_mask_of(self.views, index)
        if mask is None:
            return shown
        return mask * shown

    def __len__(self) -> int:
        """Number of views."""
        return len(self.views)

    def __getitem__(self, index: int) -> View:  # type: ignore[override]
        """The view."""
        return self.views[index]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Background:
    """The object gone, and in its place what other photographs show behind it."""

    scene: GaussianScene  # the surroundings of the object
    render: RenderFn
    reach: int
    name: str = "the background that other photographs show"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The image with the rendering of the background on the object.

        The rendering is matched to the image along the outline, so that no seam is
        left, and less and less far inside.
        """
        hole = grown(mask, self.reach)
        if not bool(hole.any()):
            return view.image
        with torch.no_grad():
            shown = self.render(self.scene, view.camera)[..., :3].clamp(0, 1)
        shown = shown.to(view.image)
        correction = spread(view.image - shown, hole)
        return torch.where(
            hole[..., None], (shown + correction).clamp(0, 1), view.image
        )


def spread(difference: Tensor, hole: Tensor) -> Tensor:
    """(H, W, 3) differences outside of a hole (H, W), blurred into it.

    Close to the outline it is the mean of what is near; deep inside that of the whole
    ring, so that noise of single pixels is not drawn into the hole. Where the two
    images show different things, nothing is taken from there.
    """
    unit = max(1, round(max(hole.shape) / _SIDE))
    around = grown(hole, RING * unit) & ~hole & (difference.abs().amax(-1) < _ALIKE)
    planes = torch.cat([difference, torch.ones_like(difference[..., :1])], -1)
    planes = (planes.double() * around[..., None]).permute(2, 0, 1)[None]
    # smooth values do not need the pixels of a large image
    small = functional.avg_pool2d(planes, unit, ceil_mode=True)[0].numpy()
    result: NDArray[np.float64] | None = None
    for sigma in _BLURS:
        *values, share = ndimage.gaussian_filter(small, sigma, axes=(1, 2))
        mean = np.stack(values) / np.maximum(share, 1e-12)
        near = np.minimum(share / _ENOUGH, 1.0)
        result = mean if result is None else near * mean + (1 - near) * result
    assert result is not None
    smooth = functional.interpolate(
        torch.from_numpy(result)[None], tuple(hole.shape), mode="bilinear"
    )
    return smooth[0].permute(1, 2, 0).to(difference)


def without_object(
    views: Sequence[View],
    splat: GaussianScene,
    rows: Tensor,
    masks: Callable[[Camera], Tensor],
    *,
    render: RenderFn,
    reach: int,
    up: Point,
    steps: int = STEPS,
    seed: int = 0,
    on_step: OnStep | None = None,
) -> GaussianScene:
    """The surroundings of an object as a splat.

    Args:
        views: Photographs from all around the object.
        splat: A splat of them.
        rows: (N,) bool, the object's Gaussians.
        masks: (H, W) bool, where the object is in the image of a camera.
        render: Renders splats, and is differentiable.
        reach: Pixels around the object that do not count either.
        up: (3,) direction that is up.
        steps: Steps of training.
        seed: Of the order of the photographs.
        on_step: Told of the progress.

    Returns:
        The splat without what lies in the outlines of the object.
    """
    cameras = cameras_of(views)
    hidden = [grown(masks(camera), reach) for camera in cameras]
    inside = rows | hull(splat.means, cameras, hidden)
    kept = splat.select(~inside)
    filling = ground_under(splat.select(rows), kept, up)
    if filling is not None:
        unseen = hull(filling.means, cameras, hidden)
        kept = merge(kept, filling.select(unseen).with_degree(kept.degree))
    config = FitConfig(
        iterations=steps,
        strategy=FixedConfig(),
        sh_degree=splat.degree,
        sh_degree_interval=0,
        lr_means=LR_MEANS,
        eval_interval=0,
    )
    done = fit(
        Surroundings(views=views, hidden=hidden),
        kept,
        render=render,
        config=config,
        seed=seed,
        on_step=None if on_step is None else lambda one: on_step(one.iteration, steps),
    )
    return done.scene


LR_MEANS = 1.6e-5
"""First learning rate of the means: a tenth of that of a training from points."""


def hull(
    points: Tensor, cameras: Sequence[Camera], outlines: Sequence[Tensor]
) -> Tensor:
    """(N,) bool, which points lie in the outlines of all but a few images that show
    them.
    """
    seen = torch.zeros(len(points))
    inside = torch.zeros(len(points))
    for camera, outline in zip(cameras, outlines, strict=True):
        pixels, depth = project_points(points.detach().double(), camera)
        size = pixels.new_tensor([camera.width, camera.height])
        shown = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(1)
        columns, rows = pixels[shown].long().unbind(1)
        seen += shown
        inside[shown] += outline[rows, columns].to(inside)
    return (seen > 0) & (inside >= HULL * seen)


def ground_under(
    thing: GaussianScene, around: GaussianScene, up: Point
) -> GaussianScene | None:
    """Gaussians of the ground under an object; None where none is found around it."""
    turn = from_z(torch.tensor(list(up), dtype=torch.float64)).T
    means = thing.means.detach().double() @ turn.T
    low = means.quantile(0.02, dim=0)
    high = means.quantile(0.98, dim=0)
    centre = (low + high) / 2
    size = float((high - low).norm())
    others = around.means.detach().double() @ turn.T
    flat = (others - centre)[:, :2].norm(dim=1)
    beside = (flat < size) & ((others[:, 2] - low[2]).abs() < _BESIDE * size)
    beside &= around.opacities > 0.3
    rows = beside.nonzero()[:, 0]
    if len(rows) < _FEWEST:
        return None
    plane, rows = _plane(others, rows, size)
    ground = others[rows]
    tree = KDTree(ground.numpy())
    apart = float(np.median(tree.query(ground.numpy(), 2)[0][:, 1]))
    across = high[:2] - low[:2]
    apart = max(apart, float(across.prod() * 2.25 / _MOST_FILLED) ** 0.5, 1e-6)
    steps = [
        torch.arange(
            float(low[i] - 0.25 * across[i]), float(high[i] + 0.25 * across[i]), apart
        )
        for i in range(2)
    ]
    grid = (
        torch.stack(torch.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 2).double()
    )
    heights = grid @ plane[:2] + plane[2]
    points = torch.cat([grid, heights[:, None]], 1)
    distances, nearest = tree.query(points.numpy(), _NEIGHBOURS)
    weights = torch.from_numpy(1 / np.maximum(distances, 1e-9))
    weights = weights / weights.sum(1, keepdim=True)
    colours = dc_to_colour(around.sh[rows, 0]).double()[torch.from_numpy(nearest)]
    mixed = (weights[..., None] * colours).sum(1).float()
    count = len(points)
    return GaussianScene(
        means=(points @ turn).float(),
        scales=torch.full((count, 3), 0.7 * apart),
        rotations=torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous(),
        opacities=torch.full((count,), 0.95),
        sh=colour_to_dc(mixed)[:, None],
    )


def _plane(points: Tensor, rows: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """(a, b, c) of z = a x + b y + c through most of some points, and the rows of those
    that lie on it.

    It begins level, at the median, and each round keeps what is nearer to the last
    plane; `size` is that of the object.
    """
    every = torch.cat([points[rows, :2], points.new_ones(len(rows), 1)], 1)
    heights = points[rows, 2]
    plane = points.new_tensor([0.0, 0.0, float(heights.median())])
    near = torch.ones_like(heights, dtype=torch.bool)
    for share in _TOLERANCES:
        errors = (heights - every @ plane).abs()
        # half of them, even where the ground is rough
        near = errors <= max(share * size, float(errors.median()))
        fitted = torch.linalg.lstsq(every[near], heights[near, None])
        plane = fitted.solution[:, 0]
    return plane, rows[near]
