"""Where the records of Gaussians lie in memory: along a space-filling curve, as neighbouring tiles share them.

The places change how fast a picture is made and none of its bits, so an order that was made for means which have moved
since, or for those of another scene, does no harm.
"""

import functools
import itertools
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.rasterization.frozen import numbers
from mi_splat.rasterization.layouts import Layout

_FEWEST = 50_000  # with fewer, all records lie in the caches of the processor
_USES = 50  # an order is made anew after so many pictures


def places(layout: Layout, arrays: tuple[Any, ...]) -> Any:
    """UInt32, the place of each Gaussian's record."""
    count = len(arrays[-2])
    if count < _FEWEST:
        return numbers(mi.variant(), count)
    uses, made = _orders(mi.variant(), count)
    if next(uses) % _USES == 0:
        made[:] = [_along_curve(layout, arrays, count)]
    return made[0]


@functools.lru_cache(maxsize=4)
def _orders(variant: str, count: int) -> tuple[Any, list[Any]]:
    return itertools.count(), []


def _along_curve(layout: Layout, arrays: tuple[Any, ...], count: int) -> Any:
    """Ranks of the means on a Morton curve of 1024 cells along each axis of their box."""
    index = numbers(mi.variant(), count)
    mean = layout.read(arrays, index, 1).mean
    code = mi.UInt32(0)
    for axis in range(3):
        low, high = dr.min(mean[axis]), dr.max(mean[axis])
        cell = mi.UInt32(dr.clip((mean[axis] - low) * (1023.0 / dr.maximum(high - low, 1e-30)), 0.0, 1023.0))
        for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
            cell = (cell | (cell << shift)) & mask
        code |= cell << axis
    ranks = dr.empty(mi.UInt32, count)
    dr.scatter(ranks, index, dr.argsort(code))
    dr.make_opaque(ranks)
    return ranks
