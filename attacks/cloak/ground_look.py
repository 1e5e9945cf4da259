"""The look of the ground, laid on the object: a texture that stays where it is when the camera moves.

Where the object is removed, each of its points has to show another piece of the ground to each camera. A splat's colour
is a polynomial of low degree in the direction, so that it shows their mean: a smooth patch. Here each point of the
object has one piece of the ground, the one behind it when it is looked at from the side that it faces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from attacks.cloak.appearances import remove
from attacks.cloak.mesh_scene import MeshScene
from mi_splat.assets.mesh import Asset
from mi_splat.cameras import Camera, View, look_at, project_points

LOWEST_GROUND = 45.0
"""Elevation from which a side of the object is taken to be looked at, at least, degrees."""

_HEIGHT, _SIZE = 12.0, 768
"""Of the camera above the ground that takes its picture, in lengths of the object; width of the picture, pixels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundLook:
    """The object in the colours that the ground has where it is lit, without the object and its shadow.

    Attributes:
        mesh_scene: The scene as the victim sees it.
        lowest: Lowest elevation from which a point is taken to be looked at, degrees: the sides of the object face
            the horizon, where there is no ground behind them.
        reach: Pixels around the target in which the picture is that without the object.
    """

    mesh_scene: MeshScene
    lowest: float = LOWEST_GROUND
    reach: int = 1

    @property
    def name(self) -> str:
        """For manifests."""
        return f"the ground laid on it, from elevation {self.lowest:g}"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The picture with the ground on the object."""
        around = remove(self.mesh_scene, reach=self.reach)(view, mask)
        points = self.mesh_scene.points(view.camera)[mask.cpu()]
        picture = around.clone()
        picture[mask] = self.colours(points).to(picture)
        return picture

    def colours(self, points: Tensor) -> Tensor:
        """(N, 3) sRGB in [0, 1] of the ground behind (N, 3) points of the object, world units."""
        low, high = _bounds(self.mesh_scene.target)
        foot = torch.stack([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
        # The normal of an ellipsoid about the foot's middle through the corners' distances: smooth, whatever the mesh.
        half = torch.stack([(high[0] - low[0]) / 2, (high[1] - low[1]) / 2, high[2] - low[2]]).clamp(min=1e-6)
        facing = functional.normalize((points - foot) / half**2, dim=-1)
        flat = facing[:, :2].norm(dim=-1)
        elevation = torch.atan2(facing[:, 2], flat).clamp(min=math.radians(self.lowest))
        away = (points[:, 2] - low[2])[:, None] / elevation.tan()[:, None]
        ground = points.clone()
        ground[:, :2] -= away * facing[:, :2] / flat.clamp(min=1e-9)[:, None]
        ground[:, 2] = low[2]
        camera, picture = self._ground
        pixels, _ = project_points(ground, camera)
        grid = 2 * pixels / torch.tensor([camera.width, camera.height]) - 1
        sampled = functional.grid_sample(
            picture.permute(2, 0, 1)[None], grid[None, None].to(picture), padding_mode="border", align_corners=False
        )
        return sampled[0, :, 0].T

    @cached_property
    def _ground(self) -> tuple[Camera, Tensor]:
        """The ground from above, without the object."""
        low, high = _bounds(self.mesh_scene.target)
        middle, reach = (low + high) / 2, float((high - low).norm())
        above = (float(middle[0]), float(middle[1]), float(low[2]) + _HEIGHT * reach)
        camera = Camera(
            to_world=look_at(above, (above[0], above[1], float(low[2]))),
            focal=_HEIGHT * _SIZE / 2,
            width=_SIZE,
            height=_SIZE,
        )
        empty = self.mesh_scene.with_target(Asset(self.mesh_scene.target.name, ()))
        return camera, empty.picture(camera)


def _bounds(target: Asset) -> tuple[Tensor, Tensor]:
    """(3,) lowest and (3,) highest corner of the box around the target."""
    low, high = torch.from_numpy(target.bounds.copy()).float()
    return low, high
