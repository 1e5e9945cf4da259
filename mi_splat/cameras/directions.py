"""Directions of cameras from a centre, and how deep they lie in a band, a wedge or a
cap of the sphere of directions.

A direction is a point of the unit sphere around the centre: azimuth in degrees from
world +x towards +y, elevation in degrees above the horizontal plane, as in
`mi_splat.cameras.camera.orbit_pose`. Depths are angles between directions, in degrees:
the signed distance on the sphere to the region's edge, positive inside, infinite if
there is no edge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from mi_splat.cameras.camera import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.maths.rotation import from_z

Point = Sequence[float]

UP: Point = (0.0, 0.0, 1.0)
"""Where up is, unless something else is said."""
POLE = 1e-7
"""Radians around straight above and straight below in which a direction has no
azimuth.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Direction:
    """Where a camera stands, as seen from the centre."""

    # degrees in [0, 360) from world +x towards +y; 0 straight above and below, where
    # there is none
    azimuth: float
    elevation: float  # degrees above the horizontal plane, in [-90, 90]
    pole: bool  # whether the camera stands straight above or below


def direction_of(camera: Camera, centre: Point, up: Point = UP) -> Direction:
    """Direction from `centre` (3,), world units, to a camera."""
    camera = upright(camera, centre, up)
    x, y, z = (
        a - float(b) for a, b in zip(camera.position.tolist(), centre, strict=True)
    )
    flat = math.hypot(x, y)
    length = math.hypot(x, y, z)
    if not length > 0:
        raise InvalidValueError.of(
            "centre",
            "a point away from the cameras",
            tuple(centre),
            "move one of the two",
        )
    pole = flat <= POLE * length
    azimuth = 0.0 if pole else math.degrees(math.atan2(y, x)) % 360.0
    return Direction(
        azimuth=azimuth % 360.0, elevation=math.degrees(math.atan2(z, flat)), pole=pole
    )


def upright(camera: Camera, centre: Point, up: Point = UP) -> Camera:
    """A camera as it stands in a world that was turned about `centre` (3,) so that `up`
    (3,) is z.
    """
    if tuple(up) == UP:
        return camera
    import torch

    middle = torch.tensor([float(value) for value in centre], dtype=torch.float64)
    turn = from_z(torch.tensor(list(up), dtype=torch.float64)).T
    return camera.turned(turn, middle)


def depth_in_band(direction: Direction, least: float, most: float) -> float:
    """Depth between two elevations; a limit of -90 or 90 degrees is none."""
    above = direction.elevation - least if least > -90 else math.inf
    below = most - direction.elevation if most < 90 else math.inf
    return min(above, below)


def azimuth_gap(direction: Direction, azimuth: float) -> float:
    """Degrees in [0, 180] between a direction's azimuth and another, the shorter way
    around.
    """
    return abs(_turn(direction, azimuth))


def depth_in_wedge(direction: Direction, middle: float, half_width: float) -> float:
    """Depth within an angle of an azimuth.

    The edge is two half great circles, from pole to pole.

    To a half great circle the shortest way runs across it, or, from where it has no
    foot on that half, to a pole. Across it, Napier's rules for right spherical
    triangles give sin(distance) = sin(azimuth difference) cos(elevation).
    """
    if half_width == 180:
        return math.inf
    if direction.pole:
        return 0.0
    nearest = 90.0 - abs(direction.elevation)
    for edge in (-half_width, half_width):
        turn = math.radians(_turn(direction, middle + edge))
        if math.cos(turn) > 0:
            across = abs(math.sin(turn)) * math.cos(math.radians(direction.elevation))
            nearest = min(nearest, math.degrees(math.asin(min(across, 1.0))))
    if azimuth_gap(direction, middle) <= half_width:
        return nearest
    return -nearest


def depth_in_cap(
    direction: Direction, azimuth: float, elevation: float, half_angle: float
) -> float:
    """Depth within an angle of a direction; a half angle of 180 degrees is every
    direction.
    """
    if half_angle == 180:
        return math.inf
    # the middle has azimuth 0
    x, y, z = unit_vector(direction.azimuth - azimuth, direction.elevation)
    flat = math.cos(math.radians(elevation))
    up = math.sin(math.radians(elevation))
    return half_angle - math.degrees(
        math.atan2(math.hypot(y, z * flat - x * up), x * flat + z * up)
    )


def unit_vector(azimuth: float, elevation: float) -> tuple[float, float, float]:
    """(x, y, z) of a direction given in degrees."""
    turn = math.radians(azimuth)
    rise = math.radians(elevation)
    return (
        math.cos(turn) * math.cos(rise),
        math.sin(turn) * math.cos(rise),
        math.sin(rise),
    )


def _turn(direction: Direction, azimuth: float) -> float:
    """Degrees in [-180, 180) from an azimuth to that of a direction."""
    return (direction.azimuth - azimuth + 180.0) % 360.0 - 180.0


def sun_direction(
    hour: float, *, latitude: float, declination: float = 0.0
) -> tuple[float, float, float]:
    """Unit vector to the sun: east, north, up.

    The hour angle grows by 15 degrees an hour from 0 at noon (Meeus, Astronomical
    Algorithms, chapter 13).
    """
    angle = math.radians(15 * (hour - 12))
    phi = math.radians(latitude)
    tilt = math.radians(declination)
    east = -math.cos(tilt) * math.sin(angle)
    north = math.cos(phi) * math.sin(tilt) - math.sin(phi) * math.cos(tilt) * math.cos(
        angle
    )
    up = math.sin(phi) * math.sin(tilt) + math.cos(phi) * math.cos(tilt) * math.cos(
        angle
    )
    if up <= 1e-6:
        raise InvalidValueError.of(
            "hour", "an hour when the sun is up", f"{hour:g}", "leave it out"
        )
    return east, north, up
