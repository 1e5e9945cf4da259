"""Objects of a shown splat that visitors have picked by a click: which Gaussians, in another colour, and undone."""

from __future__ import annotations

import io
import shlex
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras import RenderFn
from mi_splat.directions import UP
from mi_splat.errors import InvalidValueError, message
from mi_splat.scene import GaussianScene
from mi_splat.selection.config import Box, Selection
from mi_splat.selection.masks import box_mask
from mi_splat.selection.select import select
from mi_splat.sh import colour_to_dc
from mi_splat.viewer.command import camera_words
from mi_splat.viewer.composition import SPLIT, Layout, needed, panes
from mi_splat.viewer.exhibit import Exhibit, ShownSplat
from mi_splat.viewer.lines import Lines
from mi_splat.viewer.orbit import Orbit

TINT = (1.0, 0.0, 0.8)
"""sRGB colour that picked Gaussians are mixed with, half and half."""
WHOLE = ((0.0, 1.0),) * 3
"""Parts of a box that are all of it."""
MASK = "mask.npy"
"""File of the picked Gaussians, in commands."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Picked:
    """Gaussians of a splat: those that clicks have picked, as far as they are in a box.

    Attributes:
        splat: Its name.
        mask: (N,) bool.
        clicked: (N,) bool, those that were picked, in the box or not.
        largest: x0, y0, z0, x1, y1, z1, the box that holds all that were picked, in the coordinates of the page.
        parts: Where the box begins and ends along each axis, as parts of the largest one in [0, 1].
        words: Of the `mi-splat select` that picks what was clicked on; none where several clicks did.
        level: Whether the coordinates of the page are those of the file.
    """

    splat: str
    mask: Tensor
    clicked: Tensor
    largest: Box
    parts: tuple[tuple[float, float], ...] = WHOLE
    words: tuple[str, ...] = ()
    level: bool = True

    @classmethod
    def of(cls, splat: ShownSplat, mask: Tensor, **more: Any) -> Picked:
        """Gaussians, (N,) bool, of a splat, and the box that holds them."""
        means = splat.scene.means[mask].detach().double()
        x0, y0, z0, x1, y1, z1 = torch.cat([means.amin(0), means.amax(0)]).tolist()
        return cls(splat=splat.name, mask=mask, clicked=mask, largest=(x0, y0, z0, x1, y1, z1), **more)

    @property
    def box(self) -> Box:
        """x0, y0, z0, x1, y1, z1 in the coordinates of the page."""
        ends = zip(self.largest[:3], self.largest[3:], self.parts, strict=True)
        (x0, x1), (y0, y1), (z0, z1) = ((_between(a, b, low), _between(a, b, high)) for a, b, (low, high) in ends)
        return x0, y0, z0, x1, y1, z1

    def within(self, scene: GaussianScene, axis: int, part: tuple[float, float]) -> Picked:
        """What of it lies in another part of the largest box along an axis (0, 1, 2), in the scene that it is of."""
        parts = (*self.parts[:axis], part, *self.parts[axis + 1 :])
        smaller = replace(self, parts=parts)
        mask = self.clicked if parts == WHOLE else self.clicked & box_mask(scene, smaller.box)
        if not bool(mask.any()):
            raise InvalidValueError(message("box", "a part of the object", "none of it", "make it larger"))
        return replace(smaller, mask=mask)

    def fits(self, scene: GaussianScene) -> bool:
        """Whether a scene has as many Gaussians."""
        return len(scene) == len(self.mask)

    @property
    def text(self) -> str:
        """How many there are."""
        return f"{int(self.mask.sum()):,} of {len(self.mask):,} Gaussians of {self.splat}"

    @property
    def command(self) -> str:
        """The `mi-splat select` that picks them; empty where there is none."""
        box = [] if self.parts == WHOLE else ["--box", *map(str, self.box)]
        if not self.words or (box and not self.level):
            return ""
        return shlex.join(["mi-splat", *self.words, *box, "--out", MASK])

    @property
    def file(self) -> bytes:
        """The mask as `mi-splat select --out mask.npy` writes it."""
        buffer = io.BytesIO()
        np.save(buffer, self.mask.numpy())
        return buffer.getvalue()


@dataclass(frozen=True, slots=True, kw_only=True)
class Click:
    """A pixel of the picture of a splat that `mi-splat render` makes.

    Attributes:
        splat: Name of the splat.
        pixel: x and y from the upper left corner.
        orbit: The camera.
        adds: Whether what is there joins what was picked before.
    """

    splat: str
    pixel: tuple[int, int]
    orbit: Orbit
    adds: bool = False


def clicked(
    at: tuple[float, float], layout: Layout, show: str, exhibit: Exhibit, orbit: Orbit, *, split: float = 0.5
) -> tuple[str, tuple[int, int]] | None:
    """The splat and the pixel of its picture that a point of the page shows; None beside the pictures.

    A point of a photograph is one of the picture of the splat beside it.
    """
    x, y = (part * side for part, side in zip(at, layout.canvas, strict=True))
    (width, height), size = layout.size, exhibit.size_at(orbit)
    rendered = [splat.name for splat in exhibit.splats]
    for pane, (left, top) in zip(panes(show, exhibit.names), layout.corners, strict=True):
        across, down = (x - left) / width, (y - top) / height
        if 0 <= across < 1 and 0 <= down < 1:
            first, *others = needed(pane, exhibit.names)
            splat = others[0] if pane == SPLIT and others and across >= split else first
            if not rendered:
                return None
            return splat if splat in rendered else rendered[0], (int(across * size[0]), int(down * size[1]))
    return None


def pick(click: Click, exhibit: Exhibit, render: RenderFn, before: Picked | None) -> Picked:
    """The object at a pixel, as `mi-splat select --click` takes it."""
    splat = exhibit.splat(click.splat)
    selection = Selection(click=(click.pixel,))
    mask = select(splat.scene, selection, camera=click.orbit.camera(exhibit.size_at(click.orbit)), render=render)
    if click.adds and before is not None and before.mask.shape == mask.shape:
        return Picked.of(splat, mask | before.mask)
    return Picked.of(splat, mask, words=_words(splat, click, exhibit), level=tuple(exhibit.up) == UP)


def _words(splat: ShownSplat, click: Click, exhibit: Exhibit) -> tuple[str, ...]:
    size = exhibit.size_at(click.orbit)
    camera = camera_words(click.orbit, size, settings=exhibit.settings, up=exhibit.up, path=splat.path)
    x, y = click.pixel
    return ("select", str(splat.path), "--click", f"{x},{y}", *camera)


def _between(start: float, end: float, part: float) -> float:
    """A point on the way from a start to an end, which are exact."""
    return end if part == 1 else start + part * (end - start)


def edges(box: Box) -> Lines:
    """The twelve edges of a box."""
    corners = torch.cartesian_prod(
        *(torch.tensor(ends, dtype=torch.float64) for ends in zip(box[:3], box[3:], strict=True))
    )
    pairs = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]
    return Lines(segments=corners[torch.tensor(pairs)], colour="#ffffff")


def tinted(scene: GaussianScene, mask: Tensor) -> GaussianScene:
    """The scene with the Gaussians of a mask, (N,) bool, mixed with another colour."""
    sh = scene.sh.clone()
    sh[mask] *= 0.5
    sh[mask, 0] += 0.5 * colour_to_dc(torch.tensor(TINT)).to(sh)
    return GaussianScene.unchecked(*scene.tensors()[:4], sh)
