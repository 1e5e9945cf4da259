"""The curve between sRGB values and linear intensities (IEC 61966-2-1)."""

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.assets.mesh import Floats


def to_linear(colour: ArrayLike) -> Floats:
    """Linear intensities from sRGB values."""
    value = np.asarray(colour, np.float64)
    low, high = value / 12.92, (np.maximum(value, 0) + 0.055) / 1.055
    return np.where(value <= 0.04045, low, high**2.4).astype(np.float32)


def to_srgb(intensity: ArrayLike) -> Floats:
    """The sRGB values, clipped to [0, 1], from linear intensities."""
    value = np.clip(np.asarray(intensity, np.float64), 0, 1)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055).astype(np.float32)
