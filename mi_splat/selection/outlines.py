"""The outline of an object in images in which only a box around it is known.

A box shows background, too. First the Gaussians are taken that lie in most of the
boxes, which leaves what is near the object in space. Then each image is cut along the
outline of what they make up there by GrabCut (Rother et al. 2004), and the images vote
again, now with outlines in place of boxes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.scene import GaussianScene
from mi_splat.selection.association import associated
from mi_splat.selection.regions import ImageRegion, require_regions, vote
from mi_splat.selection.visibility import object_weight

BOX_LEAST = 0.9
"""Share of the boxes that a Gaussian lies in which is likely the object's."""
BOX_MARGIN = 0.05
"""How much boxes are widened on every side, as a share of their width and height:
detectors often cut a hand or an ear.
"""
ROUNDS = 1
"""How often images are cut and vote; a second time changed little."""
_ITERATIONS = 3
_POSSIBLE = 0.1
_LIKELY = 0.5
"""Share of a pixel that is made up where the object may be, and where it is likely."""
_EDGE = 0.12
"""How wide the uncertain edge inside of what is likely is, as a share of the root of
its area.
"""
_NO_RECTANGLE = (0, 0, 1, 1)
_MARGIN = 0.15
_LEAST_MARGIN = 10
"""How far around the object colours of the background are taken, as a share of the
object's longer side, and in pixels at least.
"""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BoxedImage:
    """An image with one box around the object or several, one of which may be.

    Attributes:
        camera: The camera of the image.
        image: (height, width, 3) sRGB in [0, 1].
        boxes: (K, 4) boxes x0, y0, x1, y1 in pixels, the most confident first.
    """

    camera: Camera
    image: Tensor
    boxes: Tensor


def outlines_in_boxes(
    scene: GaussianScene,
    images: Sequence[BoxedImage],
    *,
    render: RenderFn,
    rounds: int = ROUNDS,
) -> tuple[Tensor, list[ImageRegion | None]]:
    """The object in boxes of several images.

    Args:
        scene: The scene.
        images: Images with boxes, two or more.
        render: Renders the images.
        rounds: How often images are cut and vote.

    Returns:
        (N,) bool, the object's Gaussians; and its outline in each image, None where no
        box is that of the object which most images show.

    Raises:
        InvalidValueError: There are boxes of one object in fewer than two images.
    """
    require_regions(len(images), "boxes")
    chosen = associated(
        scene.means.detach().cpu(),
        [item.camera for item in images],
        [item.boxes for item in images],
    )
    kept = [number for number, index in enumerate(chosen) if index is not None]
    require_regions(len(kept), "boxes of one object")
    boxes = [
        ImageRegion.of_box(item.camera, _widened(item.boxes[index]))
        for item, index in zip(images, chosen, strict=True)
        if index is not None
    ]
    mask = vote(scene, boxes, render=render, least=BOX_LEAST)
    outlines = boxes
    for _ in range(rounds):
        outlines = []
        for number, box in zip(kept, boxes, strict=True):
            item = images[number]
            weight = object_weight(scene, mask, item.camera, render).cpu()
            inside = cut_out(item.image, weight * box.inside)
            outlines.append(ImageRegion(camera=item.camera, inside=inside))
        mask = vote(scene, outlines, render=render)
    found = dict(zip(kept, outlines, strict=True))
    return mask, [found.get(number) for number in range(len(images))]


def _widened(box: Tensor) -> list[float]:
    """A box that is a little larger on every side."""
    sides = BOX_MARGIN * (box[2:] - box[:2])
    return [*(box[:2] - sides).tolist(), *(box[2:] + sides).tolist()]


def cut_out(image: Tensor, weight: Tensor) -> Tensor:
    """(H, W) zeros and ones, the object's outline in an image by GrabCut, which begins
    with what Gaussians make up of each pixel.
    """
    import cv2

    labels = _labels(weight.numpy())
    outline = torch.from_numpy((labels & 1).astype(np.float32))
    if not outline.any():
        return outline
    # colours of the background from near the object, which is faster, too
    rows, columns = np.nonzero(labels != cv2.GC_BGD)
    margin = max(_LEAST_MARGIN, round(_MARGIN * max(np.ptp(rows), np.ptp(columns))))
    window = (
        slice(max(int(rows.min()) - margin, 0), int(rows.max()) + margin + 1),
        slice(max(int(columns.min()) - margin, 0), int(columns.max()) + margin + 1),
    )
    cut = np.ascontiguousarray(labels[window])
    if not (cut == cv2.GC_BGD).any():
        return outline
    pixels = (image[window].clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    cv2.setRNGSeed(0)
    cv2.grabCut(
        np.ascontiguousarray(pixels[..., ::-1]),
        cut,
        _NO_RECTANGLE,
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        _ITERATIONS,
        cv2.GC_INIT_WITH_MASK,
    )
    outline[:] = 0
    outline[window] = torch.from_numpy((cut & 1).astype(np.float32))
    return outline


def _labels(weight: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W) what GrabCut begins with: background, perhaps either, or object.

    Deep inside of what is likely the object's, it is certain: else a part that has the
    colour of the ground, a wheel or a bumper of a car, would be taken for it.
    """
    import cv2

    likely = (weight >= _LIKELY).astype(np.uint8)
    labels = np.full(weight.shape, cv2.GC_BGD, np.uint8)
    labels[weight >= _POSSIBLE] = cv2.GC_PR_BGD
    labels[likely > 0] = cv2.GC_PR_FGD
    edge = max(1.0, _EDGE * float(np.sqrt(likely.sum())))
    depth = cv2.distanceTransform(likely, cv2.DIST_L2, 5)
    labels[depth > edge] = cv2.GC_FGD
    return labels
