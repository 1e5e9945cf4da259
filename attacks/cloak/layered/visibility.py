"""How much each Gaussian of a splat has to do with each picture of it: exact, by differentiation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mi_splat.cameras import Camera, RenderFn
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc


def contributions(scene: GaussianScene, rows: Tensor, cameras: Sequence[Camera], *, render: RenderFn) -> Tensor:
    """(M, D) pixels that each of M Gaussians contributes to the pictures of D cameras.

    A picture is linear in the colours: a pixel is the sum over Gaussians of colour times opacity there times what
    those in front let through. The derivative of a picture's sum after a Gaussian's colour is thus its blending weight,
    summed over pixels, and what is hidden by others counts nothing.

    Args:
        scene: N Gaussians.
        rows: (M,) indices of those that are asked for.
        cameras: D cameras.
        render: The renderer, differentiable after SH.
    """
    weights = []
    grey = torch.zeros_like(scene.sh[:, :1])
    step = float(colour_to_dc(torch.tensor(1.0)) - colour_to_dc(torch.tensor(0.0)))
    for camera in cameras:
        sh = grey.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(render(scene.replace(sh=sh), camera).sum(), sh)
        weights.append(gradient[rows, 0].mean(-1) * step)
    return torch.stack(weights, 1)
