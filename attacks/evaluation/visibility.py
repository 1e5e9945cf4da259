"""What attacks and evaluations measure alike: 8-bit pictures, where an object is visible, how a picture changed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.gaussian_subset import GaussianSubset
from mi_splat.cameras import Camera, RenderFn
from mi_splat.selection.visibility import object_weight
from mi_splat.sh import degree_of, sh_basis


def visible_weight(subset: GaussianSubset, camera: Camera, render: RenderFn) -> Tensor:
    """How much of each pixel the object makes up: (H, W) in [0, 1], occlusion by the rest of the scene included.

    As in `object_weight`.
    """
    return object_weight(subset.scene, subset.rows, camera, render)


def visible_box(weight: Tensor, *, threshold: float = 0.5) -> Tensor | None:
    """(4,) pixel box around the pixels of which the object makes up at least `threshold`; None without any."""
    rows, columns = torch.nonzero(weight >= threshold, as_tuple=True)
    if not len(rows):
        return None
    corners = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    return torch.stack(corners).to(torch.float32)


def clamped_fraction(subset: GaussianSubset, camera: Camera) -> float:
    """Fraction of the object's colour channels clamped at 0 from this camera: their SH gradient is exactly zero."""
    means, sh = subset.scene.means[subset.rows].detach(), subset.scene.sh[subset.rows].detach()
    directions = torch.nn.functional.normalize(means - camera.position.to(means), dim=-1)
    basis = sh_basis(directions, degree_of(sh.shape[1]))
    colours = 0.5 + (basis[..., None] * sh).sum(1)
    return float((colours <= 0).to(torch.float64).mean())


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageChange:
    """How far the attacked pictures are from the clean ones; values in [0, 1], all views together.

    Attributes:
        l2: Euclidean norm of the difference, per view (root mean square over views).
        linf: Largest change of a channel of a pixel.
        psnr: dB over whole pictures; None when nothing changed.
        psnr_object: dB over the pixels that are at least half the object's.
        outside: Largest change of a pixel of which the object makes up less than 1/255.
    """

    l2: float
    linf: float
    psnr: float | None
    psnr_object: float | None
    outside: float


def image_change(before: Sequence[Tensor], after: Sequence[Tensor], weights: Sequence[Tensor]) -> ImageChange:
    """Compare (H, W, 3) pictures pairwise; `weights` are (H, W) as from `visible_weight`."""
    gaps = [(b.detach() - a.detach()).double() for b, a in zip(before, after, strict=True)]
    squares = [gap.square() for gap in gaps]
    on_object = [square[weight >= 0.5] for square, weight in zip(squares, weights, strict=True)]
    outside = [gap[weight < 1 / 255].abs() for gap, weight in zip(gaps, weights, strict=True)]
    return ImageChange(
        l2=math.sqrt(sum(float(square.sum()) for square in squares) / len(squares)),
        linf=max(float(gap.abs().max()) for gap in gaps),
        psnr=_psnr(torch.cat([square.flatten() for square in squares])),
        psnr_object=_psnr(torch.cat([square.flatten() for square in on_object])),
        outside=max((float(gap.max()) for gap in outside if gap.numel()), default=0.0),
    )


def _psnr(squares: Tensor) -> float | None:
    error = float(squares.mean()) if squares.numel() else 0.0
    return -10 * math.log10(error) if error > 0 else None
