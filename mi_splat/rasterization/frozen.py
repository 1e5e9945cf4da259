"""Frozen stages, and the arrays that they need to be made outside of them; README.md says why."""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi


@functools.cache
def frozen(variant: str, stage: Callable[..., Any]) -> Callable[..., Any]:
    """A stage as a frozen function of one variant; recordings follow shapes, never values."""
    return dr.freeze(stage, warn_after=1 << 20)  # type: ignore[no-any-return]


def run(stage: Callable[..., Any], *arguments: Any) -> Any:
    """Call a stage, recorded the first time and replayed from then on.

    A garbage collection in the middle of a recording may free arrays of torch or Mitsuba, which Dr.Jit cannot record:
    it stops the process. So there is none while this runs.
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        return frozen(mi.variant(), stage)(*arguments)
    finally:
        if collecting:
            gc.enable()


def buffer(size: int, dtype: Any = None, value: float | None = None) -> Any:
    """An evaluated array that a stage may write into; unset where no value is given."""
    dtype = dtype or mi.Float
    array = dr.empty(dtype, size) if value is None else dr.full(dtype, value, size)
    dr.make_opaque(array)
    return array


@functools.lru_cache(maxsize=16)
def numbers(variant: str, count: int) -> Any:
    """0, 1, 2, ... in memory."""
    found = dr.arange(mi.UInt32, count)
    dr.make_opaque(found)
    return found
