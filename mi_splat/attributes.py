"""Names of a splat's tensors, and how large their values may be; light, so that options
can be parsed without torch.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, get_args

if TYPE_CHECKING:
    from numpy.typing import NDArray

Attribute = Literal["means", "scales", "rotations", "opacities", "sh"]
"""The name of one tensor of a `GaussianScene`."""

ATTRIBUTES: tuple[Attribute, ...] = get_args(Attribute)
"""The five tensors of a scene, in the order in which renderers take them."""

LARGEST = 1e9
"""Largest coordinate, scale and SH coefficient of a scene, and largest coordinate and
focal length of a camera.

Renderers compute in float32, which ends at 3e38: the fourth power of this number, as in
the determinant of a footprint, is just inside. Coordinates on Earth, whatever their
origin, are below 3e7 metres. At 1e9, float32 steps are 64 units.
"""


def values_hash(values: Mapping[Attribute, NDArray[Any]]) -> str:
    """SHA-256 (hexadecimal) over names, dtypes, shapes and values of the five tensors,
    as contiguous arrays.
    """
    digest = hashlib.sha256()
    for name in ATTRIBUTES:
        value = values[name]
        digest.update(f"{name} torch.{value.dtype} {tuple(value.shape)};".encode())
        digest.update(value.data)
    return digest.hexdigest()
