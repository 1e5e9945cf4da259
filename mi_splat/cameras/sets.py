"""Sets of cameras around a point: orbits, hemispheres and grids, and the short texts
that name them.

`hemisphere:210`, `orbit:36@20`, `cap:40@60`, `grid:12x3`, or the path of a transforms
file.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.directions import UP
from mi_splat.cameras.forms import MOST, parse_form
from mi_splat.cameras.lens import Lens
from mi_splat.datasets.transforms import read_cameras
from mi_splat.errors import InvalidValueError
from mi_splat.fields import above, checked_number
from mi_splat.maths.rotation import from_z

MARGIN = 1.05
"""How much farther away cameras are than would just show the whole of what they look
at.
"""
HELD_OUT_START = 67.0
"""Azimuth of the first held-out camera in degrees, so that these are not where the
others are.
"""
_GOLDEN = 180.0 * (3.0 - math.sqrt(5.0))
"""The golden angle, degrees."""


def orbit(
    target: Sequence[float],
    *,
    count: int,
    elevation: float,
    distance: float,
    lens: Lens,
    start: float = 0.0,
    span: float = 360.0,
) -> list[Camera]:
    """`count` cameras at equal azimuths around `target`, or over a `span` of them, the
    first at azimuth `start`.
    """
    azimuths = (start + span * i / count for i in range(count))
    poses = (
        orbit_pose(target, azimuth=azimuth, elevation=elevation, distance=distance)
        for azimuth in azimuths
    )
    return [Camera(to_world=pose, lens=lens) for pose in poses]


def hemisphere(
    target: Sequence[float],
    *,
    count: int,
    distance: float,
    lens: Lens,
    elevation: tuple[float, float] = (0.0, 90.0),
    start: float = 0.0,
    offset: float = 0.5,
    up: Sequence[float] = UP,
) -> list[Camera]:
    """`count` cameras spread evenly in area over a band of the upper hemisphere.

    They stand on a Fibonacci lattice (Swinbank and Purser 2006): heights in equal
    steps, azimuths in golden angles. A cap straight above the target is the band from
    its lowest elevation to 90 degrees.

    Args:
        target: (3,) point that all cameras look at.
        count: Number of cameras.
        distance: World units from the target.
        lens: Lens of all cameras.
        elevation: Lowest and highest elevation in degrees.
        start: Azimuth of the first camera in degrees.
        offset: Where in its step of height each camera stands, in [0, 1].
        up: (3,) direction from the centre to the pole.

    Returns:
        The cameras, in the order of a spiral from the lowest to the highest.
    """
    low, high = (math.sin(math.radians(e)) for e in elevation)
    cameras = list[Camera]()
    for i in range(count):
        azimuth = (start + i * _GOLDEN) % 360.0
        angle = math.degrees(math.asin(low + (high - low) * (i + offset) / count))
        pose = orbit_pose(target, azimuth=azimuth, elevation=angle, distance=distance)
        cameras.append(
            with_up(
                Camera(to_world=pose, lens=lens),
                target,
                up,
            )
        )
    return cameras


def with_up(camera: Camera, centre: Sequence[float], up: Sequence[float]) -> Camera:
    """A camera that was placed around a point with z up, turned with that point fixed
    so that `up` is up.
    """
    turn = from_z(torch.tensor(up, dtype=torch.float64))
    if torch.equal(turn, torch.eye(3, dtype=torch.float64)):
        return camera
    return camera.turned(turn, torch.tensor(centre, dtype=torch.float64))


def tiers(
    target: Sequence[float],
    *,
    count: int,
    distance: float,
    lens: Lens,
    distances: tuple[float, float] = (1.0, 1.0),
    elevations: Sequence[float] = (),
    start: float = 0.0,
    offset: float = 0.5,
    span: float = 360.0,
) -> list[Camera]:
    """`count` cameras on a hemisphere, or on rings or arcs of it, each at a distance of
    its own.
    """
    placed: dict[str, Any] = {"distance": distance, "lens": lens}
    if elevations:
        cameras = list[Camera]()
        for ring, elevation in enumerate(elevations):
            share = count // len(elevations) + (ring < count % len(elevations))
            turned = start + ring * _GOLDEN * (span == 360.0)
            cameras += orbit(
                target,
                count=share,
                elevation=elevation,
                start=turned,
                span=span,
                **placed,
            )
    else:
        cameras = hemisphere(target, count=count, start=start, offset=offset, **placed)
    low, high = distances
    if low == high == 1.0:
        return cameras
    multiples = (
        low + (high - low) * ((offset + i * math.sqrt(2)) % 1.0)
        for i in range(len(cameras))
    )
    return [
        _moved(camera, target, multiple)
        for camera, multiple in zip(cameras, multiples, strict=True)
    ]


def _moved(camera: Camera, target: Sequence[float], multiple: float) -> Camera:
    """A camera on the line from the target through it, at so many times its
    distance.
    """
    pose = camera.to_world.clone()
    middle = pose.new_tensor(tuple(target))
    pose[:3, 3] = middle + multiple * (pose[:3, 3] - middle)
    return dataclasses.replace(camera, to_world=pose)


def grid(
    target: Sequence[float],
    *,
    azimuths: int,
    elevations: int,
    distance: float,
    lens: Lens,
) -> list[Camera]:
    """Cameras at every pair of an azimuth and an elevation, row by row from the
    lowest.
    """
    cameras = list[Camera]()
    for row in range(elevations):
        middle = 90.0 * (row + 0.5) / elevations
        cameras += orbit(
            target,
            count=azimuths,
            elevation=middle,
            distance=distance,
            lens=lens,
        )
    return cameras


def framing(radius: float, *, fov: float, size: tuple[int, int]) -> tuple[float, Lens]:
    """Distance in world units from which a ball is seen whole, and the lens with that
    field of view, degrees.
    """
    half = math.radians(fov) / 2
    return MARGIN * radius / math.sin(half), Lens.with_view(fov, size)


def camera_set(
    spec: str,
    centre: Sequence[float],
    *,
    distance: float,
    lens: Lens,
) -> list[Camera]:
    """The cameras that a text describes."""
    if spec.lower().endswith(".json"):
        return read_cameras(Path(spec), lens.size)
    kind, numbers = parse_form(spec)
    count = int(numbers["count"])
    angle = float(numbers.get("angle", 0.0))
    checked_number("distance", distance, above(0))
    if kind == "orbit":
        return orbit(
            centre,
            count=count,
            elevation=angle,
            distance=distance,
            lens=lens,
        )
    if kind == "grid":
        return grid(
            centre,
            azimuths=count,
            elevations=int(numbers["rows"]),
            distance=distance,
            lens=lens,
        )
    return hemisphere(
        centre,
        count=count,
        distance=distance,
        elevation=(angle, 90.0),
        lens=lens,
    )


def held_out_set(
    spec: str,
    count: int,
    centre: Sequence[float],
    *,
    distance: float,
    lens: Lens,
) -> list[Camera]:
    """`count` cameras for tests, spread evenly over the elevations of `camera_set`, but
    rotated away from it.
    """
    if not 0 <= count <= MOST:
        raise InvalidValueError.of(
            "test cameras", f"0 to {MOST}", count, "ask for fewer"
        )
    if count == 0:
        return []
    if spec.lower().endswith(".json"):
        do = "capture the file of the test cameras into a folder of its own"
        raise InvalidValueError.of(
            "test cameras", f"a set by name with {spec}", "a file", do
        )
    kind, numbers = parse_form(spec)
    angle = float(numbers.get("angle", 0.0))
    checked_number("distance", distance, above(0))
    placed: dict[str, Any] = {"distance": distance, "lens": lens}
    if kind == "orbit":
        starts = _between(int(numbers["count"]), count)
        return [
            orbit(centre, count=1, elevation=angle, start=start, **placed)[0]
            for start in starts
        ]
    return hemisphere(
        centre, count=count, elevation=(angle, 90.0), start=HELD_OUT_START, **placed
    )


def _between(others: int, count: int) -> list[float]:
    """Azimuths in degrees, spread evenly, none of which is one of so many others that
    begin at 0.
    """
    if count <= others:
        return [360 * (0.5 + i * others // count) / others for i in range(count)]
    return [180 / math.lcm(others, count) + 360 * i / count for i in range(count)]
