"""The contracts of a detector (`attacks.detectors.Detector`) and of an objective
(`attacks.objectives.base.Objective`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from attacks.detectors.base import Candidates, Detections, Detector, check_images
from attacks.detectors.registry import operating_threshold
from attacks.objectives.base import Target
from attacks.search.loop import Verdict
from attacks.testing.promises import (
    Contract,
    expect,
    expect_repeatable,
    expect_same,
    expect_text,
    expect_uphill,
)
from mi_splat.errors import InvalidValueError

_OBJECT = (20.0, 10.0, 70.0, 50.0)
_COUNT = 12
_STEPS = 150
_RATE = 0.1
"""Candidates around the object, steps that follow the loss, and their length."""


def check_objective(objective: Any, *, original: str = "car") -> None:
    """Raise unless an objective keeps its contract.

    A made-up detector sees an object; the loss then moves its candidates freely, as no
    attack could. What counts has to come nearer by that, or an attack would follow a
    loss that leads elsewhere.

    Args:
        objective: The objective.
        original: What the object is, which a verdict may ask for.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(
        f"objective {getattr(objective, 'name', type(objective).__name__)}"
    )
    with contract.promise("names"):
        expect_text(getattr(objective, "name", None), "name")
        label = getattr(objective, "label", 0)
        expect(
            label is None or (isinstance(label, str) and label),
            "a label, or None",
            repr(label),
            "name a class",
        )
    target = _target(getattr(objective, "label", None), original)
    start = _start(target)
    with contract.promise("loss"):
        loss = objective(_candidates(start), target)
        is_number = isinstance(loss, Tensor) and loss.ndim == 0
        if isinstance(loss, Tensor):
            got = f"shape {tuple(loss.shape)}"
        else:
            got = type(loss).__name__
        expect(is_number, "a tensor without axes", got, "end it with .sum() or .mean()")
        expect(
            bool(torch.isfinite(loss)),
            "a finite loss",
            float(loss),
            "clamp before a logarithm",
        )
    with contract.promise("gradients"):
        gradients = _gradients(objective, start, target)
        finite = all(bool(torch.isfinite(gradient).all()) for gradient in gradients)
        expect(
            finite,
            "finite gradients",
            "NaN or infinity",
            "clamp before a logarithm or a root",
        )
        do = (
            "leave out .detach(), comparisons and rounding on the way from scores and"
            " boxes to the loss"
        )
        expect(
            any(bool(gradient.any()) for gradient in gradients),
            "a gradient in scores or boxes",
            "zeros",
            do,
        )
    with contract.promise("no candidates"):
        nothing = [
            torch.zeros(0, len(target.classes)),
            torch.zeros(0, len(target.classes), 4),
        ]
        gradients = _gradients(objective, nothing, target)
        loss = objective(_candidates(nothing), target)
        do = "return candidates.scores.sum() * 0.0 where nothing is considered"
        expect(
            bool(torch.isfinite(loss)),
            "a finite loss where nothing is considered",
            float(loss),
            do,
        )
    with contract.promise("verdict"):
        for seen in (
            _reported(start, target),
            Detections(torch.zeros(0, 4), torch.zeros(0), ()),
        ):
            _verdict(objective, seen, target)
    with contract.promise("determinism"):
        losses = "the same loss in a second look"
        expect_repeatable(
            lambda: [objective(_candidates(start), target)],
            losses,
            "draw nothing in it",
        )
    with contract.promise("loss and success"):
        before = _verdict(objective, _reported(start, target), target)
        end, fell = _followed(objective, start, target)
        after = _verdict(objective, _reported(end, target), target)
        expect(
            fell > 0,
            "a loss that falls along its gradient",
            f"one that rises by {-fell:.3g}",
            "look at its sign",
        )
        got = (
            f"a score of {before.score:.3g} before and {after.score:.3g} after {_STEPS}"
            " steps along the loss"
        )
        do = "look at the sign of the loss, and whether both functions mean the same"
        expect(
            before.success or after.score > before.score,
            "success that comes nearer as the loss falls",
            got,
            do,
        )
    contract.settle()


def _target(label: str | None, original: str) -> Target:
    classes = tuple(dict.fromkeys((original, label or "person", "stop sign")))
    return Target(
        box=torch.tensor(_OBJECT), label=label, classes=classes, original=original
    )


def _start(target: Target) -> list[Tensor]:
    """Logits (A, C) and boxes (A, C, 4) of a detector that is sure of the original on
    the object.
    """
    generator = torch.Generator().manual_seed(0)
    columns = len(target.classes)
    logits = -3.0 + 0.3 * torch.randn(_COUNT, columns, generator=generator)
    logits[:, 0] += 5.0
    boxes = target.box.expand(_COUNT, columns, 4) + 2.0 * torch.randn(
        _COUNT, 1, 4, generator=generator
    )
    return [logits, boxes.contiguous()]


def _candidates(parts: list[Tensor]) -> Candidates:
    return Candidates(parts[1], parts[0].sigmoid())


def _gradients(
    objective: Any, parts: list[Tensor], target: Target
) -> tuple[Tensor, ...]:
    leaves = [part.detach().clone().requires_grad_(True) for part in parts]
    loss = objective(_candidates(leaves), target)
    expect(
        loss.requires_grad,
        "a loss with a gradient",
        "none",
        "keep it a function of candidates.scores or boxes",
    )
    return torch.autograd.grad(loss, leaves, materialize_grads=True)


def _followed(
    objective: Any, start: list[Tensor], target: Target
) -> tuple[list[Tensor], float]:
    """Where the loss leads, and by how much it fell."""
    parts = [part.clone().requires_grad_(True) for part in start]
    search = torch.optim.Adam(parts, lr=_RATE)
    before = float(objective(_candidates(start), target))
    for _ in range(_STEPS):
        search.zero_grad()
        objective(_candidates(parts), target).backward()
        search.step()
    end = [part.detach() for part in parts]
    return end, before - float(objective(_candidates(end), target))


def _reported(parts: list[Tensor], target: Target) -> Detections:
    """What a detector would report: the class of each candidate that it is surest of,
    from 0.05 on.
    """
    candidates = _candidates(parts)
    scores, columns = candidates.scores.max(1)
    rows = [int(row) for row in scores.argsort(descending=True) if scores[row] >= 0.05]
    labels = tuple(target.classes[int(columns[row])] for row in rows)
    return Detections(candidates.boxes[rows, columns[rows]], scores[rows], labels)


def _verdict(objective: Any, seen: Detections, target: Target) -> Verdict:
    verdict = objective.verdict(seen, target)
    do = "return a Verdict of attacks.search.loop, or use attacks.objective"
    expect(isinstance(verdict, Verdict), "a Verdict", type(verdict).__name__, do)
    expect(0 <= verdict.score <= 1, "a score in [0, 1]", verdict.score, "scale it")
    checked: Verdict = verdict
    return checked


_Report = TypeVar("_Report", Candidates, Detections)
_PIXEL = 1 / 255
_BOX = 0.1
_SCORE = 1e-3
"""How far boxes (pixels) and scores may be apart for the same image in another
stack.
"""
_REFUSED = {
    "images with channels first": torch.zeros(1, 3, 32, 40),
    "values up to 255": torch.full((1, 32, 40, 3), 255.0),
    "NaN": torch.full((1, 32, 40, 3), torch.nan),
}


def check_detector(
    detector: Any, *, images: Tensor | None = None, differentiable: bool = True
) -> None:
    """Raise unless a detector keeps its contract.

    It is asked for a few images: what it considers has to lie in the image and in
    [0, 1], to have a gradient that is true, and to be the same each time and in any
    stack of images.

    Args:
        detector: The detector.
        images: (B, H, W, 3) sRGB in [0, 1], two or more images that are not square, in
            whose upper left part it considers something; None takes smooth noise of 96
            by 128 pixels.
        differentiable: Whether gradients are promised; a `DetectorSpec` says so itself.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
        InvalidValueError: The images cannot be.
    """
    pictures = _noise() if images is None else images
    check_images(pictures)
    if len(pictures) < 2:
        raise InvalidValueError.of(
            "images", "two or more", len(pictures), "give another one"
        )
    contract = Contract(
        f"detector {getattr(detector, 'name', type(detector).__name__)}"
    )
    with contract.promise("names"):
        _names(detector)
    with contract.promise("candidates"):
        for seen in _of_each(detector.candidates(pictures), Candidates, pictures):
            _candidates_of(seen, detector, pictures)
    with contract.promise("detections"):
        for reported in _of_each(detector.detect(pictures), Detections, pictures):
            _detections_of(reported, detector)
    if differentiable:
        _gradients_of(contract, detector, pictures)
    with contract.promise("stacks"):
        _stacks(detector, pictures)
    with contract.promise("sizes"):
        smaller = pictures[:, : pictures.shape[1] // 4 * 3, : pictures.shape[2] // 2]
        for seen in _of_each(detector.candidates(smaller), Candidates, smaller):
            _candidates_of(seen, detector, smaller)
    with contract.promise("determinism"):
        do = "draw nothing, and put the module into evaluation mode (no dropout)"
        expect_repeatable(
            lambda: _tensors(detector, pictures),
            "the same in a second look",
            do,
            atol=1e-5,
        )
    with contract.promise("images"):
        kept = pictures.clone()
        detector.candidates(kept)
        detector.detect(kept)
        expect(
            torch.equal(kept, pictures),
            "images that stay as they are",
            "others",
            "work on a copy",
        )
    for words, refused in _REFUSED.items():
        with contract.promise("refusals"):
            _refuses(detector, words, refused)
    contract.settle()


def _gradients_of(contract: Contract, detector: Any, pictures: Tensor) -> None:
    """A true gradient, and none in the other images of a stack."""
    with contract.promise("gradients"):
        do = (
            "keep the way from the images to the scores free of .detach(), .numpy(),"
            " rounding and 8 bits"
        )
        expect_uphill(
            lambda image: detector.candidates(image[None])[0].scores.sum(),
            pictures[0],
            _PIXEL / 3,
            do=do,
        )
    with contract.promise("each image for itself"):
        leaf = pictures.clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(
            detector.candidates(leaf)[0].scores.sum(), leaf
        )
        do = "do not normalise over the stack: put the module into evaluation mode"
        expect(
            not gradient[1:].any(),
            "no gradient in the other images of a stack",
            "some",
            do,
        )


def _stacks(detector: Any, pictures: Tensor) -> None:
    """Each image gives the same alone."""
    together = _tensors(detector, pictures)
    alone = [
        value for picture in pictures for value in _tensors(detector, picture[None])
    ]
    do = "keep images of a stack apart"
    expect_same(
        together[0::2],
        alone[0::2],
        atol=_BOX,
        expected="the same boxes for a single image",
        do=do,
    )
    expect_same(
        together[1::2],
        alone[1::2],
        atol=_SCORE,
        expected="the same scores for a single image",
        do=do,
    )


def _noise() -> Tensor:
    coarse = torch.rand(3, 3, 8, 10, generator=torch.Generator().manual_seed(0))
    fine = torch.nn.functional.interpolate(
        coarse, size=(96, 128), mode="bicubic"
    ).clamp(0.1, 0.9)
    return fine.permute(0, 2, 3, 1).contiguous()


def _names(detector: Any) -> None:
    missing = [
        name
        for name in ("candidates", "detect")
        if not callable(getattr(detector, name, None))
    ]
    missing += [
        name
        for name in ("name", "classes", "fingerprint", "min_confidence")
        if not hasattr(detector, name)
    ]
    expect(
        not missing,
        "all members of Detector",
        f"no {', '.join(missing)}",
        "see attacks.detectors.Detector",
    )
    expect(
        isinstance(detector, Detector),
        "a Detector",
        type(detector).__name__,
        "see attacks.detectors.Detector",
    )
    expect_text(detector.name, "name")
    classes = detector.classes
    good = (
        isinstance(classes, tuple)
        and classes
        and all(isinstance(label, str) for label in classes)
    )
    expect(
        good and len(set(classes)) == len(classes),
        "a tuple of different classes",
        repr(classes)[:80],
        "name each",
    )
    mark = detector.fingerprint
    do = "make it by attacks.detectors.weights.fingerprint"
    expect(
        isinstance(mark, str) and re.fullmatch(r"[0-9a-f]{16}", mark),
        "16 hex digits as fingerprint",
        mark,
        do,
    )
    least = detector.min_confidence
    expect(
        0 <= least <= 1,
        "a min_confidence in [0, 1]",
        least,
        "give the threshold of `detect`",
    )
    operating = operating_threshold(detector)
    expect(
        least <= operating <= 1,
        f"an operating threshold from min_confidence ({least:g}) to 1",
        operating,
        "state it as `threshold` of the detector or of its DetectorSpec",
    )


def _of_each(seen: Sequence[Any], kind: type[_Report], images: Tensor) -> list[_Report]:
    """What a detector gives, known to be one of a kind for each image."""
    name = kind.__name__
    expect(
        len(seen) == len(images),
        f"{name} of each of {len(images)} images",
        len(seen),
        "give one of each",
    )
    for report in seen:
        expect(
            isinstance(report, kind),
            name,
            type(report).__name__,
            f"return attacks.detectors.{name}",
        )
    return list(seen)


def _candidates_of(seen: Candidates, detector: Any, images: Tensor) -> None:
    scores = seen.scores.detach()
    boxes = seen.boxes.detach()
    expect(
        len(seen),
        "candidates before any threshold",
        "none",
        "leave out thresholds and suppression",
    )
    columns = len(detector.classes)
    expect(
        scores.shape[1] == columns,
        f"a score of each of {columns} classes",
        scores.shape[1],
        "leave background out",
    )
    low = float(scores.min())
    high = float(scores.max())
    expect(
        low >= 0 and high <= 1,
        "scores in [0, 1]",
        f"{low:g} to {high:g}",
        "take a sigmoid or a softmax of logits",
    )
    expect(
        bool(torch.isfinite(boxes).all()),
        "finite boxes",
        "others",
        "look at the decoding of boxes",
    )
    ordered = bool((boxes[..., 2:] >= boxes[..., :2] - 1e-3).all())
    do = "give x0, y0, x1, y1: neither centre and size, nor y first"
    expect(ordered, "boxes whose first corner is the upper left one", "others", do)
    height, width = images.shape[1:3]
    size = boxes.new_tensor([width, height] * 2)
    middle = (boxes[..., :2] + boxes[..., 2:]) / 2
    inside = ((middle >= -1) & (middle <= size[:2] + 1)).all(-1)
    share = float(inside.double().mean())
    do = (
        f"give pixels of the image, which is {width} wide and {height} high, whatever"
        " size the network works at"
    )
    expect(
        share >= 0.9,
        "boxes with their middle in the image",
        f"{share:.0%} of them",
        do,
    )
    expect(
        float(boxes.max()) > 1.5,
        "boxes in pixels",
        f"numbers up to {float(boxes.max()):g}",
        do,
    )


def _detections_of(seen: Detections, detector: Any) -> None:
    unknown = sorted({*seen.labels} - {*detector.classes})
    expect(
        not unknown,
        "labels that are among the classes",
        ", ".join(unknown),
        "translate label numbers to classes",
    )
    scores = seen.scores.detach()
    expect(
        not scores.requires_grad and not seen.scores.requires_grad,
        "no gradient",
        "one",
        "use torch.no_grad()",
    )
    falling = bool((scores[1:] <= scores[:-1] + 1e-6).all())
    expect(
        falling,
        "detections with the best first",
        "another order",
        "sort them by their scores",
    )
    if len(scores):
        low = float(scores.min())
        high = float(scores.max())
        expected = f"scores from min_confidence ({detector.min_confidence:g}) to 1"
        kept = low >= detector.min_confidence - 1e-6 and high <= 1
        expect(
            kept, expected, f"{low:g} to {high:g}", "apply the threshold that it states"
        )


def _tensors(detector: Any, images: Tensor) -> list[Tensor]:
    """Boxes and scores of each image."""
    with torch.no_grad():
        return [
            value
            for seen in _of_each(detector.candidates(images), Candidates, images)
            for value in (seen.boxes, seen.scores)
        ]


def _refuses(detector: Any, words: str, images: Tensor) -> None:
    for look in (detector.candidates, detector.detect):
        try:
            look(images)
        except InvalidValueError:
            continue
        except Exception as error:  # noqa: BLE001  # a plug-in may raise anything
            got = type(error).__name__
        else:
            got = "an answer"
        expect(
            False,
            f"InvalidValueError for {words}",
            got,
            "call attacks.detectors.base.check_images first",
        )
