"""What of an image each Gaussian and each object makes up; exact for any renderer, by
changing colours.

An image is linear in the colours: a pixel is the sum over Gaussians of weight times
colour, w_i = alpha_i T_i with T_i what those in front let through. So weights are what
an image of other colours shows, or its derivative by colours.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, RenderFn, as_cameras
from mi_splat.errors import InvalidValueError
from mi_splat.maths.sh import colour_to_dc
from mi_splat.scene import GaussianScene

Box = tuple[int, int, int, int]
"""Pixels of an image: x0, y0, x1, y1 from the upper left corner, x1 and y1 no longer
among them.
"""

_EMPTY_PIXEL = 0.05
"""A pixel of which Gaussians make up less shows nothing."""


def contributions(
    scene: GaussianScene,
    cameras: Camera | Sequence[Camera],
    *,
    render: RenderFn,
    rows: Tensor | None = None,
    boxes: Sequence[Box] | None = None,
) -> Tensor:
    """(M, D) pixels that each of M Gaussians makes up in the images of D cameras: the
    sum of its weights over pixels.

    Exact: the derivative of an image's sum by a Gaussian's colour, taken at grey,
    where no colour is clamped. What is hidden by others counts nothing, and over all
    Gaussians the sum is that of the images' opacity. It takes an image of SH degree
    0 and its gradient for each camera.
    """
    cameras = as_cameras(cameras)
    if boxes is not None and len(boxes) != len(cameras):
        raise InvalidValueError.of(
            "boxes", f"{len(cameras)}, one a camera", len(boxes), "pass one for each"
        )
    rows = torch.arange(len(scene)) if rows is None else rows
    geometry = scene.detach().tensors()[:4]
    grey = torch.zeros_like(scene.sh[:, :1])
    if not len(scene):
        return grey.new_zeros(0, len(cameras))
    step = float(colour_to_dc(torch.tensor(1.0)) - colour_to_dc(torch.tensor(0.0)))
    weights = [grey.new_zeros(len(grey[rows]), 0)]
    for number, camera in enumerate(cameras):
        x0, y0, x1, y1 = (
            (0, 0, camera.width, camera.height)
            if boxes is None
            else _checked(boxes[number], camera)
        )
        sh = grey.clone().requires_grad_()
        with torch.enable_grad():
            picture = render(GaussianScene.unchecked(*geometry, sh), camera)
            (gradient,) = torch.autograd.grad(picture[y0:y1, x0:x1, :3].sum(), sh)
        weights.append((gradient[rows, 0].mean(-1) * step)[:, None])
    return torch.cat(weights, 1)


def _checked(box: Box, camera: Camera) -> Box:
    x0, y0, x1, y1 = box
    if not (0 <= x0 < x1 <= camera.width and 0 <= y0 < y1 <= camera.height):
        expected = f"x0 < x1 and y0 < y1 inside {camera.width} x {camera.height}"
        raise InvalidValueError.of(
            "box", expected, box, "count pixels from the upper left corner"
        )
    return box


def object_weight(
    scene: GaussianScene, rows: Tensor | slice, camera: Camera, render: RenderFn
) -> Tensor:
    """How much of each pixel an object makes up: (H, W) in [0, 1], occlusion by the
    rest of the scene included.

    The scene is rendered with the object white and all else black, and again all black,
    which takes any background away.
    """
    white = torch.zeros_like(scene.means)
    white[rows] = 1
    with torch.no_grad():
        both = [
            colour_to_dc(colours)[:, None]
            for colours in (white, torch.zeros_like(white))
        ]
        scenes = [GaussianScene.unchecked(*scene.tensors()[:4], sh) for sh in both]
        shown, hidden = (render(painted, camera)[..., :3] for painted in scenes)
    return (shown - hidden).mean(-1).clamp(0, 1)


def pixel_weights(
    scene: GaussianScene, camera: Camera, pixel: tuple[int, int], render: RenderFn
) -> Tensor:
    """(N,) how much of a pixel each Gaussian makes up; their sum is what the background
    leaves.
    """
    x, y = pixel
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        expected = f"a pixel of {camera.width} x {camera.height}"
        raise InvalidValueError.of(
            "click", expected, f"{x},{y}", "count pixels from the upper left corner"
        )
    weights = contributions(scene, camera, render=render, boxes=[(x, y, x + 1, y + 1)])[
        :, 0
    ]
    if float(weights.sum()) < _EMPTY_PIXEL:
        got = f"one of which Gaussians make up {float(weights.sum()):.1%}"
        raise InvalidValueError.of(
            f"click {x},{y}", "a pixel that shows something", got, "click on the object"
        )
    return weights
