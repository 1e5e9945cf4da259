"""How far apart the pictures of two methods are, and how far apart their gradients."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras import Camera, RenderFn
from mi_splat.metrics import Perceptual, mse, ssim
from mi_splat.scene import GaussianScene

LEAST_SSIM, LEAST_LPIPS = 11, 32
"""Pixels that the shorter side of a picture needs for a figure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureDistance:
    """How far apart two pictures are, clipped to [0, 1]; None is what was not measured."""

    pixels: int
    mse: float
    ssim: float | None
    lpips: float | None

    @property
    def psnr(self) -> float | None:
        """DB; None for equal pictures, whose PSNR is infinite."""
        return None if self.mse == 0 else -10 * math.log10(self.mse)


def picture_distance(first: Tensor, second: Tensor, *, lpips: Perceptual | None = None) -> PictureDistance:
    """Compare two pictures."""
    first, second = (picture.detach().clamp(0, 1) for picture in (first, second))
    side = min(first.shape[:2])
    return PictureDistance(
        pixels=first.shape[0] * first.shape[1],
        mse=float(mse(first.double(), second.double())),
        ssim=float(ssim(first, second)) if side >= LEAST_SSIM else None,
        lpips=float(lpips(first, second)) if lpips is not None and side >= LEAST_LPIPS else None,
    )


def pooled(distances: Sequence[PictureDistance]) -> PictureDistance:
    """Several pictures as one: the squared error of all their pixels, and means of the other figures."""
    pixels = sum(distance.pixels for distance in distances)
    return PictureDistance(
        pixels=pixels,
        mse=sum(distance.mse * distance.pixels for distance in distances) / pixels,
        ssim=_mean([distance.ssim for distance in distances]),
        lpips=_mean([distance.lpips for distance in distances]),
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def weighting(camera: Camera, seed: int) -> Tensor:
    """(H, W, 3) fixed random weights, normally distributed; with them a picture becomes one number."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(camera.height, camera.width, 3, generator=generator)


def gradients(render: RenderFn, scene: GaussianScene, camera: Camera, weights: Tensor) -> dict[str, Tensor]:
    """The gradient of a weighted sum of a picture's values with respect to each attribute.

    A quaternion's length means nothing, and renderers differ in whether they divide by it. So of the gradient of
    rotations the part along the quaternion is taken out.
    """
    leaves = [tensor.detach().clone().requires_grad_(True) for tensor in scene.tensors()]
    picture = render(GaussianScene(*leaves), camera)
    (picture * weights.to(picture.device)).sum().backward()  # type: ignore[no-untyped-call]
    pairs = zip(ATTRIBUTES, leaves, strict=True)
    by_attribute: dict[str, Tensor] = {
        name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in pairs
    }
    along = (by_attribute["rotations"] * scene.rotations).sum(-1, keepdim=True)
    return {**by_attribute, "rotations": by_attribute["rotations"] - along * scene.rotations}


class GradientAgreement:
    """How well two gradients of one attribute agree, over all cameras that were added."""

    def __init__(self) -> None:
        # Of each Gaussian: first . second, first . first, second . second, |first - second|^2.
        self._sums = torch.zeros(0, 4, dtype=torch.float64)

    def add(self, first: Tensor, second: Tensor) -> None:
        """Take in the gradients, (N, ...) each, of one more picture."""
        x, y = (gradient.detach().cpu().double().reshape(len(gradient), -1) for gradient in (first, second))
        products = ((x, y), (x, x), (y, y), (x - y, x - y))
        sums = torch.stack([(a * b).sum(1) for a, b in products], dim=1)
        self._sums = self._sums + sums if len(self._sums) else sums

    @property
    def cosine(self) -> float | None:
        """Cosine of the angle between them, 1 if they point the same way; None if one is 0 or not finite."""
        return _cosine(*self._sums.sum(0)[:3].tolist())

    @property
    def median_cosine(self) -> float | None:
        """The median of that over the Gaussians to which both give a gradient; None if there is none.

        A few Gaussians with large gradients, needles above all, decide the cosine of the whole; they do not decide it.
        """
        each = [_cosine(*row) for row in self._sums[:, :3].tolist()]
        known = [cosine for cosine in each if cosine is not None]
        return statistics.median(known) if known else None

    @property
    def relative_error(self) -> float | None:
        """Length of the difference over the length of the first; None if that is 0, or something is not finite."""
        _, first, _, gap = self._sums.sum(0).tolist()
        return math.sqrt(gap / first) if first > 0 and math.isfinite(first) and math.isfinite(gap) else None


def _cosine(product: float, first: float, second: float) -> float | None:
    """Cosine of two vectors by their products; None if one is 0 or not finite."""
    lengths = math.sqrt(first * second)
    return max(-1.0, min(1.0, product / lengths)) if lengths > 0 and math.isfinite(lengths) else None
