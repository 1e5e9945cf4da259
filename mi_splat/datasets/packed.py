"""Images in a quarter of their memory: the bytes that they come from, and the few
values that no byte holds.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_FULL = 255
_MOST_SHARE = 1 / 8
"""Share of values beside the 256 above which an image is kept as it is: each of these
takes 8 bytes more.
"""


class Packed(NamedTuple):
    """Values in [0, 1] of any shape, of which nothing is lost.

    An image of 8 bits holds 256 values; where it is blended with a background, at the
    edges of an object, others.
    """

    values: Tensor  # (...) uint8; float32 where packing does not pay
    # (P,) int32, places in the flattened image of values that no byte holds
    places: Tensor
    others: Tensor  # (P,) float32, these values

    @classmethod
    def of(cls, image: Tensor) -> Packed:
        """The image (...), float32."""
        rounded = (image * _FULL).round().clamp(0, _FULL).to(torch.uint8)
        differs = (_unpacked(rounded) != image).flatten()
        places = differs.nonzero()[:, 0].int()
        if len(places) > _MOST_SHARE * image.numel():
            return cls(image, places[:0], image.flatten()[:0])
        return cls(rounded, places, image.flatten()[differs])

    @property
    def bytes(self) -> int:
        """Memory that it takes."""
        return sum(part.numel() * part.element_size() for part in self)

    def unpack(self) -> Tensor:
        """The image, to the bit; do not change it."""
        if self.values.is_floating_point():
            return self.values
        image = _unpacked(self.values)
        image.view(-1)[self.places.long()] = self.others
        return image


def _unpacked(values: Tensor) -> Tensor:
    return values.float() / _FULL
