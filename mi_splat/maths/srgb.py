"""The curves of sRGB (IEC 61966-2-1) for NumPy and torch, in the precision of the
values; Dr.Jit's are in `mi_splat.render.tile.colour`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor


def to_linear(values: NDArray[Any]) -> NDArray[Any]:
    """Linear light of sRGB values."""
    return np.where(
        values <= 0.04045,
        values / 12.92,
        ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4,
    )


def to_srgb(light: NDArray[Any]) -> NDArray[Any]:
    """The sRGB values of linear light."""
    return np.where(
        light <= 0.0031308,
        light * 12.92,
        1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055,
    )


def tensor_to_linear(values: Tensor) -> Tensor:
    """Linear light of sRGB values, differentiable."""
    import torch

    high = ((values.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(values <= 0.04045, values / 12.92, high)


def tensor_to_srgb(light: Tensor) -> Tensor:
    """The sRGB values of linear light, differentiable."""
    import torch

    high = 1.055 * light.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(light <= 0.0031308, 12.92 * light, high)
