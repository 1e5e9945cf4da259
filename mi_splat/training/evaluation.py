"""How true a splat's pictures are to views that it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from mi_splat.cameras import RenderFn, View
from mi_splat.metrics import Perceptual, psnr, ssim
from mi_splat.scene import GaussianScene
from mi_splat.training.losses import masked

MOST_PSNR = 120.0
"""dB, far above what pictures of 8 bits can tell apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Means over views, of pictures clipped to [0, 1].

    Attributes:
        psnr: dB; that of a view counts at most `MOST_PSNR`, since equal pictures have none.
        ssim: At most 1.
        lpips: At least 0, less is better; None if it was not asked for.
    """

    psnr: float
    ssim: float
    lpips: float | None = None


@runtime_checkable
class HasMasks(Protocol):
    """Views that may have alpha and masks, as `mi_splat.datasets.Dataset` has."""

    def alpha(self, index: int) -> Tensor | None:
        """(H, W) in [0, 1], over black."""

    def loss_mask(self, index: int, *, files: bool = True) -> Tensor | None:
        """(H, W) in [0, 1], 1 where the picture counts; with files, masks of the set are in it."""


def score(
    scene: GaussianScene, views: Sequence[View], render: RenderFn, *, lpips: Perceptual | None = None
) -> Scores | None:
    """Compare a splat with views; None if there are none. What a photograph does not show at its border is no error.

    Args:
        scene: The splat.
        views: Cameras and true pictures.
        render: The renderer.
        lpips: See `mi_splat.metrics.load_lpips`.
    """
    rows = []
    with torch.no_grad():
        for index, view in enumerate(views):
            image = render(scene, view.camera)[..., :3].clamp(0, 1)  # a fourth channel is alpha
            image = image.to(view.image.device)
            if isinstance(views, HasMasks):
                image = masked(image, view.image, views.loss_mask(index, files=False))
            row = [psnr(image, view.image).clamp(max=MOST_PSNR), ssim(image, view.image)]
            rows.append([float(value) for value in (*row, *([lpips(image, view.image)] if lpips else []))])
    if not rows:
        return None
    return Scores(
        **dict(zip(("psnr", "ssim", "lpips"), [sum(c) / len(c) for c in zip(*rows, strict=True)], strict=False))
    )
