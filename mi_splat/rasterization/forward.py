"""Stages 1 to 5, from Gaussians to a picture; `pipeline.rasterize` calls them in this order.

Each stage is recorded once by `frozen.run` and replayed. README.md says what a stage may and may not do for a replay to
stay right when sizes change.
"""

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.rasterization import binning, blending, pinhole
from mi_splat.rasterization.binning import NO_TILE, TILE
from mi_splat.rasterization.blending import RECORD
from mi_splat.rasterization.layouts import Layout
from mi_splat.rasterization.picture import PictureBuffers, tile_columns, width_and_height
from mi_splat.rasterization.pinhole import KernelCamera, StageCamera
from mi_splat.rasterization.projection import Gaussians, Splat, project
from mi_splat.rasterization.sorting import length_key

BROKEN = 0xFFFFFFFF
"""In place of a number of tiles: a number of the Gaussian is not finite."""

BROKEN_ROWS = 1 << 40
"""What such a Gaussian counts for among the rows: more than memory has, so that one number tells the host both."""


def projected(gaussians: Gaussians, camera: KernelCamera) -> tuple[Splat, Any, Any, Any]:
    """What `project` returns, and a Bool: whether the Gaussian may touch a tile at all."""
    splat, extent, depth = project(gaussians, camera)
    visible = (depth >= camera.near) & (extent.x >= 0.0)
    visible &= dr.isfinite(splat.u0 + splat.u1 + splat.v1 + splat.centre.x + splat.centre.y)
    return splat, extent, depth, visible


def project_gaussians(
    layout: Layout,
    terms: int,
    arrays: tuple[Any, ...],
    index: Any,
    buffers: PictureBuffers,
    stage_camera: StageCamera,
    records: tuple[Any, ...],
) -> tuple[Any, Any]:
    """Stage 1: project every Gaussian and count the tiles that it touches."""
    camera = pinhole.unpack(stage_camera.numbers, antialiased=stage_camera.antialiased)
    gaussians = layout.read(arrays, index, terms)
    splat, extent, depth, visible = projected(gaussians, camera)
    width, height = width_and_height(buffers.size)
    count = binning.count_tiles(splat, extent, visible, width, height)
    components = splat.components()
    dr.scatter(records[0], mi.ArrayXf(components[:RECORD]), index)
    dr.scatter(records[1], components[RECORD], index)
    if len(records) > 2:
        dr.scatter(records[2], depth, index)
    # Depths that count are positive, and positive floats sort like their bits.
    key = dr.select(count > 0, dr.reinterpret_array(mi.UInt32, depth), NO_TILE)
    return key, dr.select(gaussians.finite(), count, BROKEN)


def allot_rows(count: Any, depth_order: Any) -> tuple[Any, Any, Any]:
    """Stage 2: which rows each Gaussian gets."""
    counts = dr.gather(mi.UInt32, count, depth_order)
    broken = counts == BROKEN
    counts = dr.select(broken, 0, counts)
    first = dr.prefix_sum(counts)
    return first, first + counts, dr.sum(dr.select(broken, mi.UInt64(BROKEN_ROWS), mi.UInt64(counts)))


def write_pairs(records: Any, depth_order: Any, first: Any, last: Any, size: Any, pairs: Any) -> Any:
    """Stage 3: write the pairs' tiles and Gaussians, Gaussian by Gaussian from near to far."""
    v = dr.gather(mi.ArrayXf, records, depth_order, shape=(RECORD, dr.width(depth_order)))
    splat = Splat(mi.Point2f(v[0], v[1]), v[2], v[3], v[4], v[5], mi.Color3f(0))
    return binning.emit_pairs(splat, depth_order, (first, last), width_and_height(size), pairs)


def find_lists(
    pairs: Any, rows: Any, index: Any, total: Any, buffers: PictureBuffers, ranges: tuple[Any, Any]
) -> tuple[Any, Any]:
    """Stage 4: where the list of each tile lies."""
    tile, gaussians = dr.gather(mi.ArrayXu, pairs, rows, shape=(2, dr.width(rows)))
    gaussians = dr.select(tile == NO_TILE, 0, gaussians)
    dr.eval(gaussians, tile)
    binning.bounds_of_tiles(tile, index, mi.UInt32(total), ranges)
    dr.eval(ranges)
    first, last = (dr.gather(mi.UInt32, edge, buffers.tiles) for edge in ranges)
    return gaussians, length_key(last - first)


def blend_tiles(
    records: tuple[Any, ...],
    lists: tuple[Any, Any, Any],
    order: Any,
    buffers: PictureBuffers,
    canvas: tuple[Any, ...],
    walked: Any,
) -> None:
    """Stage 5: blend every tile, then lay the tiles out as a row-major picture over the background."""
    tile = dr.gather(mi.UInt32, buffers.tiles, order)
    first, last = (dr.gather(mi.UInt32, edge, tile) for edge in lists[1:])
    width, _ = width_and_height(buffers.size)
    corner = blending.first_pixel(mi.Int32(tile), tile_columns(width))
    colours, transmittances, depths, reached = blending.blend_tile(records, lists[0], (first, last), corner)
    dr.scatter(walked, length_key(reached - first), order)
    n = TILE * TILE
    values = [v for p in range(n) for v in (colours[p], colours[n + p], colours[2 * n + p], transmittances[p])]
    dr.scatter(canvas[0], mi.ArrayXf(values), tile)
    if depths:
        dr.scatter(canvas[1], mi.ArrayXf([depths[k * n + p] for p in range(n) for k in range(3)]), tile)
    dr.eval(canvas, walked)

    pixel = buffers.pixels
    where = buffers.tiled_indices
    value = dr.gather(mi.ArrayXf, canvas[0], where, shape=(4, dr.width(where)))
    rgb = [dr.fma(value[3], dr.gather(mi.Float, buffers.background, mi.UInt32(c)), value[c]) for c in range(3)]
    dr.scatter(buffers.colour, mi.ArrayXf(rgb), pixel)
    dr.scatter(buffers.opacity, 1.0 - value[3], pixel)
    if depths:
        median, total, summed = dr.gather(mi.ArrayXf, canvas[1], where, shape=(3, dr.width(where)))
        expected = dr.select(total > 0, summed / total, 0.0)
        for array, values in zip(buffers.depths, (expected, median, total), strict=True):
            dr.scatter(array, values, pixel)
    dr.eval(buffers.colour, buffers.opacity, buffers.depths)
