"""False positives per picture: confident detections where there is no object of their class."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from attacks.detectors.base import Detections
from attacks.detectors.training.average_precision import match
from attacks.detectors.training.pictures import LabelledPicture

_TAIL = 0.025


@dataclass(frozen=True, slots=True, kw_only=True)
class FalsePositives:
    """Detections that match no object, in a set of pictures.

    Attributes:
        pictures: Number of pictures.
        pictures_with: Number of those with at least one false positive.
        by_class: Number of false positives of each class.
    """

    pictures: int
    pictures_with: int
    by_class: dict[str, int]

    def __add__(self, other: FalsePositives) -> FalsePositives:
        """Those of two sets of pictures together."""
        names = {**self.by_class, **other.by_class}
        return FalsePositives(
            pictures=self.pictures + other.pictures,
            pictures_with=self.pictures_with + other.pictures_with,
            by_class={name: self.by_class.get(name, 0) + other.by_class.get(name, 0) for name in names},
        )

    @property
    def total(self) -> int:
        """Number of false positives."""
        return sum(self.by_class.values())

    @property
    def rate(self) -> float:
        """False positives per picture; 0 where there are no pictures."""
        return self.total / self.pictures if self.pictures else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % range of `rate`, if false positives came independently; those of one scene often do not."""
        low, high = poisson_interval(self.total)
        return (low / self.pictures, high / self.pictures) if self.pictures else (0.0, math.inf)

    def as_dict(self) -> dict[str, Any]:
        """The values as JSON can hold them; there must be pictures."""
        return {
            "per_picture": self.rate,
            "total": self.total,
            "pictures": self.pictures,
            "interval": list(self.interval),
            "pictures_with": self.pictures_with,
            "by_class": self.by_class,
        }


def false_positives(
    results: Sequence[Detections],
    pictures: Sequence[LabelledPicture],
    classes: Sequence[str],
    *,
    confidence: float = 0.5,
    iou: float = 0.5,
) -> FalsePositives:
    """Count detections that match no object of their class, or one that a more confident detection has taken.

    Args:
        results: What a detector reports, picture by picture.
        pictures: The pictures with their objects; labels count from 1 in `classes`.
        classes: The detector's, in its order.
        confidence: Least confidence of a detection that counts.
        iou: Least intersection over union of a match.
    """
    by_class, pictures_with = dict.fromkeys(classes, 0), 0
    for found, picture in zip(results, pictures, strict=True):
        confident, before = found.scores.cpu() >= confidence, sum(by_class.values())
        for number, name in enumerate(classes, start=1):
            mine = torch.tensor([label == name for label in found.labels], dtype=torch.bool) & confident
            boxes, scores = found.boxes.cpu()[mine], found.scores.cpu()[mine]
            correct = match(boxes, scores, picture.boxes[picture.labels == number], threshold=iou)
            by_class[name] += int((~correct).sum())
        pictures_with += sum(by_class.values()) > before
    return FalsePositives(pictures=len(pictures), pictures_with=pictures_with, by_class=by_class)


def poisson_interval(count: int) -> tuple[float, float]:
    """Exact 95 % interval for the mean of a Poisson variable of which `count` was seen (Garwood 1936)."""

    def at_most(number: int, mean: float) -> float:
        terms = (number_of * math.log(mean) - mean - math.lgamma(number_of + 1) for number_of in range(number + 1))
        return math.fsum(math.exp(term) for term in terms)

    low = 0.0 if count == 0 else _root(lambda mean: (1 - at_most(count - 1, mean)) - _TAIL, count)
    return low, _root(lambda mean: _TAIL - at_most(count, mean), count)


def _root(rising: Callable[[float], float], count: int) -> float:
    """Where a rising function of the mean is zero, by bisection."""
    low, high = 1e-9, count + 10 * math.sqrt(count + 1) + 10.0
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if rising(middle) < 0 else (low, middle)
    return (low + high) / 2
