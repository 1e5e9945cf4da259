"""CenterNet on MobileNetV3: one heat map of centres for each class, and at each cell the distances to a box's sides.

Zhou et al., "Objects as Points", 2019. The graph's own detections are those cells whose score is the largest of the
3 x 3 cells about it, the best hundred of them.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

OUTPUTS = ("tower_0/keypoints", "tower_0/wh")
SIDE = 512
STRIDE = 4
"""Pixels of the input from one cell to the next."""
MOST = 100
"""Detections in one picture."""


def prepare(picture: Tensor) -> Tensor:
    """(1, 3, 512, 512) in [0, 1] to (1, 512, 512, 3) in [0, 255]."""
    return picture.permute(0, 2, 3, 1) * 255


def decode(outputs: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Boxes (A, 4) in pixels of the input and scores (A, 80) of all 128 x 128 cells, row by row.

    Args:
        outputs: Scores (1, h, w, 80), and distances (1, h, w, 4) in pixels to the left, upper, right and lower side.
    """
    scores, distances = outputs
    high, wide = scores.shape[1:3]
    y, x = torch.meshgrid(torch.arange(high), torch.arange(wide), indexing="ij")
    centres = STRIDE * torch.stack([x, y], -1).reshape(-1, 2).to(scores)
    return around(centres, distances.reshape(-1, 4)), scores.reshape(-1, scores.shape[-1])


def around(centres: Tensor, distances: Tensor) -> Tensor:
    """Boxes x0, y0, x1, y1 (A, 4) from points (A, 2) and distances (A, 4) to the left, upper, right and lower side."""
    return torch.cat([centres - distances[:, :2], centres + distances[:, 2:]], -1)


def keep(boxes: Tensor, scores: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Rows and columns of the peaks, best first.

    Args:
        boxes: Not looked at.
        scores: (A, C) of all cells.
        least: Lowest score that is kept.
    """
    side, found = int(len(scores) ** 0.5), torch.zeros_like(scores, dtype=torch.bool)
    likely = (scores >= least).any(0)  # few classes, and what follows is slow for all 80
    maps = scores[:, likely].T.reshape(1, -1, side, side)
    if len(maps[0]):
        peak = (maps == functional.max_pool2d(maps, 3, 1, 1)) & (maps >= least)
        found[:, likely] = peak.reshape(len(maps[0]), -1).T
    places = found.flatten().nonzero()[:, 0]
    kept = places[scores.flatten()[places].sort(descending=True, stable=True).indices[:MOST]]
    return kept // scores.shape[1], kept % scores.shape[1]
