"""What every adapter of a detector keeps, with pictures, random weights and finite differences for their tests."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from attacks.detectors import torchvision
from attacks.detectors.base import Candidates, Detector
from mi_splat.errors import InvalidValueError

REFUSED = (torch.zeros(1, 3, 32, 40), torch.full((1, 32, 40, 3), 255.0), torch.full((1, 32, 40, 3), torch.nan))
"""Channels first, 0 to 255, and NaN."""


def check_detector(detector: Detector) -> None:
    """Candidates in pixels and [0, 1], alike in any stack and each time, with a true gradient; detections in order."""
    images = pictures(96, 128, count=3) * 0.8 + 0.1
    kept = images.clone()
    with torch.no_grad():
        together, again = detector.candidates(images), detector.candidates(images)
        alone = [detector.candidates(image[None])[0] for image in images]
        (smaller,) = detector.candidates(images[:1, :72, :64])
    for seen, other, single in zip(together, again, alone, strict=True):
        _in_picture(seen, detector, images)
        torch.testing.assert_close(other.scores, seen.scores, atol=1e-5, rtol=0)
        torch.testing.assert_close(single.scores, seen.scores, atol=1e-3, rtol=0)
        torch.testing.assert_close(single.boxes, seen.boxes, atol=0.1, rtol=0)
    _in_picture(smaller, detector, images[:1, :72, :64])
    for reported in detector.detect(images):
        assert {*reported.labels} <= {*detector.classes}
        assert not reported.scores.requires_grad
        assert bool((reported.scores[1:] <= reported.scores[:-1] + 1e-6).all())
        assert all(detector.min_confidence - 1e-6 <= score <= 1 for score in reported.scores.tolist())
    assert torch.equal(images, kept)
    _leads_uphill(detector, images)
    for refused in REFUSED:
        for look in (detector.candidates, detector.detect):
            with pytest.raises(InvalidValueError):
                look(refused)


def _in_picture(seen: Candidates, detector: Detector, images: Tensor) -> None:
    height, width = images.shape[1:3]
    assert seen.scores.shape == (len(seen), len(detector.classes))
    assert 0 <= float(seen.scores.min()) <= float(seen.scores.max()) <= 1
    assert bool((seen.boxes[..., 2:] >= seen.boxes[..., :2] - 1e-3).all())
    middle = (seen.boxes[..., :2] + seen.boxes[..., 2:]) / 2
    inside = (middle >= -1) & (middle <= middle.new_tensor([width, height]) + 1)
    assert float(inside.all(-1).double().mean()) >= 0.9
    assert float(seen.boxes.max()) > 1.5


def _leads_uphill(detector: Detector, images: Tensor) -> None:
    """The gradient of one picture is none in the others of its stack, and as steep as central differences say."""
    leaf = images.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(detector.candidates(leaf)[0].scores.sum(), leaf)
    assert not gradient[1:].any()
    direction = gradient[0] / gradient.abs().max()
    promised, slopes = float((gradient[0].double() * direction.double()).sum()), []
    for step in (0.1 / 255, 1 / 765, 1 / 255):
        with torch.no_grad():
            ends = [detector.candidates((images[0] + way * step * direction)[None])[0] for way in (1, -1)]
        slopes.append(float(ends[0].scores.sum() - ends[1].scores.sum()) / (2 * step))
    assert any(0.5 * promised <= slope <= 2 * promised for slope in slopes), (promised, slopes)


def pictures(height: int, width: int, count: int = 2) -> Tensor:
    """Smooth random pictures of 8 bits."""
    coarse = torch.rand(count, 3, 6, 9, generator=torch.Generator().manual_seed(height))
    fine = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bicubic").clamp(0, 1)
    return (fine.permute(0, 2, 3, 1) * 255).round() / 255


def slope_is_the_gradient(
    measured: Callable[[Tensor], Tensor], image: Tensor, *, step: float = 1e-6, rtol: float = 1e-4, least: float = 0.0
) -> None:
    """The derivative along a random direction is that of central differences.

    The picture is in double precision; the slope has to be above `least`, so that it is none of rounding.
    """
    direction = torch.randn(image.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    leaf = image.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(measured(leaf), leaf)
    with torch.no_grad():
        slope = (measured(image + step * direction) - measured(image - step * direction)) / (2 * step)
    assert float(slope.abs()) > least
    torch.testing.assert_close((gradient * direction).sum(), slope, rtol=rtol, atol=1e-8)


def random_detector(name: str, *, seed: int = 0) -> torchvision.TorchvisionDetector:
    """A detector of random weights; it finds nothing, but its image gradients are not zero.

    Without the warm-up of the BatchNorm statistics, the signal of a random network dies on the way.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = torchvision._build(name)
        warm_up(model.eval())
    torchvision._freeze_norms(name, model)
    return torchvision.wrap(name, model, torchvision._labels(name))


def warm_up(model: nn.Module, *, batches: int = 8, side: int = 64) -> None:
    """Let every BatchNorm average the statistics of a few batches of noise; frozen ones stay."""
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
    transform.min_size, holder.score_thresh = (side,), 1.0  # small, and nothing to suppress
    with torch.no_grad():
        for _ in range(batches):
            model(list(torch.rand(2, 3, side, side)))
    transform.min_size, holder.score_thresh = usual
