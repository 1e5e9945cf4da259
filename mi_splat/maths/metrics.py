"""How far apart two images are."""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from mi_splat.errors import InvalidValueError

_WINDOW = 11
"""Pixels on the side of the window of `ssim`."""


def mse(image: Tensor, reference: Tensor) -> Tensor:
    """Mean squared error of two tensors of one shape, a scalar; differentiable."""
    _check_shapes(image, reference)
    return ((image - reference) ** 2).mean()


def psnr(image: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB for values in [0, 1], a scalar; infinite for
    equal images.
    """
    return -10 * torch.log10(mse(image, reference))


def ssim(image: Tensor, reference: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004; Gaussian window with sigma 1.5) for
    values in [0, 1]; differentiable.
    """
    _check_shapes(image, reference)
    if image.ndim not in (3, 4):
        raise InvalidValueError.of(
            "image",
            "shape (H, W, 3) or (B, H, W, 3)",
            tuple(image.shape),
            "pass images",
        )
    a, b = (
        picture.reshape(-1, *picture.shape[-3:]).movedim(-1, 1)
        for picture in (image, reference)
    )
    mean_a = _windowed(a)
    mean_b = _windowed(b)
    variance_a = (_windowed(a * a) - mean_a**2).clamp(min=0)
    variance_b = (_windowed(b * b) - mean_b**2).clamp(min=0)
    covariance = _windowed(a * b) - mean_a * mean_b
    c1 = 0.01**2
    c2 = 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    return (luminance * (2 * covariance + c2) / (variance_a + variance_b + c2)).mean()


def _windowed(planes: Tensor) -> Tensor:
    """(B, C, H, W) means over a Gaussian window around each pixel; the image is
    mirrored at its rim.
    """
    offsets = (
        torch.arange(_WINDOW, device=planes.device, dtype=planes.dtype) - _WINDOW // 2
    )
    weights = torch.exp(-((offsets / 1.5) ** 2) / 2)
    row = (weights / weights.sum()).expand(planes.shape[1], 1, 1, _WINDOW)
    padded = F.pad(planes, 4 * [_WINDOW // 2], mode="reflect")
    return F.conv2d(F.conv2d(padded, row, groups=len(row)), row.mT, groups=len(row))


def _check_shapes(image: Tensor, reference: Tensor) -> None:
    if image.shape != reference.shape:
        expected = f"shape {tuple(reference.shape)}"
        do = "compare images of one size"
        raise InvalidValueError.of("image", expected, tuple(image.shape), do)
