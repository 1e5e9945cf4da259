"""The gradient of BatchNorm for a gradient in the order of tokens, as a transformer's attention gives it."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from attacks.detectors.batch_norm import keep_gradients_right


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("layout", ["rows", "tokens", "channels last"])
def test_the_gradient_is_the_scale_of_each_channel(batch: int, layout: str) -> None:
    generator = torch.Generator().manual_seed(0)
    norm = nn.BatchNorm2d(5).eval()
    variance = torch.rand(5, generator=generator) + 0.5
    norm.running_var = variance
    nn.init.uniform_(norm.weight, 0.5, 2, generator=generator)
    keep_gradients_right(nn.Sequential(norm))
    picture = torch.randn(batch, 5, 3, 4, generator=generator).requires_grad_()
    gradient = torch.randn(batch, 5, 3, 4, generator=generator)
    expected = gradient * (norm.weight / torch.sqrt(variance + norm.eps)).view(5, 1, 1)
    if layout == "tokens":
        gradient = gradient.flatten(2).transpose(1, 2).contiguous().transpose(1, 2).view(batch, 5, 3, 4)
    elif layout == "channels last":
        gradient = gradient.contiguous(memory_format=torch.channels_last)
    (found,) = torch.autograd.grad(norm(picture), picture, gradient)
    torch.testing.assert_close(found, expected)


def test_the_forward_pass_stays_and_needs_no_gradient() -> None:
    norm = nn.BatchNorm2d(5).eval()
    picture = torch.randn(1, 5, 3, 4, generator=torch.Generator().manual_seed(0))
    before = norm(picture).detach()
    keep_gradients_right(norm)
    with torch.no_grad():
        assert torch.equal(norm(picture), before)
