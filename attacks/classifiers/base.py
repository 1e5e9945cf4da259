"""What an attack sees of a classifier: scores by class, differentiable in the images.

Images are channels-last sRGB, as the renderer makes them, of any size; a classifier
brings them to its own.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor


@runtime_checkable
class Classifier(Protocol):
    """A classifier with frozen weights in evaluation mode.

    An implementation may have plain attributes where this has properties.
    """

    @property
    def name(self) -> str:
        """For rows and tables."""
        ...

    @property
    def classes(self) -> tuple[str, ...]:
        """The classes that it tells apart, in the order of the second axis of
        `scores`.
        """
        ...

    @property
    def fingerprint(self) -> str:
        """16 hex digits that stand for the weights and classes; in every result."""
        ...

    @property
    def size(self) -> int:
        """Width and height of the images that the network works on, pixels."""
        ...

    def scores(self, images: Tensor) -> Tensor:
        """(B, C) logits, whose softmax is the confidence in each class; differentiable
        in the images.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Raises:
            InvalidValueError: The images have another shape, or values outside [0, 1]
                (`check_images`).
        """
        ...
