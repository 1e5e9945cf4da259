"""How well selected Gaussians agree with regions of images that show the object."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median
from typing import NamedTuple

import torch
from torch import Tensor

from mi_splat.cameras.camera import RenderFn
from mi_splat.scene import GaussianScene
from mi_splat.selection.regions import ImageRegion
from mi_splat.selection.visibility import object_weight

LEAST_IOU = 0.8
"""Intersection over union of the selection and the object's outline in an image; below,
the selection is doubted.
"""
MOST_OUTSIDE = 0.03
"""Share of an image that the selection may cover outside the object's outline."""
LEAST_FIT = 0.7
"""Intersection over union of the box around an outline and the box that it was cut out
of; below, the outline is doubted.
"""
_HALF = 0.5


class Agreement(NamedTuple):
    """A selection beside the region of the object in one image."""

    iou: float  # intersection over union of their pixels
    outside: float  # share of the image that the selection covers outside the region


def agreement(
    scene: GaussianScene,
    mask: Tensor,
    regions: Mapping[str, ImageRegion],
    *,
    render: RenderFn,
) -> dict[str, Agreement]:
    """How well a selection agrees with the object's regions, image by image.

    Args:
        scene: The scene.
        mask: (N,) bool, the selected Gaussians.
        regions: Where the object is, by the names of images.
        render: Renders the images.

    Returns:
        For each image the intersection over union of the pixels of which the selection
        makes up at least a half with the region, and the share of the image that it
        covers outside.
    """
    found = dict[str, Agreement]()
    for name, region in regions.items():
        weight = object_weight(scene, mask, region.camera, render).cpu()
        shown = weight >= _HALF
        inside = region.inside.cpu() >= _HALF
        union = int((shown | inside).sum())
        both = int((shown & inside).sum())
        outside = float((shown & ~inside).double().mean())
        found[name] = Agreement(iou=both / max(union, 1), outside=outside)
    return found


def box_fit(inside: Tensor, boxes: Tensor) -> float:
    """How well the box around an outline agrees with the one of several boxes that it
    agrees with best.

    Args:
        inside: (H, W) in [0, 1], the outline.
        boxes: (K, 4) boxes x0, y0, x1, y1 in pixels.

    Returns:
        The largest intersection over union; 0 without an outline.
    """
    rows, columns = torch.nonzero(inside >= _HALF, as_tuple=True)
    if not len(rows):
        return 0.0
    corners = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    own = torch.stack(corners).to(boxes)
    overlap = torch.minimum(boxes[:, 2:], own[2:]) - torch.maximum(
        boxes[:, :2], own[:2]
    )
    both = overlap.clamp(min=0).prod(1)
    either = (boxes[:, 2:] - boxes[:, :2]).prod(1) + (own[2:] - own[:2]).prod() - both
    return float((both / either.clamp(min=1e-6)).max())


def summary(agreed: Mapping[str, Agreement]) -> str:
    """How well a selection agrees with the object's outlines, in one line."""
    iou = median(item.iou for item in agreed.values())
    outside = median(item.outside for item in agreed.values())
    return (
        f"agrees with the outlines of {len(agreed)} images: intersection over union"
        f" {iou:.2f}, {outside:.1%} of the image outside (medians)"
    )


def disagreements(agreed: Mapping[str, Agreement]) -> list[str]:
    """Reasons to look twice at a selection, in words."""
    if not agreed:
        return []
    texts = []
    worst = min(agreed, key=lambda name: agreed[name].iou)
    iou = median(item.iou for item in agreed.values())
    if iou < LEAST_IOU:
        texts.append(
            f"the selection and the object's outlines in {len(agreed)} images differ:"
            f" intersection over union {iou:.2f} in the median, {agreed[worst].iou:.2f}"
            f" in {worst}"
        )
    outside = median(item.outside for item in agreed.values())
    if outside > MOST_OUTSIDE:
        texts.append(
            f"the selection covers {outside:.1%} of the image outside the object's"
            " outline in the median"
        )
    return texts
