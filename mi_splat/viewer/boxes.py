"""Boxes that are drawn around an object on a page, from two cameras or more, and the
object in them.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from mi_splat.cameras.camera import RenderFn
from mi_splat.cameras.directions import UP
from mi_splat.maths.rotation import from_z
from mi_splat.selection.boxes import DrawnBox, DrawnBoxes, PixelBox
from mi_splat.selection.outlines import BoxedImage, outlines_in_boxes
from mi_splat.viewer.content import Content
from mi_splat.viewer.orbit import Orbit, camera_options
from mi_splat.viewer.picking import MASK, Picked, clicked
from mi_splat.viewer.session import Layout

FILE = "boxes.json"  # file of the boxes in commands
FEWEST = 2
_NARROWEST = 3  # pixels of a box; a smaller one was a slip of the mouse
Place = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Drag:
    """A box in pixels of the image of a splat as `mi-splat render` makes it."""

    splat: str
    box: PixelBox
    orbit: Orbit


def dragged(
    ends: tuple[Place, Place],
    layout: Layout,
    mode: str,
    content: Content,
    orbit: Orbit,
) -> Drag | None:
    """The box between two points of the page, as far as it is on one image; None if
    none is, or it is narrow.
    """
    if not all(math.isfinite(value) for end in ends for value in end):
        return None
    width, height = content.size_at(orbit)
    middle = (
        (ends[0][0] + ends[1][0]) / 2,
        (ends[0][1] + ends[1][1]) / 2,
    )
    hit = clicked(middle, layout, mode, content, orbit)
    if hit is None:
        return None
    splat, (column, row) = hit
    # half a box on the page in pixels of the image
    across = abs(ends[1][0] - ends[0][0]) / 2 * layout.canvas[0]
    down = abs(ends[1][1] - ends[0][1]) / 2 * layout.canvas[1]
    across *= width / layout.size[0]
    down *= height / layout.size[1]
    x0 = max(column + 0.5 - across, 0.0)
    x1 = min(column + 0.5 + across, float(width))
    y0 = max(row + 0.5 - down, 0.0)
    y1 = min(row + 0.5 + down, float(height))
    if min(x1 - x0, y1 - y0) < _NARROWEST:
        return None
    box = (round(x0, 1), round(y0, 1), round(x1, 1), round(y1, 1))
    return Drag(splat=splat, box=box, orbit=orbit)


def document_of(drags: Sequence[Drag], content: Content) -> DrawnBoxes:
    """The boxes as a file has them, with cameras in the world of the splat's file."""
    turn = torch.eye(3, dtype=torch.float64)
    if tuple(content.up) != UP:
        turn = from_z(torch.tensor(list(content.up), dtype=torch.float64))
    names = [f"view-{number}" for number in range(len(drags))]
    return DrawnBoxes(
        boxes=tuple(
            DrawnBox(image=name, box=drag.box, size=content.size_at(drag.orbit))
            for name, drag in zip(names, drags, strict=True)
        ),
        cameras={
            name: drag.orbit.camera(content.size_at(drag.orbit)).turned(turn)
            for name, drag in zip(names, drags, strict=True)
        },
    )


def file_of(drags: Sequence[Drag], content: Content) -> bytes:
    """The boxes as `mi-splat select --boxes` takes them."""
    return json.dumps(document_of(drags, content).document(), indent=1).encode()


def pick_in_boxes(drags: Sequence[Drag], content: Content, render: RenderFn) -> Picked:
    """The object in boxes of two cameras or more, as `mi-splat select --boxes` selects
    it.
    """
    last = drags[-1]
    splat = content.splat(last.splat)
    images = []
    for drag in drags:
        camera = drag.orbit.camera(content.size_at(drag.orbit))
        with torch.no_grad():
            image = render(splat.scene, camera)[..., :3].clamp(0, 1).cpu()
        boxes = torch.tensor([drag.box])
        images.append(BoxedImage(camera=camera, image=image, boxes=boxes))
    mask, _ = outlines_in_boxes(splat.scene, images, render=render)
    size = content.size_at(last.orbit)
    view = camera_options(
        last.orbit, size, settings=content.settings, up=content.up, path=splat.path
    )
    command = ["mi-splat", "select", str(splat.path), "--boxes", FILE, *view]
    command += ["--out", MASK]
    return Picked(splat=splat.name, mask=mask, command=shlex.join(command))
