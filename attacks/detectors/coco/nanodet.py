"""NanoDet: at each cell of three levels a quality for each class, and for each side of the box a distribution.

Its head is that of Li et al., "Generalized Focal Loss", 2020: the distance to a side is the mean of eleven bins.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchvision.ops import batched_nms

from attacks.detectors.coco.centernet import around

STRIDES = (8, 16, 32)
OUTPUTS = ("Identity:0", "Identity_3:0", "Identity_1:0", "Identity_4:0", "Identity_2:0", "Identity_5:0")
"""Scores and bins of each level, in the order of `STRIDES`."""
SIDE = 416
BINS = 11
MEAN = (103.53, 116.28, 123.675)
DEVIATION = (57.375, 57.12, 58.395)
"""Of blue, green and red in [0, 255]."""
OVERLAP = 0.6
"""Intersection over union from which the weaker of two boxes of a class is dropped."""
MOST = 100
"""Detections in one picture."""


def prepare(picture: Tensor) -> Tensor:
    """(1, 3, 416, 416) RGB in [0, 1] to the same in BGR, standardised."""
    mean, deviation = (picture.new_tensor(values).reshape(1, 3, 1, 1) for values in (MEAN, DEVIATION))
    return (picture.flip(1) * 255 - mean) / deviation


def decode(outputs: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Boxes (A, 4) in pixels of the input and scores (A, 80) of the cells of all levels.

    Args:
        outputs: For each level scores (1, cells, 80) and logits of bins (1, cells, 44): eleven for each of the left,
            upper, right and lower side.
    """
    boxes, scores = [], []
    for stride, score, logits in zip(STRIDES, outputs[::2], outputs[1::2], strict=True):
        side = SIDE // stride
        y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
        centres = stride * (torch.stack([x, y], -1).reshape(-1, 2).to(score) + 0.5)
        bins = torch.softmax(logits.reshape(-1, 4, BINS), -1)
        distances = stride * (bins @ torch.arange(BINS).to(bins))
        boxes.append(around(centres, distances))
        scores.append(score[0])
    return torch.cat(boxes), torch.cat(scores)


def keep(boxes: Tensor, scores: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Rows and columns of what is left after non-maximum suppression in each class, best first.

    Args:
        boxes: (A, 4).
        scores: (A, C).
        least: Lowest score that is kept.
    """
    rows, columns = (scores >= least).nonzero(as_tuple=True)
    kept = batched_nms(boxes[rows], scores[rows, columns], columns, OVERLAP)[:MOST]
    return rows[kept], columns[kept]
