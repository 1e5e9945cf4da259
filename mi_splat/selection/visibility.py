"""What of a picture an object makes up, and which Gaussians make a pixel; exact for any renderer."""

from __future__ import annotations

import torch
from torch import Tensor

from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, message
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc

_EMPTY_PIXEL = 0.05
"""A pixel of which Gaussians make up less shows nothing."""


def object_weight(scene: GaussianScene, rows: Tensor | slice, camera: Camera, render: RenderFn) -> Tensor:
    """How much of each pixel an object makes up: (H, W) in [0, 1], occlusion by the rest of the scene included.

    The scene is rendered with the object white and all else black, and again all black, which takes any background
    away.

    Args:
        scene: The scene.
        rows: The object's Gaussians: (N,) bool, row numbers, or a slice.
        camera: Where from.
        render: The renderer.
    """
    black = torch.zeros_like(scene.sh)
    black[:, 0] = colour_to_dc(black.new_zeros(3))
    white = black.clone()
    white[rows, 0] = colour_to_dc(black.new_ones(3))
    with torch.no_grad():
        pictures = [
            render(GaussianScene.unchecked(scene.means, scene.scales, scene.rotations, scene.opacities, sh), camera)
            for sh in (white, black)
        ]
    return (pictures[0] - pictures[1]).mean(-1).clamp(0, 1)


def pixel_weights(scene: GaussianScene, camera: Camera, pixel: tuple[int, int], render: RenderFn) -> Tensor:
    """(N,) how much of a pixel each Gaussian makes up; their sum is what the background leaves.

    A pixel is the sum of weights times colours, so its derivative by a Gaussian's colour is the weight. It is taken at
    grey, where no colour is clamped.

    Args:
        scene: The scene.
        camera: Where from.
        pixel: x and y from the upper left corner.
        render: A renderer that is differentiable in the SH coefficients and gives sRGB.

    Raises:
        InvalidValueError: The pixel is outside the picture, or Gaussians make up less than a twentieth of it.
    """
    x, y = pixel
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        expected = f"a pixel of {camera.width} x {camera.height}"
        raise InvalidValueError(message("click", expected, f"{x},{y}", "count pixels from the upper left corner"))
    grey = colour_to_dc(scene.sh.new_full((len(scene), 1, 3), 0.5)).requires_grad_(True)
    with torch.enable_grad():
        picture = render(GaussianScene.unchecked(*scene.detach().tensors()[:4], grey), camera)
        (gradient,) = torch.autograd.grad(picture[y, x, 0], grey)
    one = colour_to_dc(torch.tensor(1.0)) - colour_to_dc(torch.tensor(0.0))
    weights: Tensor = gradient[:, 0, 0] * one.to(gradient)
    if float(weights.sum()) < _EMPTY_PIXEL:
        got = f"one of which Gaussians make up {float(weights.sum()):.1%}"
        raise InvalidValueError(message(f"click {x},{y}", "a pixel that shows something", got, "click on the object"))
    return weights
