"""The attacker's copy of the scene: the meshes that the victim photographs, to take other pictures of."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from mi_splat.assets.daylight import Light
from mi_splat.assets.mesh import Asset
from mi_splat.cameras import Camera
from mi_splat.capture.path_tracer import PathTracer, in_front, scene_dict
from mi_splat.errors import InvalidValueError, message

Colour = tuple[float, float, float]

_SEED_BITS = 28
"""Bits of a stage's seed, and of what is added to it for each camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshScene:
    """An object in its surroundings, ready for the path tracer.

    To be of one piece with the victim's pictures, assets, light and background have to be theirs.

    Attributes:
        target: The object under attack, placed in the world.
        surroundings: Everything else.
        light: Sun and sky; the default light if None.
        samples: Samples per pixel.
        seed: Seed of the noise; each camera has its own from there on, so a picture depends on nothing else.
        background: sRGB colour in the place of the sky, for sets with transparent pictures; None shows the sky.

    Raises:
        InvalidValueError: The seed or the background is out of range.
    """

    target: Asset
    surroundings: Asset | None = None
    light: Light | None = None
    samples: int = 32
    seed: int = 0
    background: Colour | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 1 << _SEED_BITS:
            raise InvalidValueError(message("seed", f"0 to {(1 << _SEED_BITS) - 1}", self.seed, "choose another"))
        if self.background is not None and not all(0 <= value <= 1 for value in self.background):
            do = "white is (1, 1, 1)"
            raise InvalidValueError(message("background", "three sRGB values in [0, 1]", self.background, do))

    def with_target(self, target: Asset) -> MeshScene:
        """The same surroundings and light with another object."""
        return replace(self, target=target)

    def picture(self, camera: Camera) -> Tensor:
        """(H, W, 3) float32 path-traced picture, sRGB in [0, 1].

        Raises:
            InvalidValueError: The camera's pixels are not square.
        """
        image = self._tracer.picture(camera, seed=self.seed + camera_number(camera))
        if self.background is None:
            return image
        alpha = image[..., 3:]
        return image[..., :3] * alpha + torch.tensor(self.background) * (1 - alpha)  # as `load_dataset` blends

    def mask(self, camera: Camera) -> Tensor:
        """(H, W) bool, where the target is the first thing that the ray through a pixel meets.

        Raises:
            InvalidValueError: The camera's pixels are not square.
        """
        nearest, alone = (tracer.surface(camera, seed=0)[1] for tracer in (self._tracer, self._alone))
        return in_front(alone, nearest)

    def points(self, camera: Camera) -> Tensor:
        """(H, W, 3) points of the target that the rays through pixels meet, world units; zeros beside it.

        Raises:
            InvalidValueError: The camera's pixels are not square.
        """
        return self._alone.surface(camera, seed=0)[0]

    def cutout(self, camera: Camera) -> Tensor:
        """(H, W, 4) float32 picture of the target alone, as if nothing were around it: sRGB and coverage in [0, 1].

        Raises:
            InvalidValueError: The camera's pixels are not square.
        """
        return self._cutter.picture(camera, seed=self.seed + camera_number(camera))

    @cached_property
    def _tracer(self) -> PathTracer:
        scene = scene_dict([self.target], light=self.light, backdrop=self.surroundings)
        return PathTracer(scene, samples=self.samples, alpha=self.background is not None)

    @cached_property
    def _alone(self) -> PathTracer:
        return PathTracer(scene_dict([self.target], light=self.light), samples=1)

    @cached_property
    def _cutter(self) -> PathTracer:
        return PathTracer(scene_dict([self.target], light=self.light), samples=self.samples, alpha=True)


def camera_number(camera: Camera) -> int:
    """A number for a camera's place, the same on every machine: the last digits of poses differ between them."""
    values = (math.floor(value * 1e6 + 0.5) for value in camera.to_world.flatten().tolist())
    return zlib.crc32(" ".join(map(str, values)).encode()) >> (32 - _SEED_BITS)
