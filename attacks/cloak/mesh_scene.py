"""The attacker's copy of the scene: the meshes that the victim photographs, edits of
its object, and its images.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.capture.daylight import Light
from mi_splat.capture.ground import grass, road
from mi_splat.capture.mesh import (
    Asset,
    Doubles,
    Floats,
    Mesh,
    rotation,
    scaling,
    translation,
)
from mi_splat.capture.mesh_files import image_floats, load_mesh
from mi_splat.capture.mitsuba_scene import scene_dict
from mi_splat.capture.objects import SUFFIX, chosen_file
from mi_splat.capture.path_tracer import PathTracer, in_front

DRAWN = {"road": road, "grass": grass}
"""Textures that are drawn by code and tile the plane."""
TILE = 4.0
"""Metres that one of these covers."""
_FOLDER = Path(__file__).parent / "textures"

Colour = tuple[float, float, float]

_NOTHING = Asset("nothing", ())
_SEED_BITS = 28
"""Bits of the seed of a camera's noise, by which an image depends on nothing else."""


def texture_file(name: str, what: str = "texture") -> Path:
    """The file of a shipped texture, or a user's own."""
    shipped = {file.stem: file for file in sorted(_FOLDER.glob(f"*{SUFFIX}"))}
    known = {drawn: Path(drawn) for drawn in DRAWN} | shipped
    return chosen_file(name, known, what, "an image file")


def load_texture(name: str) -> tuple[Floats, float | None]:
    """A texture, and the metres that it covers; None shows it once, as a whole."""
    if name in DRAWN:
        return DRAWN[name](), TILE
    file = texture_file(name)
    if file.suffix == SUFFIX:
        return load_mesh(file).meshes[0].texture, None
    return image_floats(file), None


def repainted(
    target: Asset,
    picture: Floats,
    *,
    azimuth: float,
    elevation: float,
    tile: float | None = None,
) -> Asset:
    """An object covered all over, glass and wheels included, with an image thrown onto
    it from one direction.

    The projection is parallel, so the image is undistorted for a viewer far away in
    that direction, upright for the camera of `mi_splat.cameras.camera.orbit_pose`; from
    straight above its top points away from `azimuth`. Surfaces are diffuse, as gloss
    would give the object away.
    """
    axes = screen_axes(azimuth, elevation)
    seen = target.vertices.astype(np.float64) @ axes.T
    low = seen.min(0)
    high = seen.max(0)
    scale = np.maximum(high - low, 1e-9) if tile is None else np.full(2, tile)

    def paint(mesh: Mesh) -> Mesh:
        uvs = ((mesh.vertices.astype(np.float64) @ axes.T - low) / scale).astype(
            np.float32
        )
        return replace(mesh, uvs=uvs, texture=picture, roughness=None)

    return replace(target, meshes=tuple(paint(mesh) for mesh in target.meshes))


def stand_in(target: Asset, other: Asset, *, azimuth: float | None) -> Asset:
    """Another object in a target's place, turned to face a
    viewer at `azimuth`.

    It is scaled, in proportion, to fit the target's outline from there, and centred on
    it. Its front lies where the target's does: near the surface that a splat shows from
    there, so that there is little parallax to be hidden.
    """
    # In a frame where the viewer is at +x both are boxes side by side.
    turn = rotation("z", 0.0 if azimuth is None else azimuth).astype(np.float64)
    wanted = (
        Asset(target.name, target.meshes)
        .transformed(np.linalg.inv(turn))
        .bounds.astype(np.float64)
    )
    own = other.bounds.astype(np.float64)
    outline = slice(0, 2) if azimuth is None else slice(1, 3)
    scale = float(
        (
            (wanted[1] - wanted[0])[outline]
            / np.maximum((own[1] - own[0])[outline], 1e-9)
        ).min()
    )
    shift = (wanted.mean(0) - scale * own.mean(0)).tolist()
    axis, end = (2, 0) if azimuth is None else (0, 1)
    shift[axis] = float(wanted[end, axis] - scale * own[end, axis])
    return other.transformed(turn @ translation(*shift) @ scaling(scale, scale, scale))


def screen_axes(azimuth: float, elevation: float) -> Doubles:
    """(2, 3) unit vectors to the right and up in the image of a camera on an orbit,
    world frame.
    """
    a = math.radians(azimuth)
    e = math.radians(elevation)
    right = (-math.sin(a), math.cos(a), 0.0)
    up = (-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e))
    return np.array([right, up])


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshScene:
    """An object in its surroundings, ready for the path tracer; assets, light and
    background are the victim's.
    """

    target: Asset
    surroundings: Asset = _NOTHING
    light: Light = field(default_factory=Light)  # sun and sky
    samples: int = 32
    background: Colour | None = None

    def with_target(self, target: Asset) -> MeshScene:
        """A scene with another object in the same surroundings and light."""
        return replace(self, target=target)

    def picture(self, camera: Camera) -> Tensor:
        """(H, W, 3) float32 path-traced image, sRGB in [0, 1]."""
        image = self._tracer.picture(camera, seed=camera_number(camera))
        if self.background is None:
            return image
        alpha = image[..., 3:]
        # as `load_dataset` blends
        return image[..., :3] * alpha + torch.tensor(self.background) * (1 - alpha)

    def mask(self, camera: Camera) -> Tensor:
        """(H, W) bool, where the target is the first thing that the ray through a pixel
        meets.
        """
        nearest, alone = (
            tracer.surface(camera, seed=0)[1] for tracer in (self._tracer, self._alone)
        )
        return in_front(alone, nearest)

    def points(self, camera: Camera) -> Tensor:
        """(H, W, 3) points of the target that the rays through pixels meet, world
        units; zeros beside it.
        """
        return self._alone.surface(camera, seed=0)[0]

    @cached_property
    def _tracer(self) -> PathTracer:
        scene = scene_dict([self.target], light=self.light, backdrop=self.surroundings)
        return PathTracer(
            scene, samples=self.samples, alpha=self.background is not None
        )

    @cached_property
    def _alone(self) -> PathTracer:
        return PathTracer(scene_dict([self.target], light=self.light), samples=1)


def camera_number(camera: Camera) -> int:
    """A number for a camera's place, the same on every machine: the last digits of
    poses differ between them.
    """
    values = (
        math.floor(value * 1e6 + 0.5) for value in camera.to_world.flatten().tolist()
    )
    return zlib.crc32(" ".join(map(str, values)).encode()) >> (32 - _SEED_BITS)
