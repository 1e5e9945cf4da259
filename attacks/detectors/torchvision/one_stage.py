"""Adapter to torchvision's one-stage detectors: RetinaNet, FCOS, SSD and SSDlite, published or built of their parts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor
from torchvision.models.detection import FCOS, RetinaNet
from torchvision.models.detection.ssd import SSD

from attacks.detectors.base import Candidates
from attacks.detectors.torchvision.adapter import TorchvisionDetector, channels_first

Outputs = Mapping[str, Tensor]
"""What a head gives: "cls_logits" (B, A, L), "bbox_regression" (B, A, 4), and FCOS "bbox_ctrness" (B, A, 1)."""


class OneStageDetector(TorchvisionDetector):
    """A frozen one-stage detector behind the `Detector` interface; see `TorchvisionDetector` for its attributes."""

    def __init__(self, name: str, model: RetinaNet | FCOS | SSD, labels: Sequence[str]) -> None:
        """As in `TorchvisionDetector`."""
        super().__init__(name, model, labels)
        self._scores = _scores_of(model)

    def candidates(self, images: Tensor) -> list[Candidates]:
        """As in `TorchvisionDetector`: every anchor as every class, with the one box that it has for all of them."""
        pictures = channels_first(images)
        size = (images.shape[1], images.shape[2])
        batch, _ = self.model.transform(pictures)
        features = self.model.backbone(batch.tensors)
        maps = list(features.values()) if isinstance(features, dict) else [features]
        outputs = self.model.head(maps)
        scores = self._scores(outputs)[:, :, self._columns]
        rows = zip(outputs["bbox_regression"], self.model.anchor_generator(batch, maps), strict=True)
        boxes = [self._decoded(deltas, anchors) for deltas, anchors in rows]
        return [
            self._in_pixels(b[:, None], s, inner, size)
            for b, s, inner in zip(boxes, scores, batch.image_sizes, strict=True)
        ]

    def _decoded(self, deltas: Tensor, anchors: Tensor) -> Tensor:
        """(A, 4) boxes in the network's picture."""
        coder: Any = self.model.box_coder
        decode: Callable[[Tensor, Tensor], Tensor] = getattr(coder, "decode_single", coder.decode)
        return decode(deltas, anchors)


def _sigmoid(outputs: Outputs) -> Tensor:
    """RetinaNet's: each class for itself."""
    return torch.sigmoid(outputs["cls_logits"])


def _with_centreness(outputs: Outputs) -> Tensor:
    """FCOS': the geometric mean of class and centreness.

    In logarithms, for the library's square root has no finite gradient where the product rounds to zero.
    """
    return torch.exp((F.logsigmoid(outputs["cls_logits"]) + F.logsigmoid(outputs["bbox_ctrness"])) / 2)


def _softmax(outputs: Outputs) -> Tensor:
    """SSD's: one class, or the background."""
    return torch.softmax(outputs["cls_logits"], -1)


def _scores_of(model: RetinaNet | FCOS | SSD) -> Callable[[Outputs], Tensor]:
    """How a model of this kind computes (B, A, L) scores."""
    kinds = ((RetinaNet, _sigmoid), (FCOS, _with_centreness), (SSD, _softmax))
    for kind, scores in kinds:
        if isinstance(model, kind):
            return scores
    raise TypeError(f"RetinaNet, FCOS or SSD expected, got {type(model).__name__}")
