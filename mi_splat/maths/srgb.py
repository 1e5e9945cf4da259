"""The curves of sRGB, in the precision of the values; NumPy alone."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


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
