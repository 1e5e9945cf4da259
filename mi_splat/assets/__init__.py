"""Procedural objects, made by code from a seed: the things that detectors here know and
attacks are aimed at.
"""

import importlib
from collections.abc import Callable, Sequence

from mi_splat.assets.mesh import Asset, Mesh
from mi_splat.errors import InvalidValueError

_MODULES = {  # whole names, which `mi_splat.import_closure` follows
    "car": "mi_splat.assets.car",
    "person": "mi_splat.assets.person",
    "stop sign": "mi_splat.assets.stop_sign",
    "elephant": "mi_splat.assets.elephant",
    "bird": "mi_splat.assets.bird",
    "tv": "mi_splat.assets.tv",
    "train": "mi_splat.assets.train",
    "suitcase": "mi_splat.assets.suitcase",
    "fire hydrant": "mi_splat.assets.hydrant",
    "house": "mi_splat.assets.house",
}
PAINTED = ("car", "fire hydrant")
"""Assets whose paint can have any colour."""


def _builder(module: str) -> Callable[..., Asset]:
    def build_one(seed: int = 0, *colour: Sequence[float]) -> Asset:
        asset: Asset = importlib.import_module(module).build(seed, *colour)
        return asset

    return build_one


ASSETS: dict[str, Callable[..., Asset]] = {
    name: _builder(module) for name, module in _MODULES.items()
}
"""Name -> function that builds an object of that class from a seed; one of `PAINTED`
takes a colour, too. The names are COCO's, but for the house, which COCO does not know.
"""


def build(name: str, seed: int = 0, *, colour: Sequence[float] | None = None) -> Asset:
    """Build an object of class `name`; the same seed gives the same object."""
    known = ASSETS if colour is None else PAINTED
    if name not in known:
        raise InvalidValueError.of(
            "name", f"one of {sorted(known)}", repr(name), "choose one of these"
        )
    if colour is None:
        return ASSETS[name](seed)
    return ASSETS[name](seed, colour)


__all__ = ["ASSETS", "PAINTED", "Asset", "Mesh", "build"]
