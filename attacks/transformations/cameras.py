"""Cameras drawn from a region around an object."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch

from attacks.transformations.config import CameraRegion
from mi_splat.cameras import Camera, orbit_pose
from mi_splat.errors import InvalidValueError, message


def draw_camera(
    region: CameraRegion,
    generator: np.random.Generator,
    *,
    centre: Sequence[float],
    radius: float,
    reference: Camera,
) -> Camera:
    """A camera of the region.

    Args:
        region: Where cameras may stand.
        generator: Source of the draw; the same number of values is taken from it whatever the region.
        centre: (3,) middle of the object, world units.
        radius: Of the object, world units.
        reference: Size of the picture, and what the region leaves open: field of view, and the unit of distances.

    Raises:
        InvalidValueError: The reference camera stands at the centre and the region has no unit of its own.
    """
    unit = region.distance_unit
    if unit is None:
        unit = math.dist(reference.position.tolist(), [float(x) for x in centre])
    if not unit > 0:
        raise InvalidValueError(
            message("reference", "a camera away from the object", "one in its middle", "set distance_unit")
        )
    azimuth, elevation, distance, roll, fov, *shift = generator.uniform(size=8).tolist()
    pose = orbit_pose(
        [c + region.aim * radius * s for c, s in zip(centre, _in_ball(shift), strict=True)],
        azimuth=_between(region.azimuths, azimuth),
        elevation=_between(region.elevations, elevation),
        distance=unit * _between(region.distances, distance),
    )
    angle = math.radians(region.roll * (2 * roll - 1))
    turn = torch.eye(4, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    camera = dataclasses.replace(reference, to_world=pose @ turn if region.roll else pose)
    if region.fovs is None:
        return camera
    focal = reference.width / (2 * math.tan(math.radians(_between(region.fovs, fov)) / 2))
    return dataclasses.replace(camera, focal=(focal, focal * reference.fy / reference.fx))


def _between(interval: tuple[float, float], share: float) -> float:
    return interval[0] + (interval[1] - interval[0]) * share


def _in_ball(shares: Sequence[float]) -> tuple[float, float, float]:
    """Three numbers in [0, 1] to a point of the unit ball, evenly."""
    height, turn, length = 2 * shares[0] - 1, 2 * math.pi * shares[1], shares[2] ** (1 / 3)
    flat = math.sqrt(max(0.0, 1 - height * height))
    return length * flat * math.cos(turn), length * flat * math.sin(turn), length * height
