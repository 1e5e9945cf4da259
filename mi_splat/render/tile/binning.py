"""Which Gaussians touch which tiles, nearest first.

A pair is one (tile, Gaussian) touch. Pairs are emitted Gaussian by Gaussian in depth
order and then sorted stably by tile, so the pairs of one tile lie together in depth
order, and the pairs of one Gaussian lay together before the sort.
"""

import functools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_splat.render.tile.projection import CUTOFF, Splat

BLOCK = 16
"""Side of a block, in tiles.

The tiles of about one block are sorted among themselves.
"""

_KEY_BITS = 8
_LAST_KEY = (1 << _KEY_BITS) - 1
# of one pass, measured for LLVM; for CUDA those of dr.argsort
_PASS_BITS = {"llvm": 15, "cuda": 8}


def order_below(keys: Any, values: int) -> Any:
    """UInt32, the stable order of UInt32 keys below `values`; larger keys come last, in
    no order.
    """
    bits = values.bit_length()
    passes = -(-bits // _PASS_BITS[mi.variant().partition("_")[0]])
    order = None
    low = 0
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
    """UInt32, the numbers of the tiles or pixels of an image, block after block of
    side x side of them.
    """
    row, column = np.divmod(np.arange(columns * rows), columns)
    order = np.lexsort((column // side, row // side))
    numbers = mi.UInt32(order.astype(np.uint32).tolist())
    dr.make_opaque(numbers)
    return numbers


def length_key(length: Any) -> Any:
    """UInt32 keys that sort tiles by the length of their lists (UInt32), the longest
    first.
    """
    return _LAST_KEY - dr.minimum(mi.UInt32(8.0 * dr.sqrt(mi.Float(length))), _LAST_KEY)


def by_length(keys: Any) -> Any:
    """UInt32, the order that sorts the tiles of each block by their keys, which lie
    block after block.

    A packet works as long as the longest list of its tiles. Tiles of about equal length
    from one neighbourhood keep all of its lanes busy, and what its lanes read lies
    together.
    """
    order = dr.detail.block_mkperm(keys, BLOCK * BLOCK, 1 << _KEY_BITS)
    dr.eval(order)
    return order


TILE = 4
"""Pixels along one side of a tile."""

NO_TILE = 0xFFFFFFFF
"""Sorts behind every tile and every depth."""

# px; keeps rounding from dropping a pixel whose alpha is just above 1/255
_SLACK = 4e-3


def pixel_span(centre: Any, low: Any, high: Any, size: Any) -> tuple[Any, Any]:
    """First and last pixel (Int32, inside the image) whose centre lies in [centre +
    low, centre + high].
    """
    first = dr.ceil(centre + low - (0.5 + _SLACK))
    last = dr.floor(centre + high - (0.5 - _SLACK))
    # Clip before the conversion: a float outside of Int32's range has no defined
    # integer.
    limit = mi.Float(size)
    return mi.Int32(dr.clip(first, 0.0, limit)), mi.Int32(
        dr.clip(last, -1.0, limit - 1.0)
    )


def tiles_of_row(splat: Splat, row: Any, height: Any, width: Any) -> tuple[Any, Any]:
    """First and last tile column in which tile row `row` meets the ellipse alpha >=
    1/255; first > last if none.

    The ellipse is (u0 dx + u1 dy)^2 + (v1 dy)^2 <= tau. Its right edge over dy is
    concave with its top at -(u1 / v1) sqrt(tau / (u1^2 + v1^2)), its left edge the
    mirror image, so clamping that dy to the row's band of pixel centres gives the exact
    extent of the band.
    """
    tau = splat.level - CUTOFF
    first_y = mi.Float(row * TILE)
    last_y = dr.minimum(first_y + (TILE - 1), mi.Float(height - 1))
    reach = dr.sqrt(tau) / splat.v1
    low = dr.clip(first_y + (0.5 - _SLACK) - splat.centre.y, -reach, reach)
    high = dr.clip(last_y + (0.5 + _SLACK) - splat.centre.y, -reach, reach)
    top = -(splat.u1 / splat.v1) * dr.sqrt(
        tau / (splat.u1 * splat.u1 + splat.v1 * splat.v1)
    )
    inverse = 1.0 / splat.u0

    def edge(dy: Any, sign: float) -> Any:
        half = dr.sqrt(dr.maximum(tau - dr.square(splat.v1 * dy), 0.0))
        return (sign * half - splat.u1 * dy) * inverse

    left = edge(dr.clip(-top, low, high), -1.0)
    right = edge(dr.clip(top, low, high), 1.0)
    first, last = pixel_span(splat.centre.x, left, right, width)
    empty = (first > last) | (low >= high)
    return dr.select(empty, 1, first // TILE), dr.select(empty, 0, last // TILE)


def tile_rows(splat: Splat, extent: Any, height: Any) -> tuple[Any, Any]:
    """First and last tile row (Int32) of the box around the ellipse; first > last if it
    lies outside the image.
    """
    first, last = pixel_span(splat.centre.y, -extent.y, extent.y, height)
    empty = (first > last) | ~(extent.y >= 0.0)
    return dr.select(empty, 1, first // TILE), dr.select(empty, 0, last // TILE)


def count_tiles(
    splat: Splat, extent: Any, visible: Any, width: Any, height: Any
) -> Any:
    """UInt32 number of tiles that each Gaussian touches."""
    first, last = tile_rows(splat, extent, height)

    def body(row: Any, total: Any) -> tuple[Any, Any]:
        left, right = tiles_of_row(splat, row, height, width)
        return row + 1, total + mi.UInt32(dr.maximum(right - left + 1, 0))

    start = (mi.Int32(first), mi.UInt32(0))
    _, total = dr.while_loop(
        start, lambda row, _: visible & (row <= last), body, label="count tiles"
    )
    return total


def emit_pairs(
    splat: Splat,
    gaussian: Any,
    slots: tuple[Any, Any],
    size: tuple[Any, Any],
    pairs: Any,
) -> Any:
    """Write the pairs of every Gaussian into its slots."""
    width, height = size
    columns = (width + (TILE - 1)) // TILE
    reach = dr.sqrt(splat.level - CUTOFF) / splat.v1
    first, last = tile_rows(splat, mi.Vector2f(reach), height)

    def write_row(slot: Any, row: Any) -> tuple[Any, Any]:
        left, right = tiles_of_row(splat, row, height, width)

        def write(slot: Any, column: Any) -> tuple[Any, Any]:
            dr.scatter(
                pairs, mi.ArrayXu([mi.UInt32(row * columns + column), gaussian]), slot
            )
            return slot + 1, column + 1

        slot, _ = dr.while_loop(
            (slot, left),
            lambda slot, column: (slot < stop) & (column <= right),
            write,
            label="row",
        )
        return slot, row + 1

    start, stop = slots
    begin = (mi.UInt32(start), mi.Int32(first))
    used, _ = dr.while_loop(
        begin,
        lambda slot, row: (slot < stop) & (row <= last),
        write_row,
        label="emit pairs",
    )
    return used


def lower_bound(sorted_keys: Any, count: Any, key: Any) -> Any:
    """UInt32 number of entries of `sorted_keys` (of which there are `count`) that are
    smaller than `key`.
    """

    def body(low: Any, high: Any) -> tuple[Any, Any]:
        middle = (low + high) >> 1
        smaller = dr.gather(mi.UInt32, sorted_keys, middle) < key
        return dr.select(smaller, middle + 1, low), dr.select(smaller, high, middle)

    low, _ = dr.while_loop(
        (mi.UInt32(0), mi.UInt32(count)),
        lambda low, high: low < high,
        body,
        label="tile bounds",
    )
    return low


def bounds_of_tiles(tile: Any, index: Any, total: Any, ranges: tuple[Any, Any]) -> None:
    """Write where each tile's pairs begin and end; tiles without pairs keep what the
    buffers hold.
    """
    before = dr.gather(mi.UInt32, tile, index - 1, index > 0)
    fresh = (index > 0) & (before != tile)
    dr.scatter(ranges[0], index, tile, fresh & (tile != NO_TILE))
    dr.scatter(ranges[1], index, before, fresh)
    dr.scatter(ranges[1], total, tile, (index + 1 == total) & (tile != NO_TILE))
