"""Regions of images that show an object, and the Gaussians that make these regions up.

An image says of each Gaussian that it shows whether it lies in the region: by its
weights there, w_i = alpha_i T_i, so that what is hidden behind the object is not taken
for a part of it. Images vote, so that a wrong region among several does little harm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, RenderFn, project_points
from mi_splat.errors import InvalidValueError
from mi_splat.maths.sh import colour_to_dc
from mi_splat.scene import GaussianScene

FEWEST_IMAGES = 2
"""One image says nothing of how far an object reaches along its rays."""
MOST = 0.51
"""Share of the images that is most of them, and of two both."""
_SHOWN = 0.1
"""Pixels that a Gaussian makes up in an image which then has a whole vote."""
_LEAST_PIXELS = 1e-6
_HIDDEN = 0.1
"""Votes of all images together below which a Gaussian is hidden."""
_IN_FRAME = 0.2
"""Share of the images that have a Gaussian of the object in their frames at least."""
_HALF = 0.5


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ImageRegion:
    """Where an object is in an image.

    Attributes:
        camera: The camera of the image.
        inside: (height, width) float32 in [0, 1], 1 where the object is.

    Raises:
        InvalidValueError: The region has another size than the camera's images.
    """

    camera: Camera
    inside: Tensor

    def __post_init__(self) -> None:
        expected = (self.camera.height, self.camera.width)
        if tuple(self.inside.shape) != expected:
            do = "resize it, or the camera"
            raise InvalidValueError.of(
                "inside", f"shape {expected}", tuple(self.inside.shape), do
            )

    @classmethod
    def of_box(cls, camera: Camera, box: Sequence[float]) -> ImageRegion:
        """The region of a box x0, y0, x1, y1 in pixels of the camera's image.

        Args:
            camera: The camera of the image.
            box: (4,) pixels from the upper left corner.

        Returns:
            The region of all pixels whose centres lie in the box.
        """
        x0, y0, x1, y1 = (float(value) for value in box)
        across = torch.arange(camera.width) + 0.5
        down = torch.arange(camera.height) + 0.5
        columns = (across >= x0) & (across <= x1)
        rows = (down >= y0) & (down <= y1)
        return cls(camera=camera, inside=(rows[:, None] & columns).float())


def vote(
    scene: GaussianScene,
    regions: Sequence[ImageRegion],
    *,
    render: RenderFn,
    least: float = MOST,
) -> Tensor:
    """The Gaussians that lie in most of the regions, of the images that show them.

    Args:
        scene: The scene.
        regions: Where the object is in two images or more.
        render: Renders the images.
        least: Share of the images from which on a Gaussian is the object's, in (0, 1].

    Returns:
        (N,) bool.

    Raises:
        InvalidValueError: There are fewer than two regions.
    """
    return shares(scene, regions, render=render) >= least


def shares(
    scene: GaussianScene, regions: Sequence[ImageRegion], *, render: RenderFn
) -> Tensor:
    """The share of the images in which each Gaussian lies in the region, of the images
    that show it.

    In each image a Gaussian lies in the region by the share of its pixels there, each
    pixel by its weight in it, and where its mean is projected. The smaller share of the
    images counts; of Gaussians that no image shows, as those in the middle of the
    object, that of their means.

    Args:
        scene: The scene.
        regions: Where the object is in two images or more.
        render: Renders the images.

    Returns:
        (N,) in [0, 1]; 0 where too few images have a Gaussian in their frames.

    Raises:
        InvalidValueError: There are fewer than two regions.
    """
    require_regions(len(regions), "regions")
    votes, shown, projected, in_frame = torch.zeros(4, len(scene))
    for region in regions:
        inside, pixels = _pixels(scene, region, render)
        # an image that shows next to nothing of a Gaussian says little of it
        weight = (pixels / _SHOWN).clamp(0, 1)
        votes += weight * (inside / pixels.clamp(min=_LEAST_PIXELS)).clamp(0, 1)
        shown += weight
        is_inside, is_in_frame = _projected(scene, region)
        projected += is_inside
        in_frame += is_in_frame
    by_mean = projected / in_frame.clamp(min=1)
    by_weight = torch.where(shown > _HIDDEN, votes / shown.clamp(min=_HIDDEN), by_mean)
    share = torch.minimum(by_weight, by_mean)
    enough = max(FEWEST_IMAGES, _IN_FRAME * len(regions))
    return torch.where(in_frame >= enough, share, 0)


def require_regions(count: int, what: str) -> None:
    """Raise unless there are regions in enough images."""
    if count < FEWEST_IMAGES:
        expected = f"regions in {FEWEST_IMAGES} images or more"
        do = "pass more cameras that show the object"
        raise InvalidValueError.of(what, expected, count, do)


def _pixels(
    scene: GaussianScene, region: ImageRegion, render: RenderFn
) -> tuple[Tensor, Tensor]:
    """(N,) pixels that each Gaussian makes up inside a region, and in the whole image.

    Derivatives by colours, as in `mi_splat.selection.visibility.contributions`: red is
    summed over the region, green over the image.
    """
    geometry = scene.detach().tensors()[:4]
    sh = torch.zeros_like(scene.sh[:, :1]).requires_grad_()
    with torch.enable_grad():
        image = render(GaussianScene.unchecked(*geometry, sh), region.camera)
        inside = region.inside.to(image)
        total = (image[..., 0] * inside).sum() + image[..., 1].sum()
        (gradient,) = torch.autograd.grad(total, sh)
    step = float(colour_to_dc(torch.tensor(1.0)) - colour_to_dc(torch.tensor(0.0)))
    weights = (gradient[:, 0] * step).cpu()
    return weights[:, 0], weights[:, 1]


def _projected(scene: GaussianScene, region: ImageRegion) -> tuple[Tensor, Tensor]:
    """(N,) bool, which means are projected into a region, and which into the image."""
    camera = region.camera
    places, depths = project_points(scene.means.detach().cpu(), camera)
    columns = places[:, 0].floor()
    rows = places[:, 1].floor()
    in_frame = (depths > 0) & (columns >= 0) & (columns < camera.width)
    in_frame &= (rows >= 0) & (rows < camera.height)
    column = torch.where(in_frame, columns, 0).long()
    row = torch.where(in_frame, rows, 0).long()
    inside = in_frame & (region.inside.cpu()[row, column] >= _HALF)
    return inside, in_frame
