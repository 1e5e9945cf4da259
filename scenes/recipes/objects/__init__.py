"""Procedural objects, made by code from a seed: the things that the shipped detectors
know and attacks are aimed at.

The library knows them as GLB files, which `python -m scenes.recipes.objects` writes.
"""

from collections.abc import Callable, Sequence

from mi_splat.errors import InvalidValueError
from scenes.recipes.objects import (
    bird,
    car,
    elephant,
    house,
    hydrant,
    person,
    stop_sign,
    suitcase,
    train,
    tv,
)
from scenes.recipes.objects.model import Model

BUILDERS: dict[str, Callable[..., Model]] = {
    "car": car.build,
    "person": person.build,
    "stop sign": stop_sign.build,
    "elephant": elephant.build,
    "bird": bird.build,
    "tv": tv.build,
    "train": train.build,
    "suitcase": suitcase.build,
    "fire hydrant": hydrant.build,
    "house": house.build,
}
"""Name -> function that builds an object of that class from a seed; one of `PAINTED`
takes a colour, too. The names are COCO's, but for the house, which COCO does not know.
"""
PAINTED = ("car", "fire hydrant")
"""Objects whose paint can have any colour."""


def build(name: str, seed: int = 0, *, colour: Sequence[float] | None = None) -> Model:
    """Build an object of class `name`; the same seed gives the same object."""
    known = tuple(BUILDERS) if colour is None else PAINTED
    if name not in known:
        expected = f"one of {sorted(known)}"
        do = "choose one of these"
        raise InvalidValueError.of("name", expected, repr(name), do)
    if colour is None:
        return BUILDERS[name](seed)
    return BUILDERS[name](seed, colour)


__all__ = ["BUILDERS", "PAINTED", "Model", "build"]
