"""Pictures of 8 bits: what a PNG file keeps of a rendered picture."""

import numpy as np
import torch
from torch import Tensor


def quantise(image: Tensor) -> Tensor:
    """The picture as 8 bits hold it, back in [0, 1]."""
    return (image.detach().clamp(0, 1) * 255).round() / 255


def to_bytes(image: Tensor) -> np.ndarray:
    """(H, W, 3) sRGB in [0, 1] as uint8."""
    return (image.detach().clamp(0, 1) * 255).round().to("cpu", torch.uint8).numpy()


def through_png(image: Tensor) -> Tensor:
    """The picture as an 8-bit PNG keeps it, which loses nothing else; (H, W, 3) float32 in [0, 1]."""
    return torch.from_numpy(to_bytes(image).astype(np.float32) / 255).to(image.device)
