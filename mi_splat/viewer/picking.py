"""Objects of a shown splat that visitors have picked by a click: which Gaussians, in another colour, and undone."""

from __future__ import annotations

import io
import shlex
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras import RenderFn
from mi_splat.scene import GaussianScene
from mi_splat.selection.config import Selection
from mi_splat.selection.select import select
from mi_splat.sh import colour_to_dc
from mi_splat.viewer.command import camera_words
from mi_splat.viewer.composition import SPLIT, Layout, needed, panes
from mi_splat.viewer.exhibit import Exhibit, ShownSplat
from mi_splat.viewer.orbit import Orbit

TINT = (1.0, 0.0, 0.8)
"""sRGB colour that picked Gaussians are mixed with, half and half."""
MASK = "mask.npy"
"""File of the picked Gaussians, in commands."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Picked:
    """Gaussians of a splat.

    Attributes:
        splat: Its name.
        mask: (N,) bool.
        command: The `mi-splat select` that picks them; empty where there is none, since several clicks did.
    """

    splat: str
    mask: Tensor
    command: str = ""

    def fits(self, scene: GaussianScene) -> bool:
        """Whether a scene has as many Gaussians."""
        return len(scene) == len(self.mask)

    @property
    def words(self) -> str:
        """How many there are."""
        return f"{int(self.mask.sum()):,} of {len(self.mask):,} Gaussians of {self.splat}"

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

    Args:
        at: Column and row of the point, each in parts of the page, from the upper left corner.
        layout: Where pictures stand.
        show: The way of showing.
        exhibit: What is shown.
        orbit: From where; the pixel is one of the picture that is inspected.
        split: Part of the width left of the dividing line.
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
    """The object at a pixel, as `mi-splat select --click` takes it.

    Args:
        click: Where.
        exhibit: What is shown.
        render: Makes its pictures.
        before: What was picked before, which the object may join.

    Raises:
        InvalidValueError: Nothing is there.
    """
    splat = exhibit.splat(click.splat)
    selection = Selection(click=(click.pixel,))
    mask = select(splat.scene, selection, camera=click.orbit.camera(exhibit.size_at(click.orbit)), render=render)
    if click.adds and before is not None and before.mask.shape == mask.shape:
        return Picked(splat=splat.name, mask=mask | before.mask)
    return Picked(splat=splat.name, mask=mask, command=_command(splat, click, exhibit))


def _command(splat: ShownSplat, click: Click, exhibit: Exhibit) -> str:
    size = exhibit.size_at(click.orbit)
    camera = camera_words(click.orbit, size, settings=exhibit.settings, up=exhibit.up, path=splat.path)
    x, y = click.pixel
    return shlex.join(["mi-splat", "select", str(splat.path), "--click", f"{x},{y}", *camera, "--out", MASK])


def tinted(scene: GaussianScene, mask: Tensor) -> GaussianScene:
    """The scene with the Gaussians of a mask, (N,) bool, mixed with another colour."""
    sh = scene.sh.clone()
    sh[mask] *= 0.5
    sh[mask, 0] += 0.5 * colour_to_dc(torch.tensor(TINT)).to(sh)
    return GaussianScene.unchecked(*scene.tensors()[:4], sh)
