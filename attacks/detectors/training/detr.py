"""How `detr_small` is trained by the loop of `attacks.detectors.training.loop`: a set loss after every layer."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn
from torchvision.ops import box_convert, generalized_box_iou, sigmoid_focal_loss

from attacks.detectors import small_detr
from attacks.detectors.base import Detector
from attacks.detectors.classes import SMALL_SIDE
from attacks.detectors.small_detr import DETR, DETRDetector, Guesses, resized
from attacks.detectors.training.assignment import least_cost
from attacks.detectors.training.loop import Targets
from attacks.detectors.training.pretraining import CutOutTrainer

_WEIGHTS = {"class": 2.0, "distance": 5.0, "overlap": 2.0}
"""Those of Deformable DETR, in the match and in the loss."""
_CELLS_EACH = 4
"""Cells that learn from each object; queries learn from one each, so that an object is reported once."""
_ALPHA, _GAMMA = 0.25, 2.0


class DETRTrainer(CutOutTrainer):
    """The small detection transformer."""

    name = "detr_small"

    def __init__(self) -> None:
        self._side = SMALL_SIDE

    def build(self) -> nn.Module:
        """See `DetectorTrainer`."""
        return small_detr.build()

    def begin_epoch(self, model: nn.Module, *, side: int | None, final: bool) -> None:
        """See `DetectorTrainer`; the last epochs are like the others."""
        self._side = side or SMALL_SIDE

    def losses(
        self, model: nn.Module, pictures: list[Tensor], targets: Targets, generator: Generator
    ) -> dict[str, Tensor]:
        """As in `DetectorTrainer`: those of Deformable DETR, summed over the layers."""
        planes = torch.stack(pictures)
        height, width = planes.shape[2:]
        layers = model(resized(planes, self._side).contiguous(memory_format=torch.channels_last))
        size = torch.tensor([width, height, width, height])
        boxes = [box_convert(target["boxes"] / size, "xyxy", "cxcywh") for target in targets]
        labels = [target["labels"] - 1 for target in targets]
        total = dict.fromkeys(_WEIGHTS, torch.zeros(()))
        with torch.autocast("cpu", enabled=False):
            for number, guesses in enumerate(layers):
                for name, value in set_losses(guesses, boxes, labels, each=1 if number else _CELLS_EACH).items():
                    total[name] = total[name] + _WEIGHTS[name] * value
        return total

    def detector(self, model: nn.Module) -> Detector:
        """See `DetectorTrainer`."""
        assert isinstance(model, DETR)
        return DETRDetector(self.name, model)


def set_losses(
    guesses: Guesses, boxes: Sequence[Tensor], labels: Sequence[Tensor], *, each: int = 1
) -> dict[str, Tensor]:
    """Match guesses with objects at the least cost, then score the scores of all and the boxes of the matched ones.

    Args:
        guesses: Of B pictures.
        boxes: (G, 4) of the objects of each picture, as in `Guesses`.
        labels: (G,) class numbers, from 0.
        each: How many guesses each object gets.

    Returns:
        Focal loss of the classes, L1 distance and 1 - generalized IoU of the boxes, each by object.
    """
    logits = guesses.logits.float()
    wanted = torch.zeros_like(logits)
    ours, theirs = [guesses.boxes[0, :0]], [guesses.boxes[0, :0]]
    for i, (own, names) in enumerate(zip(boxes, labels, strict=True)):
        found, objects = matched(logits[i], guesses.boxes[i], own, names, each)
        wanted[i, found, names[objects]] = 1.0
        ours.append(guesses.boxes[i, found])
        theirs.append(own[objects])
    guessed, true = torch.cat(ours), torch.cat(theirs)
    count = max(len(true), 1)
    classes = sigmoid_focal_loss(logits, wanted, alpha=_ALPHA, gamma=_GAMMA, reduction="sum")
    return {
        "class": classes / count,
        "distance": (guessed - true).abs().sum() / count,
        "overlap": (1 - generalized_box_iou(_corners(guessed), _corners(true)).diag()).sum() / count,
    }


def matched(logits: Tensor, boxes: Tensor, true: Tensor, labels: Tensor, each: int) -> tuple[Tensor, Tensor]:
    """Numbers of the guesses that get an object, and of their objects.

    Args:
        logits: (N, C) of a picture's guesses.
        boxes: (N, 4), as in `Guesses`.
        true: (G, 4) objects.
        labels: (G,) their classes, from 0.
        each: How many guesses each object gets.
    """
    with torch.no_grad():
        scores = logits.sigmoid()[:, labels]
        gain = _ALPHA * (1 - scores) ** _GAMMA * -(scores + 1e-8).log()
        loss = (1 - _ALPHA) * scores**_GAMMA * -(1 - scores + 1e-8).log()
        overlap = generalized_box_iou(_corners(boxes), _corners(true))
        cost = _WEIGHTS["class"] * (gain - loss) + _WEIGHTS["distance"] * torch.cdist(boxes, true, p=1)
        cost = (cost - _WEIGHTS["overlap"] * overlap).repeat(1, each)
    found = torch.from_numpy(least_cost(cost.double().numpy().T))
    return found, torch.arange(len(found)) % max(len(true), 1)


def _corners(boxes: Tensor) -> Tensor:
    corners: Tensor = box_convert(boxes, "cxcywh", "xyxy")
    return corners
