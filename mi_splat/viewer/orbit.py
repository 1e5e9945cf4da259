"""A camera that looks at a point from an azimuth, an elevation and a distance: what sliders and a mouse can change."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from mi_splat.cameras import Camera, orbit_pose
from mi_splat.directions import POLE, Point
from mi_splat.errors import InvalidValueError, message
from mi_splat.scene_files import resized

_ANGLE_DIGITS, _LENGTH_DIGITS = 2, 5
"""Decimals that are kept of angles (degrees), and digits of lengths, of a pose that came from a mouse."""
_CAMERA_DIGITS, _ROLL_DIGITS = 6, 3
"""Decimals that are kept of the pose of a camera and of its roll; cameras of files have single precision."""
_SAME_POSE = 1e-3
"""Part of the distance by which two poses may differ and still be the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Orbit:
    """A camera without a picture size, whose numbers can be changed; or a camera of a file, until they are.

    A camera of a file is kept as it is: no number is rounded, and it may have two focal lengths, or a principal point
    off the centre.

    Attributes:
        target: (3,) point that is looked at, world units.
        azimuth: Degrees from world +x towards +y, in [0, 360).
        elevation: Degrees above the horizontal plane, in [-90, 90].
        distance: World units between camera and target, > 0.
        fov: Degrees over the shorter side of a picture, in (0, 180).
        roll: Degrees that the camera is turned about its axis, clockwise as it looks, in [-180, 180].
        exact: The very camera, if it is one of a file.
        source: What `mi-splat render --cameras` calls that; empty if it has no name for it.

    Raises:
        InvalidValueError: A number is out of range or not finite.
    """

    target: Point
    azimuth: float
    elevation: float
    distance: float
    fov: float
    roll: float = 0.0
    exact: Camera | None = None
    source: str = ""

    def __post_init__(self) -> None:
        numbers = (*self.target, self.azimuth, self.elevation, self.distance, self.fov, self.roll)
        ranges = -90 <= self.elevation <= 90 and self.distance > 0 and 0 < self.fov < 180 and abs(self.roll) <= 180
        if not (len(self.target) == 3 and ranges and all(map(math.isfinite, numbers))):
            expected = "three coordinates, elevation in [-90, 90], distance > 0, fov in (0, 180), roll in [-180, 180]"
            raise InvalidValueError(message("orbit", expected, numbers, "change the number that is out of range"))
        object.__setattr__(self, "target", tuple(float(value) + 0.0 for value in self.target))  # -0.0 becomes 0.0
        object.__setattr__(self, "azimuth", self.azimuth % 360.0)

    @property
    def camera_size(self) -> tuple[int, int] | None:
        """Width and height in pixels of the picture of a camera of a file; None of others."""
        return None if self.exact is None else (self.exact.width, self.exact.height)

    @property
    def position(self) -> tuple[float, float, float]:
        """(3,) where the camera stands, world units."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        x, y, z = self.target
        flat = self.distance * math.cos(e)
        return x + flat * math.cos(a), y + flat * math.sin(a), z + self.distance * math.sin(e)

    def camera(self, size: tuple[int, int]) -> Camera:
        """The camera with a picture of so many pixels, (width, height); the same as `mi-splat render` takes."""
        if self.exact is not None:
            return resized(self.exact, size)
        angles = {"azimuth": self.azimuth, "elevation": self.elevation, "roll": self.roll}
        pose = orbit_pose(self.target, distance=self.distance, **angles)
        return Camera(to_world=pose, focal=focal_length(self.fov, size), width=size[0], height=size[1])

    def vertical_fov(self, size: tuple[int, int]) -> float:
        """Field of view in radians from the top to the bottom of a picture of (width, height)."""
        return 2 * math.atan(size[1] / 2 / focal_length(self.fov, size))

    def is_at(self, position: Sequence[float], look_at: Sequence[float]) -> bool:
        """Whether this is a camera at `position` (3,) that looks at `look_at` (3,), to a thousandth of the distance."""
        apart = max(math.dist(self.position, position), math.dist(self.target, look_at))
        return apart <= _SAME_POSE * self.distance

    def changed(self, **numbers: Any) -> Orbit:
        """The camera with other numbers, which is none of a file any more."""
        return replace(self, exact=None, source="", **numbers)

    def moved(self, position: Sequence[float], look_at: Sequence[float]) -> Orbit:
        """The camera at `position` (3,) that looks at `look_at` (3,), in numbers short enough to be typed.

        Straight above and below, where there is no azimuth, it keeps the one it had. A pose that is no camera (both
        points the same, or not finite) changes nothing.
        """
        x, y, z = (float(a) - float(b) for a, b in zip(position, look_at, strict=True))
        flat, length = math.hypot(x, y), math.hypot(x, y, z)
        if not (math.isfinite(length) and length > 0):
            return self
        decimals = _LENGTH_DIGITS - 1 - math.floor(math.log10(length))
        azimuth = self.azimuth if flat <= POLE * length else math.degrees(math.atan2(y, x)) % 360.0
        near = math.dist(look_at, self.target) <= _SAME_POSE * length
        return self.changed(
            # What was not moved keeps every digit: the middle of a scene is not told from its neighbours by rounding.
            target=self.target if near else tuple(round(float(value), decimals) for value in look_at),
            azimuth=round(azimuth, _ANGLE_DIGITS),
            elevation=round(math.degrees(math.atan2(z, flat)), _ANGLE_DIGITS),
            distance=round(length, decimals),
        )


def focal_length(fov: float, size: tuple[int, int]) -> float:
    """Focal length in pixels of a field of view (degrees, over the shorter side) at (width, height)."""
    return min(size) / 2 / math.tan(math.radians(fov) / 2)


def orbit_of(camera: Camera, middle: Point, *, source: str = "") -> Orbit:
    """A camera of a file as an orbit: around the point of its axis that is nearest to `middle` (3,), world units.

    Where `middle` is behind it, that point is as far before it.
    """
    pose, centre = camera.to_world, torch.tensor(list(middle), dtype=torch.float64)
    forward = pose[:3, 2]
    distance = float((centre - camera.position) @ forward)
    if not round(distance, _CAMERA_DIGITS) > 0:
        distance = max(float((centre - camera.position).norm()), 10**-_CAMERA_DIGITS)
    x, y, z = (-forward).tolist()
    elevation = math.degrees(math.atan2(z, math.hypot(x, y)))
    if math.hypot(x, y) > POLE:
        azimuth = math.degrees(math.atan2(y, x))
    else:  # straight above and below the picture's right edge points along (-sin azimuth, cos azimuth, 0)
        azimuth = math.degrees(math.atan2(-float(pose[0, 0]), float(pose[1, 0])))
    level = orbit_pose((0.0, 0.0, 0.0), azimuth=azimuth, elevation=elevation, distance=1.0)
    right = level[:3, :2].T @ pose[:3, 0]
    fov = 2 * math.degrees(math.atan(min(camera.width, camera.height) / 2 / camera.fx))
    numbers = (round(value, _CAMERA_DIGITS) for value in (azimuth, elevation, distance, fov))
    azimuth, elevation, distance, fov = numbers
    return Orbit(
        target=[round(value, _CAMERA_DIGITS) for value in (camera.position + distance * forward).tolist()],
        azimuth=azimuth,
        elevation=elevation,
        distance=distance,
        fov=fov,
        roll=round(math.degrees(math.atan2(float(right[1]), float(right[0]))), _ROLL_DIGITS) + 0.0,
        exact=camera,
        source=source,
    )


def focus_of(cameras: Sequence[Camera], otherwise: Point) -> Point:
    """(3,) the point nearest to the axes of all cameras, in the sense of least squares; world units."""
    if not cameras:
        return otherwise
    forward = torch.stack([camera.to_world[:3, 2] for camera in cameras])
    # A point's distance to an axis is the length of what is left of it when its part along the axis is taken away.
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    positions = torch.stack([camera.position for camera in cameras])
    total = across.sum(0)
    if float(torch.linalg.eigvalsh(total)[0]) < 1e-3:
        return otherwise
    x, y, z = torch.linalg.solve(total, (across @ positions[:, :, None]).sum(0))[:, 0].tolist()
    return x, y, z
