"""Random changes of training images: framing, light, and the softness, noise and
holes of a splat's render.

Every function takes a (3, H, W) float image in [0, 1] and a seeded generator.
"""

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Generator, Tensor

from scenes.recipes.detector_pictures import LabelledPicture

_MIN_SIDE = 5.0
_MIN_VISIBLE = 0.3


def augment(
    sample: LabelledPicture, generator: Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """A training example from a labelled image."""
    image = sample.image.permute(2, 0, 1).float() / 255
    boxes = sample.boxes
    labels = sample.labels
    if _chance(0.5, generator):
        image, width = image.flip(2), image.shape[2]
        boxes = torch.stack(
            [width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], 1
        )
    image, boxes, labels = reframe(image, boxes, labels, generator)
    image = relight(image, generator)
    if _chance(0.25, generator):
        image = like_a_splat(image, generator)
    elif _chance(0.35, generator):
        image = blur(image, _uniform(0.4, 1.6, generator))
    if _chance(0.25, generator):
        image = coarsen(image, _uniform(1.2, 2.5, generator))
    if _chance(0.4, generator):
        image = image + _uniform(0.005, 0.05, generator) * torch.randn(
            image.shape, generator=generator
        )
    return (image.clamp(0, 1) * 255).round() / 255, boxes, labels


def reframe(
    image: Tensor, boxes: Tensor, labels: Tensor, generator: Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Zoom by 0.8 to 1.4 and shift; boxes that lose most of their area are dropped."""
    height, width = image.shape[1:]
    zoom = math.exp(_uniform(math.log(0.8), math.log(1.4), generator))
    slack = abs(1 - 1 / zoom) + 0.1
    dx, dy = (_uniform(-slack, slack, generator) for _ in range(2))
    matrix = torch.tensor([[[1 / zoom, 0.0, dx], [0.0, 1 / zoom, dy]]])
    grid = F.affine_grid(matrix, [1, 3, height, width], align_corners=False)
    moved = F.grid_sample(
        image[None], grid, padding_mode="border", align_corners=False
    )[0]
    centre = boxes.new_tensor([width, height, width, height]) / 2
    shift = boxes.new_tensor([dx * width, dy * height, dx * width, dy * height]) / 2
    whole = (boxes - centre - shift) * zoom + centre
    inside = whole.clamp(min=0).minimum(2 * centre)
    size = inside[:, 2:] - inside[:, :2]
    full = whole[:, 2:] - whole[:, :2]
    fraction = size.clamp(min=0).prod(1) / full.prod(1)
    keep = (size.amin(1) >= _MIN_SIDE) & (fraction >= _MIN_VISIBLE)
    return moved, inside[keep], labels[keep]


def relight(image: Tensor, generator: Generator) -> Tensor:
    """Exposure, gamma, contrast, saturation and white balance."""
    gains = torch.tensor([_uniform(0.88, 1.14, generator) for _ in range(3)])
    image = image * gains[:, None, None] * _uniform(0.7, 1.35, generator)
    image = image.clamp(1e-4, 1.3) ** _uniform(0.75, 1.35, generator)
    grey = image.mean(0, keepdim=True)
    image = grey + (image - grey) * _uniform(0.6, 1.4, generator)
    middle = image.mean()
    return middle + (image - middle) * _uniform(0.75, 1.25, generator)


def blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian blur with `sigma` in pixels."""
    reach = max(1, math.ceil(2.5 * sigma))
    at = torch.arange(-reach, reach + 1, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (at / sigma) ** 2)
    kernel = (kernel / kernel.sum()).expand(3, 1, -1)
    padded = F.pad(image[None], (reach,) * 4, mode="replicate")
    return F.conv2d(
        F.conv2d(padded, kernel[:, :, None], groups=3), kernel[..., None], groups=3
    )[0]


def coarsen(image: Tensor, factor: float) -> Tensor:
    """Down and up again, as a small image that was enlarged."""
    size = image.shape[1:]
    small = F.interpolate(
        image[None], scale_factor=1 / factor, mode="bilinear", antialias=True
    )
    return F.interpolate(small, size=size, mode="bilinear")[0]


def like_a_splat(image: Tensor, generator: Generator) -> Tensor:
    """Edges that fray and soften, and small holes through which something else
    shines.
    """
    height, width = image.shape[1:]
    identity = F.affine_grid(
        torch.eye(2, 3)[None], [1, 3, height, width], align_corners=False
    )
    coarse = torch.randn((1, 2, height // 2, width // 2), generator=generator)
    fray = F.interpolate(coarse, size=(height, width), mode="bilinear").permute(
        0, 2, 3, 1
    )
    pixels = _uniform(0.3, 1.6, generator)
    frayed = F.grid_sample(
        image[None], identity + fray * (2 * pixels / width), align_corners=False
    )[0]
    soft = blur(frayed, _uniform(0.5, 1.1, generator))
    holes = (
        torch.rand((1, height, width), generator=generator)
        < _uniform(0, 0.004, generator)
    ).float()
    cover = (blur(holes.expand(3, -1, -1), 0.8) * 4).clamp(0, 1)
    return soft * (1 - cover) + cover * torch.rand((3, 1, 1), generator=generator)


def _chance(probability: float, generator: Generator) -> bool:
    return float(torch.rand((), generator=generator)) < probability


def _uniform(low: float, high: float, generator: Generator) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator))
