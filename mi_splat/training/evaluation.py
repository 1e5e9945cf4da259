"""How true a splat's pictures are to views that it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mi_splat.cameras import RenderFn, View
from mi_splat.metrics import Perceptual, psnr, ssim
from mi_splat.scene import GaussianScene

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


def score(
    scene: GaussianScene, views: Sequence[View], render: RenderFn, *, lpips: Perceptual | None = None
) -> Scores | None:
    """Compare a splat with views; None if there are none.

    Args:
        scene: The splat.
        views: Cameras and true pictures.
        render: The renderer.
        lpips: See `mi_splat.metrics.load_lpips`.
    """
    rows = []
    with torch.no_grad():
        for view in views:
            image = render(scene, view.camera)[..., :3].clamp(0, 1)  # a fourth channel is alpha
            image = image.to(view.image.device)
            row = [psnr(image, view.image).clamp(max=MOST_PSNR), ssim(image, view.image)]
            rows.append([float(value) for value in (*row, *([lpips(image, view.image)] if lpips else []))])
    if not rows:
        return None
    return Scores(
        **dict(zip(("psnr", "ssim", "lpips"), [sum(c) / len(c) for c in zip(*rows, strict=True)], strict=False))
    )
