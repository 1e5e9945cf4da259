"""What an attack sees of a detector: differentiable candidates, and the detections a user would get.

Boxes are x0, y0, x1, y1 in pixels of the input image, whatever size the network works at. Images are channels-last
sRGB, as the renderer makes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor

from mi_splat.errors import InvalidValueError, message


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Everything a detector considered in one image, before any threshold or non-maximum suppression.

    Attributes:
        boxes: (A, C, 4) pixels; candidate a as foreground class c would be reported with boxes[a, c].
        scores: (A, C) in [0, 1], confidence of class `detector.classes[c]`. Both are differentiable in the image.
    """

    boxes: Tensor
    scores: Tensor

    def __post_init__(self) -> None:
        if self.boxes.shape != (*self.scores.shape, 4) or self.scores.ndim != 2:
            raise InvalidValueError(
                message(
                    "Candidates",
                    "boxes (A, C, 4) and scores (A, C)",
                    f"{tuple(self.boxes.shape)} and {tuple(self.scores.shape)}",
                    "give every class of every candidate a box and a score",
                )
            )

    def __len__(self) -> int:
        return len(self.scores)


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """What a user of the library gets for one image, best first.

    Attributes:
        boxes: (D, 4) pixels.
        scores: (D,) in [0, 1].
        labels: D class names.
    """

    boxes: Tensor
    scores: Tensor
    labels: tuple[str, ...]

    def __post_init__(self) -> None:
        count = len(self.labels)
        if self.boxes.shape != (count, 4) or self.scores.shape != (count,):
            raise InvalidValueError(
                message(
                    "Detections",
                    f"{count} boxes and scores for {count} labels",
                    f"{tuple(self.boxes.shape)} and {tuple(self.scores.shape)}",
                    "give every detection a box, a score and a label",
                )
            )

    def __len__(self) -> int:
        return len(self.labels)


@runtime_checkable
class Detector(Protocol):
    """A detector with frozen weights in evaluation mode.

    Attributes:
        name: Key in `attacks.detectors.DETECTORS`.
        classes: Foreground classes by COCO name; the second axis of `Candidates.scores`.
    """

    name: str
    classes: tuple[str, ...]

    def candidates(self, images: Tensor, *, extra: Sequence[Tensor] | None = None) -> list[Candidates]:
        """Boxes and scores before thresholds, differentiable in the images.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].
            extra: One (E, 4) tensor of pixel boxes per image that are scored as well, whether or not the detector's own
                proposals found them: an objective on a known object then always has a candidate there. They are the
                last E candidates of their image.
        """
        ...

    def detect(self, images: Tensor) -> list[Detections]:
        """The library's own detections: thresholds and non-maximum suppression applied.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].
        """
        ...


def check_images(images: Tensor) -> None:
    """Raise unless `images` is a stack that a detector takes.

    Raises:
        InvalidValueError: It is not floating point of shape (B, H, W, 3), or empty.
    """
    if images.ndim != 4 or images.shape[-1] != 3 or not images.is_floating_point() or 0 in images.shape:
        raise InvalidValueError(
            message(
                "images",
                "floating point (B, H, W, 3)",
                f"{images.dtype} {tuple(images.shape)}",
                "stack channels-last sRGB pictures in [0, 1]",
            )
        )
