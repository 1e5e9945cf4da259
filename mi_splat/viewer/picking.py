"""What was selected by a click: an object, how it is highlighted, and the Gaussian in
front there with its colours.
"""

from __future__ import annotations

import io
import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, RenderFn, project_points
from mi_splat.maths.rotation import to_matrix
from mi_splat.maths.sh import colour_to_dc, sh_to_colour
from mi_splat.scene import GaussianScene
from mi_splat.selection.config import Selection
from mi_splat.selection.select import select
from mi_splat.selection.visibility import pixel_weights
from mi_splat.viewer.content import Content
from mi_splat.viewer.orbit import Orbit, camera_options
from mi_splat.viewer.session import Layout, panes, pictures_of

# sRGB colour that is mixed half and half with the colour of selected Gaussians
TINT = (1.0, 0.0, 0.8)
MASK = "mask.npy"  # file of the selected Gaussians in commands


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Picked:
    """Selected Gaussians, (N,) bool, of the splat of this name, and which of them makes
    up most of the pixel.
    """

    splat: str
    mask: Tensor
    row: int | None = None
    command: str = ""

    def fits(self, scene: GaussianScene) -> bool:
        """Whether a scene has as many Gaussians."""
        return len(scene) == len(self.mask)

    @property
    def text(self) -> str:
        """Their number."""
        return (
            f"{int(self.mask.sum()):,} of {len(self.mask):,} Gaussians of {self.splat}"
        )

    @property
    def file(self) -> bytes:
        """The mask as `mi-splat select --out mask.npy` writes it."""
        buffer = io.BytesIO()
        np.save(buffer, self.mask.numpy())
        return buffer.getvalue()


@dataclass(frozen=True, slots=True, kw_only=True)
class Click:
    """A pixel (x, y) of the image of a splat as `mi-splat render` makes it; `adds`
    extends the selection.
    """

    splat: str
    pixel: tuple[int, int]
    orbit: Orbit
    adds: bool = False


def clicked(
    at: tuple[float, float], layout: Layout, mode: str, content: Content, orbit: Orbit
) -> tuple[str, tuple[int, int]] | None:
    """The splat and the pixel of its image at a point of the page; None beside the
    images.
    """
    x, y = (part * side for part, side in zip(at, layout.canvas, strict=True))
    (width, height), size = layout.size, content.size_at(orbit)
    rendered = [splat.name for splat in content.splats]
    for pane, (left, top) in zip(
        panes(mode, content.names), layout.corners, strict=True
    ):
        across = (x - left) / width
        down = (y - top) / height
        if rendered and 0 <= across < 1 and 0 <= down < 1:
            splat = pictures_of(pane, content.names)[0]
            return splat if splat in rendered else rendered[0], (
                int(across * size[0]),
                int(down * size[1]),
            )
    return None


def pick(
    click: Click, content: Content, render: RenderFn, before: Picked | None
) -> Picked:
    """The object at a pixel, as `mi-splat select --click` selects it."""
    splat, size, (x, y) = (
        content.splat(click.splat),
        content.size_at(click.orbit),
        click.pixel,
    )
    view = click.orbit.camera(size)
    mask = select(
        splat.scene, Selection(click=(f"{x},{y}",)), camera=view, render=render
    )
    row = int(pixel_weights(splat.scene, view, click.pixel, render).argmax())
    if click.adds and before is not None and before.fits(splat.scene):
        return Picked(splat=splat.name, mask=mask | before.mask, row=row)
    camera = camera_options(
        click.orbit, size, settings=content.settings, up=content.up, path=splat.path
    )
    command = [
        "mi-splat",
        "select",
        str(splat.path),
        "--click",
        f"{x},{y}",
        *camera,
        "--out",
        MASK,
    ]
    return Picked(splat=splat.name, mask=mask, row=row, command=shlex.join(command))


def tinted(scene: GaussianScene, mask: Tensor) -> GaussianScene:
    """The scene with the Gaussians of a mask, (N,) bool, mixed with another colour."""
    sh = scene.sh.clone()
    sh[mask] *= 0.5
    sh[mask, 0] += 0.5 * colour_to_dc(torch.tensor(TINT)).to(sh)
    return GaussianScene.unchecked(*scene.tensors()[:4], sh)


def border(scene: GaussianScene, row: int, view: Camera) -> Tensor:
    """(P, 2) pixels of the outline of a Gaussian at two standard deviations; none where
    it is not in front.
    """
    mean, scales, rotation = (
        part[row : row + 1].detach().cpu()
        for part in (scene.means, scene.scales, scene.rotations)
    )
    axes = (to_matrix(rotation)[0] * scales).T
    ends, depths = project_points(torch.cat([mean, mean + axes, mean - axes]), view)
    if float(depths.min()) <= 0:
        return ends[:0]
    sides = (ends[1:4] - ends[4:]) / 2
    shape = torch.linalg.cholesky(sides.T @ sides + 1e-4 * torch.eye(2))
    angles = torch.linspace(0, 2 * math.pi, 65)
    outline: Tensor = (
        ends[0] + 2 * torch.stack([angles.cos(), angles.sin()], dim=1) @ shape.T
    )
    return outline


def colours(
    scene: GaussianScene, row: Tensor | int, cameras: Sequence[Camera]
) -> Tensor:
    """(views, ..., 3) colours of Gaussians as they are seen, sRGB."""
    means = scene.means[row].detach()
    sh = scene.sh[row].detach()
    directions = torch.stack([means - view.position.to(means) for view in cameras])
    return sh_to_colour(sh, torch.nn.functional.normalize(directions, dim=-1)).clamp(
        max=1
    )


def one_gaussian(scene: GaussianScene, row: int, orbit: Orbit) -> str:
    """HTML with the colour of a Gaussian by elevation, from the camera's azimuth, and
    its SH coefficients.
    """
    cameras = [
        orbit.changed(elevation=float(angle)).camera((1, 1))
        for angle in range(0, 91, 5)
    ]
    stops = ", ".join(
        f"rgb({r}, {g}, {b})"
        for r, g, b in (255 * colours(scene, row, cameras)).int().tolist()
    )
    lines = (
        " ".join(f"{value:+.2f}" for value in channel)
        for channel in scene.sh[row].detach().T.tolist()
    )
    texts = "<br>".join(
        f"{name}: {line}"
        for name, line in zip(("red", "green", "blue"), lines, strict=True)
    )
    strip = (
        '<div style="height: 1rem; background: linear-gradient(to right,'
        f' {stops})"></div>'
    )
    head = (
        f"Gaussian {row:,}, outlined: its colour from the side (left) to straight"
        " above, and its SH coefficients"
    )
    return (
        '<div style="padding: 0 0.75rem 0.5rem; font-size:'
        f' 0.75rem">{head}{strip}{texts}</div>'
    )
