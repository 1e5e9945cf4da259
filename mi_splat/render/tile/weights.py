"""What an image keeps when only colours change: the weights alpha T of its pairs,
packed, and which rows hold them.

Made once per scene and camera by the stages of the image's own forward pass, so
nothing here is replayed. A pair is *kept* if its Gaussian is free and has a weight
above 0 at a pixel of its tile that lies in the image.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.errors import MiSplatError
from mi_splat.render.tile.binning import TILE, lower_bound
from mi_splat.render.tile.blending import (
    MAX_ALPHA,
    Record,
    any_open,
    blend_step,
    first_pixel,
    read_record,
)
from mi_splat.render.tile.frozen import buffer, numbers
from mi_splat.render.tile.picture import Picture, tile_columns, tiled_index

PIXELS = TILE * TILE
HIDDEN_DC = -10.0
"""A constant SH term with which a colour is exactly 0."""

MAX_SLOTS = 1 << 27
"""Above this many, 32 bits do not number their weights."""

GROUP = 16
"""From the place of a pair to that of its slot's next."""

BLOCK = 16
"""Tiles along one side of a block of tiles whose slots follow one another."""

_MOST = 1023
_FIXED = 0xFFFFFFFF
_SLOT_BYTES = 4 * (PIXELS + 2 + 4)  # weights, Gaussian, row, sums
_PIXEL_BYTES = 4 * (3 + 3 + 4 + 4 + 3)  # base, where, canvas, gradients, image
_GAUSSIAN_BYTES = 4 * (4 + 4 + 2)  # direction, colour, range of rows


@dataclass(eq=False)  # not frozen: dr.freeze assigns the fields again
class FrozenPairs:
    """Everything that the two stages of `colour_steps` read.

    A *slot* is a tile with kept pairs. Slots are numbered block of tiles by block of
    tiles, so that neighbours share Gaussians, and inside a block from the tile with
    most pairs to that with fewest, so that the tiles that share a packet end together.
    `GROUP` slots after one another share memory in which their pairs take turns: the
    first of each, the second of each, and so on, so that a packet reads *places* that
    lie together.
    """

    slots: Any  # UInt32, 0, 1, 2, ... (as many as there are tiles with kept pairs)
    # UInt32, place of the first pair of each slot, and of the last plus GROUP
    ranges: tuple[Any, Any]
    weights: Any  # Float, 16 a place, nearest Gaussian first
    pairs: tuple[Any, Any]  # UInt32, of each place: which free Gaussian, and row
    rows: tuple[Any, Any]  # UInt32, first and one-past-last row of each free Gaussian
    # Float, 4 a free Gaussian: from the camera's centre to its mean, length 1, and a 0
    directions: Any
    columns: Any  # UInt32, 0, 1, 2, ... (as many as there are free Gaussians)
    # UInt32, of each value of the image: its place in `canvas` (the last slot: there
    # is none)
    where: Any
    # Float, 3 a pixel, row-major: the image without the free Gaussians' colours
    base: Any
    # Float, 4 a pixel of a slot, one slot more that is 0: scratch of a forward step
    canvas: Any
    gradients: Any  # Float, the same of a backward step
    sums: Any  # Float, 4 a row: scratch of a backward step


def needed_bytes(slots_needed: int, pixels: int, gaussians: int) -> int:
    """Memory for so many places, pixels of the image and free Gaussians, that of one
    step included.
    """
    return (
        _SLOT_BYTES * slots_needed + _PIXEL_BYTES * pixels + _GAUSSIAN_BYTES * gaussians
    )


def freeze_pairs(
    picture: Picture, free: Any, directions: Any, *, max_bytes: int, held: int = 0
) -> tuple[FrozenPairs | None, int]:
    """Keep the weights of an image."""
    pixels = len(picture.opacity)
    if picture.state is None or len(free) == 0:
        return None, _within(held + needed_bytes(0, pixels, len(free)), 0, max_bytes)
    column_of = buffer(len(picture.arrays[-2]), mi.UInt32, _FIXED)
    dr.scatter(column_of, numbers(mi.variant(), len(free)), free)
    columns = dr.gather(mi.UInt32, column_of, picture.state.pairs[0])
    kept = buffer(len(columns) + 1, mi.UInt32, 0)
    _walk(
        picture,
        numbers(mi.variant(), len(picture.state.buffers.tiles)),
        columns,
        kept=kept,
    )
    before = dr.prefix_sum(kept)  # of each pair: how many kept ones lie before it
    if int(before[len(columns)]) == 0:
        return None, _within(held + needed_bytes(0, pixels, len(free)), 0, max_bytes)
    tiles, ranges, slots_needed = _slots(picture, before)
    needed = _within(
        held + needed_bytes(slots_needed, pixels, len(free)), slots_needed, max_bytes
    )
    return _pack(picture, directions, columns, (tiles, ranges, slots_needed)), needed


def _within(needed: int, pairs: int, max_bytes: int) -> int:
    if pairs > MAX_SLOTS:
        raise MiSplatError.of(
            "FrozenView", f"at most {MAX_SLOTS} pairs", pairs, "free fewer rows"
        )
    if needed > max_bytes:
        do = "raise max_bytes, free fewer rows, or render it smaller"
        expected = f"at most {max_bytes / 1e6:.1f} MB (max_bytes)"
        raise MiSplatError.of(
            "FrozenView", expected, f"{needed / 1e6:.1f} MB for {pairs:,} pairs", do
        )
    return needed


def _slots(picture: Picture, before: Any) -> tuple[Any, tuple[Any, Any], int]:
    """The slots' tiles in order, their `FrozenPairs.ranges`, and the number of
    places.
    """
    assert picture.state is not None
    first, last = (
        dr.gather(mi.UInt32, before, edge) for edge in picture.state.pair_ranges
    )
    count = last - first
    dr.eval(count)
    tiles = dr.compress(count > 0)
    width, _ = picture.state.buffers.size
    columns = mi.UInt32(tile_columns(width))
    block = (
        tiles // columns // BLOCK * (columns // BLOCK + 1) + tiles % columns // BLOCK
    )
    most = mi.UInt32(_MOST)
    key = block * (_MOST + 1) + (
        most - dr.minimum(dr.gather(mi.UInt32, count, tiles), most)
    )
    tiles = dr.gather(mi.UInt32, tiles, dr.argsort(key))
    counts = dr.gather(mi.UInt32, count, tiles)
    slot = dr.arange(mi.UInt32, len(tiles))
    whole = buffer(-(-len(tiles) // GROUP) * GROUP, mi.UInt32, 0)
    dr.scatter(whole, counts, slot)
    dr.eval(whole)
    sizes = GROUP * dr.block_reduce(dr.ReduceOp.Max, whole, GROUP)
    dr.eval(sizes)
    starts = dr.prefix_sum(sizes)
    start = dr.gather(mi.UInt32, starts, slot // GROUP) + slot % GROUP
    stop = start + GROUP * counts
    dr.eval(tiles, start, stop)
    return tiles, (start, stop), int(dr.sum(mi.UInt64(sizes))[0])


def _pack(
    picture: Picture,
    directions: Any,
    columns: Any,
    slots: tuple[Any, tuple[Any, Any], int],
) -> FrozenPairs:
    """Fill the places that `_slots` has made, with Float directions, 3 a free
    Gaussian.
    """
    tiles, ranges, slots_needed = slots
    gaussians = len(directions) // 3
    weights = buffer(PIXELS * slots_needed, value=0.0)
    owners = buffer(slots_needed, mi.UInt32, _FIXED)
    _walk(picture, tiles, columns, packed=(ranges[0], weights, owners))
    rows, row_ranges = _rows(owners, gaussians)
    column = numbers(mi.variant(), gaussians)
    padded = buffer(4 * gaussians, value=0.0)
    for axis in range(3):
        dr.scatter(
            padded,
            dr.gather(mi.Float, directions, 3 * column + axis),
            4 * column + axis,
        )
    frozen = FrozenPairs(
        slots=numbers(mi.variant(), len(tiles)),
        ranges=ranges,
        weights=weights,
        pairs=(owners, rows),
        rows=row_ranges,
        directions=padded,
        columns=column,
        where=_slots_of_pixels(picture, tiles),
        base=picture.colour,
        canvas=buffer(4 * PIXELS * (len(tiles) + 1), value=0.0),
        gradients=buffer(4 * PIXELS * (len(tiles) + 1), value=0.0),
        sums=buffer(4 * slots_needed, value=0.0),
    )
    dr.make_opaque(
        frozen.ranges,
        weights,
        frozen.pairs,
        frozen.rows,
        frozen.directions,
        frozen.where,
        frozen.base,
    )
    return frozen


def _rows(owners: Any, gaussians: int) -> tuple[Any, tuple[Any, Any]]:
    """The row of each place, and the first and one-past-last row of each free
    Gaussian.
    """
    index = dr.arange(mi.UInt32, len(owners))
    used = owners != _FIXED
    earliest = buffer(gaussians, mi.UInt32, _FIXED)
    dr.scatter_reduce(dr.ReduceOp.Min, earliest, index, owners, used)
    key = dr.select(used, dr.gather(mi.UInt32, earliest, owners, used), _FIXED)
    # stable: a Gaussian's rows are in the order of their places
    order = dr.argsort(key)
    rows = buffer(len(owners), mi.UInt32)
    sorted_key = dr.gather(mi.UInt32, key, order)
    dr.scatter(rows, index, order)
    dr.eval(rows, sorted_key, earliest)
    # a literal would make another kernel for each number
    count = dr.opaque(mi.UInt32, len(owners))
    first = lower_bound(sorted_key, count, earliest)
    # 0 where there is none: _FIXED + 1
    last = lower_bound(sorted_key, count, earliest + 1)
    return rows, (first, last)


def _slots_of_pixels(picture: Picture, tiles: Any) -> Any:
    """`FrozenPairs.where` of slots that are these tiles."""
    assert picture.state is not None
    slot_of = buffer(len(picture.state.buffers.tiles), mi.UInt32, len(tiles))
    dr.scatter(slot_of, dr.arange(mi.UInt32, len(tiles)), tiles)
    value = dr.arange(mi.UInt32, len(picture.colour))
    width, _ = picture.state.buffers.size
    tiled = tiled_index(mi.Int32(value // 3), width)
    return (
        4 * (PIXELS * dr.gather(mi.UInt32, slot_of, tiled // PIXELS) + tiled % PIXELS)
        + value % 3
    )


def _walk(
    picture: Picture,
    tiles: Any,
    columns: Any,
    *,
    kept: Any | None = None,
    packed: tuple[Any, Any, Any] | None = None,
) -> None:
    """Walk the lists of tiles as the image did, and find the pairs to keep."""
    state = picture.state
    assert state is not None
    width, height = state.buffers.size
    corner = first_pixel(mi.Int32(tiles), tile_columns(width))
    right = mi.Float(width)
    below = mi.Float(height)
    inside = [
        (corner[0] + float(p % TILE) < right) & (corner[1] + float(p // TILE) < below)
        for p in range(PIXELS)
    ]
    ranges = [dr.gather(mi.UInt32, edge, tiles) for edge in state.pair_ranges]
    begin = packed[0] if packed else mi.UInt32(0)

    def body(
        pair: Any, offset: Any, transmittances: list[Any]
    ) -> tuple[Any, Any, list[Any]]:
        record = Record(
            read_record(
                state.records, dr.gather(mi.UInt32, state.pairs[0], pair), corner
            )
        )
        values = []
        behind = []
        for p, alpha in enumerate(record.alphas()):
            weight, left = blend_step(dr.minimum(alpha, MAX_ALPHA), transmittances[p])
            values.append(dr.select(inside[p], weight, 0.0))
            behind.append(left)
        column = dr.gather(mi.UInt32, columns, pair)
        largest = mi.Float(0)
        for weight in values:
            largest = dr.maximum(largest, weight)
        keep = (column != _FIXED) & (largest > 0.0)
        if kept is not None:
            dr.scatter(kept, mi.UInt32(1), pair, keep)
        if packed:
            dr.scatter(packed[1], mi.ArrayXf(values), offset, keep)
            dr.scatter(packed[2], column, offset, keep)
        return (
            pair + 1,
            offset + dr.select(keep, mi.UInt32(GROUP), mi.UInt32(0)),
            behind,
        )

    dr.while_loop(
        (mi.UInt32(ranges[0]), mi.UInt32(begin), [mi.Float(1) for _ in range(PIXELS)]),
        lambda pair, _, transmittances: (pair < ranges[1]) & any_open(transmittances),
        body,
        label="weights",
    )
    dr.eval(kept, packed)
