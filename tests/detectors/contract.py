"""Images, random weights and finite differences for the tests of adapters; the contract
is `attacks.testing`.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from attacks.detectors import torchvision


def pictures(height: int, width: int, count: int = 2) -> Tensor:
    """Smooth random images of 8 bits."""
    coarse = torch.rand(count, 3, 6, 9, generator=torch.Generator().manual_seed(height))
    fine = torch.nn.functional.interpolate(
        coarse, size=(height, width), mode="bicubic"
    ).clamp(0, 1)
    return (fine.permute(0, 2, 3, 1) * 255).round() / 255


def slope_is_the_gradient(
    measured: Callable[[Tensor], Tensor],
    image: Tensor,
    *,
    step: float = 1e-6,
    rtol: float = 1e-4,
    least: float = 0.0,
) -> None:
    """The derivative along a random direction is that of central differences.

    The image is in double precision; the slope has to be above `least`, so that it is
    none of rounding.
    """
    direction = torch.randn(
        image.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    leaf = image.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(measured(leaf), leaf)
    with torch.no_grad():
        slope = (
            measured(image + step * direction) - measured(image - step * direction)
        ) / (2 * step)
    assert float(slope.abs()) > least
    torch.testing.assert_close(
        (gradient * direction).sum(), slope, rtol=rtol, atol=1e-8
    )


def random_detector(name: str, *, seed: int = 0) -> torchvision.TorchvisionDetector:
    """A detector of random weights; it finds nothing, but its image gradients are not
    zero.

    Without the warm-up of the BatchNorm statistics, the signal of a random network dies
    on the way.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = torchvision._build(name)
        warm_up(model.eval())
    torchvision._freeze_norms(name, model)
    return torchvision.wrap(name, model, torchvision._labels(name))


def warm_up(model: nn.Module, *, batches: int = 8, side: int = 64) -> None:
    """Let every BatchNorm average the statistics of a few batches of noise; frozen ones
    stay.
    """
    norms = [m for m in model.modules() if isinstance(m, nn.BatchNorm2d)]
    if not norms:
        return
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a cumulative average
        norm.train()
    transform: Any = model.transform
    holder = torchvision._threshold_holder(model)
    usual = transform.min_size, holder.score_thresh
    # small, and nothing to suppress
    transform.min_size = (side,)
    holder.score_thresh = 1.0
    with torch.no_grad():
        for _ in range(batches):
            model(list(torch.rand(2, 3, side, side)))
    transform.min_size, holder.score_thresh = usual
