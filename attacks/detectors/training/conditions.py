"""How an object in a picture is seen: from how high, from how far, in what light."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mi_splat.assets.daylight import Light
from mi_splat.assets.mesh import Floats
from mi_splat.cameras import Camera
from mi_splat.directions import direction_of


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewingConditions:
    """How one object in one picture is seen.

    Attributes:
        elevation: Degrees above the horizontal plane, of the camera as seen from the centre of the object's box.
        distance: World units from the camera to that centre.
        extent: World units, diagonal of the object's box.
        sun_elevation: Degrees above the horizon; None where the light is not known.
        sun_strength: Irradiance of the sun on a surface that faces it; None where the light is not known.
    """

    elevation: float
    distance: float
    extent: float
    sun_elevation: float | None = None
    sun_strength: float | None = None


def viewing_conditions(points: Floats, camera: Camera, light: Light | None = None) -> ViewingConditions:
    """How an object is seen from a camera, rounded to six digits after the point.

    Args:
        points: (N, 3) of the object, world units.
        camera: Takes the picture.
        light: What it stands in; None where that is not known.
    """
    low, high = points.min(0).astype(np.float64), points.max(0).astype(np.float64)
    centre: list[float] = ((low + high) / 2).tolist()
    return ViewingConditions(
        elevation=round(direction_of(camera, centre).elevation, 6),
        distance=round(math.dist(camera.position.tolist(), centre), 6),
        extent=round(float(np.linalg.norm(high - low)), 6),
        sun_elevation=None if light is None else round(light.sun_elevation, 6),
        sun_strength=None if light is None else round(light.sun_strength, 6),
    )
