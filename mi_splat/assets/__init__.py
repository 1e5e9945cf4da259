"""Procedural objects, made by code from a seed: the things that detectors here know and attacks are aimed at."""

from __future__ import annotations

import importlib
from collections.abc import Callable

from mi_splat.assets.mesh import Asset, Mesh
from mi_splat.errors import InvalidValueError, message

_MODULES = {  # whole names, which `mi_splat.import_closure` follows
    "car": "mi_splat.assets.car",
    "person": "mi_splat.assets.person",
    "stop sign": "mi_splat.assets.stop_sign",
    "elephant": "mi_splat.assets.elephant",
    "bird": "mi_splat.assets.bird",
    "tv": "mi_splat.assets.tv",
    "train": "mi_splat.assets.train",
    "suitcase": "mi_splat.assets.suitcase",
}


def _builder(module: str) -> Callable[[int], Asset]:
    def build_one(seed: int = 0) -> Asset:
        asset: Asset = importlib.import_module(module).build(seed)
        return asset

    return build_one


ASSETS: dict[str, Callable[[int], Asset]] = {name: _builder(module) for name, module in _MODULES.items()}
"""COCO name -> function that builds an object of that class from a seed."""


def build(name: str, seed: int = 0) -> Asset:
    """Build an object of class `name`; the same seed gives the same object.

    Raises:
        InvalidValueError: there is no asset of that name.
    """
    if name not in ASSETS:
        raise InvalidValueError(message("name", f"one of {sorted(ASSETS)}", repr(name), "choose one of these"))
    return ASSETS[name](seed)


__all__ = ["ASSETS", "Asset", "Mesh", "build"]
