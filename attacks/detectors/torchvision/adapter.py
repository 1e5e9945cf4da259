"""What the adapters to torchvision's detectors have in common: everything but how candidates are computed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torchvision.models.detection.transform import resize_boxes
from torchvision.ops.boxes import clip_boxes_to_image

from attacks.detectors.base import Candidates, Detections, check_images
from attacks.detectors.classes import BACKGROUND, UNUSED
from attacks.detectors.frozen import FrozenDetector


class TorchvisionDetector(FrozenDetector, ABC):
    """A frozen detector of torchvision behind the `Detector` interface.

    Attributes:
        name: Name in `attacks.detectors.DETECTORS`.
        classes: Foreground classes; COCO's unused numbers ("N/A") are left out of them.
        model: The library's model, in evaluation mode, its weights without gradients.
    """

    def __init__(self, name: str, model: nn.Module, labels: Sequence[str]) -> None:
        """Wrap `model`, whose label number i means labels[i]; labels[0] is the background."""
        self._labels = tuple(labels)
        self._columns = [i for i, label in enumerate(labels) if label not in (BACKGROUND, UNUSED)]
        super().__init__(name, model, [labels[i] for i in self._columns])

    @property
    def min_confidence(self) -> float:
        """See `Detector`; what the model was built with."""
        return float(threshold_holder(self.model).score_thresh)

    @abstractmethod
    def candidates(self, images: Tensor) -> list[Candidates]:
        """Boxes and scores before thresholds, differentiable in the images.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Raises:
            InvalidValueError: The images have another shape, or values outside [0, 1].
        """

    def detect(self, images: Tensor) -> list[Detections]:
        """The library's own forward pass.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Raises:
            InvalidValueError: The images have another shape, or values outside [0, 1].
        """
        with torch.no_grad():
            results = self.model(channels_first(images))
        return [
            Detections(r["boxes"], r["scores"], tuple(self._labels[i] for i in r["labels"].tolist())) for r in results
        ]

    def _in_pixels(self, boxes: Tensor, scores: Tensor, inner: tuple[int, int], size: tuple[int, int]) -> Candidates:
        """Boxes in the network's picture, clipped to it, in pixels of the input.

        Args:
            boxes: (A, C, 4) for each class, or (A, 1, 4) for all of them.
            scores: (A, C) in [0, 1].
            inner: Height and width of the network's picture.
            size: Height and width of the input.
        """
        inside = clip_boxes_to_image(boxes, inner)
        pixels = resize_boxes(inside.reshape(-1, 4), inner, size).reshape(boxes.shape)
        return Candidates(pixels.expand(-1, len(self.classes), -1), scores)


def threshold_holder(model: nn.Module) -> Any:
    """The part of a model that has the score threshold: the box heads of a Faster R-CNN, a one-stage model itself."""
    return getattr(model, "roi_heads", model)


def channels_first(images: Tensor) -> list[Tensor]:
    """The list of pictures that the library's models take.

    Raises:
        InvalidValueError: The images have another shape, or values outside [0, 1].
    """
    check_images(images)
    return list(images.permute(0, 3, 1, 2))
