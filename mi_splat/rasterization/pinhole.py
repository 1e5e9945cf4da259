"""The camera as the rasteriser's kernels see it: a row of numbers in one small array."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_splat.cameras import Camera

GUARD = 1.3
"""x/z and y/z in the projection's Jacobian are clamped to this many times tan(fov / 2)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pinhole:
    """A camera with what else the projection depends on."""

    camera: Camera
    near: float  # means with a smaller camera-space depth are culled, world units
    antialiased: bool = False  # whether a Gaussian keeps its weight under the low-pass filter, see `project`
    field: tuple[float, float] | None = None  # tan(fov / 2) in x and y of the whole picture, of which this is a part

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels of the picture that is made."""
        return self.camera.width, self.camera.height

    def numbers(self) -> Any:
        """The 22 floats of `KernelCamera` as one array of the current variant, made anew."""
        camera, pose = self.camera, self.camera.to_camera.numpy()
        field = self.field or (0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)
        row = [pose[:3, :3].ravel(), pose[:3, 3], -pose[:3, :3].T @ pose[:3, 3], (camera.fx, camera.fy)]
        row += [(camera.cx, camera.cy), GUARD * np.asarray(field), [self.near]]
        # As a list: Dr.Jit copies that to memory of its own, where it would borrow a NumPy array's (see `aligned`).
        return mi.Float(np.concatenate(row).tolist())

    def key(self) -> tuple[Any, ...]:
        """Equal for two cameras that make the same picture."""
        camera = self.camera
        lens = camera.fx, camera.fy, camera.cx, camera.cy
        return camera.to_world.numpy().tobytes(), lens, self.size, self.field, self.near, self.antialiased

    def for_stages(self) -> StageCamera:
        """The camera's numbers as one array, as the frozen stages take them."""
        return StageCamera(self.numbers(), self.antialiased)


@dataclass(eq=False)  # not frozen: dr.freeze assigns the fields again
class StageCamera:
    """A camera as an argument of a frozen stage: its numbers may change, and its switch makes another recording."""

    numbers: Any  # `Pinhole.numbers`
    antialiased: bool


@dataclass(frozen=True, slots=True, eq=False)
class KernelCamera:
    """The same numbers inside a kernel, as Dr.Jit scalars."""

    rotation: Any  # Matrix3f, world to camera
    translation: Any  # Vector3f
    position: Any  # Point3f, camera centre in world space
    focal: Any  # Vector2f
    principal: Any  # Point2f
    guard: Any  # Vector2f, bound of |x/z| and |y/z| in the Jacobian
    near: Any  # Float
    antialiased: bool = False


def unpack(numbers: Any, *, antialiased: bool = False) -> KernelCamera:
    """Read a `KernelCamera` out of the array that `Pinhole.numbers` made."""
    v = [dr.gather(mi.Float, numbers, mi.UInt32(i)) for i in range(22)]
    return KernelCamera(
        rotation=mi.Matrix3f(*v[0:9]),
        translation=mi.Vector3f(*v[9:12]),
        position=mi.Point3f(*v[12:15]),
        focal=mi.Vector2f(*v[15:17]),
        principal=mi.Point2f(*v[17:19]),
        guard=mi.Vector2f(*v[19:21]),
        near=v[21],
        antialiased=antialiased,
    )
