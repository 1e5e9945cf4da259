"""How true a splat's images are to views that it was not trained on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from mi_splat.cameras.camera import RenderFn, View
from mi_splat.maths.metrics import psnr, ssim
from mi_splat.scene import GaussianScene
from mi_splat.training.losses import masked

MOST_PSNR = 120.0
"""dB, far above what images of 8 bits can tell apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Means over views, of images clipped to [0, 1]."""

    # dB; that of a view counts at most `MOST_PSNR`, since equal images have none
    psnr: float
    ssim: float


@runtime_checkable
class HasMasks(Protocol):
    """Views of which some parts may not count, as of `mi_splat.datasets.Dataset`."""

    def loss_mask(self, index: int) -> Tensor | None:
        """(H, W) in [0, 1], 1 where the image of a view counts; None if all of it
        does.
        """


def loss_mask_of(views: Sequence[View], index: int) -> Tensor | None:
    """The mask of a view; None if all of it counts, as of views without masks."""
    if isinstance(views, HasMasks):
        return views.loss_mask(index)
    return None


def score(
    scene: GaussianScene, views: Sequence[View], render: RenderFn
) -> Scores | None:
    """Compare a splat with views: PSNR over the pixels that count, SSIM of images that
    are black elsewhere.
    """
    rows: list[dict[str, float]] = []
    with torch.no_grad():
        for index, view in enumerate(views):
            # a fourth channel is alpha
            image = render(scene, view.camera)[..., :3].clamp(0, 1)
            mask = loss_mask_of(views, index)
            image, truth = (
                masked(image.to(view.image.device), mask),
                masked(view.image, mask),
            )
            best = psnr(image, truth)
            if mask is not None:
                # the masked pixels have no error
                best = best + 10 * mask.mean().clamp(min=1e-6).log10()
            rows.append(
                {
                    "psnr": float(best.clamp(max=MOST_PSNR)),
                    "ssim": float(ssim(image, truth)),
                }
            )
    if not rows:
        return None
    return Scores(
        **{name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}
    )
