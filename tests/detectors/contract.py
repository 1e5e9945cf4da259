"""What every adapter of a detector keeps to, whatever the library behind it."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.detectors.base import Detector
from mi_splat.errors import InvalidValueError


def pictures(height: int, width: int, count: int = 2) -> Tensor:
    """Smooth random pictures of 8 bits."""
    coarse = torch.rand(count, 3, 6, 9, generator=torch.Generator().manual_seed(height))
    fine = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bicubic").clamp(0, 1)
    return (fine.permute(0, 2, 3, 1) * 255).round() / 255


def holds_the_protocol(detector: Any) -> None:
    """It is a `Detector` of frozen weights in evaluation mode, and refuses what is no picture."""
    known: object = detector
    assert isinstance(known, Detector)
    assert not detector.model.training
    assert not any(p.requires_grad for p in detector.model.parameters())
    assert len(detector.fingerprint) == 16
    for look in (detector.candidates, detector.detect):
        for shape in ((96, 96, 3), (1, 3, 96, 96), (1, 0, 96, 3), (0, 96, 96, 3)):
            with pytest.raises(InvalidValueError, match="images: expected floating point"):
                look(torch.zeros(shape))
        for value, words in OTHER_VALUES.items():
            images = torch.full((1, 32, 32, 3), 0.5)
            images[0, 3, 4, 1] = value
            with pytest.raises(InvalidValueError, match=words):
                look(images)


OTHER_VALUES = {
    255.0: "got values from 0.5 to 255; divide 8-bit",
    1.1: "from 0.5 to 1.1",
    1.005: "from 0.5 to 1.005",
    -0.1: "from -0.1 to 0.5",
    float("nan"): "from nan to nan",
}


def each_picture_has_its_own_gradient(detector: Detector, images: Tensor) -> None:
    """A score of the first picture has a gradient in all that shows it, and none in the second."""
    images = images.requires_grad_()
    detector.candidates(images)[0].scores[:, 0].max().backward()  # type: ignore[no-untyped-call]
    assert images.grad is not None
    assert torch.isfinite(images.grad).all()
    assert float(images.grad[0].abs().max()) > 1e-6
    assert float(images.grad[1].abs().max()) == 0


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
