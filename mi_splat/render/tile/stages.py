"""The stages, from Gaussians to an image (1 to 5) and back (6 to 8); `pipeline` calls
them in this order.

Each stage is recorded once by `frozen.run` and replayed. README.md says what a stage
may and may not do for a replay to stay right when sizes change.
"""

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.render.tile import binning, blending
from mi_splat.render.tile.binning import NO_TILE, TILE, length_key
from mi_splat.render.tile.blending import RECORD
from mi_splat.render.tile.layouts import Layout
from mi_splat.render.tile.picture import PictureBuffers, tile_columns
from mi_splat.render.tile.pinhole import KernelCamera
from mi_splat.render.tile.projection import Gaussians, Splat, project

BROKEN = 0xFFFFFFFF
"""In place of a number of tiles: a number of the Gaussian is not finite."""

BROKEN_ROWS = 1 << 40
"""What such a Gaussian counts for among the rows: more than memory has, so that one
number tells the host both.
"""


def projected(
    gaussians: Gaussians, camera: KernelCamera
) -> tuple[Splat, Any, Any, Any]:
    """What `project` returns, and a Bool: whether the Gaussian may touch a tile at
    all.
    """
    splat, extent, depth = project(gaussians, camera)
    visible = (depth >= camera.near) & (extent.x >= 0.0)
    visible &= dr.isfinite(
        splat.u0 + splat.u1 + splat.v1 + splat.centre.x + splat.centre.y
    )
    return splat, extent, depth, visible


def project_gaussians(
    layout: Layout,
    terms: int,
    arrays: tuple[Any, ...],
    index: Any,
    buffers: PictureBuffers,
    camera: KernelCamera,
    records: tuple[Any, ...],
) -> tuple[Any, Any]:
    """Stage 1: project every Gaussian and count the tiles that it touches."""
    gaussians = layout.read(arrays, index, terms)
    splat, extent, depth, visible = projected(gaussians, camera)
    width, height = buffers.size
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
    return (
        first,
        first + counts,
        dr.sum(dr.select(broken, mi.UInt64(BROKEN_ROWS), mi.UInt64(counts))),
    )


def write_pairs(
    records: Any, depth_order: Any, first: Any, last: Any, size: Any, pairs: Any
) -> Any:
    """Stage 3: write the pairs' tiles and Gaussians, Gaussian by Gaussian from near to
    far.
    """
    v = dr.gather(
        mi.ArrayXf, records, depth_order, shape=(RECORD, dr.width(depth_order))
    )
    splat = Splat(mi.Point2f(v[0], v[1]), v[2], v[3], v[4], v[5], mi.Color3f(0))
    return binning.emit_pairs(splat, depth_order, (first, last), size, pairs)


def find_lists(
    pairs: Any,
    rows: Any,
    index: Any,
    total: Any,
    buffers: PictureBuffers,
    ranges: tuple[Any, Any],
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
    """Stage 5: blend every tile, then lay the tiles out as a row-major image over the
    background.
    """
    tile, corner = _tiles(order, buffers)
    first, last = (dr.gather(mi.UInt32, edge, tile) for edge in lists[1:])
    values, depths, reached = blending.blend_tile(
        records, lists[0], (first, last), corner
    )
    dr.scatter(walked, length_key(reached - first), order)
    dr.scatter(canvas[0], mi.ArrayXf(values), tile)
    if depths:
        dr.scatter(
            canvas[1],
            mi.ArrayXf(
                [v for p in range(TILE * TILE) for v in depths[p :: TILE * TILE]]
            ),
            tile,
        )
    dr.eval(canvas, walked)

    pixel = buffers.pixels
    where = buffers.tiled_indices
    value = dr.gather(mi.ArrayXf, canvas[0], where, shape=(4, dr.width(where)))
    rgb = [
        dr.fma(
            value[3], dr.gather(mi.Float, buffers.background, mi.UInt32(c)), value[c]
        )
        for c in range(3)
    ]
    dr.scatter(buffers.colour, mi.ArrayXf(rgb), pixel)
    dr.scatter(buffers.opacity, 1.0 - value[3], pixel)
    if depths:
        median, total, summed = dr.gather(
            mi.ArrayXf, canvas[1], where, shape=(3, dr.width(where))
        )
        expected = dr.select(total > 0, summed / total, 0.0)
        for array, values in zip(
            buffers.depths, (expected, median, total), strict=True
        ):
            dr.scatter(array, values, pixel)
    dr.eval(buffers.colour, buffers.opacity, buffers.depths)


def _tiles(order: Any, buffers: PictureBuffers) -> tuple[Any, tuple[Any, Any]]:
    """The lanes' tiles, and the centres of their first pixels."""
    tile = dr.gather(mi.UInt32, buffers.tiles, order)
    return tile, blending.first_pixel(mi.Int32(tile), tile_columns(buffers.size[0]))


_LN2 = math.log(2.0)


def blend_backward(
    records: tuple[Any, ...],
    lists: tuple[Any, Any, Any, Any],
    order: Any,
    buffers: PictureBuffers,
    grad_picture: tuple[Any, ...],
    moments: tuple[Any, ...],
) -> None:
    """Stage 7: each pair's moments of the gradient, in the pair's own row."""
    tile, corner = _tiles(order, buffers)
    width, height = buffers.size
    first, last = (dr.gather(mi.UInt32, edge, tile) for edge in lists[2:])
    grad_colours = []
    grad_opacity = []
    grad_depth = []
    weighted = []
    for p in range(TILE * TILE):
        x = mi.Int32(corner[0]) + p % TILE
        y = mi.Int32(corner[1]) + p // TILE
        pixel = mi.UInt32(y * width + x)
        inside = (x < width) & (y < height)
        both = (buffers.colour, grad_picture[0])
        value, grad = (
            dr.gather(mi.ArrayXf, a, pixel, inside, shape=(3, dr.width(pixel)))
            for a in both
        )
        grad_colours.append(list(grad))
        weighted.append(grad[0] * value[0] + grad[1] * value[1] + grad[2] * value[2])
        if len(grad_picture) > 1:
            grad_opacity.append(dr.gather(mi.Float, grad_picture[1], pixel, inside))
            weighted[-1] += grad_opacity[-1] * dr.gather(
                mi.Float, buffers.opacity, pixel, inside
            )
        if len(grad_picture) > 2:
            expected, total = (
                dr.gather(mi.Float, buffers.depths[k], pixel, inside) for k in (0, 2)
            )
            slope = dr.select(
                total > 0,
                dr.gather(mi.Float, grad_picture[2], pixel, inside) / total,
                0.0,
            )
            grad_depth.append((slope, expected))
    grad_colour = [grad[channel] for channel in range(3) for grad in grad_colours]
    reached = blending.blend_tile_backward(
        records,
        lists[:2],
        (first, last),
        corner,
        (grad_colour, grad_opacity, grad_depth, weighted),
        moments,
    )
    dr.eval(moments, reached, last)
    blending.clear_rows(lists[1], (reached, last), moments)
    dr.eval(moments)


def rows_by_gaussian(
    depth_order: Any,
    row_ranges: tuple[Any, Any],
    pairs: tuple[Any, Any],
    scratch: tuple[Any, Any],
) -> tuple[Any, tuple[Any, Any]]:
    """Stage 6: rows for the moments, in the order of the Gaussians and not of their
    depths.
    """
    first, last = row_ranges
    count, shift = scratch
    dr.scatter(count, last - first, depth_order)
    dr.eval(count)
    begin = dr.prefix_sum(count)
    dr.eval(begin)
    dr.scatter(shift, dr.gather(mi.UInt32, begin, depth_order) - first, depth_order)
    dr.eval(shift)
    return pairs[1] + dr.gather(mi.UInt32, shift, pairs[0]), (begin, begin + count)


def project_backward(
    layout: Layout,
    terms: int,
    arrays: tuple[Any, ...],
    camera: KernelCamera,
    rows: tuple[Any, Any, Any],
    moments: tuple[Any, ...],
    gradients: tuple[Any, ...],
    screen: Any | None,
) -> None:
    """Stage 8: sum every Gaussian's moments and take them back through the
    projection.
    """
    index, first, last = rows
    visible = last > first
    gaussians = _with_invisible_ones_harmless(
        layout.read(arrays, index, terms), visible, camera
    )
    dr.enable_grad(gaussians.parts())
    splat, _, depth = project(gaussians, camera)
    sums = _sum_rows(first, last, moments)
    grad_splat = _splat_gradient(splat, sums)
    if screen is not None:
        touching = dr.select(visible, mi.Float(1), mi.Float(0))
        dr.scatter(screen, mi.ArrayXf([grad_splat[0], grad_splat[1], touching]), index)
    # its derivative by the Gaussians is the vector-Jacobian product that we are after
    product = mi.Float(0)
    for component, grad_component in zip(splat.components(), grad_splat, strict=True):
        product += component * grad_component
    if len(moments) > 2:
        product += depth * sums[RECORD + 1]
    dr.backward(product)
    layout.write(gradients, index, gaussians.gradient())
    dr.eval(gradients, screen)


def _sum_rows(first: Any, last: Any, moments: tuple[Any, ...]) -> list[Any]:
    """Add the rows of each Gaussian in their fixed order: nine Floats a lane, ten with
    gradients of depth.
    """

    def body(row: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        m = dr.gather(mi.ArrayXf, moments[0], row, shape=(RECORD, dr.width(row)))
        others = [dr.gather(mi.Float, single, row) for single in moments[1:]]
        return row + 1, [s + v for s, v in zip(sums, [*m, *others], strict=True)]

    zeros = [mi.Float(0) for _ in range(RECORD + len(moments) - 1)]
    _, sums = dr.while_loop(
        (mi.UInt32(first), zeros),
        lambda row, _: row < last,
        body,
        label="sum of moments",
    )
    return list(sums)


def _splat_gradient(splat: Splat, sums: list[Any]) -> list[Any]:
    """dL/d(components of a splat) from the moments of h = alpha dL/dalpha: dL/d(log2
    alpha) is h ln 2.
    """
    h, hx, hy, hxx, hxy, hyy = (_LN2 * s for s in sums[:6])
    u0, u1, v1 = (dr.detach(v) for v in (splat.u0, splat.u1, splat.v1))
    along = u0 * hx + u1 * hy
    return [
        2.0 * u0 * along,
        2.0 * (u1 * along + v1 * v1 * hy),
        -2.0 * (u0 * hxx + u1 * hxy),
        -2.0 * (u0 * hxy + u1 * hyy),
        -2.0 * v1 * hyy,
        h,
        *sums[6:9],
    ]


def _with_invisible_ones_harmless(
    gaussians: Gaussians, visible: Any, camera: KernelCamera
) -> Gaussians:
    """Invisible lanes moved in front of the camera, so that no infinity of theirs meets
    the zero of their gradient.
    """
    rotation = camera.rotation
    ahead = camera.position + mi.Vector3f(
        rotation[2, 0], rotation[2, 1], rotation[2, 2]
    )
    unit = mi.Float(1.0)
    return Gaussians(
        mean=dr.select(visible, gaussians.mean, mi.Point3f(ahead)),
        scale=dr.select(visible, gaussians.scale, mi.Vector3f(1.0)),
        rotation=[dr.select(visible, q, unit) for q in gaussians.rotation],
        opacity=dr.select(visible, gaussians.opacity, unit),
        sh=gaussians.sh,
    )
