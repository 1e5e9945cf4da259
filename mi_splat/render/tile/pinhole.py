"""The camera as the rasteriser's kernels see it."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.cameras.camera import Camera

GUARD = 1.3
"""x/z and y/z in the projection's Jacobian are clamped to this many times tan(fov /
2).
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pinhole:
    """A camera with what else the projection depends on."""

    camera: Camera
    near: float  # means with a smaller camera-space depth are culled, world units
    # whether a Gaussian keeps its weight under the low-pass filter, see `project`
    antialiased: bool = False
    # tan(fov / 2) in x and y of the whole image, of which this is a part
    field: tuple[float, float] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels of the image that is made."""
        return self.camera.width, self.camera.height

    def key(self) -> tuple[Any, ...]:
        """Equal for two cameras that make the same image."""
        camera = self.camera
        return (
            camera.to_world.numpy().tobytes(),
            camera.lens,
            self.field,
            self.near,
            self.antialiased,
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Pinhole) and self.key() == other.key()

    def __hash__(self) -> int:
        return hash(self.key())

    def for_kernels(self) -> KernelCamera:
        """The camera's numbers in memory, for the rasteriser: a kernel reads each once,
        and is not another one for others.
        """
        self.camera.lens.require_perspective()
        return self.for_rays()

    def for_rays(self) -> KernelCamera:
        """The same for a renderer that honours any projection."""
        return _in_memory(mi.variant(), self)


@functools.lru_cache(maxsize=128)
def _in_memory(variant: str, pinhole: Pinhole) -> KernelCamera:
    camera = pinhole.camera
    pose = camera.to_camera.numpy()
    scale = camera.lens.scale
    field = pinhole.field or (
        0.5 * camera.width / scale[0],
        0.5 * camera.height / scale[1],
    )
    made = KernelCamera(
        rotation=mi.Matrix3f(*pose[:3, :3].ravel().tolist()),
        translation=mi.Vector3f(*pose[:3, 3].tolist()),
        position=mi.Point3f(*(-pose[:3, :3].T @ pose[:3, 3]).tolist()),
        focal=mi.Vector2f(*scale),
        principal=mi.Point2f(camera.cx, camera.cy),
        guard=mi.Vector2f(*(GUARD * side for side in field)),
        near=mi.Float(pinhole.near),
        antialiased=pinhole.antialiased,
    )
    dr.make_opaque(made)
    return made


@dataclass(eq=False)  # not frozen: dr.freeze assigns the fields again
class KernelCamera:
    """A camera inside a kernel, as Dr.Jit scalars; its switch makes another
    recording.
    """

    rotation: Any  # Matrix3f, world to camera
    translation: Any  # Vector3f
    position: Any  # Point3f, camera centre in world space
    focal: Any  # Vector2f
    principal: Any  # Point2f
    guard: Any  # Vector2f, bound of |x/z| and |y/z| in the Jacobian
    near: Any  # Float
    antialiased: bool
