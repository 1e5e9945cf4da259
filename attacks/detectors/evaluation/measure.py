"""Detections against labelled pictures: a row for each detection and each object; every figure is counted from them.

A detection is right if it overlaps an object of its class that no more confident one has taken, by `IOU` or more.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torchvision.ops import box_iou

from attacks.detectors.base import Detections, Detector
from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.training.pictures import LabelledPicture
from attacks.rate import Rate

IOU = 0.5
"""Least intersection over union of a detection and its object."""
_BATCH = 16
_LUMA = (0.2126, 0.7152, 0.0722)


class Condition(NamedTuple):
    """How an object is seen.

    Attributes:
        unit: Of its values.
        edges: Of the bins in which recall is given.
    """

    unit: str
    edges: tuple[float, ...]

    @property
    def bins(self) -> list[str]:
        """Names of the bins, for instance "0 to 15" and "6 or more"."""
        return [
            f"{low:g} or more" if math.isinf(high) else f"{low:g} to {high:g}" for low, high in pairwise(self.edges)
        ]


CONDITIONS = {
    "elevation": Condition("degrees", (0, 15, 30, 45, 60, 75, 90)),
    "distance": Condition("diagonals of the object", (0, 1.5, 2.5, 4, 6, math.inf)),
    "size": Condition("of the picture's side", (0, 0.2, 0.35, 0.5, 0.75, 1)),
    "brightness": Condition("mean luma", (0, 0.2, 0.3, 0.4, 1)),
    "sun_elevation": Condition("degrees", (0, 30, 45, 60, 90)),
    "sun_strength": Condition("irradiance", (0, 0.5, 1.5, 2.5, math.inf)),
}
"""How an object is seen.

elevation: above the horizontal plane, of the camera as seen from the object; an object that is seen from below is in no
bin. distance: from the camera to the object, in diagonals of the object's box in the world. size: longer side of the
box in the picture. brightness: mean luma (Rec. 709 weights on sRGB values) of the picture in that box; it counts the
shade that an object stands in, and its own colour. sun_elevation: above the horizon. sun_strength: irradiance of the
sun on a surface that faces it, 0 under a closed cover of clouds; rooms stand under the same sun, behind walls.
"""


class DetectionRow(NamedTuple):
    """One detection.

    Attributes:
        picture: Number of the picture.
        label: What is reported.
        score: Its confidence.
        counts: Whether it is confident enough for everything but an average precision.
        right: Whether an object matches it.
    """

    picture: int
    label: str
    score: float
    counts: bool
    right: bool


class ObjectRow(NamedTuple):
    """One object in one picture.

    Attributes:
        label: Its class.
        found: Whether a detection that counts matches it.
        reported_as: Other classes that are reported where it is, in alphabetical order.
        seen: Key of `CONDITIONS` to its value; what is not known is absent.
    """

    label: str
    found: bool
    reported_as: tuple[str, ...]
    seen: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """A detector on one set of pictures.

    Attributes:
        pictures: Their number.
        classes: That objects may have; detections of others are listed, and count for nothing else.
        detections: What is reported, picture by picture.
        objects: What there is, picture by picture.
    """

    pictures: int
    classes: tuple[str, ...]
    detections: tuple[DetectionRow, ...]
    objects: tuple[ObjectRow, ...]

    @property
    def counts(self) -> dict[str, int]:
        """Class to the number of its objects; classes without any are absent."""
        totals = Counter(row.label for row in self.objects)
        return {label: totals[label] for label in self.classes if totals[label]}

    @property
    def recall(self) -> dict[str, float]:
        """Class to the fraction of its objects that are found."""
        hits = Counter(row.label for row in self.objects if row.found)
        return {label: hits[label] / count for label, count in self.counts.items()}

    @property
    def ap(self) -> dict[str, float]:
        """Class to its average precision, every detection kept."""
        precisions = {}
        for label, count in self.counts.items():
            rows = [row for row in self.detections if row.label == label]
            scores = torch.tensor([row.score for row in rows])
            precisions[label] = average_precision(scores, torch.tensor([row.right for row in rows]).bool(), count)
        return precisions

    @property
    def mean(self) -> float:
        """mAP: mean of `ap` over the classes."""
        return sum(self.ap.values()) / max(len(self.ap), 1)

    def recall_by(self, condition: str, label: str | None = None) -> list[Rate]:
        """How many objects are found in each bin of a condition, or of those of one class.

        A bin has its lower edge, the last one also its upper edge; objects of which the condition is not known are left
        out.
        """
        rows = [row for row in self.objects if condition in row.seen and label in (None, row.label)]
        edges = CONDITIONS[condition].edges
        last = edges[-1]
        bins = [
            [row.found for row in rows if low <= row.seen[condition] < high or row.seen[condition] == high == last]
            for low, high in pairwise(edges)
        ]
        return [Rate(successes=sum(found), total=len(found)) for found in bins]

    @property
    def reported_as(self) -> dict[str, dict[str, int]]:
        """Class of the objects to what else is reported on them, to the number of objects; the most frequent first."""
        counts = {label: Counter[str]() for label in dict.fromkeys(row.label for row in self.objects)}
        for row in self.objects:
            counts[row.label].update(row.reported_as)
        return {label: _most_frequent_first(count) for label, count in counts.items() if count}

    @property
    def other_classes(self) -> dict[str, int]:
        """Class that no object has to the number of its detections that count; the most frequent first."""
        return _most_frequent_first(
            Counter(row.label for row in self.detections if row.counts and row.label not in self.classes)
        )

    def as_dict(self) -> dict[str, Any]:
        """Every figure as JSON can hold it; average precision and recall only where there are objects."""
        figures: dict[str, Any] = {}
        if self.objects:
            figures = {"ap": self.ap, "recall": self.recall, "counts": self.counts, "map": self.mean}
            figures |= {"recall_by": self._bins(), "reported_as": self.reported_as}
        counted = {"pictures": self.pictures, "false_positives": false_positives([self])}
        return {**figures, **counted, "other_classes": self.other_classes}

    def _bins(self) -> dict[str, dict[str, list[dict[str, Any]]]]:
        """Condition to the bins of all objects, and to those of cars where there are any; infinite edges are None."""
        figures: dict[str, dict[str, list[dict[str, Any]]]] = {}
        for name, condition in CONDITIONS.items():
            edges = [
                {"low": low, "high": high if math.isfinite(high) else None} for low, high in pairwise(condition.edges)
            ]
            for which, label in (("all", None), ("car", "car")):
                rates = self.recall_by(name, label)
                if any(name in row.seen and label in (None, row.label) for row in self.objects):
                    bins = [{**edge, **rate.as_dict()} for edge, rate in zip(edges, rates, strict=True)]
                    figures.setdefault(name, {})[which] = bins
        return figures


def measure(
    results: Sequence[Detections],
    pictures: Sequence[LabelledPicture],
    classes: Sequence[str],
    *,
    confidence: float = 0.5,
) -> Measurement:
    """Compare detections with labelled pictures.

    Args:
        results: What a detector reports, picture by picture.
        pictures: The pictures with their objects; labels count from 1 in `classes`.
        classes: That objects may have.
        confidence: Least confidence of an object that is found, and of a false positive.
    """
    detections, objects = [], []
    for number, (result, picture) in enumerate(zip(results, pictures, strict=True)):
        labels = [classes[label - 1] for label in picture.labels.tolist()]
        scores, overlap = result.scores.cpu(), box_iou(result.boxes.cpu(), picture.boxes).tolist()
        matches, counts = _matches(result.labels, scores, labels, overlap), (scores >= confidence).tolist()
        for label, score, counting, match in zip(result.labels, scores.tolist(), counts, matches, strict=True):
            detections.append(DetectionRow(number, label, score, counting, match is not None))
        likely = [row for row, counting in enumerate(counts) if counting]
        for index, label in enumerate(labels):
            near = {result.labels[row] for row in likely if overlap[row][index] >= IOU}
            is_found = any(matches[row] == index for row in likely)
            objects.append(ObjectRow(label, is_found, tuple(sorted(near - {label})), _seen(picture, index)))
    return Measurement(
        pictures=len(pictures), classes=tuple(classes), detections=tuple(detections), objects=tuple(objects)
    )


def measure_detector(
    detector: Detector, pictures: Sequence[LabelledPicture], *, confidence: float = 0.5
) -> Measurement:
    """As `measure`, of a detector on pictures of one size, whose labels count from 1 in SMALL_CLASSES."""
    results: list[Detections] = []
    for start in range(0, len(pictures), _BATCH):
        stack = torch.stack([picture.image for picture in pictures[start : start + _BATCH]]).float() / 255
        results += detector.detect(stack)
    return measure(results, pictures, SMALL_CLASSES, confidence=confidence)


def _matches(
    reported: Sequence[str], scores: Tensor, labels: Sequence[str], overlap: Sequence[Sequence[float]]
) -> list[int | None]:
    """Which object each detection matches; the most confident ones choose first, and no object is taken twice."""
    matches: list[int | None] = [None] * len(reported)
    for row in torch.argsort(scores, descending=True, stable=True).tolist():
        free = [index for index, label in enumerate(labels) if label == reported[row] and index not in matches]
        best = max(free, key=overlap[row].__getitem__, default=None)
        if best is not None and overlap[row][best] >= IOU:
            matches[row] = best
    return matches


def _seen(picture: LabelledPicture, index: int) -> dict[str, float]:
    """How object `index` of a picture is seen."""
    x0, y0, x1, y1 = (round(value) for value in picture.boxes[index].tolist())
    inside = picture.image[y0:y1, x0:x1].float() / 255
    values: dict[str, float | None] = {
        "size": max(x1 - x0, y1 - y0) / max(picture.image.shape[:2]),
        "brightness": float((inside @ torch.tensor(_LUMA)).mean()) if inside.numel() else None,
    }
    if picture.conditions:
        seen = picture.conditions[index]
        values |= {"elevation": seen.elevation, "distance": seen.distance / seen.extent if seen.extent else None}
        values |= {"sun_elevation": seen.sun_elevation, "sun_strength": seen.sun_strength}
    return {name: value for name, value in values.items() if value is not None}


def average_precision(scores: Tensor, right: Tensor, objects: int) -> float:
    """Area under the precision-recall curve, precision made monotonous (all-point interpolation of PASCAL VOC 2010).

    Args:
        scores: (D,) confidences.
        right: (D,) bool, whether each detection matched an object.
        objects: Number of objects that there are, at least one.
    """
    hits = right[torch.argsort(scores, descending=True, stable=True)].double()
    precision = hits.cumsum(0) / torch.arange(1, len(hits) + 1)
    best_later = precision.flip(0).cummax(0).values.flip(0)
    return float((best_later * hits).sum() / objects)


def false_positives(measurements: Iterable[Measurement]) -> dict[str, Any]:
    """False positives of some sets of pictures together, as JSON can hold them; there must be pictures.

    The interval is a 95 % range of those per picture if they came independently; those of one scene often do not.
    """
    by_class: Counter[str] = Counter()
    pictures = pictures_with = 0
    for part in measurements:
        wrong = [row for row in part.detections if row.counts and not row.right and row.label in part.classes]
        by_class.update({label: sum(row.label == label for row in wrong) for label in part.classes})
        pictures, pictures_with = pictures + part.pictures, pictures_with + len({row.picture for row in wrong})
    total = by_class.total()
    return {
        "per_picture": total / pictures,
        "total": total,
        "pictures": pictures,
        "interval": [end / pictures for end in poisson_interval(total)],
        "pictures_with": pictures_with,
        "by_class": dict(by_class),
    }


def confidences_at(measurements: Iterable[Measurement], per_picture: Sequence[float]) -> dict[str, float | None]:
    """From which confidence a detector has so many false positives per picture: where detectors are equally strict.

    Args:
        measurements: Some sets of pictures, together; every detection is kept.
        per_picture: Numbers of false positives.

    Returns:
        For each of them, as text, the least confidence at which there are at most so many; None where the detector's
        own floor lets fewer through, so that no confidence is known.
    """
    sets = list(measurements)
    wrong = sorted(
        (row.score for part in sets for row in part.detections if not row.right and row.label in part.classes),
        reverse=True,
    )
    pictures = sum(part.pictures for part in sets)
    allowed = {f"{rate:g}": math.floor(rate * pictures + 1e-9) for rate in per_picture}
    return {
        name: math.nextafter(wrong[most], math.inf) if most < len(wrong) else None for name, most in allowed.items()
    }


def poisson_interval(count: int) -> tuple[float, float]:
    """Exact 95 % interval for the mean of a Poisson variable of which `count` was seen (Garwood 1936)."""
    return _gamma_quantile(count, 0.025) if count else 0.0, _gamma_quantile(count + 1, 0.975)


def _gamma_quantile(shape: int, probability: float) -> float:
    """Where the distribution function of a gamma variable of rate 1 has a value, by bisection."""
    low, high = 0.0, shape + 10 * math.sqrt(shape) + 10.0
    for _ in range(100):
        middle = (low + high) / 2
        arguments = torch.tensor([shape, middle], dtype=torch.float64)
        low, high = (middle, high) if float(torch.special.gammainc(*arguments)) < probability else (low, middle)
    return (low + high) / 2


def _most_frequent_first(counts: Mapping[str, int]) -> dict[str, int]:
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))
