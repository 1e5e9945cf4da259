"""What decides about an image: a splat as a file has it, a camera, and what a renderer
makes of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mi_splat.oracle import (
    DEFAULT,
    Array,
    Convention,
    PinholeCamera,
    Pixels,
    Splat,
    every_pixel,
    project,
    render,
    render_rays,
)

C0 = 0.28209479177387814

Mirrored = Literal["no", "left to right", "upside down", "both"]


def look_at(
    eye: ArrayLike,
    target: ArrayLike,
    *,
    focal: float,
    width: int,
    height: int,
    up: ArrayLike = (0.0, 0.0, 1.0),
) -> PinholeCamera:
    """The camera at `eye` that looks at `target`; where it looks along `up`, y is up in
    its image.
    """
    position = np.asarray(eye, dtype=np.float64)
    pose = np.eye(4)
    pose[:3, :3] = upright(np.asarray(target, dtype=np.float64) - position, up)
    pose[:3, 3] = position
    return PinholeCamera(
        to_world=pose,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        width=width,
        height=height,
    )


def upright(forward: Array, up: ArrayLike) -> Array:
    """(3, 3) axes x right, y down and z forward of a camera."""
    right = np.cross(forward, np.asarray(up))
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(forward):
        right = np.cross(forward, np.roll(np.asarray(up), -1))
    axes: Array = np.stack([right, np.cross(forward, right), forward], axis=1)
    axes /= np.linalg.norm(axes, axis=0)
    return axes


def _sigmoid(logits: Array) -> Array:
    return 1 / (1 + np.exp(-logits))


@dataclass(frozen=True, kw_only=True, eq=False)
class Setup:
    """A splat, a camera, and what a renderer makes of them."""

    # as a PLY file has it: logarithms of scales, logits of opacities, quaternions as w,
    # x, y, z
    stored: Splat
    camera: PinholeCamera
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    model: Literal["tile", "ray"] = "tile"
    convention: Convention = DEFAULT
    scales: Callable[[Array], Array] = np.exp
    opacities: Callable[[Array], Array] = field(default=_sigmoid)
    before: Callable[[Array], Array] | None = None  # of colours before they are blended
    # of the finished image (H, W, 3) and its alpha (H, W, 1)
    after: Callable[[Array, Array], Array] | None = None
    mirrored: Mirrored = "no"

    @property
    def splat(self) -> Splat:
        """The Gaussians as values, without those that are not finite or have no
        rotation.
        """
        stored = Splat(*(values.astype(np.float64) for values in self.stored))
        rows = [values.reshape(len(values), -1) for values in stored]
        finite = [np.isfinite(values).all(axis=1) for values in rows]
        whole = np.all(finite, axis=0) & stored.rotations.any(axis=1)
        stored = Splat(*(values[whole] for values in stored))
        return stored._replace(
            scales=self.scales(stored.scales),
            opacities=self.opacities(stored.opacities),
        )

    # a wrong camera may have Gaussians beside it, at a depth of 0
    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def render(self, pixels: Pixels | None = None) -> tuple[Array, Array]:
        """The image (H, W, 3) and its alpha (H, W); all pixels by default."""
        seen = every_pixel(self.camera) if pixels is None else pixels
        rows, columns = seen
        if self.mirrored in ("upside down", "both"):
            rows = self.camera.height - 1 - rows
        if self.mirrored in ("left to right", "both"):
            columns = self.camera.width - 1 - columns
        image, alpha = self._render(Pixels(rows, columns))
        if self.after is not None:
            image = self.after(image, alpha[..., None])
        return image, alpha

    def _render(self, pixels: Pixels) -> tuple[Array, Array]:
        splat = self.splat
        background = np.array(self.background)
        if self.model == "ray":
            return render_rays(splat, self.camera, background=background, pixels=pixels)
        convention = self.convention
        if self.before is not None:
            colours = self.before(project(splat, self.camera, convention).colour)
            splat = splat._replace(sh=(colours[:, None] - 0.5) / C0)
            background = self.before(background)
            convention = replace(convention, clamp="none")
        seen = render(
            splat,
            self.camera,
            background=background,
            convention=convention,
            pixels=pixels,
        )
        return seen.image, seen.alpha
