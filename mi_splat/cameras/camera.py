"""Cameras, views, and the one call signature by which training, auditing and
attacks see a renderer.

Frames: the world is right-handed with z up; a camera looks along its own +z with x
right and y down (OpenCV). Pixel centres lie at half integers, so the image spans [0,
width] x [0, height].
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Protocol

import numpy as np
import torch
from torch import Tensor

from mi_splat.attributes import LARGEST
from mi_splat.cameras.lens import Lens, angle_of
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Range, above, checked_number, several_of, taken
from mi_splat.maths.rotation import is_rotation
from mi_splat.scene import GaussianScene

_Point = tuple[
    Annotated[float, Range()], Annotated[float, Range()], Annotated[float, Range()]
]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Camera:
    """A camera with exact pose and intrinsics.

    Attributes:
        to_world: (4, 4) float64 rigid transform from camera space (x right, y down, z
            forward) to world space.
        lens: Its intrinsics, and the size of its images.

    Raises:
        InvalidValueError: to_world is not a finite rigid transform, or a coordinate is
            larger than `mi_splat.attributes.LARGEST`.
    """

    to_world: Tensor
    lens: Lens

    def __repr__(self) -> str:
        at = ", ".join(f"{value + 0.0:.3g}" for value in self.position.tolist())
        return (
            f"Camera(at ({at}), {self.width} x {self.height} pixels, focal"
            f" {self.lens.scale[0]:.4g})"
        )

    def __post_init__(self) -> None:
        pose = pose_tensor(self.to_world)
        if pose.shape != (4, 4):
            raise InvalidValueError.of(
                "to_world",
                "shape (4, 4)",
                tuple(pose.shape),
                "pass a camera-to-world matrix",
            )
        *rows, last = pose.tolist()
        is_affine = (
            all(abs(value) <= 1e-8 for value in last[:3]) and abs(last[3] - 1) <= 1e-5
        )
        if not (
            is_affine
            and is_rotation(pose[:3, :3])
            and all(math.isfinite(row[3]) for row in rows)
        ):
            do = "remove scale, shear and reflections from it"
            raise InvalidValueError.of(
                "to_world", "a finite rotation and translation", pose.tolist(), do
            )
        if not all(abs(row[3]) <= LARGEST for row in rows):
            expected = f"coordinates up to {LARGEST:g}"
            do = "move the scene and its cameras to the origin"
            raise InvalidValueError.of(
                "camera position", expected, pose[:3, 3].tolist(), do
            )
        object.__setattr__(self, "to_world", pose)
        if not isinstance(self.lens, Lens):
            raise InvalidValueError.of(
                "lens", "a Lens", repr(self.lens), "pass mi_splat.Lens(...)"
            )

    @property
    def width(self) -> int:
        """Width of its images in pixels."""
        return self.lens.size[0]

    @property
    def height(self) -> int:
        """Height of its images in pixels."""
        return self.lens.size[1]

    @property
    def fx(self) -> float:
        """Horizontal focal length in pixels; an error unless it is perspective."""
        return self.lens.fx

    @property
    def fy(self) -> float:
        """Vertical focal length in pixels; an error unless it is perspective."""
        return self.lens.fy

    @property
    def cx(self) -> float:
        """Horizontal principal point in pixels."""
        return self.lens.cx

    @property
    def cy(self) -> float:
        """Vertical principal point in pixels."""
        return self.lens.cy

    @property
    def position(self) -> Tensor:
        """(3,) float64 centre of projection in world space."""
        return self.to_world[:3, 3]

    def turned(self, turn: Tensor, about: Tensor | None = None) -> Camera:
        """The camera as it stands in a world that was turned about a point.

        Args:
            turn: (3, 3) float64 rotation of world coordinates.
            about: (3,) point that stays, world units; the origin if None.

        Returns:
            The same camera, seen in that world.
        """
        middle = torch.zeros(3, dtype=torch.float64) if about is None else about
        pose = self.to_world.clone()
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] = turn @ (pose[:3, 3] - middle) + middle
        return replace(self, to_world=pose)

    def downscaled(self, factor: int) -> Camera:
        """The camera of an image that was made smaller; a rest of its size is cut off.

        Args:
            factor: Integer by which both sides are divided.

        Returns:
            The camera with the lens of the smaller image, at the same place.
        """
        if factor == 1:
            return self
        across, down = self.lens.scale
        lens = replace(
            self.lens,
            focal=(across / factor, down / factor),
            size=(self.width // factor, self.height // factor),
            principal=(self.cx / factor, self.cy / factor),
        )
        return replace(self, lens=lens)

    @property
    def to_camera(self) -> Tensor:
        """(4, 4) float64 transform from world to camera space."""
        # torch's takes ten times as long
        return torch.from_numpy(np.linalg.inv(self.to_world.numpy()))


def as_cameras(cameras: Camera | Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras as a tuple, whether one was given or several."""
    return several_of(Camera, "cameras", cameras)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class View:
    """An image and the camera that took it.

    Attributes:
        camera: The camera.
        image: (height, width, 3) float32, sRGB in [0, 1].
    """

    camera: Camera
    image: Tensor

    def __repr__(self) -> str:
        return f"View({self.camera!r})"

    def __post_init__(self) -> None:
        expected = (self.camera.height, self.camera.width, 3)
        if tuple(self.image.shape) != expected:
            do = "resize it or fix the camera's size"
            raise InvalidValueError.of(
                "image", f"shape {expected}", tuple(self.image.shape), do
            )


class ViewSet(Sequence[View]):
    """Views that need not be in memory: what can be known of them without decoding an
    image, the set says itself.
    """

    __slots__ = ()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} views{sizes_of(self.cameras)})"

    @property
    @abstractmethod
    def cameras(self) -> tuple[Camera, ...]:
        """The camera of each view."""

    @property
    def fingerprint(self) -> str | None:
        """What tells this set from others, pixels included; None where only decoding
        the images would.
        """
        return None


def sizes_of(cameras: Sequence[Camera]) -> str:
    """The size of their images, as the end of a sentence."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    width, height = max(sizes, default=(0, 0))
    if not sizes:
        return ""
    return f" of {'up to ' if len(sizes) > 1 else ''}{width} x {height} pixels"


def cameras_of(views: Sequence[View]) -> tuple[Camera, ...]:
    """The camera of each view; a `ViewSet` is not made to read its images."""
    if isinstance(views, ViewSet):
        return views.cameras
    return tuple(view.camera for view in views)


def fingerprint_of(views: Sequence[View]) -> str | None:
    """What tells the images of a `ViewSet` from others without decoding them; None of
    any other sequence.
    """
    if isinstance(views, ViewSet):
        return views.fingerprint
    return None


class RenderFn(Protocol):
    """How training, auditing and attacks see a renderer: differentiable in the five
    tensors of the scene.
    """

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """Render `scene` to an (H, W, 3) sRGB image.

        Args:
            scene: The splat; images are differentiable in its five tensors.
            camera: From where, and how large the image is.

        Returns:
            (H, W, 3) sRGB, on the device of the scene; differentiable in the scene's
            five tensors.
        """
        ...


def look_at(
    origin: Sequence[float],
    target: Sequence[float],
    *,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> Tensor:
    """(4, 4) float64 camera-to-world pose (OpenCV axes) at `origin` facing `target`.

    When the view direction is parallel to `up`, the image's top points along world +y
    instead.

    Args:
        origin: (3,) position of the camera, world units.
        target: (3,) point in the middle of the image, world units.
        up: (3,) direction that points up in the image; its length does not matter.

    Returns:
        (4, 4) float64: x to the right, y down, z forward, and the origin.

    Raises:
        InvalidValueError: origin and target coincide, or one is not three finite
            numbers.
    """
    given = {"origin": origin, "target": target, "up": up}
    eye, middle, top = (
        torch.tensor(taken(_Point, value, name), dtype=torch.float64)
        for name, value in given.items()
    )
    forward = middle - eye
    length = torch.linalg.norm(forward)
    if not length > 0:
        raise InvalidValueError.of(
            "target", "a point other than origin", tuple(target), "move one of the two"
        )
    forward = forward / length
    right = torch.linalg.cross(forward, top)
    if torch.linalg.norm(right) < 1e-9:
        right = torch.linalg.cross(
            forward, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        )
    right = right / torch.linalg.norm(right)
    pose = torch.eye(4, dtype=torch.float64)
    torch.stack(
        (right, torch.linalg.cross(forward, right), forward, eye), 1, out=pose[:3]
    )
    return pose


def orbit_pose(
    target: Sequence[float],
    *,
    azimuth: float,
    elevation: float,
    distance: float,
    roll: float = 0.0,
) -> Tensor:
    """Camera-to-world pose on a sphere around `target`, looking at it."""
    target = taken(_Point, target, "target")
    for name, angle in (("azimuth", azimuth), ("elevation", elevation), ("roll", roll)):
        checked_number(name, angle)
    checked_number("distance", distance, above(0, "world units"))
    a = math.radians(azimuth)
    e = math.radians(elevation)
    offset = (math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e))
    origin = [t + distance * o for t, o in zip(target, offset, strict=True)]
    # Near the zenith world z is no usable "up"; this direction is perpendicular to the
    # view everywhere.
    up = (-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e))
    pose = look_at(origin, target, up=up)
    if roll:
        c = math.cos(math.radians(roll))
        s = math.sin(math.radians(roll))
        pose[:3, :2] = pose[:3, :2] @ torch.tensor(
            [[c, -s], [s, c]], dtype=torch.float64
        )
    return pose


NARROWEST = 1.0
WIDEST = 170.0
"""Degrees: a camera with another field of view is hardly meant."""


def odd_fields_of_view(cameras: Sequence[Camera]) -> str | None:
    """What to warn of where cameras have a focal length that is hardly meant; None if
    none has.
    """
    angles = []
    for camera in cameras:
        if not camera.lens.is_perspective:
            continue
        across = math.degrees(angle_of(camera.fx, camera.width))
        down = math.degrees(angle_of(camera.fy, camera.height))
        if min(across, down) < NARROWEST or max(across, down) > WIDEST:
            angles.append((across, camera))
    if not angles:
        return None
    angle, camera = angles[0]
    return (
        f"{len(angles)} of {len(cameras)} cameras have a field of view of {angle:.2g}"
        f" degrees (a focal length of {camera.fx:,.5g} pixels for {camera.width}"
        " pixels); check the unit of the focal length"
    )


def project_points(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Project world points with a camera."""
    pose = camera.to_camera.to(points)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    place = camera.lens.model.place(local[:, 0], local[:, 1], depth)
    scale = local.new_tensor(camera.lens.scale)
    centre = local.new_tensor([camera.cx, camera.cy])
    return torch.stack(place, 1) * scale + centre, depth


def project_box(points: Tensor, camera: Camera) -> Tensor | None:
    """The pixel box around the projection of `points`, clipped to the image."""
    pixels, depth = project_points(points, camera)
    pixels = pixels[depth > 1e-6]
    if len(pixels) == 0:
        return None
    limit = pixels.new_tensor([camera.width, camera.height])
    low = pixels.amin(0).clamp(min=0).minimum(limit)
    high = pixels.amax(0).clamp(min=0).minimum(limit)
    if bool((high > low).all()):
        return torch.cat([low, high])
    return None


def pose_tensor(value: object) -> Tensor:
    """A pose as float64 on the CPU, from a tensor, an array or nested lists."""
    try:
        return torch.as_tensor(value).detach().to("cpu", torch.float64)
    except (TypeError, ValueError, RuntimeError):
        got = f"{type(value).__name__} {value!r:.80}"
        raise InvalidValueError.of(
            "to_world", "a (4, 4) matrix of numbers", got, "pass a tensor"
        ) from None
