"""What the shipped example scenes show: a target object in surroundings, their light, and where cameras stand.

Each recipe is fixed, seeds included; asset seeds from 900000 on are kept out of the training of detectors.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from mi_splat.assets import build
from mi_splat.assets.daylight import Light
from mi_splat.assets.mesh import Asset, rotation, translation
from mi_splat.assets.street import build as build_street

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneRecipe:
    """One scene: a target object in surroundings."""

    target: str
    surroundings: str
    assets: Callable[[], tuple[Asset, Asset]]
    light: Light
    centre: Point
    sensors: dict[str, Point]
    distance: tuple[float, float]
    elevation: tuple[float, float]
    azimuth: tuple[float, float]
    counts: tuple[int, int, int]
    views: int
    steps: int
    limit: int


def around(azimuth: float, elevation: float, distance: float) -> Point:
    """Offset of a camera from the centre, rounded to millimetres: angles in degrees, distance in metres."""
    a, e = math.radians(azimuth), math.radians(elevation)
    x, y, z = math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)
    return round(distance * x, 3), round(distance * y, 3), round(distance * z, 3)


def _stop_sign() -> tuple[Asset, Asset]:
    street = build_street(900001, clearance=8.0)
    placed = street.transformed(translation(0, -2.9, 0) @ rotation("z", 180))
    sign = build("stop sign", 900003).transformed(translation(0, 0, 0.115))
    return sign.body, Asset(placed.name, (*placed.meshes, *sign.support))


RECIPES = {
    "car_street": SceneRecipe(
        target="car",
        surroundings="street",
        assets=lambda: (build("car", 900004), build_street(900005, clearance=9.0)),
        light=Light(sun_azimuth=-50, sun_elevation=52, seed=900000),
        centre=(0.0, 0.0, 0.7),
        sensors={
            "front": around(5, 8, 5.4),
            "three_quarter": around(-38, 14, 5.6),
            "side": around(-92, 9, 6.0),
            "rear": around(152, 16, 5.6),
            "high": around(55, 42, 6.0),
            "top": around(20, 80, 6.2),
        },
        distance=(4.8, 8.0),
        elevation=(2, 85),
        azimuth=(0, 360),
        counts=(16_000, 60_000, 1_500),
        views=96,
        steps=7000,
        limit=48_000,
    ),
    "stop_sign": SceneRecipe(
        target="stop_sign",
        surroundings="roadside",
        assets=_stop_sign,
        light=Light(sun_azimuth=35, sun_elevation=48, seed=900001),
        centre=(0.0, 0.0, 1.94),
        sensors={
            "front": around(0, 2, 1.7),
            "left": around(38, 4, 1.7),
            "right": around(-35, 0, 1.7),
            "low": around(12, -22, 1.8),
            "high": around(-15, 35, 1.8),
            "far": around(8, 3, 2.8),
        },
        distance=(1.4, 3.4),
        elevation=(-20, 55),
        azimuth=(-62, 62),
        counts=(6_000, 60_000, 1_500),
        views=80,
        steps=7000,
        limit=24_000,
    ),
}
