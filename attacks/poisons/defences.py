"""What a victim may do against images that make its splat large: filters of images,
and pruning of the splat.

Filters are differentiable, so that an attacker may look through them. None changes an
image of one colour.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from attacks.cloak.setup import SET
from attacks.poisons.config import FilterConfig, FrequencyPruningConfig, PictureFilter
from mi_splat.cameras.camera import Camera, View, cameras_of, project_points
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat, save_splat
from mi_splat.scene import GaussianScene
from mi_splat.training.resume import SPLAT

if TYPE_CHECKING:
    from mi_splat.ledger import Out

_BLUR_RADIUS = 2
"""Of the blur's window of 5 x 5."""
_LEVELS = 2
"""Of the wavelet transform."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PrunedConfig:
    """A job that prunes the finished splat of a victim by frequency."""

    prune: FrequencyPruningConfig
    near: float


def run(config: PrunedConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Prune the `splat` by the cameras of its training `pictures`."""
    views = load_dataset(inputs["pictures"] / SET, split="train")
    save_splat(
        frequency_pruned(
            load_splat(inputs["splat"]), views, config.prune, near=config.near
        ),
        out / SPLAT,
    )


def filtered(image: Tensor, config: FilterConfig) -> Tensor:
    """An image after a filter."""
    return _FILTERS[config.name](image, config.amount).clamp(0, 1)


def blurred(image: Tensor, sigma: float = 1.5) -> Tensor:
    """A Gaussian window of 5 x 5 over an image (H, W, 3), whose rim goes on
    outside.
    """
    taps = [
        math.exp(-0.5 * (k / sigma) ** 2)
        for k in range(-_BLUR_RADIUS, _BLUR_RADIUS + 1)
    ]
    return _smoothed(image, [tap / sum(taps) for tap in taps])


def low_frequencies(image: Tensor, share: float = 0.5) -> Tensor:
    """An image (H, W, 3) of its lowest spatial frequencies alone, by FFT of the
    image and its mirror images.
    """
    height, width, _ = image.shape
    mirrored = torch.cat([image, image.flip(0)])
    # without it, opposite rims would bleed into each other
    mirrored = torch.cat([mirrored, mirrored.flip(1)], dim=1)
    spectrum = torch.fft.rfft2(mirrored, dim=(0, 1))
    low_rows = torch.fft.fftfreq(2 * height, device=image.device).abs() <= share / 2
    low_columns = torch.fft.rfftfreq(2 * width, device=image.device) <= share / 2
    kept = spectrum * (low_rows[:, None] & low_columns)[..., None]
    low: Tensor = torch.fft.irfft2(kept, s=(2 * height, 2 * width), dim=(0, 1))
    return low[:height, :width]


def shrunk_detail(image: Tensor, steps: float = 16.0) -> Tensor:
    """An image (H, W, 3) whose fine detail is shrunk by soft thresholds, as wavelet
    denoising does.

    DefenseSplat (arXiv 2602.19323) takes detail bands of a wavelet transform out of
    training images. Here the transform is the undecimated one "a trous" of the kernel
    (1, 2, 1)/4, of two levels, which leaves no blocks, and strong edges stay.
    """
    coarse = image
    detail = torch.zeros_like(image)
    for level in range(_LEVELS):
        smoother = _smoothed(coarse, [0.25, 0.5, 0.25], apart=2**level)
        detail = detail + F.softshrink(coarse - smoother, steps / 255)
        coarse = smoother
    return coarse + detail


def finest_samples(
    scene: GaussianScene, cameras: Sequence[Camera], *, near: float
) -> Tensor:
    """Size of a pixel at each Gaussian, in its finest camera (Mip-Splatting, Yu et al.
    2024, equation 7).
    """
    finest = torch.full_like(scene.opacities.detach(), torch.inf)
    for camera in cameras:
        pixels, depths = project_points(scene.means.detach(), camera)
        inside = (
            (pixels >= 0) & (pixels <= pixels.new_tensor([camera.width, camera.height]))
        ).all(1) & (depths > near)
        finest = torch.where(
            inside, torch.minimum(finest, depths / max(camera.fx, camera.fy)), finest
        )
    return finest


def frequency_pruned(
    scene: GaussianScene,
    views: Sequence[View],
    config: FrequencyPruningConfig,
    *,
    near: float,
) -> GaussianScene:
    """A splat without what is finer than its cameras can sample.

    Spectral Defense (arXiv 2603.12796) prunes Gaussians of high frequency. What is high
    is taken from the sampling of the training cameras here. A surface needs Gaussians
    that are thin along its normal, so that the middle axis counts and not the shortest.
    What no camera sees stays.
    """
    finest = finest_samples(scene, cameras_of(views), near=near)
    middle = scene.scales.detach().sort(dim=1).values[:, 1]
    kept = ~(middle < config.samples * finest) | finest.isinf()
    if not bool(kept.any()):
        do = "lower samples"
        raise InvalidValueError(
            message("pruning by frequency", "Gaussians that are left", "none", do)
        )
    return scene.select(kept)


def _smoothed(image: Tensor, taps: Sequence[float], *, apart: int = 1) -> Tensor:
    """An image (H, W, 3) under one window along columns and rows; its rim goes on
    outside.
    """
    margin, (height, width, _) = apart * (len(taps) // 2), image.shape
    padded = F.pad(image.permute(2, 0, 1), (margin,) * 4, mode="replicate")
    rows = sum(
        tap * padded[:, k * apart : k * apart + height] for k, tap in enumerate(taps)
    )
    assert isinstance(rows, Tensor)
    columns = sum(
        tap * rows[:, :, k * apart : k * apart + width] for k, tap in enumerate(taps)
    )
    assert isinstance(columns, Tensor)
    return columns.permute(1, 2, 0)


_FILTERS: dict[PictureFilter, Callable[[Tensor, float], Tensor]] = {
    "blur": blurred,
    "fourier": low_frequencies,
    "wavelet": shrunk_detail,
}
