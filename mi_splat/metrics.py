"""How far apart two pictures are."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError, MiSplatError, message


def mse(image: Tensor, reference: Tensor) -> Tensor:
    """Mean squared error of two tensors of one shape, a scalar; differentiable.

    Raises:
        InvalidValueError: The shapes differ.
    """
    _check_shapes(image, reference)
    return ((image - reference) ** 2).mean()


def psnr(image: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB for values in [0, 1], a scalar; infinite for equal pictures.

    Args:
        image: (..., H, W, 3) sRGB in [0, 1].
        reference: Same shape.

    Raises:
        InvalidValueError: The shapes differ.
    """
    return -10 * torch.log10(mse(image, reference))


def ssim(image: Tensor, reference: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004; Gaussian window with sigma 1.5) for values in [0, 1]; differentiable.

    Args:
        image: (H, W, 3) or (B, H, W, 3) sRGB in [0, 1].
        reference: Same shape.

    Returns:
        A scalar, 1 for equal pictures.

    Raises:
        InvalidValueError: The shapes differ or are not those of pictures.
        MiSplatError: torchmetrics is not installed.
    """
    _check_shapes(image, reference)
    if image.ndim not in (3, 4):
        raise InvalidValueError(
            message("image", "shape (H, W, 3) or (B, H, W, 3)", tuple(image.shape), "pass pictures")
        )
    try:
        from torchmetrics.functional.image import structural_similarity_index_measure as measure
    except ImportError as error:
        raise MiSplatError(
            message("ssim", "the package torchmetrics", "no such package", "pip install torchmetrics")
        ) from error
    planes = [picture.reshape(-1, *picture.shape[-3:]).movedim(-1, 1) for picture in (image, reference)]
    return cast("Tensor", measure(planes[0], planes[1], data_range=1.0))


def _check_shapes(image: Tensor, reference: Tensor) -> None:
    if image.shape != reference.shape:
        raise InvalidValueError(
            message("image", f"shape {tuple(reference.shape)}", tuple(image.shape), "compare pictures of one size")
        )
