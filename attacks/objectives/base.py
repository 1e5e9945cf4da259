"""What an attacker wants of a detector: a differentiable loss on candidates, and
success judged on detections.

The two are separate on purpose. The loss sees everything the detector considered,
before thresholds and non-maximum suppression, where gradients are; success sees only
what a user of the detector would get. Both are about one object, whose box in the
image is known: candidates and detections belong to it when they overlap that box.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from attacks.detectors.base import Candidates, Detections
from attacks.search.loop import Verdict
from mi_splat.errors import InvalidValueError


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Target:
    """The attacked object in one view."""

    box: Tensor  # (4,) x0, y0, x1, y1 in pixels: where the object is visible
    # class that the attacker wants to be seen there; None when any change will do
    label: str | None
    # the detector's classes, in the order of the columns of `Candidates.scores`
    classes: tuple[str, ...]
    # class that the detector sees there before the attack; None when it sees nothing
    original: str | None = None
    # confidence from which the detector's detections count: its operating threshold,
    # or 0.5 where the objective states a confidence of its own
    threshold: float = 0.5


class Objective(Protocol):
    """An attacker's aim. `__call__` is the loss, lower is better for the attacker."""

    @property
    def name(self) -> str:
        """Short name for reports."""
        ...

    @property
    def label(self) -> str | None:
        """Class that the object should become; None if no particular one."""
        ...

    def __call__(self, candidates: Candidates, target: Target) -> Tensor:
        """The loss of one view.

        Args:
            candidates: Every box and class score of one detector on the image, before
                the detector drops weak ones.
            target: The attacked object: its box in the image, and its class.

        Returns:
            Scalar, lower is better for the attacker.
        """
        ...

    def verdict(self, detections: Detections, target: Target) -> Verdict:
        """Success and score of one view, from what the detector reports.

        Args:
            detections: What the detector reports on the image.
            target: The attacked object: its box in the image, and its class.

        Returns:
            Whether the aim is reached, and how near it is.
        """
        ...


def least_confidence(objective: Objective, target: Target) -> float | None:
    """Confidence that an objective counts from in a view; None of one of another
    package that states none.
    """
    needed = getattr(objective, "needed", None)
    if needed is not None:
        number: float = needed(target)
        return number
    stated: float | None = getattr(objective, "confidence", None)
    return stated


def check_objective(value: object) -> None:
    """Raise unless a value is an `Objective`."""
    if not callable(value) or not all(
        hasattr(value, name) for name in ("name", "label", "verdict")
    ):
        if isinstance(value, str):
            do = f"pass relabel({value!r})"
        else:
            do = "pass for instance hide()"
        raise InvalidValueError.of(
            "objective", "an Objective", type(value).__name__, do
        )


def overlap(boxes: Tensor, box: Tensor) -> Tensor:
    """Intersection over union of (..., 4) boxes with one (4,) box, both x0, y0, x1, y1
    in pixels.
    """
    box = box.to(boxes)
    corner = torch.minimum(boxes[..., 2:], box[2:]) - torch.maximum(
        boxes[..., :2], box[:2]
    )
    shared = corner.clamp(min=0).prod(-1)
    areas = (boxes[..., 2:] - boxes[..., :2]).clamp(min=0).prod(-1) + (
        box[2:] - box[:2]
    ).clamp(min=0).prod(-1)
    return shared / (areas - shared).clamp(min=1e-9)


def confidence(
    detections: Detections,
    box: Tensor,
    *,
    labels: Sequence[str] | None = None,
    iou: float = 0.5,
) -> float:
    """Highest score among the detections that overlap `box`; 0 when there are none."""
    if not len(detections):
        return 0.0
    near = overlap(detections.boxes, box) >= iou
    scores = [
        float(detections.scores[i])
        for i, label in enumerate(detections.labels)
        if near[i] and (labels is None or label in labels)
    ]
    return max(scores, default=0.0)


def column_of(target: Target, label: str) -> int:
    """The column of a class among a detector's scores."""
    if label not in target.classes:
        raise InvalidValueError.of(
            "label",
            f"one of {', '.join(target.classes)}",
            label,
            "choose a class that the detector knows",
        )
    return target.classes.index(label)
