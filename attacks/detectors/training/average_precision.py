"""Average precision at an intersection over union of 0.5, with every detection kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torchvision.ops import box_iou

from attacks.detectors.base import Detections, Detector
from attacks.detectors.training.pictures import LabelledPicture


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Detection quality over a set of pictures.

    Attributes:
        ap: Class name to average precision; classes without an object in the pictures are absent.
        recall: Class name to the fraction of its objects that were found with enough confidence.
        counts: Class name to number of objects.
    """

    ap: dict[str, float]
    recall: dict[str, float]
    counts: dict[str, int]

    @property
    def mean(self) -> float:
        """mAP: mean of `ap` over the classes."""
        return sum(self.ap.values()) / max(len(self.ap), 1)


def average_precision(scores: Tensor, correct: Tensor, objects: int) -> float:
    """Area under the precision-recall curve, precision made monotonous (all-point interpolation of PASCAL VOC 2010).

    Args:
        scores: (D,) confidences.
        correct: (D,) bool, whether each detection matched an object of its own.
        objects: Number of objects that there are, at least one.
    """
    hits = correct[torch.argsort(scores, descending=True, stable=True)].double()
    found = hits.cumsum(0)
    precision = found / torch.arange(1, len(hits) + 1)
    best_later = precision.flip(0).cummax(0).values.flip(0)
    return float((best_later * hits).sum() / objects)


def assign(boxes: Tensor, scores: Tensor, truth: Tensor, *, threshold: float = 0.5) -> Tensor:
    """(D,) int64: which object each detection matches, or -1; the best ones choose first, and no object is taken twice.

    Args:
        boxes: (D, 4) detections of one class in one picture.
        scores: (D,) their confidences.
        truth: (B, 4) objects of that class in the picture.
        threshold: Least intersection over union.
    """
    taken = torch.full((len(boxes),), -1)
    if len(truth) == 0 or len(boxes) == 0:
        return taken
    overlap = box_iou(boxes, truth)
    for i in torch.argsort(scores, descending=True, stable=True).tolist():
        best, j = overlap[i].max(0)
        if float(best) >= threshold:
            taken[i] = j
            overlap[:, j] = -1
    return taken


def match(boxes: Tensor, scores: Tensor, truth: Tensor, *, threshold: float = 0.5) -> Tensor:
    """As in `assign`: (D,) bool, which detections match an object."""
    return assign(boxes, scores, truth, threshold=threshold) >= 0


def score(
    results: Sequence[Detections],
    pictures: Sequence[LabelledPicture],
    classes: Sequence[str],
    *,
    confidence: float = 0.5,
) -> Score:
    """Compare detections with labelled pictures.

    Args:
        results: What a detector reports, picture by picture.
        pictures: The pictures with their objects; labels count from 1 in `classes`.
        classes: That objects may have.
        confidence: Least confidence with which an object counts as found.
    """
    ap, recall, counts = {}, {}, {}
    for number, name in enumerate(classes, start=1):
        confidences, correct, objects = [torch.empty(0)], [torch.empty(0, dtype=torch.bool)], 0
        for found, picture in zip(results, pictures, strict=True):
            mine = torch.tensor([label == name for label in found.labels], dtype=torch.bool)
            boxes, scores = found.boxes[mine].cpu(), found.scores[mine].cpu()
            truth = picture.boxes[picture.labels == number]
            confidences.append(scores)
            correct.append(match(boxes, scores, truth))
            objects += len(truth)
        if objects:
            every, right = torch.cat(confidences), torch.cat(correct)
            ap[name] = average_precision(every, right, objects)
            recall[name] = float((right & (every >= confidence)).sum()) / objects
            counts[name] = objects
    return Score(ap=ap, recall=recall, counts=counts)


def detect_all(detector: Detector, pictures: Sequence[LabelledPicture], *, batch: int = 16) -> list[Detections]:
    """What a detector reports on pictures of one size, `batch` of them at a time."""
    results: list[Detections] = []
    for start in range(0, len(pictures), batch):
        stack = torch.stack([picture.image for picture in pictures[start : start + batch]]).float() / 255
        results += detector.detect(stack)
    return results


def evaluate(detector: Detector, pictures: Sequence[LabelledPicture]) -> Score:
    """Run `detector` over labelled pictures of one size and score it."""
    return score(detect_all(detector, pictures), pictures, detector.classes)
