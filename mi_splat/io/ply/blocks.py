"""Large tables a block at a time, in a few threads, within a fixed amount of memory."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.void]

BLOCK_BYTES = 2 << 20
"""Bytes of file rows in one block: small enough for a core's cache, large enough to hide the cost of a call."""

_MAX_THREADS = 4


def for_each_block(count: int, record: np.dtype[np.void], work: Callable[[int, Rows], None]) -> None:
    """Call `work(first, rows)` for consecutive blocks of `count` records, in no fixed order.

    NumPy and torch let go of the interpreter inside their loops, so that two threads take about two thirds of the time.
    """
    at_once = max(1, BLOCK_BYTES // record.itemsize)
    starts = range(0, count, at_once)
    local = threading.local()

    def run(first: int) -> None:
        if not hasattr(local, "buffer"):
            local.buffer = np.zeros(min(at_once, count), record)
        work(first, local.buffer[: count - first])

    if len(starts) < 2:
        for first in starts:
            run(first)
        return
    with ThreadPoolExecutor(min(_MAX_THREADS, os.cpu_count() or 1, len(starts))) as pool:
        for _ in pool.map(run, starts):
            pass
