"""Any torch detector behind the `Detector` interface: the module, its classes, and what
its outputs mean.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from attacks.detectors.base import (
    Candidates,
    Detections,
    Detector,
    check_images,
    eight_bits,
)
from attacks.detectors.catalogue import DEFAULT_THRESHOLD
from attacks.detectors.vision import torchvision
from attacks.detectors.weights import FrozenModel
from mi_splat.errors import InvalidValueError
from mi_splat.fields import between, checked_number

Decode = Callable[[Any, tuple[int, int]], Iterable[tuple[Tensor, Tensor]]]
"""From what a module gives, and the height and width of the images, to boxes and
scores of each image.
"""

MOST = 100
"""Detections that are reported in an image."""
_ROUNDING = 1e-4
"""How far a score may lie outside [0, 1]."""


def wrap_detector(
    module: nn.Module,
    classes: Sequence[str],
    decode: Decode,
    *,
    name: str = "wrapped",
    prepare: Callable[[Tensor], Any] | None = None,
    min_confidence: float = 0.05,
    max_iou: float = 0.5,
    detect: Callable[[Tensor], list[Detections]] | None = None,
    threshold: float = DEFAULT_THRESHOLD,
) -> Detector:
    """A torch module as a detector that can be attacked and can evaluate attacks.

    The module is frozen in place: evaluation mode, weights without gradients.

    Args:
        module: The network.
        classes: Foreground classes by COCO name, in the order of the columns of the
            scores.
        decode: From what the module gives, and the height and width of the images, to
            one pair for each image: boxes (A, 4), or (A, C, 4) if they differ by
            class, as x0, y0, x1, y1 in pixels of the images; and scores (A, C) in [0,
            1]. These are all that the module considered, before thresholds and
            non-maximum suppression, and differentiable in the images.
        name: Of the detector, in results.
        prepare: From images (B, H, W, 3), sRGB in [0, 1], to what the module takes;
            differentiable. None is (B, 3, H, W) on the device and in the precision of
            the weights.
        min_confidence: Confidence below which nothing is reported, in [0, 1].
        max_iou: Of two boxes of one class that overlap more, the surer is reported.
        detect: What the detector's own program reports in images (B, H, W, 3). None
            takes the candidates in images of 8 bits from `min_confidence` on, and
            suppresses by `max_iou`.
        threshold: Operating threshold: the confidence from which detections count where
            nothing else is given, in [0, 1].

    Returns:
        The detector, as `attack` and `evaluate` take it.

    Raises:
        InvalidValueError: The module is none, there are no classes, one is named twice,
            or a number is not in [0, 1].
        DetectorError: A weight is not a finite number.
    """
    if not isinstance(module, nn.Module):
        got = type(module).__name__
        raise InvalidValueError.of(
            "module",
            "a torch.nn.Module",
            got,
            "put its function into a module's forward",
        )
    names = (classes,) if isinstance(classes, str) else tuple(classes)
    if (
        not names
        or len(set(names)) < len(names)
        or not all(isinstance(label, str) for label in names)
    ):
        raise InvalidValueError.of(
            "classes", "different names", names, "name each column of the scores once"
        )
    allowed = between(0, 1)
    least = float(checked_number("min_confidence", min_confidence, allowed))
    overlap = float(checked_number("max_iou", max_iou, allowed))
    operating = float(checked_number("threshold", threshold, allowed))
    return _Wrapped(
        name,
        module,
        names,
        decode=decode,
        prepare=prepare,
        limits=(least, overlap),
        detect=detect,
        threshold=operating,
    )


class _Wrapped(FrozenModel):
    """See `wrap_detector`."""

    def __init__(
        self,
        name: str,
        module: nn.Module,
        classes: tuple[str, ...],
        *,
        decode: Decode,
        prepare: Callable[[Tensor], Any] | None,
        limits: tuple[float, float],
        detect: Callable[[Tensor], list[Detections]] | None,
        threshold: float,
    ) -> None:
        super().__init__(name, module, classes)
        self.threshold = threshold
        self.min_confidence, self._max_iou = limits
        self._decode = decode
        self._prepare = prepare or self._channels_first
        self._detect = detect

    def candidates(self, images: Tensor) -> list[Candidates]:
        """What `decode` makes of the images, checked."""
        check_images(images)
        pairs = list(
            self._decode(
                self.model(self._prepare(images)), (images.shape[1], images.shape[2])
            )
        )
        if len(pairs) != len(images):
            do = "give a pair of boxes and scores for each image"
            raise InvalidValueError.of(
                f"decode of {self.name}", f"{len(images)} pairs", len(pairs), do
            )
        return [self._checked(boxes, scores, images) for boxes, scores in pairs]

    def _checked(self, boxes: Tensor, scores: Tensor, images: Tensor) -> Candidates:
        what, (count, columns) = (
            f"decode of {self.name}",
            (len(scores), len(self.classes)),
        )
        if scores.shape != (count, columns) or boxes.shape not in (
            (count, 4),
            (count, columns, 4),
        ):
            expected = f"scores (A, {columns}) and boxes (A, 4) or (A, {columns}, 4)"
            got = f"{tuple(scores.shape)} and {tuple(boxes.shape)}"
            raise InvalidValueError.of(
                what, expected, got, "give each candidate a score of every class"
            )
        low, high = (
            (float(value) for value in scores.detach().aminmax())
            if count
            else (0.0, 0.0)
        )
        if not (low >= -_ROUNDING and high <= 1 + _ROUNDING):
            got = f"values from {low:g} to {high:g}"
            raise InvalidValueError.of(
                what, "scores in [0, 1]", got, "take a sigmoid or a softmax of logits"
            )
        if (
            count
            and images.requires_grad
            and torch.is_grad_enabled()
            and not scores.requires_grad
        ):
            do = (
                "leave out .detach(), .numpy() and torch.no_grad() on the way from the"
                " images to the scores"
            )
            raise InvalidValueError.of(what, "scores with a gradient", "none", do)
        if boxes.ndim == 3:
            return Candidates(boxes, scores)
        return Candidates.of_all_classes(boxes, scores)

    def detect(self, images: Tensor) -> list[Detections]:
        """What the detector's own program reports, or the candidates after thresholds
        and suppression.
        """
        check_images(images)
        with torch.no_grad():
            if self._detect is not None:
                return self._detect(images)
            return [
                self._reported(seen)
                for seen in self.candidates(eight_bits(images).to(images) / 255)
            ]

    def _reported(self, candidates: Candidates) -> Detections:
        rows, columns = torch.nonzero(
            candidates.scores >= self.min_confidence, as_tuple=True
        )
        boxes = candidates.boxes[rows, columns]
        scores = candidates.scores[rows, columns]
        kept = torchvision.ops.batched_nms(
            boxes.float(), scores.float(), columns, self._max_iou
        )
        kept = kept[:MOST]  # the surest first
        return Detections(
            boxes[kept],
            scores[kept],
            tuple(self.classes[column] for column in columns[kept].tolist()),
        )

    def _channels_first(self, images: Tensor) -> Tensor:
        weights = (
            part
            for part in itertools.chain(self.model.parameters(), self.model.buffers())
        )
        like = next((part for part in weights if part.is_floating_point()), images)
        return images.permute(0, 3, 1, 2).to(like)
