"""A camera around a point, which sliders and the mouse can change, and the options that
give it to a command.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.directions import POLE, UP, Point
from mi_splat.cameras.lens import Lens, angle_of, focal_of
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.camera_records import OF
from mi_splat.maths.rotation import from_z
from mi_splat.render.renderer import RenderSettings
from mi_splat.render.scene_files import resized

_ANGLE_DIGITS = 2
_LENGTH_DIGITS = 5
"""Decimals of angles (degrees), and significant digits of lengths, that are kept of a
pose set with the mouse.
"""
_CAMERA_DIGITS = 6
_ROLL_DIGITS = 3
"""Decimals that are kept of the pose of a camera and of its roll; cameras of files have
single precision.
"""
_SAME_POSE = 1e-3  # fraction of the distance within which two poses count as the same


@dataclass(frozen=True, slots=True, kw_only=True)
class Orbit:
    """A camera around `target`, without an image size: angles in degrees, lengths in
    world units.

    A camera of a file stays in `exact` to the bit until one of its numbers changes.
    `source` is its name for `mi-splat render --cameras`, if it has one. `fov` covers
    the shorter side.
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
        numbers = (
            *self.target,
            self.azimuth,
            self.elevation,
            self.distance,
            self.fov,
            self.roll,
        )
        ranges = (
            -90 <= self.elevation <= 90
            and self.distance > 0
            and 0 < self.fov < 180
            and abs(self.roll) <= 180
        )
        if not (len(self.target) == 3 and ranges and all(map(math.isfinite, numbers))):
            expected = (
                "three coordinates, elevation in [-90, 90], distance > 0, fov in (0,"
                " 180), roll in [-180, 180]"
            )
            raise InvalidValueError(
                message(
                    "orbit", expected, numbers, "change the number that is out of range"
                )
            )
        # -0.0 becomes 0.0
        object.__setattr__(
            self, "target", tuple(float(value) + 0.0 for value in self.target)
        )
        object.__setattr__(self, "azimuth", self.azimuth % 360.0)

    @property
    def camera_size(self) -> tuple[int, int] | None:
        """Width and height in pixels of the image of a camera of a file; None for
        others.
        """
        if self.exact is None:
            return None
        return (self.exact.width, self.exact.height)

    @property
    def position(self) -> tuple[float, float, float]:
        """(3,) position of the camera in world units."""
        a = math.radians(self.azimuth)
        e = math.radians(self.elevation)
        x, y, z = self.target
        flat = self.distance * math.cos(e)
        return (
            x + flat * math.cos(a),
            y + flat * math.sin(a),
            z + self.distance * math.sin(e),
        )

    def camera(self, size: tuple[int, int]) -> Camera:
        """The camera that `mi-splat render` uses for an image of (width, height)
        pixels.
        """
        if self.exact is not None:
            return resized(self.exact, size)
        angles = {
            "azimuth": self.azimuth,
            "elevation": self.elevation,
            "roll": self.roll,
        }
        pose = orbit_pose(self.target, distance=self.distance, **angles)
        focal = focal_of(math.radians(self.fov), min(size))
        return Camera(to_world=pose, lens=Lens(focal=focal, size=size))

    def is_at(self, position: Sequence[float], look_at: Sequence[float]) -> bool:
        """Whether this camera stands at `position` (3,) and looks at `look_at` (3,)."""
        apart = max(math.dist(self.position, position), math.dist(self.target, look_at))
        return apart <= _SAME_POSE * self.distance

    def changed(self, **numbers: Any) -> Orbit:
        """The camera with other numbers, which is no longer one of a file."""
        return replace(self, exact=None, source="", **numbers)

    def moved(self, position: Sequence[float], look_at: Sequence[float]) -> Orbit:
        """The camera at `position` (3,) that looks at `look_at` (3,), in numbers short
        enough to be typed.
        """
        x, y, z = (float(a) - float(b) for a, b in zip(position, look_at, strict=True))
        flat = math.hypot(x, y)
        length = math.hypot(x, y, z)
        if not (math.isfinite(length) and length > 0):
            return self
        decimals = _LENGTH_DIGITS - 1 - math.floor(math.log10(length))
        if flat <= POLE * length:
            azimuth = self.azimuth
        else:
            azimuth = math.degrees(math.atan2(y, x)) % 360.0
        near = math.dist(look_at, self.target) <= _SAME_POSE * length
        return self.changed(
            # A target that did not move keeps every digit, because rounding would move
            # it away from the centre.
            target=(
                self.target
                if near
                else tuple(round(float(value), decimals) for value in look_at)
            ),
            azimuth=round(azimuth, _ANGLE_DIGITS),
            elevation=round(math.degrees(math.atan2(z, flat)), _ANGLE_DIGITS),
            distance=round(length, decimals),
        )


def orbit_of(camera: Camera, centre: Point, *, source: str = "") -> Orbit:
    """A camera of a file as an orbit around the point of its axis that is nearest to
    `centre` (3,).
    """
    pose = camera.to_world
    middle = torch.tensor(list(centre), dtype=torch.float64)
    forward = pose[:3, 2]
    distance = float((middle - camera.position) @ forward)
    if not round(distance, _CAMERA_DIGITS) > 0:
        distance = max(float((middle - camera.position).norm()), 10**-_CAMERA_DIGITS)
    x, y, z = (-forward).tolist()
    elevation = math.degrees(math.atan2(z, math.hypot(x, y)))
    if math.hypot(x, y) > POLE:
        azimuth = math.degrees(math.atan2(y, x))
    else:
        # straight above and below the image's right edge points along (-sin azimuth,
        # cos azimuth, 0)
        azimuth = math.degrees(math.atan2(-float(pose[0, 0]), float(pose[1, 0])))
    level = orbit_pose(
        (0.0, 0.0, 0.0), azimuth=azimuth, elevation=elevation, distance=1.0
    )
    right = level[:3, :2].T @ pose[:3, 0]
    fov = math.degrees(angle_of(camera.fx, min(camera.width, camera.height)))
    return Orbit(
        target=[
            round(value, _CAMERA_DIGITS)
            for value in (camera.position + distance * forward).tolist()
        ],
        azimuth=round(azimuth, _CAMERA_DIGITS),
        elevation=round(elevation, _CAMERA_DIGITS),
        distance=round(distance, _CAMERA_DIGITS),
        fov=round(fov, _CAMERA_DIGITS),
        roll=round(
            math.degrees(math.atan2(float(right[1]), float(right[0]))), _ROLL_DIGITS
        )
        + 0.0,
        exact=camera,
        source=source,
    )


def focus_of(cameras: Sequence[Camera], otherwise: Point) -> Point:
    """(3,) the point nearest to the axes of all cameras, in the sense of least squares;
    world units.
    """
    if not cameras:
        return otherwise
    forward = torch.stack([camera.to_world[:3, 2] for camera in cameras])
    # A point's distance to an axis is the length of what is left of it when its part
    # along the axis is taken away.
    across = (
        torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    )
    positions = torch.stack([camera.position for camera in cameras])
    total = across.sum(0)
    if float(torch.linalg.eigvalsh(total)[0]) < 1e-3:
        return otherwise
    x, y, z = torch.linalg.solve(total, (across @ positions[:, :, None]).sum(0))[
        :, 0
    ].tolist()
    return x, y, z


def camera_options(
    orbit: Orbit,
    size: tuple[int, int],
    *,
    settings: RenderSettings,
    up: Point = UP,
    path: Path | None = None,
) -> list[str]:
    """The options by which a command renders a splat of the file `path` with a
    camera.
    """
    if orbit.exact is not None and orbit.source:
        options = ["--cameras", orbit.source.removeprefix(f"{path}{OF}")]
    else:
        turn = from_z(torch.tensor(list(up)))
        if tuple(up) == UP:
            centre = orbit.target
        else:
            centre = (turn @ torch.tensor(orbit.target, dtype=torch.float64)).tolist()
        options = [
            *_option("azimuth", orbit.azimuth),
            *_option("elevation", orbit.elevation),
        ]
        options += [*_option("distance", orbit.distance), *_option("fov", orbit.fov)]
        options += _option("camera-roll", orbit.roll) if orbit.roll else []
        options += [] if tuple(up) == UP else ["--up", ",".join(map(_exact, up))]
        options += _option("centre", *centre)
    options += [
        "--size",
        f"{size[0]}x{size[1]}",
        "--background",
        ",".join(map(_exact, settings.background)),
    ]
    return [*options, *_option("near", settings.near)]


def _option(name: str, *values: float) -> list[str]:
    return [f"--{name}", *map(_exact, values)]


def _exact(value: float) -> str:
    """A number that reads back exactly."""
    return repr(value).removesuffix(".0")
