"""How true a splat's pictures are to views that it was not trained on."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mi_splat.cameras import RenderFn, View
from mi_splat.metrics import psnr, ssim
from mi_splat.scene import GaussianScene

MOST_PSNR = 120.0
"""dB, far above what pictures of 8 bits can tell apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Means over views, of pictures clipped to [0, 1]."""

    psnr: float  # dB; that of a view counts at most `MOST_PSNR`, since equal pictures have none
    ssim: float


def score(scene: GaussianScene, views: Sequence[View], render: RenderFn) -> Scores | None:
    """Compare a splat with views."""
    rows: list[dict[str, float]] = []
    with torch.no_grad():
        for view in views:
            image = render(scene, view.camera)[..., :3].clamp(0, 1)  # a fourth channel is alpha
            image = image.to(view.image.device)
            best = float(psnr(image, view.image).clamp(max=MOST_PSNR))
            rows.append({"psnr": best, "ssim": float(ssim(image, view.image))})
    if not rows:
        return None
    return Scores(**{name: sum(row[name] for row in rows) / len(rows) for name in rows[0]})
