"""Distances between pictures."""

from __future__ import annotations

import math

import pytest
import torch

from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.metrics import load_lpips, mse, psnr, ssim


def test_known_values() -> None:
    zero, tenth = torch.zeros(4, 5, 3), torch.full((4, 5, 3), 0.1)
    torch.testing.assert_close(mse(tenth, zero).item(), 0.01)
    torch.testing.assert_close(psnr(tenth, zero).item(), 20.0)
    assert psnr(zero, zero).item() == math.inf


def test_differentiable() -> None:
    image = torch.rand(3, 4, 3, dtype=torch.float64, requires_grad=True)
    reference = torch.rand(3, 4, 3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: psnr(x, reference), (image,))


@pytest.mark.parametrize("metric", [mse, psnr, ssim])
def test_shapes_must_agree(metric: object) -> None:
    assert callable(metric)
    with pytest.raises(InvalidValueError, match=r"image: expected shape \(4, 4, 3\), got \(4, 5, 3\)"):
        metric(torch.zeros(4, 5, 3), torch.zeros(4, 4, 3))


def test_ssim_of_equal_noisy_and_opposite_pictures() -> None:
    image = torch.rand(24, 20, 3)
    noisy = (image + 0.1 * torch.randn_like(image)).clamp(0, 1)
    assert ssim(image, image).item() == pytest.approx(1)
    assert -1 < ssim(image, 1 - image).item() < 0 < ssim(image, noisy).item() < 1
    pair = ssim(torch.stack([image, image]), torch.stack([image, noisy]))
    assert pair.item() == pytest.approx((1 + ssim(image, noisy).item()) / 2, abs=1e-5)


def test_ssim_wants_pictures() -> None:
    with pytest.raises(InvalidValueError, match="pass pictures"):
        ssim(torch.zeros(4, 4), torch.zeros(4, 4))


def test_lpips_without_its_network_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    from urllib.error import URLError

    import torchmetrics.image.lpip

    def unreachable(**_: object) -> None:
        raise URLError("no route to host")

    monkeypatch.setattr(torchmetrics.image.lpip, "LearnedPerceptualImagePatchSimilarity", unreachable)
    with pytest.raises(MiSplatError, match="a network that reaches"):
        load_lpips()


def test_lpips_is_a_distance_of_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """With random weights in the place of the hub's: zero for equal pictures, and more for others."""
    import torchvision

    real = torchvision.models.alexnet
    monkeypatch.setattr(torchvision.models, "alexnet", lambda weights=None: real(weights=None))
    torch.manual_seed(0)
    distance = load_lpips()
    image = torch.rand(64, 64, 3)
    assert float(distance(image, image)) == 0
    assert float(distance(image, 1 - image)) > 1e-6
