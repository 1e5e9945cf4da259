"""The statistics of centres that densification goes by."""

from __future__ import annotations

import pytest
import torch

from mi_splat.cameras import Camera, look_at
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene, merge
from tests import oracle

CAMERA = Camera(to_world=look_at((4, 0, 1), (0, 0, 0)), focal=50.0, width=40, height=40)


def test_screen_gradient_is_the_gradient_of_the_centre() -> None:
    """Weights that rise by (1, 2) a pixel: moving the only centre changes the weighted sum by the picture's sum."""
    scene = GaussianScene(
        torch.tensor([[0.1, 0.2, 0.0]]),
        torch.tensor([[0.3, 0.2, 0.25]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.tensor([0.7]),
        torch.full((1, 1, 3), 0.8),
    )
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(40.0), indexing="ij")
    screen_gradients = ScreenGradients()
    leaves = GaussianScene.unchecked(*(t.clone().requires_grad_(True) for t in scene.tensors()))
    image = Renderer(RenderSettings(), screen_gradients=screen_gradients)(leaves, CAMERA)
    (image * (x + 2 * y)[..., None]).sum().backward()  # type: ignore[no-untyped-call]
    expected = float(image.detach().sum()) * 5**0.5
    # In half pictures of 20 pixels; the jump of alpha at 1/255 has no gradient, 3 % of this sum.
    assert float(screen_gradients.lengths[0]) == pytest.approx(20 * expected, rel=0.04)
    assert screen_gradients.visible.tolist() == [1.0]


def test_screen_gradients_know_what_is_out_of_sight() -> None:
    scene = oracle.random_scene(30, degree=0, seed=3)
    behind = scene.replace(means=scene.means + torch.tensor([20.0, 0.0, 0.0]))
    screen_gradients = ScreenGradients()
    leaves = GaussianScene.unchecked(*(t.clone().requires_grad_(True) for t in merge(scene, behind).tensors()))
    Renderer(RenderSettings(), screen_gradients=screen_gradients)(leaves, CAMERA).sum().backward()  # type: ignore[no-untyped-call]
    assert screen_gradients.visible[30:].sum() == screen_gradients.lengths[30:].sum() == 0
    assert float(screen_gradients.visible[:30].sum()) > 10
