"""Names of a splat's tensors; light, so that options can be parsed without torch."""

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


def values_hash(values: Mapping[Attribute, NDArray[Any]]) -> str:
    """SHA-256 (hexadecimal) over names, dtypes, shapes and values of the five tensors, as contiguous arrays."""
    digest = hashlib.sha256()
    for name in ATTRIBUTES:
        value = values[name]
        digest.update(f"{name} torch.{value.dtype} {tuple(value.shape)};".encode())
        digest.update(value.data)
    return digest.hexdigest()
