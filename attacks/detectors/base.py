"""What an attack sees of a detector: differentiable candidates, and the detections a
user would get.

Boxes are x0, y0, x1, y1 in pixels of the input image, whatever size the network works
at. Images are channels-last sRGB, as the renderer makes them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError

_ROUNDING = 1e-3
"""How far values of an image may lie outside [0, 1]."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Everything a detector considered in one image, before any threshold or
    non-maximum suppression.
    """

    # (A, C, 4) pixels; candidate a as foreground class c would be reported with
    # boxes[a, c]
    boxes: Tensor
    # (A, C) in [0, 1], confidence of class `detector.classes[c]`. Both are
    # differentiable in the image
    scores: Tensor

    def __post_init__(self) -> None:
        if self.boxes.shape != (*self.scores.shape, 4) or self.scores.ndim != 2:
            raise InvalidValueError.of(
                "Candidates",
                "boxes (A, C, 4) and scores (A, C)",
                f"{tuple(self.boxes.shape)} and {tuple(self.scores.shape)}",
                "give every class of every candidate a box and a score",
            )

    def __len__(self) -> int:
        return len(self.scores)

    @classmethod
    def of_all_classes(cls, boxes: Tensor, scores: Tensor) -> Candidates:
        """Candidates whose box (A, 4) is the same for every class."""
        return cls(boxes[:, None].expand(-1, scores.shape[1], -1), scores)


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """What a user of the library gets for one image, best first."""

    boxes: Tensor  # (D, 4) pixels
    scores: Tensor  # (D,) in [0, 1]
    labels: tuple[str, ...]  # D class names

    def __post_init__(self) -> None:
        count = len(self.labels)
        if self.boxes.shape != (count, 4) or self.scores.shape != (count,):
            raise InvalidValueError.of(
                "Detections",
                f"{count} boxes and scores for {count} labels",
                f"{tuple(self.boxes.shape)} and {tuple(self.scores.shape)}",
                "give every detection a box, a score and a label",
            )

    def __len__(self) -> int:
        return len(self.labels)


@runtime_checkable
class Detector(Protocol):
    """A detector with frozen weights in evaluation mode.

    An implementation may have plain attributes where this has properties.
    """

    @property
    def name(self) -> str:
        """Key in `attacks.detectors.DETECTORS`."""
        ...

    @property
    def classes(self) -> tuple[str, ...]:
        """Foreground classes by COCO name; the second axis of `Candidates.scores`."""
        ...

    @property
    def fingerprint(self) -> str:
        """16 hex digits that stand for the weights (see
        `attacks.detectors.weights.fingerprint`); in every result.

        Where the network itself comes from a file, as a graph does, it belongs to them.
        """
        ...

    @property
    def min_confidence(self) -> float:
        """Confidence below which `detect` reports nothing."""
        ...

    def candidates(self, images: Tensor) -> list[Candidates]:
        """Boxes and scores before thresholds, differentiable in the images.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Returns:
            For each image all that was considered.

        Raises:
            InvalidValueError: The images have another shape, or values outside [0, 1]
                (`check_images`).
        """
        ...

    def detect(self, images: Tensor) -> list[Detections]:
        """The library's own detections: thresholds and non-maximum suppression applied.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Returns:
            For each image what is reported, the best first.

        Raises:
            InvalidValueError: As in `candidates`.
        """
        ...


def check_images(images: Tensor) -> None:
    """Raise unless `images` is a stack that a detector takes."""
    if not isinstance(images, Tensor):
        got = type(images).__name__
        raise InvalidValueError.of(
            "images", "a torch tensor", got, "use torch.from_numpy or torch.stack"
        )
    if (
        images.ndim != 4
        or images.shape[-1] != 3
        or not images.is_floating_point()
        or 0 in images.shape
    ):
        raise InvalidValueError.of(
            "images",
            "floating point (B, H, W, 3)",
            f"{images.dtype} {tuple(images.shape)}",
            "stack channels-last sRGB images in [0, 1]",
        )
    low, high = (float(value) for value in images.detach().aminmax())
    if not (low >= -_ROUNDING and high <= 1 + _ROUNDING):
        got = f"values from {low:g} to {high:g}"
        raise InvalidValueError.of(
            "images",
            "sRGB in [0, 1]",
            got,
            "divide 8-bit values by 255, and clamp what a renderer gives",
        )


def eight_bits(images: Tensor) -> Tensor:
    """Images in [0, 1] at 8 bits."""
    return (images.detach().clamp(0, 1) * 255).round().to(torch.uint8)
