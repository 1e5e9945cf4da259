"""What an attacker wants of a detector: a differentiable loss on candidates, and
success judged on detections.

The two are separate on purpose. The loss sees everything the detector considered,
before thresholds and non-maximum suppression, where gradients are; success sees only
what a user of the detector would get. Both are about one object, whose box in the
picture is known: candidates and detections belong to it when they overlap that box.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from attacks.detectors.base import Candidates, Detections
from attacks.search import Verdict
from mi_splat.errors import InvalidValueError

_TINY = 1e-30
"""Probabilities are clamped here before a logarithm."""

_SLACK = 0.1
"""How much less overlap than asked for a candidate may have that is not far from being
reported on the object.
"""

REPORTED = 0.7
"""Confidence from which a class counts as what the detector sees there."""

LEFT = 0.5
"""Confidence below which the object's own class counts as no longer reported, where
another one is wanted.
"""

_SPREAD = 16
"""Candidates on the object that `Relabel.spread` is about."""

GONE = 0.3
"""Confidence below which a detection counts as none."""


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


def joint_verdict(verdicts: Sequence[Verdict], required: float) -> Verdict:
    """Success in at least a fraction of the verdicts, and the score that so many
    reach.
    """
    needed = _needed(len(verdicts), required)
    return Verdict(
        success=sum(verdict.success for verdict in verdicts) >= needed,
        score=reached_by([verdict.score for verdict in verdicts], required),
        unambiguous=sum(verdict.unambiguous for verdict in verdicts) >= needed,
    )


def overall_verdict(
    rows: Sequence[Sequence[Verdict]], required: float, *, drawn: bool = False
) -> Verdict:
    """One verdict of views (rows) and detectors: success where enough views succeed
    with every detector.

    From chosen cameras each detector needs enough views of its own, and the score is
    what so many reach. Of drawn views a view needs all detectors, and the score orders
    by the number of these views, and between equals by the mean of what is reached in
    them.
    """
    if not drawn:
        return joint_verdict(
            [joint_verdict(verdicts, required) for verdicts in zip(*rows, strict=True)],
            1.0,
        )
    views = [joint_verdict(row, 1.0) for row in rows]
    successes, unambiguous = (
        sum(getattr(view, name) for view in views)
        for name in ("success", "unambiguous")
    )
    return Verdict(
        success=successes / len(views) >= required - 1e-9,
        score=(successes + sum(view.score for view in views) / len(views))
        / (len(views) + 1),
        unambiguous=unambiguous / len(views) >= required - 1e-9,
    )


def reached_by(values: Sequence[float], required: float) -> float:
    """The largest value that at least a fraction of the values reach."""
    return sorted(values, reverse=True)[_needed(len(values), required) - 1]


def _needed(count: int, required: float) -> int:
    # 0.07 * 100 is a little more than 7: rounding must not ask for one more.
    return math.ceil(required * count - 1e-9)


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
            candidates: Every box and class score of one detector on the picture, before
                the detector drops weak ones.
            target: The attacked object: its box in the picture, and its class.

        Returns:
            Scalar, lower is better for the attacker.
        """
        ...

    def verdict(self, detections: Detections, target: Target) -> Verdict:
        """Success and score of one view, from what the detector reports.

        Args:
            detections: What the detector reports on the picture.
            target: The attacked object: its box in the picture, and its class.

        Returns:
            Whether the aim is reached, and how near it is.
        """
        ...


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


def _column(target: Target, label: str) -> int:
    if label not in target.classes:
        raise InvalidValueError.of(
            "label",
            f"one of {', '.join(target.classes)}",
            label,
            "choose a class that the detector knows",
        )
    return target.classes.index(label)


def _suppress(scores: Tensor, overlaps: Tensor, iou: float, top: int) -> Tensor:
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
class Relabel:
    """The detector shall report `label` on the object.

    Cross entropy towards the label, on the candidates that are nearest to being such a
    detection; if wanted, plus suppression of the original class on the object.
    Suppression spends budget: over 18 attacks on the shipped sign at eps = 5, weights
    of 2, 0.5 and 0 reached 5, 6 and 8.

    Attributes:
        label: The target class.
        confidence: Score that the detection needs.
        iou: Overlap with the object's box that the detection needs.
        near: Overlap from which a candidate is worth pushing.
        top: Number of candidates pushed.
        suppression: Weight of the suppression of the original class.
        tightness: Weight of 1 - IoU of the pushed candidates' boxes.
        spread: Weight of the same cross entropy on the candidates on the object that
            are surest of the original class, so that no box there is left to report it.
        strict: Whether the original class has to be gone, too: reported on the object
            with less than `LEFT`.
    """

    label: str
    confidence: float = REPORTED
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
        column = _column(target, self.label)
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
            rival = _column(target, target.original)
            rivals = overlap(candidates.boxes[:, rival].detach(), target.box)
            if self.suppression:
                sure = candidates.scores[:, [rival]]
                loss = loss + self.suppression * _suppress(
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

    def far(self, candidates: Candidates, target: Target) -> Verdict | None:
        """The verdict of a picture in which nothing comes near the label, without
        asking what is reported there.

        None where a candidate of slightly less overlap than asked for has half of the
        confidence: what is reported are candidates, of a picture of 8 bits.
        """
        column = _column(target, self.label)
        with torch.no_grad():
            scores = candidates.scores[:, column]
            overlaps = overlap(candidates.boxes[:, column], target.box)
            if len(scores):
                highest = float(
                    torch.where(overlaps >= self.iou - _SLACK, scores, 0.0).max()
                )
            else:
                highest = 0.0
        far = highest < self.confidence / 2
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
        success = score >= self.confidence
        if self.strict and target.original not in (None, self.label):
            left = confidence(
                detections, target.box, labels=[str(target.original)], iou=self.iou
            )
            score = min(score, 1.0 - left)
            success = success and left < LEFT
        return Verdict(success=success, score=score, unambiguous=success and not beaten)


@dataclass(frozen=True, slots=True, kw_only=True)
class Suppression:
    """Something shall no longer be reported on the object; which classes, the
    subclasses say.

    Attributes:
        confidence: A detection below this score counts as none.
        iou: Overlap from which a detection belongs to the object; lower than for
            `Relabel`, so that a box that merely slid aside does not count as gone.
        top: Number of candidates pushed.
    """

    confidence: float = GONE
    iou: float = 0.3
    top: int = 16

    @property
    def label(self) -> str | None:
        """No particular class."""
        return None

    def _push(self, scores: Tensor, boxes: Tensor, target: Target) -> Tensor:
        """Loss that lets the scores (A, C) of boxes (A, C, 4) on the object fall."""
        return _suppress(
            scores, overlap(boxes.detach(), target.box), self.iou, self.top
        )

    def _judge(
        self, detections: Detections, target: Target, labels: Sequence[str] | None
    ) -> Verdict:
        """Success when none of the labels (any, if None) is left on the object."""
        left = confidence(detections, target.box, labels=labels, iou=self.iou)
        return Verdict(
            success=left < self.confidence,
            score=1.0 - left,
            unambiguous=left < self.confidence,
        )


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
        column = [_column(target, target.original)]
        return self._push(
            candidates.scores[:, column], candidates.boxes[:, column], target
        )

    def verdict(self, detections: Detections, target: Target) -> Verdict:
        """The original class is not reported on the object."""
        if target.original is None:
            return Verdict(success=False, score=0.0, unambiguous=False)
        return self._judge(detections, target, [target.original])


STRICT_NEAR = 0.8
STRICT_SPREAD = 1.0
"""How a strict search weighs candidates; chosen on single views of the sign on
`fasterrcnn_small`.
"""


def relabel(
    to: str, *, confidence: float | None = None, iou: float = 0.5, strict: bool = False
) -> Relabel:
    """The object is to be detected as another class.

    Args:
        to: The class.
        confidence: Score that the detection needs, in [0, 1]; None is 0.5 if `strict`,
            else 0.7.
        iou: Overlap with the object's box that it needs, in [0, 1].
        strict: Whether the original class has to go as well: reported on the object
            with less than 0.5.

    Returns:
        The objective.
    """
    if not strict:
        return Relabel(
            label=to, confidence=REPORTED if confidence is None else confidence, iou=iou
        )
    needed = LEFT if confidence is None else confidence
    return Relabel(
        label=to,
        confidence=needed,
        iou=iou,
        strict=True,
        near=STRICT_NEAR,
        spread=STRICT_SPREAD,
    )


def hide(*, confidence: float = GONE) -> Hide:
    """The object shall not be detected at all.

    Args:
        confidence: Score from which a detection counts, in [0, 1].

    Returns:
        The aim.
    """
    return Hide(confidence=confidence)


def untargeted(*, confidence: float = GONE) -> Untargeted:
    """The object shall not be detected as what it is; as anything else will do.

    Args:
        confidence: Score from which a detection counts, in [0, 1].

    Returns:
        The aim.
    """
    return Untargeted(confidence=confidence)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FunctionObjective:
    """An aim of two functions; see `objective`.

    Attributes:
        loss: Scalar that falls as the attacker gets nearer.
        success: Whether the aim is reached, how near it is, or a `Verdict`.
        name: Short name for reports.
        label: Class that the object should become; None if no particular one.
    """

    loss: Callable[[Candidates, Target], Tensor]
    success: Callable[[Detections, Target], bool | float | Verdict]
    name: str
    label: str | None

    def __repr__(self) -> str:
        """Text that is the same in every process, so that a search can be taken up
        again.
        """
        loss, success = (
            f"{function.__module__}.{function.__qualname__}"
            for function in (self.loss, self.success)
        )
        return f"objective({loss}, {success}, name={self.name!r}, label={self.label!r})"

    def __call__(self, candidates: Candidates, target: Target) -> Tensor:
        """Scalar loss, lower is better for the attacker."""
        value = self.loss(candidates, target)
        if not isinstance(value, Tensor) or value.ndim:
            if isinstance(value, Tensor):
                got = f"a tensor of shape {tuple(value.shape)}"
            else:
                got = type(value).__name__
            do = "end the loss with .sum() or .mean()"
            raise InvalidValueError.of(
                f"loss of {self.name}", "a tensor without axes", got, do
            )
        return value

    def verdict(self, detections: Detections, target: Target) -> Verdict:
        """What `success` says; a number is how near the aim is, and 1 is success."""
        answer = self.success(detections, target)
        if isinstance(answer, Verdict):
            return answer
        score = float(answer)
        if not 0 <= score <= 1:
            do = "give True or False, or how near the aim is"
            raise InvalidValueError.of(
                f"success of {self.name}", "a number in [0, 1]", score, do
            )
        return Verdict(success=score == 1, score=score, unambiguous=score == 1)


def objective(
    loss: Callable[[Candidates, Target], Tensor],
    success: Callable[[Detections, Target], bool | float | Verdict],
    *,
    name: str = "",
    label: str | None = None,
) -> Objective:
    """An aim of your own from two functions: what the search follows, and what counts.

    Args:
        loss: From everything that a detector considers in a view, and the object there,
            to a scalar that falls as the attacker gets nearer. It has to be
            differentiable in `Candidates.scores` or `Candidates.boxes`.
        success: From what the detector reports, and the object there, to whether the
            aim is reached; or to how near it is, in [0, 1], where 1 is success; or to a
            whole `attacks.search.Verdict`. `confidence` of this module is the score
            with which classes are reported on the object.
        name: Short name for reports; that of `success` if empty.
        label: Class that the object should become, which `Target.label` then is; None
            if no particular one.

    Returns:
        The aim, as `attack` takes it.

    Raises:
        InvalidValueError: One of them is no function.
    """
    for what, value in (("loss", loss), ("success", success)):
        if not callable(value):
            raise InvalidValueError.of(
                what,
                "a function",
                type(value).__name__,
                "pass a function of two arguments",
            )
    name = name or getattr(success, "__name__", "own").strip("<>")
    return FunctionObjective(loss=loss, success=success, name=name, label=label)
