"""The frame in which the path tracer works: objects of a few units at the origin, whatever their size and place.

Mitsuba computes in float32 and starts secondary rays about 1e-4 (1 + largest coordinate) away from a surface, and the
project's own limits (welding, visibility of points, the near clip) are in metres too. A capture of a very small, large
or distant object is therefore taken in a frame of its own, by powers of two, and written back in the world's units.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from mi_splat.assets.mesh import Asset
from mi_splat.cameras import Camera
from mi_splat.io.points import PointCloud

USUAL = 0.5, 50.0
"""Radii of objects for which the world's own units do."""
FARTHEST = 10.0
"""Largest coordinate of an object's middle, in radii, for which the world's own origin does: rays then start at most a
thousandth of the radius away from the surface."""

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkingFrame:
    """From world units to those of the path tracer: unit * (point - origin).

    Attributes:
        unit: Working units in one world unit, a power of two.
        origin: Point of the world that lies at the working origin.
    """

    unit: float = 1.0
    origin: Point = (0.0, 0.0, 0.0)

    @property
    def is_world(self) -> bool:
        """Whether this is the world's own frame."""
        return self == WorkingFrame()

    def asset(self, asset: Asset) -> Asset:
        """An asset of the world in this frame."""
        if self.is_world:
            return asset
        matrix = np.diag([self.unit] * 3 + [1.0])
        matrix[:3, 3] = -self.unit * np.asarray(self.origin)
        return asset.transformed(matrix)

    def camera(self, camera: Camera) -> Camera:
        """A camera of the world in this frame."""
        if self.is_world:
            return camera
        pose = camera.to_world.clone()
        pose[:3, 3] = self.unit * (pose[:3, 3] - torch.tensor(self.origin, dtype=pose.dtype))
        return replace(camera, to_world=pose)

    def in_world(self, cloud: PointCloud) -> PointCloud:
        """Points of this frame in the world."""
        if self.is_world:
            return cloud
        points = cloud.points.double() / self.unit + torch.tensor(self.origin, dtype=torch.float64)
        return replace(cloud, points=points.float())


def working_frame(centre: Point, radius: float) -> WorkingFrame:
    """The frame for an object: the world's own where that is good enough."""
    far = max(map(abs, centre)) > FARTHEST * radius
    usual = USUAL[0] <= radius <= USUAL[1]
    # A power of two changes no digit of a coordinate.
    unit = 1.0 if usual else 2.0 ** (1 - math.floor(math.log2(radius)))
    return WorkingFrame(unit=unit, origin=centre if far else (0.0, 0.0, 0.0))
