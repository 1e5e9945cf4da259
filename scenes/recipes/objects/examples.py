"""The scenes that are shipped as meshes and as splats: an object and surroundings."""

from mi_splat.capture.mesh import Asset, rotation, translation
from scenes.recipes.objects import build
from scenes.recipes.objects.street import build as build_street

# Seeds from 900000 on are kept out of the training of detectors.
SEED = 900004
"""Of the objects that are shipped by name."""


def car_street() -> tuple[Asset, Asset]:
    """A car, and the street that it stands on."""
    return build("car", SEED), build_street(900005, clearance=9.0)


def roadside() -> tuple[Asset, Asset]:
    """The plate of a stop sign, and a roadside to which its post belongs."""
    street = build_street(900001, clearance=8.0)
    turned = street.transformed(translation(0, -2.9, 0) @ rotation("z", 180))
    sign = build("stop sign", 900003).transformed(translation(0, 0, 0.115))
    return sign.body, Asset(turned.name, (*turned.meshes, *sign.support))
