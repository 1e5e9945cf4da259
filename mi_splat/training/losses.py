"""The loss that 3DGS trainers descend: L1 and structural dissimilarity, fast enough to be called at every step."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError, message

_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2
_TAPS = [math.exp(-0.5 * (k / _SIGMA) ** 2) for k in range(_RADIUS + 1)]
_TAPS = [tap / (2 * sum(_TAPS) - _TAPS[0]) for tap in _TAPS]


def blur(planes: Tensor) -> Tensor:
    """Gaussian window of 11 x 11 and sigma 1.5 over the last two axes of (P, H, W), zeros outside; its own adjoint.

    Shifted sums: on a CPU ten times as fast as torch's convolution of single planes.
    """
    rows = planes * _TAPS[0]
    for k, tap in enumerate(_TAPS[1:], start=1):
        rows[..., k:].add_(planes[..., :-k], alpha=tap)
        rows[..., :-k].add_(planes[..., k:], alpha=tap)
    result = rows * _TAPS[0]
    for k, tap in enumerate(_TAPS[1:], start=1):
        result[..., k:, :].add_(rows[..., :-k, :], alpha=tap)
        result[..., :-k, :].add_(rows[..., k:, :], alpha=tap)
    return result


class _Ssim(torch.autograd.Function):
    """Mean SSIM with its derivative by the first picture in closed form."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, reference: Tensor) -> Tensor:
        x, y = (picture.permute(2, 0, 1).contiguous() for picture in (image, reference))
        # Both variances come only as their sum, so that four planes are blurred and not five.
        mx, my, squares, xy = blur(torch.cat([x, y, torch.addcmul(x * x, y, y), x * y])).chunk(4)
        cross, means = mx * my, torch.addcmul(mx * mx, my, my)
        r1, r2 = (means + _C1).reciprocal_(), squares.sub_(means).add_(_C2).reciprocal_()
        luminance = torch.mul(cross, 2).add_(_C1).mul_(r1)
        structure = xy.sub_(cross).mul_(2).add_(_C2).mul_(r2)
        value = luminance * structure
        by_mx, by_squares, by_xy = (grads := x.new_empty((9, *x.shape[1:]))).chunk(3)
        torch.mul(value, r2, out=by_squares).neg_()
        torch.mul(luminance, r2, out=by_xy).mul_(2)
        torch.mul(structure, r1, out=by_mx).mul_(2).sub_(by_xy).mul_(my)
        by_mx.addcmul_((r1 - r2).mul_(value), mx, value=-2)
        ctx.save_for_backward(x, y, grads)
        return value.mean()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        x, y, grads = ctx.saved_tensors
        by_mx, by_squares, by_xy = blur(grads).chunk(3)
        gradient = (by_mx + 2 * x * by_squares + y * by_xy) * (gradients[0] / x.numel())
        return gradient.permute(1, 2, 0), None


def ssim(image: Tensor, reference: Tensor) -> Tensor:
    """Mean structural similarity as 3DGS trains with it: window of 11, sigma 1.5, zeros outside of the picture.

    `mi_splat.metrics.ssim` is the figure to report; the two differ at the picture's rim.

    Args:
        image: (H, W, 3) sRGB, differentiable.
        reference: (H, W, 3) sRGB, constant.

    Returns:
        A scalar, 1 for equal pictures (Wang et al. 2004).

    Raises:
        InvalidValueError: The shapes differ or are not those of pictures.
    """
    if image.ndim != 3 or image.shape != reference.shape:
        raise InvalidValueError(
            message("image", f"shape {tuple(reference.shape)}, (H, W, 3)", tuple(image.shape), "render it at that size")
        )
    value: Tensor = _Ssim.apply(image, reference)
    return value


def photometric_loss(image: Tensor, reference: Tensor, *, lambda_dssim: float = 0.2) -> Tensor:
    """(1 - lambda_dssim) L1 + lambda_dssim (1 - SSIM), equation 7 of Kerbl et al. 2023.

    Args:
        image: (H, W, 3) sRGB, differentiable.
        reference: (H, W, 3) sRGB in [0, 1].
        lambda_dssim: Weight of the structural term; 0 leaves it out.
    """
    absolute = (image - reference).abs().mean()
    return (
        absolute if lambda_dssim == 0 else (1 - lambda_dssim) * absolute + lambda_dssim * (1 - ssim(image, reference))
    )


def over_background(image: Tensor, colour: Tensor) -> Tensor:
    """A picture with alpha, over black, put over another colour.

    Args:
        image: (H, W, 4) sRGB over black, and alpha.
        colour: (3,) sRGB.

    Returns:
        (H, W, 3).

    Raises:
        InvalidValueError: The picture has no alpha.
    """
    if image.shape[-1] != 4:
        do = "use Renderer(RenderSettings(alpha=True))"
        raise InvalidValueError(message("picture", "four channels, the last one alpha", image.shape[-1], do))
    return image[..., :3] + (1 - image[..., 3:]) * colour


def masked(image: Tensor, reference: Tensor, mask: Tensor | None) -> Tensor:
    """The picture with the reference where a mask is 0, so that no error is left there.

    Args:
        image: (H, W, 3) sRGB, differentiable.
        reference: (H, W, 3) sRGB.
        mask: (H, W) in [0, 1]; None keeps the picture.
    """
    return image if mask is None else reference + mask[..., None] * (image - reference)
