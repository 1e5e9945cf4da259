"""The orders in which pairs and tiles are worked on: radix sorts of as many bits as the keys have.

`dr.argsort` sorts all 32 bits of a key in three passes. The number of a tile has 12 to 18 bits, which are one pass or
two. Neither may be called inside a frozen function: a recorded sort keeps the size that it was recorded with.
"""

import functools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

BLOCK = 16
"""Side of a block, in tiles. The tiles of about one block are sorted among themselves."""

_KEY_BITS = 8
_LAST_KEY = (1 << _KEY_BITS) - 1
_PASS_BITS = {"llvm": 15, "cuda": 8}  # of one pass, measured for LLVM; for CUDA those of dr.argsort


def order_below(keys: Any, values: int) -> Any:
    """UInt32, the stable order of UInt32 keys below `values`; larger keys come last, in no order."""
    bits = values.bit_length()
    passes = -(-bits // _PASS_BITS[mi.variant().partition("_")[0]])
    order, low = None, 0
    for number in range(passes):
        high = (number + 1) * bits // passes
        digit = dr.minimum(keys, (1 << bits) - 1) >> low
        digit = dr.gather(mi.UInt32, digit, order) if order is not None else digit
        digit &= (1 << (high - low)) - 1
        dr.eval(digit)
        step = dr.detail.block_mkperm(digit, len(keys), 1 << (high - low))
        order = step if order is None else dr.gather(mi.UInt32, order, step)
        low = high
    dr.eval(order)
    return order


@functools.lru_cache(maxsize=32)
def by_block(variant: str, columns: int, rows: int, side: int = BLOCK) -> Any:
    """UInt32, the numbers of the tiles or pixels of a picture, block after block of side x side of them."""
    row, column = np.divmod(np.arange(columns * rows), columns)
    order = np.lexsort((column // side, row // side))
    numbers = mi.UInt32(order.astype(np.uint32).tolist())
    dr.make_opaque(numbers)
    return numbers


def length_key(length: Any) -> Any:
    """UInt32 keys that sort tiles by the length of their lists (UInt32), the longest first.

    Steps grow with the square root of the length, so that few keys tell lists of 10 and of 1,000 apart.
    """
    return _LAST_KEY - dr.minimum(mi.UInt32(8.0 * dr.sqrt(mi.Float(length))), _LAST_KEY)


def by_length(keys: Any) -> Any:
    """UInt32, the order that sorts the tiles of each block by their keys, which lie block after block.

    A packet works as long as the longest list of its tiles. Tiles of about equal length from one neighbourhood keep all
    of its lanes busy, and what its lanes read lies together.
    """
    order = dr.detail.block_mkperm(keys, BLOCK * BLOCK, 1 << _KEY_BITS)
    dr.eval(order)
    return order
