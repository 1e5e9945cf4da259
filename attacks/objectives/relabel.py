"""The objective that makes a detector report another class on an object."""

from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.detectors.base import Candidates, Detections
from attacks.objectives.base import Target, column_of, confidence, overlap
from attacks.objectives.suppression import suppress
from attacks.search.loop import Verdict

_TINY = 1e-30
"""Probabilities are clamped here before a logarithm."""


_SLACK = 0.1
"""How much less overlap than asked for a candidate may have that is not far from being
reported on the object.
"""


REPORTED = 0.7
"""Confidence from which a class counts as what the detector sees there."""


_SPREAD = 16
"""Candidates on the object that `Relabel.spread` is about."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Relabel:
    """The detector shall report `label` on the object.

    Cross entropy towards the label, on the candidates that are nearest to being such a
    detection; if wanted, plus suppression of the original class on the object.
    Suppression spends budget: over 18 attacks on the shipped sign at eps = 5, weights
    of 2, 0.5 and 0 reached 5, 6 and 8.

    Attributes:
        label: The target class.
        confidence: Score that the detection needs; None is the operating threshold of
            each detector.
        iou: Overlap with the object's box that the detection needs.
        near: Overlap from which a candidate is worth pushing.
        top: Number of candidates pushed.
        suppression: Weight of the suppression of the original class.
        tightness: Weight of 1 - IoU of the pushed candidates' boxes.
        spread: Weight of the same cross entropy on the candidates on the object that
            are surest of the original class, so that no box there is left to report it.
        strict: Whether the original class has to be gone, too: reported on the object
            with less than the detector's operating threshold, or 0.5 where a
            confidence is stated.
    """

    label: str
    confidence: float | None = REPORTED
    iou: float = 0.5
    near: float = 0.5
    top: int = 3
    suppression: float = 0.0
    tightness: float = 0.5
    spread: float = 0.0
    strict: bool = False

    @property
    def name(self) -> str:
        """Short name for reports."""
        return "relabel"

    def __call__(self, candidates: Candidates, target: Target) -> Tensor:
        """Scalar loss, lower is better for the attacker."""
        column = column_of(target, self.label)
        scores = candidates.scores[:, column]
        if not len(candidates):
            return candidates.scores.sum() * 0.0
        overlaps = overlap(candidates.boxes[:, column], target.box)
        with torch.no_grad():
            # With nothing near the object, the boxes nearest to it still show the way.
            order = torch.where(
                overlaps >= self.near, scores.clamp(min=_TINY).log(), overlaps - 1e3
            )
            chosen = order.topk(min(self.top, len(order))).indices
            # By their scores: one detection is enough, and the front runner is the
            # cheapest to push.
            weights = torch.softmax(order[chosen], dim=0)
        entropy = -scores[chosen].clamp(min=_TINY).log()
        loss = (weights * (entropy + self.tightness * (1 - overlaps[chosen]))).sum()
        if (
            (self.suppression or self.spread)
            and target.original in target.classes
            and target.original != self.label
        ):
            rival = column_of(target, target.original)
            rivals = overlap(candidates.boxes[:, rival].detach(), target.box)
            if self.suppression:
                sure = candidates.scores[:, [rival]]
                loss = loss + self.suppression * suppress(
                    sure, rivals[:, None], self.near, self.top
                )
            if self.spread:
                surest = torch.where(
                    rivals >= self.iou, candidates.scores[:, rival].detach(), 0.0
                )
                everywhere = surest.topk(min(_SPREAD, len(surest))).indices
                loss = (
                    loss
                    - self.spread * scores[everywhere].clamp(min=_TINY).log().mean()
                )
        return loss

    def needed(self, target: Target) -> float:
        """Score that the detection needs in a view."""
        return target.threshold if self.confidence is None else self.confidence

    def far(self, candidates: Candidates, target: Target) -> Verdict | None:
        """The verdict of an image in which nothing comes near the label, without
        asking what is reported there.

        None where a candidate of slightly less overlap than asked for has half of the
        confidence: what is reported are candidates, of an image of 8 bits.
        """
        column = column_of(target, self.label)
        with torch.no_grad():
            scores = candidates.scores[:, column]
            overlaps = overlap(candidates.boxes[:, column], target.box)
            if len(scores):
                highest = float(
                    torch.where(overlaps >= self.iou - _SLACK, scores, 0.0).max()
                )
            else:
                highest = 0.0
        far = highest < self.needed(target) / 2
        if far:
            return Verdict(success=False, score=highest, unambiguous=False)
        return None

    def verdict(self, detections: Detections, target: Target) -> Verdict:
        """The label is reported on the object with enough confidence; unambiguous if no
        other class there has more.

        Where the original class has to be gone, the score is not above what its
        confidence leaves to 1.
        """
        score = confidence(detections, target.box, labels=[self.label], iou=self.iou)
        others = [label for label in detections.labels if label != self.label]
        beaten = confidence(detections, target.box, labels=others, iou=self.iou) > score
        success = score >= self.needed(target)
        if self.strict and target.original not in (None, self.label):
            left = confidence(
                detections, target.box, labels=[str(target.original)], iou=self.iou
            )
            score = min(score, 1.0 - left)
            success = success and left < target.threshold
        return Verdict(success=success, score=score, unambiguous=success and not beaten)


STRICT_NEAR = 0.8


STRICT_SPREAD = 1.0
"""How a strict search weighs candidates; chosen on single views of the sign on
`fasterrcnn_small`.
"""


QUIET_NEAR = 0.5


QUIET_SUPPRESSION = 1.0
"""How a strict search weighs candidates where the object's PSNR is the budget.

Detectors that score each class for itself do not let go of one as they find another, so
the own class is suppressed, too. A mask may lack a part of the object, so every
candidate counts that could be reported on it. Chosen on a captured person, on
`ssd_openimages`, and on the car of the demo.
"""


def relabel(
    to: str,
    *,
    confidence: float | None = None,
    iou: float = 0.5,
    strict: bool = False,
    quiet: bool = False,
) -> Relabel:
    """The object is to be detected as another class.

    Args:
        to: The class.
        confidence: Score that the detection needs, in [0, 1]; None is the detector's
            operating threshold if `strict`, else 0.7.
        iou: Overlap with the object's box that it needs, in [0, 1].
        strict: Whether the original class has to go as well: reported on the object
            with less than the operating threshold, or 0.5 beside a confidence.
        quiet: Whether the loss of a strict search is that for a budget of the object's
            PSNR, as in `mi-splat dagger --object-psnr`.

    Returns:
        The objective.
    """
    if not strict:
        return Relabel(
            label=to,
            confidence=REPORTED if confidence is None else confidence,
            iou=iou,
        )
    return Relabel(
        label=to,
        confidence=confidence,
        iou=iou,
        strict=True,
        near=QUIET_NEAR if quiet else STRICT_NEAR,
        spread=STRICT_SPREAD,
        suppression=QUIET_SUPPRESSION if quiet else 0.0,
    )
