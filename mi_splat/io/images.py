"""Pictures of 8 bits: what a PNG file keeps of a rendered picture."""

import io

import numpy as np
import torch
from PIL import Image
from torch import Tensor


def quantise(image: Tensor) -> Tensor:
    """The picture as 8 bits hold it, back in [0, 1]."""
    return (image.detach().clamp(0, 1) * 255).round() / 255


def to_bytes(image: Tensor) -> np.ndarray:
    """(H, W, 3) sRGB in [0, 1] as uint8."""
    return (image.detach().clamp(0, 1) * 255).round().to("cpu", torch.uint8).numpy()


def through_png(image: Tensor) -> Tensor:
    """The picture after it was written as an 8-bit PNG and read again; (H, W, 3) float32 in [0, 1]."""
    buffer = io.BytesIO()
    Image.fromarray(to_bytes(image)).save(buffer, format="PNG")
    buffer.seek(0)
    with Image.open(buffer) as read:
        pixels = np.asarray(read.convert("RGB"), dtype=np.float32) / 255
    return torch.from_numpy(pixels).to(image.device)
