"""Which of several boxes in each image is that of one and the same object.

Detectors report other objects of the same class, too, and now and then a wrong one with
more confidence. In space the boxes of one object meet: what most of the images' boxes
have in common says which box of each image is meant.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, project_points

_ROUNDS = 4
_NEARLY_ALL = 0.9
"""Share of the largest number of boxes that a Gaussian of the object lies in."""
_SEEN = 0.3
"""Share of the images that show a Gaussian of the object at least."""
_AROUND = 0.7
"""Share of what the boxes have in common that a box of the object has in it."""


def associated(
    means: Tensor, cameras: Sequence[Camera], boxes: Sequence[Tensor]
) -> list[int | None]:
    """For each image the index of the box of the object that most images show.

    Args:
        means: (N, 3) positions of Gaussians, world units.
        cameras: The camera of each image.
        boxes: (K, 4) boxes of each image, pixels, the most confident first.

    Returns:
        For each image an index of its boxes; None where none fits.
    """
    places = [_placed(means, camera) for camera in cameras]
    chosen: list[int | None] = [0 if len(found) else None for found in boxes]
    for _ in range(_ROUNDS):
        core = _in_common(places, boxes, chosen)
        before = chosen
        chosen = [
            _best(place[core], found)
            for place, found in zip(places, boxes, strict=True)
        ]
        if chosen == before:
            break
    return chosen


def _placed(means: Tensor, camera: Camera) -> Tensor:
    """(N, 2) pixels of means; NaN where the image does not show them."""
    places, depths = project_points(means, camera)
    size = places.new_tensor([camera.width, camera.height])
    outside = (depths <= 0) | (places < 0).any(1) | (places >= size).any(1)
    places[outside] = torch.nan
    return places


def _inside(places: Tensor, box: Tensor) -> Tensor:
    """(N,) bool, which places lie in a box."""
    return ((places >= box[:2]) & (places <= box[2:])).all(1)


def _in_common(
    places: Sequence[Tensor], boxes: Sequence[Tensor], chosen: Sequence[int | None]
) -> Tensor:
    """(N,) bool, which means lie in nearly as many of the chosen boxes as any does."""
    inside = torch.zeros(len(places[0]))
    seen = torch.zeros(len(places[0]))
    images = 0
    for place, found, index in zip(places, boxes, chosen, strict=True):
        if index is None:
            continue
        images += 1
        inside += _inside(place, found[index])
        seen += ~place[:, 0].isnan()
    share = torch.where(seen >= _SEEN * images, inside / seen.clamp(min=1), 0)
    return share >= _NEARLY_ALL * share.max()


def _best(places: Tensor, boxes: Tensor) -> int | None:
    """The most confident box around the projected object; None where none is."""
    shown = places[~places[:, 0].isnan()]
    if not len(shown):
        return None
    for index, box in enumerate(boxes):
        if float(_inside(shown, box).float().mean()) >= _AROUND:
            return index
    return None
