"""The loss that 3DGS trainers descend: L1 and structural dissimilarity, fast enough to
be called at every step.
"""

import functools
import math
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from mi_splat.errors import InvalidValueError

_RADIUS = 5
_SIGMA = 1.5
_C1 = 0.01**2
_C2 = 0.03**2
_TAPS = [math.exp(-0.5 * (k / _SIGMA) ** 2) for k in range(_RADIUS + 1)]
_TAPS = [tap / (2 * sum(_TAPS) - _TAPS[0]) for tap in _TAPS]

_HAS_ONEDNN: bool = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]


def blur(pictures: Tensor) -> Tensor:
    """Gaussian window of 11 x 11 and sigma 1.5 over images (P, H, W, C), zeros
    outside; its own adjoint.

    Two passes of a convolution by channel. No value is moved for them: along a row the
    channels are the rows of an image, and along a column they are neighbours in
    memory, whatever pixel they are of.
    """
    count, height, width, channels = pictures.shape
    if pictures.is_cpu and not (pictures.dtype == torch.float32 and _HAS_ONEDNN):
        return _blur_by_sums(_blur_by_sums(pictures, 1), 2)
    like = pictures.dtype, pictures.device
    rows = F.conv2d(
        pictures, _window(height, *like), padding=(_RADIUS, 0), groups=height
    )
    lanes = math.gcd(width * channels, 16)
    lanes = width * channels if lanes < 8 else lanes
    columns = rows.contiguous().view(count, height, -1, lanes).permute(0, 3, 1, 2)
    blurred = F.conv2d(
        columns, _window(lanes, *like), padding=(_RADIUS, 0), groups=lanes
    )
    return blurred.permute(0, 2, 3, 1).reshape(pictures.shape)


@functools.lru_cache(maxsize=16)
def _window(channels: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(channels, 1, 11, 1) taps, the same ones for each channel."""
    taps = torch.tensor([*_TAPS[:0:-1], *_TAPS], dtype=dtype, device=device)
    return taps.view(1, 1, -1, 1).repeat(channels, 1, 1, 1)


def _blur_by_sums(pictures: Tensor, axis: int) -> Tensor:
    """One pass of `blur` as a sum of shifted images, where torch has no fast
    convolution by channel.
    """
    result = pictures * _TAPS[0]
    for k, tap in enumerate(_TAPS[1:], start=1):
        rest = pictures.shape[axis] - k
        if rest > 0:
            result.narrow(axis, k, rest).add_(pictures.narrow(axis, 0, rest), alpha=tap)
            result.narrow(axis, 0, rest).add_(pictures.narrow(axis, k, rest), alpha=tap)
    return result


class _Photometric(torch.autograd.Function):
    """The loss and, in the same pass, its derivative by the first image in closed
    form.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor, weight: float) -> Tensor:
        difference = x - y
        loss = difference.abs().mean()
        gradient = difference.sign_().mul_((1 - weight) / x.numel())
        if weight:
            similarity, by_mx, by_squares, by_xy = _similarity(x, y)
            loss = (1 - weight) * loss + weight * (1 - similarity)
            by_mx.addcmul_(x, by_squares, value=2).addcmul_(y, by_xy)
            gradient.add_(by_mx, alpha=-weight / x.numel())
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * gradients[0], None, None


def _similarity(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mean SSIM of (H, W, 3) images; its sum's derivatives by x, by x^2 + y^2 and by
    x y, each held fixed apart.
    """
    # Both variances come only as their sum, so that four images are blurred and not
    # five.
    planes = x.new_empty((4, *x.shape))
    planes[0], planes[1] = x, y
    torch.mul(x, x, out=planes[2]).addcmul_(y, y)
    torch.mul(x, y, out=planes[3])
    mx, my, squares, xy = blur(planes).unbind()
    cross = mx * my
    means = torch.addcmul(mx * mx, my, my)
    squares.sub_(means).add_(_C2).reciprocal_()
    r1 = means.add_(_C1).reciprocal_()
    r2 = squares
    structure = xy.sub_(cross).mul_(2).add_(_C2).mul_(r2)
    luminance = cross.mul_(2).add_(_C1).mul_(r1)
    value = luminance * structure
    by_mx, by_squares, by_xy = (grads := planes[:3])
    torch.mul(value, r2, out=by_squares).neg_()
    torch.mul(luminance, r2, out=by_xy).mul_(2)
    torch.mul(structure, r1, out=by_mx).mul_(2).sub_(by_xy).mul_(my)
    by_mx.addcmul_(r1.sub_(r2).mul_(value), mx, value=-2)
    by_mx, by_squares, by_xy = blur(grads).unbind()
    return value.mean(), by_mx, by_squares, by_xy


def photometric_loss(
    image: Tensor, reference: Tensor, *, lambda_dssim: float = 0.2
) -> Tensor:
    """(1 - lambda_dssim) L1 + lambda_dssim (1 - SSIM), equation 7 of Kerbl et al. 2023.

    SSIM is that of Wang et al. 2004 as 3DGS trains with it: window of 11, sigma 1.5,
    zeros outside of the image. `mi_splat.maths.metrics.ssim` is the figure to report;
    the two differ at the image's rim.
    """
    if image.ndim != 3 or image.shape != reference.shape:
        expected = f"shape {tuple(reference.shape)}, (H, W, 3)"
        raise InvalidValueError.of(
            "image", expected, tuple(image.shape), "render it at that size"
        )
    loss: Tensor = _Photometric.apply(image, reference, lambda_dssim)
    return loss


def masked(image: Tensor, mask: Tensor | None) -> Tensor:
    """The image, black where a mask is 0.

    A loss of two images that were masked alike depends neither on what is behind the
    mask, which windows of SSIM would see, nor on what is rendered there.

    Args:
        image: (H, W, 3) image.
        mask: (H, W) in [0, 1], 1 where the image counts; None if all of it does.

    Returns:
        (H, W, 3) image.
    """
    if mask is None:
        return image
    return image * mask.to(image.device)[..., None]
