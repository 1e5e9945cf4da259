"""The contract of a detector (`attacks.detectors.Detector`)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from attacks.detectors.base import Candidates, Detections, Detector, check_images
from attacks.testing.promises import Contract, expect, expect_repeatable, expect_same, expect_text, expect_uphill
from mi_splat.errors import InvalidValueError

_Report = TypeVar("_Report", Candidates, Detections)
_PIXEL = 1 / 255
_BOX, _SCORE = 0.1, 1e-3
"""How far boxes (pixels) and scores may be apart for the same picture in another stack."""
_REFUSED = {
    "pictures with channels first": torch.zeros(1, 3, 32, 40),
    "values up to 255": torch.full((1, 32, 40, 3), 255.0),
    "NaN": torch.full((1, 32, 40, 3), torch.nan),
}


def check_detector(detector: Any, *, images: Tensor | None = None) -> None:
    """Raise unless a detector keeps its contract.

    It is asked for a few pictures: what it considers has to lie in the picture and in [0, 1], to have a gradient that
    is true, and to be the same each time and in any stack of pictures.

    Args:
        detector: The detector.
        images: (B, H, W, 3) sRGB in [0, 1], two or more pictures that are not square, of which it considers something;
            None takes smooth noise of 96 by 128 pixels.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
        InvalidValueError: The pictures cannot be.
    """
    pictures = _noise() if images is None else images
    check_images(pictures)
    if len(pictures) < 2:
        raise InvalidValueError.of("images", "two or more", len(pictures), "give another one")
    contract = Contract(f"detector {getattr(detector, 'name', type(detector).__name__)}")
    with contract.promise("names"):
        _names(detector)
    with contract.promise("candidates"):
        for seen in _of_each(detector.candidates(pictures), Candidates, pictures):
            _candidates_of(seen, detector, pictures)
    with contract.promise("detections"):
        for reported in _of_each(detector.detect(pictures), Detections, pictures):
            _detections_of(reported, detector)
    with contract.promise("gradients"):
        do = "keep the way from the pictures to the scores free of .detach(), .numpy(), rounding and 8 bits"
        expect_uphill(lambda image: detector.candidates(image[None])[0].scores.sum(), pictures[0], _PIXEL / 3, do=do)
    with contract.promise("each picture for itself"):
        leaf = pictures.clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(detector.candidates(leaf)[0].scores.sum(), leaf)
        do = "do not normalise over the stack: put the module into evaluation mode"
        expect(not gradient[1:].any(), "no gradient in the other pictures of a stack", "some", do)
    with contract.promise("stacks"):
        together = _tensors(detector, pictures)
        alone = [value for picture in pictures for value in _tensors(detector, picture[None])]
        do = "keep pictures of a stack apart"
        expect_same(together[0::2], alone[0::2], atol=_BOX, expected="the same boxes for a picture alone", do=do)
        expect_same(together[1::2], alone[1::2], atol=_SCORE, expected="the same scores for a picture alone", do=do)
    with contract.promise("sizes"):
        smaller = pictures[:, : pictures.shape[1] // 4 * 3, : pictures.shape[2] // 2]
        for seen in _of_each(detector.candidates(smaller), Candidates, smaller):
            _candidates_of(seen, detector, smaller)
    with contract.promise("determinism"):
        do = "draw nothing, and put the module into evaluation mode (no dropout)"
        expect_repeatable(lambda: _tensors(detector, pictures), "the same in a second look", do, atol=1e-5)
    with contract.promise("pictures"):
        kept = pictures.clone()
        detector.candidates(kept)
        detector.detect(kept)
        expect(torch.equal(kept, pictures), "pictures that stay as they are", "others", "work on a copy")
    for words, refused in _REFUSED.items():
        with contract.promise("refusals"):
            _refuses(detector, words, refused)
    contract.settle()


def _noise() -> Tensor:
    coarse = torch.rand(3, 3, 8, 10, generator=torch.Generator().manual_seed(0))
    fine = torch.nn.functional.interpolate(coarse, size=(96, 128), mode="bicubic").clamp(0.1, 0.9)
    return fine.permute(0, 2, 3, 1).contiguous()


def _names(detector: Any) -> None:
    missing = [name for name in ("candidates", "detect") if not callable(getattr(detector, name, None))]
    missing += [name for name in ("name", "classes", "fingerprint", "min_confidence") if not hasattr(detector, name)]
    expect(not missing, "all members of Detector", f"no {', '.join(missing)}", "see attacks.detectors.Detector")
    expect(isinstance(detector, Detector), "a Detector", type(detector).__name__, "see attacks.detectors.Detector")
    expect_text(detector.name, "name")
    classes = detector.classes
    good = isinstance(classes, tuple) and classes and all(isinstance(label, str) for label in classes)
    expect(good and len(set(classes)) == len(classes), "a tuple of different classes", repr(classes)[:80], "name each")
    mark = detector.fingerprint
    do = "make it by attacks.detectors.weights.fingerprint"
    expect(isinstance(mark, str) and re.fullmatch(r"[0-9a-f]{16}", mark), "16 hex digits as fingerprint", mark, do)
    least = detector.min_confidence
    expect(0 <= least <= 1, "a min_confidence in [0, 1]", least, "give the threshold of `detect`")


def _of_each(seen: Sequence[Any], kind: type[_Report], images: Tensor) -> list[_Report]:
    """What a detector gives, known to be one of a kind for each picture."""
    name = kind.__name__
    expect(len(seen) == len(images), f"{name} of each of {len(images)} pictures", len(seen), "give one of each")
    for report in seen:
        expect(isinstance(report, kind), name, type(report).__name__, f"return attacks.detectors.{name}")
    return list(seen)


def _candidates_of(seen: Candidates, detector: Any, images: Tensor) -> None:
    scores, boxes = seen.scores.detach(), seen.boxes.detach()
    expect(len(seen), "candidates before any threshold", "none", "leave out thresholds and suppression")
    columns = len(detector.classes)
    expect(scores.shape[1] == columns, f"a score of each of {columns} classes", scores.shape[1], "leave background out")
    low, high = float(scores.min()), float(scores.max())
    expect(low >= 0 and high <= 1, "scores in [0, 1]", f"{low:g} to {high:g}", "take a sigmoid or a softmax of logits")
    expect(bool(torch.isfinite(boxes).all()), "finite boxes", "others", "look at the decoding of boxes")
    ordered = bool((boxes[..., 2:] >= boxes[..., :2] - 1e-3).all())
    do = "give x0, y0, x1, y1: neither centre and size, nor y first"
    expect(ordered, "boxes whose first corner is the upper left one", "others", do)
    height, width = images.shape[1:3]
    size = boxes.new_tensor([width, height] * 2)
    middle = (boxes[..., :2] + boxes[..., 2:]) / 2
    inside = ((middle >= -1) & (middle <= size[:2] + 1)).all(-1)
    share = float(inside.double().mean())
    do = f"give pixels of the picture, which is {width} wide and {height} high, whatever size the network works at"
    expect(share >= 0.9, "boxes with their middle in the picture", f"{share:.0%} of them", do)
    expect(float(boxes.max()) > 1.5, "boxes in pixels", f"numbers up to {float(boxes.max()):g}", do)


def _detections_of(seen: Detections, detector: Any) -> None:
    unknown = sorted({*seen.labels} - {*detector.classes})
    expect(not unknown, "labels that are among the classes", ", ".join(unknown), "translate label numbers to classes")
    scores = seen.scores.detach()
    expect(not scores.requires_grad and not seen.scores.requires_grad, "no gradient", "one", "use torch.no_grad()")
    falling = bool((scores[1:] <= scores[:-1] + 1e-6).all())
    expect(falling, "detections with the best first", "another order", "sort them by their scores")
    if len(scores):
        low, high = float(scores.min()), float(scores.max())
        expected = f"scores from min_confidence ({detector.min_confidence:g}) to 1"
        kept = low >= detector.min_confidence - 1e-6 and high <= 1
        expect(kept, expected, f"{low:g} to {high:g}", "apply the threshold that it states")


def _tensors(detector: Any, images: Tensor) -> list[Tensor]:
    """Boxes and scores of each picture."""
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
        expect(False, f"InvalidValueError for {words}", got, "call attacks.detectors.base.check_images first")
