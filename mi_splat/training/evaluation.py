"""How true a splat's pictures are to views that it was not trained on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from mi_splat.cameras import RenderFn, View
from mi_splat.metrics import psnr, ssim
from mi_splat.scene import GaussianScene
from mi_splat.training.losses import masked

MOST_PSNR = 120.0
"""dB, far above what pictures of 8 bits can tell apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Means over views, of pictures clipped to [0, 1]."""

    psnr: float  # dB; that of a view counts at most `MOST_PSNR`, since equal pictures have none
    ssim: float
    corrected_psnr: float | None = None  # after the affine map of colours by which each picture is nearest to its view


@runtime_checkable
class HasMasks(Protocol):
    """Views that may have masks, as `mi_splat.datasets.Dataset` has."""

    def loss_mask(self, index: int, *, files: bool = True) -> Tensor | None:
        """(H, W) in [0, 1], 1 where the picture counts; with files, masks of the set are in it."""


def score(
    scene: GaussianScene,
    views: Sequence[View],
    render: RenderFn,
    *,
    corrected: bool = False,
) -> Scores | None:
    """Compare a splat with views. What a photograph does not show at its border is no error."""
    rows: list[dict[str, float]] = []
    with torch.no_grad():
        for index, view in enumerate(views):
            image = render(scene, view.camera)[..., :3].clamp(0, 1)  # a fourth channel is alpha
            image = image.to(view.image.device)
            mask = views.loss_mask(index, files=False) if isinstance(views, HasMasks) else None
            image = masked(image, view.image, mask)
            row = {"psnr": _psnr(image, view.image), "ssim": float(ssim(image, view.image))}
            if corrected:
                row["corrected_psnr"] = _psnr(_with_colours_of(view.image, image, mask), view.image)
            rows.append(row)
    if not rows:
        return None
    return Scores(**{name: sum(row[name] for row in rows) / len(rows) for name in rows[0]})


def _psnr(image: Tensor, truth: Tensor) -> float:
    return float(psnr(image, truth).clamp(max=MOST_PSNR))


def _with_colours_of(truth: Tensor, image: Tensor, mask: Tensor | None) -> Tensor:
    """(H, W, 3) the picture after the affine map by which it comes nearest to another, where that counts."""
    colours = torch.nn.functional.pad(image.double(), (0, 1), value=1.0)
    counts = torch.ones_like(colours[..., :1]) if mask is None else mask[..., None].to(colours)
    weighted = (counts * colours).flatten(0, 1)
    squares, products = weighted.T @ colours.flatten(0, 1), weighted.T @ truth.double().flatten(0, 1)
    transform = torch.linalg.pinv(squares, hermitian=True) @ products  # on any device, and for a picture of one colour
    return masked((colours @ transform).clamp(0, 1).to(image), truth, mask)
