"""Frozen stages, and the memory that they may be given: made here, or checked here;
README.md says why.
"""

import functools
import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_splat.errors import MiSplatError

# bytes; all memory that Dr.Jit allocates itself starts at a multiple of it
_ALIGNMENT = 64
between_stages: ContextVar[Callable[[], None]] = ContextVar(
    "between_stages", default=lambda: None
)
"""Called before each stage; what it raises ends an image that is not wanted any
more.
"""


class PictureInterruptedError(MiSplatError):
    """An image that was not finished, because something else is urgent."""


@contextmanager
def interrupted_by(urgent: Callable[[], bool]) -> Iterator[None]:
    """Images that are rendered in this block end between two stages once something is
    urgent.
    """

    def check() -> None:
        dr.sync_thread()  # stages are only queued, and would all be waited for
        if urgent():
            raise PictureInterruptedError(
                "image: expected time to finish it, got an interruption; make it again"
            )

    before = between_stages.set(check)
    try:
        yield
    finally:
        between_stages.reset(before)


@functools.cache
def frozen(variant: str, stage: Callable[..., Any]) -> Callable[..., Any]:
    """A stage as a frozen function of one variant; recordings follow shapes, never
    values.
    """
    return dr.freeze(stage, warn_after=1 << 20)  # type: ignore[no-any-return]


def run(stage: Callable[..., Any], *arguments: Any) -> Any:
    """Call a stage, recorded the first time and replayed from then on.

    A garbage collection in the middle of a recording may free arrays of torch or
    Mitsuba, which Dr.Jit cannot record: it stops the process. So there is none while
    this runs.
    """
    between_stages.get()()
    collecting = gc.isenabled()
    gc.disable()
    try:
        return frozen(mi.variant(), stage)(*arguments)
    finally:
        if collecting:
            gc.enable()


def aligned(array: Any) -> Any:
    """The array, evaluated, in memory for which a frozen function needs no recording of
    its own.

    Dr.Jit borrows the memory of NumPy arrays and torch tensors without a copy. Where
    that memory does not start at a multiple of 64 bytes, which is left to chance,
    kernels that read it are other ones: a second recording, and seconds of compilation.
    So every array that may come from a user passes through here; one that is aligned is
    not copied.
    """
    dr.make_opaque(array)
    if len(array) == 0 or dr.backend_v(array) != dr.JitBackend.LLVM:
        return array
    if int(np.from_dlpack(array).ctypes.data) % _ALIGNMENT == 0:
        return array
    copy = buffer(len(array), type(array))
    dr.scatter(copy, array, dr.arange(mi.UInt32, len(array)))
    dr.eval(copy)
    return copy


def buffer(size: int, dtype: Any = None, value: float | None = None) -> Any:
    """An evaluated array that a stage may write into; unset where no value is given."""
    dtype = dtype or mi.Float
    array = dr.empty(dtype, size) if value is None else dr.full(dtype, value, size)
    dr.make_opaque(array)
    return array


@functools.lru_cache(maxsize=16)
def numbers(variant: str, count: int) -> Any:
    """0, 1, 2, ... in memory."""
    return index_of(count)


def index_of(count: int) -> Any:
    """0, 1, 2, ... in memory, for a count that is another one in every image."""
    index = dr.arange(mi.UInt32, count)
    dr.make_opaque(index)
    return index
