"""Objectives that make a detection of an object go: hide and untargeted."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.detectors.base import Candidates, Detections
from attacks.objectives.base import Target, column_of, confidence, overlap
from attacks.search.loop import Verdict

GONE = 0.3
"""Confidence below which a detection counts as none."""


def suppress(scores: Tensor, overlaps: Tensor, iou: float, top: int) -> Tensor:
    """Mean of -log(1 - p) over the `top` most confident candidates, p their scores
    summed over the classes given.

    In a logit z its derivative is p: full strength while the detector is sure, none
    once it has let go. The sum makes all classes fall together; one at a time, a
    softmax would only hand its confidence from one to the next. Of (A, C) scores those
    whose overlap with the object is below `iou` are left alone.
    """
    if not len(scores):
        return scores.sum() * 0.0
    relevant = torch.where(overlaps >= iou, scores, 0.0).sum(-1)
    # The clamp keeps the logarithm finite; the derivative passes through it, or a sure
    # detector would have none.
    strongest = relevant.topk(min(top, relevant.numel())).values
    limited = strongest + (strongest.clamp(max=1 - 1e-6) - strongest).detach()
    return -torch.log1p(-limited).mean()


@dataclass(frozen=True, slots=True, kw_only=True)
class Suppression:
    """Something shall no longer be reported on the object; which classes, the
    subclasses say.

    Attributes:
        confidence: A detection below this score counts as none; None is `GONE`, or the
            detector's operating threshold where that is lower.
        iou: Overlap from which a detection belongs to the object; lower than for
            `Relabel`, so that a box that merely slid aside does not count as gone.
        top: Number of candidates pushed.
    """

    confidence: float | None = GONE
    iou: float = 0.3
    top: int = 16

    @property
    def label(self) -> str | None:
        """No particular class."""
        return None

    def needed(self, target: Target) -> float:
        """Score below which a detection counts as none in a view."""
        if self.confidence is None:
            return min(GONE, target.threshold)
        return self.confidence

    def _push(self, scores: Tensor, boxes: Tensor, target: Target) -> Tensor:
        """Loss that lets the scores (A, C) of boxes (A, C, 4) on the object fall."""
        return suppress(scores, overlap(boxes.detach(), target.box), self.iou, self.top)

    def _judge(
        self, detections: Detections, target: Target, labels: Sequence[str] | None
    ) -> Verdict:
        """Success when none of the labels (any, if None) is left on the object."""
        left = confidence(detections, target.box, labels=labels, iou=self.iou)
        is_gone = left < self.needed(target)
        return Verdict(success=is_gone, score=1.0 - left, unambiguous=is_gone)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hide(Suppression):
    """The detector shall report nothing on the object, whatever the class."""

    @property
    def name(self) -> str:
        """Short name for reports."""
        return "hide"

    def __call__(self, candidates: Candidates, target: Target) -> Tensor:
        """Scalar loss, lower is better for the attacker."""
        return self._push(candidates.scores, candidates.boxes, target)

    def verdict(self, detections: Detections, target: Target) -> Verdict:
        """Nothing is reported on the object."""
        return self._judge(detections, target, None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Untargeted(Suppression):
    """The detector shall no longer report the original class on the object; anything
    else will do.
    """

    @property
    def name(self) -> str:
        """Short name for reports."""
        return "untargeted"

    def __call__(self, candidates: Candidates, target: Target) -> Tensor:
        """Scalar loss, lower is better for the attacker."""
        if target.original is None:
            return candidates.scores.sum() * 0.0
        column = [column_of(target, target.original)]
        return self._push(
            candidates.scores[:, column], candidates.boxes[:, column], target
        )

    def verdict(self, detections: Detections, target: Target) -> Verdict:
        """The original class is not reported on the object."""
        if target.original is None:
            return Verdict(success=False, score=0.0, unambiguous=False)
        return self._judge(detections, target, [target.original])


def hide(*, confidence: float | None = None) -> Hide:
    """The object shall not be detected at all.

    Args:
        confidence: Score from which a detection counts, in [0, 1]; None is 0.3, or the
            detector's operating threshold where that is lower.

    Returns:
        The aim.
    """
    return Hide(confidence=confidence)


def untargeted(*, confidence: float | None = None) -> Untargeted:
    """The object must not be detected as its own class; any other class will do.

    Args:
        confidence: Score from which a detection counts, in [0, 1]; None is 0.3, or the
            detector's operating threshold where that is lower.

    Returns:
        The aim.
    """
    return Untargeted(confidence=confidence)
