"""Pictures of a set: 8 bits a channel on the disk, floats in memory; sizes are known from a file's header."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.datasets.errors import DatasetError
from mi_splat.io.picture_files import load_picture, picture_header

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".PNG", ".JPG", ".JPEG")
"""What is appended, in this order, to the name of a picture that has no suffix."""

_MODES = ("1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", "HSV", "LAB")

Pixels = NDArray[np.float32]


def picture_size(path: Path, claimed: tuple[int, int] | None = None) -> tuple[int, int]:
    """Width and height of a picture, read off its header."""
    size, mode = picture_header(path)
    if mode not in _MODES:
        raise DatasetError.of(str(path), "8 bits a channel", f"mode {mode}", "convert it to 8 bits")
    if claimed is not None and size != claimed:
        got, do = f"{size[0]} x {size[1]}", "use the pictures from which the cameras were made"
        raise DatasetError.of(str(path), f"{claimed[0]} x {claimed[1]} pixels", got, do)
    return size


def read_picture(
    path: Path, *, downscale: int, background: tuple[float, float, float], upright: bool = False
) -> tuple[Tensor, Tensor | None]:
    """A picture over a background, and its alpha."""
    picture = load_picture(path, upright=upright)
    has_alpha = "A" in picture.mode or "a" in picture.mode or "transparency" in picture.info
    values = np.asarray(picture.convert("RGBA" if has_alpha else "RGB"), np.float32) / np.float32(255)
    if not has_alpha:
        return torch.from_numpy(area_mean(values, downscale)), None
    alpha = values[..., 3:]
    blended = values[..., :3] * alpha + np.asarray(background, np.float32) * (1 - alpha)
    return torch.from_numpy(area_mean(blended, downscale)), torch.from_numpy(area_mean(alpha, downscale)[..., 0])


def read_mask(path: Path, *, downscale: int) -> Tensor:
    """(H, W) float32 mask in [0, 1] from a picture in its grey values."""
    values = np.asarray(load_picture(path).convert("L"), np.float32)[..., None] / np.float32(255)
    return torch.from_numpy(area_mean(values, downscale)[..., 0])


def area_mean(values: Pixels, factor: int) -> Pixels:
    """(H // factor, W // factor, C) means over squares of pixels; a rest at the right and at the bottom is cut off."""
    if factor == 1:
        return np.ascontiguousarray(values)
    height, width = values.shape[0] // factor, values.shape[1] // factor
    squares = values[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    means: Pixels = squares.mean((1, 3), dtype=np.float64).astype(np.float32)
    return means
