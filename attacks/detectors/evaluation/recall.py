"""Which objects a detector finds, by how they are seen, and what else it reports on them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torchvision.ops import box_iou

from attacks.detectors.base import Detections
from attacks.detectors.training.average_precision import assign
from attacks.detectors.training.pictures import LabelledPicture
from attacks.rate import Rate

CONDITIONS: dict[str, tuple[float, ...]] = {
    "elevation": (0, 15, 30, 45, 60, 75, 90),
    "distance": (0, 1.5, 2.5, 4, 6, math.inf),
    "size": (0, 0.2, 0.35, 0.5, 0.75, 1),
    "brightness": (0, 0.2, 0.3, 0.4, 1),
    "sun_elevation": (0, 30, 45, 60, 90),
    "sun_strength": (0, 0.5, 1.5, 2.5, math.inf),
}
"""How an object is seen, and the edges of the bins in which recall is given.

elevation: degrees above the horizontal plane, of the camera as seen from the object; an object that is seen from below
is in no bin. distance: from the camera to the
object, in diagonals of the object's box in the world. size: longer side of the box in the picture, as a fraction of the
picture's. brightness: mean luma (Rec. 709 weights on sRGB values) of the picture in that box; it counts the shade that
an object stands in, and its own colour. sun_elevation: degrees above the horizon. sun_strength: irradiance of the sun
on a surface that faces it, 0 under a closed cover of clouds; rooms stand under the same sun, behind walls.
"""

UNITS = {
    "elevation": "degrees",
    "distance": "diagonals of the object",
    "size": "of the picture's side",
    "brightness": "mean luma",
    "sun_elevation": "degrees",
    "sun_strength": "irradiance",
}
"""Condition to the unit of its edges."""

_LUMA = (0.2126, 0.7152, 0.0722)


def bin_names(condition: str) -> list[str]:
    """The bins of a condition in words, for instance "0 to 15" and "6 or more"."""
    edges = CONDITIONS[condition]
    return [f"{low:g} or more" if math.isinf(high) else f"{low:g} to {high:g}" for low, high in pairwise(edges)]


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectResult:
    """What a detector makes of one object in one picture.

    Attributes:
        label: Class of the object.
        found: Whether a detection of that class matches it.
        reported_as: Other classes that are reported where it is, in alphabetical order.
        seen: Key of `CONDITIONS` to its value here; what is not known is absent.
    """

    label: str
    found: bool
    reported_as: tuple[str, ...]
    seen: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bin:
    """Recall of the objects that are seen in one range of a condition.

    Attributes:
        low: Lower edge, which belongs to the bin.
        high: Upper edge, which does not, but for the last bin; may be infinite.
        rate: How many of them are found.
    """

    low: float
    high: float
    rate: Rate

    def as_dict(self) -> dict[str, Any]:
        """The values as JSON can hold them; an infinite edge is None."""
        return {"low": self.low, "high": self.high if math.isfinite(self.high) else None, **self.rate.as_dict()}


def object_results(
    results: Sequence[Detections],
    pictures: Sequence[LabelledPicture],
    classes: Sequence[str],
    *,
    confidence: float = 0.5,
    iou: float = 0.5,
) -> list[ObjectResult]:
    """What a detector makes of every labelled object.

    Args:
        results: What it reports, picture by picture.
        pictures: The pictures; labels count from 1 in `classes`.
        classes: Of the objects.
        confidence: Least confidence of a detection that counts.
        iou: Least intersection over union of a match.
    """
    rows = []
    for found, picture in zip(results, pictures, strict=True):
        confident = found.scores.cpu() >= confidence
        boxes, scores = found.boxes.cpu()[confident], found.scores.cpu()[confident]
        labels = [label for label, kept in zip(found.labels, confident.tolist(), strict=True) if kept]
        for index, number in enumerate(picture.labels.tolist()):
            own = classes[number - 1]
            mine = torch.tensor([label == own for label in labels], dtype=torch.bool)
            rivals = picture.boxes[picture.labels == number]
            place = int((picture.labels[:index] == number).sum())
            overlap = box_iou(boxes, picture.boxes[index : index + 1])[:, 0]
            near = {label for label, much in zip(labels, (overlap >= iou).tolist(), strict=True) if much}
            rows.append(
                ObjectResult(
                    label=own,
                    found=place in assign(boxes[mine], scores[mine], rivals, threshold=iou).tolist(),
                    reported_as=tuple(sorted(near - {own})),
                    seen=_seen(picture, index),
                )
            )
    return rows


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


def recall_by(objects: Iterable[ObjectResult], condition: str) -> list[Bin]:
    """Recall in each bin of a condition; objects of which it is not known are left out.

    Args:
        objects: From `object_results`.
        condition: Key of `CONDITIONS`.
    """
    edges = CONDITIONS[condition]
    known = [(one.seen[condition], one.found) for one in objects if condition in one.seen]
    bins = []
    for low, high in pairwise(edges):
        last = high == edges[-1]
        inside = [found for value, found in known if low <= value < high or (last and value == high)]
        bins.append(Bin(low=low, high=high, rate=Rate(successes=sum(inside), total=len(inside))))
    return bins


def reported_as(objects: Iterable[ObjectResult]) -> dict[str, dict[str, int]]:
    """Class of the objects to what else is reported on them, to the number of objects; the most frequent first."""
    counts: dict[str, Counter[str]] = {}
    for one in objects:
        counts.setdefault(one.label, Counter()).update(one.reported_as)
    return {label: dict(sorted(count.items(), key=_often)) for label, count in counts.items() if count}


def other_classes(results: Iterable[Detections], classes: Sequence[str], *, confidence: float = 0.5) -> dict[str, int]:
    """Number of confident detections of each class that no object of these pictures has; the most frequent first.

    Args:
        results: What a detector reports, picture by picture.
        classes: That objects may have.
        confidence: Least confidence of a detection that counts.
    """
    counts: Counter[str] = Counter()
    for found in results:
        confident = (found.scores >= confidence).tolist()
        counts.update(label for label, kept in zip(found.labels, confident, strict=True) if kept)
    return dict(sorted(((n, c) for n, c in counts.items() if n not in classes), key=_often))


def _often(item: tuple[str, int]) -> tuple[int, str]:
    return -item[1], item[0]
