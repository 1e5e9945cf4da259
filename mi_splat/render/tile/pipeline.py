"""The rasteriser as two calls: an image with what its derivative needs, and the
derivative.

Each calls its stages in order. Tracing them in Python costs several times their run
time, so each stage is a frozen function that Dr.Jit replays; the sorts stand between
them, and all buffers are made here, for reasons in README.md.
"""

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.errors import MiSplatError
from mi_splat.render.tile import binning, stages
from mi_splat.render.tile.binning import NO_TILE, TILE
from mi_splat.render.tile.blending import RECORD
from mi_splat.render.tile.frozen import aligned, buffer, index_of, numbers, run
from mi_splat.render.tile.layouts import Layout, check_finite
from mi_splat.render.tile.picture import (
    BackwardState,
    Picture,
    PictureBuffers,
    new_buffers,
    sh_terms,
)
from mi_splat.render.tile.pinhole import Pinhole

MAX_PAIRS = 1 << 28
"""Above this many (tile, Gaussian) pairs an image is refused, before memory runs
out.
"""

MANY_GAUSSIANS = 60_000
"""From so many on, the copy of the gradient's memory that a replay makes costs more
than tracing its kernel.
"""


def rasterize(
    layout: Layout,
    arrays: tuple[Any, ...],
    camera: Pinhole,
    background: tuple[float, float, float],
    *,
    depths: bool = False,
) -> Picture:
    """Render Gaussians to an image."""
    buffers = new_buffers(camera.size, background, depths=depths)
    count = len(arrays[-2])
    if count == 0:
        return _nothing_visible(buffers, layout, arrays)
    kernel_camera = camera.for_kernels()
    records = (
        buffer(RECORD * count),
        *(buffer(count) for _ in range(2 if depths else 1)),
    )
    index = numbers(mi.variant(), count)
    terms = sh_terms(arrays)
    depth_key, touched = run(
        stages.project_gaussians,
        layout,
        terms,
        arrays,
        index,
        buffers,
        kernel_camera,
        records,
    )
    # Not inside a frozen function: a recorded argsort keeps the size that it was
    # recorded with.
    depth_order = dr.argsort(depth_key)
    first, last, total = run(stages.allot_rows, touched, depth_order)
    number = int(total[0])  # the one time that the host waits for the kernels
    if number >= stages.BROKEN_ROWS:
        check_finite(layout, arrays)
    if number == 0:
        return _nothing_visible(buffers, layout, arrays)
    if number > MAX_PAIRS:
        do = "render it smaller or shrink the Gaussians"
        raise MiSplatError.of("image", f"at most {MAX_PAIRS} tile touches", number, do)
    pairs = buffer(2 * number, mi.UInt32, NO_TILE)
    used = run(
        stages.write_pairs, records[0], depth_order, first, last, buffers.size, pairs
    )
    tiles = len(buffers.tiles)
    index = index_of(number)
    ranges = tuple(buffer(tiles, mi.UInt32, 0) for _ in range(2))
    rows = binning.order_below(dr.gather(mi.UInt32, pairs, 2 * index), tiles)
    gaussians, length_key = run(
        stages.find_lists, pairs, rows, index, total, buffers, ranges
    )
    tile_order = binning.by_length(length_key)
    walked = buffer(tiles, mi.UInt32)
    canvas = tuple(
        buffer(width * TILE * TILE * tiles) for width in ((4, 3) if depths else (4,))
    )
    run(
        stages.blend_tiles,
        records,
        (gaussians, *ranges),
        tile_order,
        buffers,
        canvas,
        walked,
    )
    lists = (first, used), (gaussians, rows), ranges
    state = BackwardState(buffers, kernel_camera, records, depth_order, *lists, walked)
    return Picture(
        buffers.colour, buffers.opacity, buffers.depths, layout, arrays, state
    )


def _nothing_visible(
    buffers: PictureBuffers, layout: Layout, arrays: tuple[Any, ...]
) -> Picture:
    colour = dr.tile(buffers.background, len(buffers.opacity))
    return Picture(colour, buffers.opacity, buffers.depths, layout, arrays, None)


def rasterize_backward(
    picture: Picture,
    grad_colour: Any,
    grad_opacity: Any | None = None,
    grad_depth: Any | None = None,
    *,
    screen: Any | None = None,
) -> tuple[Any, ...]:
    """Gradient of a scalar L with respect to the Gaussians, from its gradient with
    respect to the image.
    """
    arrays = picture.arrays
    state = picture.state
    if state is None:
        return tuple(buffer(len(array), value=0.0) for array in arrays)
    gradients = tuple(buffer(len(array)) for array in arrays)
    grad_picture = tuple(
        aligned(grad)
        for grad in (grad_colour, grad_opacity, grad_depth)
        if grad is not None
    )
    pairs = len(state.pairs[0])
    moments = (
        buffer(RECORD * pairs),
        *(buffer(pairs) for _ in range(1 if grad_depth is None else 2)),
    )
    gaussians = len(state.depth_order)
    scratch = tuple(buffer(gaussians, mi.UInt32) for _ in range(2))
    rows, row_ranges = run(
        stages.rows_by_gaussian,
        state.depth_order,
        state.row_ranges,
        state.pairs,
        scratch,
    )
    lists = (state.pairs[0], rows, *state.pair_ranges)
    tile_order = binning.by_length(state.walked)
    run(
        stages.blend_backward,
        state.records,
        lists,
        tile_order,
        state.buffers,
        grad_picture,
        moments,
    )
    rows_of_each = numbers(mi.variant(), gaussians), *row_ranges
    given = (
        picture.layout,
        sh_terms(arrays),
        arrays,
        state.camera,
        rows_of_each,
        moments,
        gradients,
        screen,
    )
    if gaussians < MANY_GAUSSIANS:
        run(stages.project_backward, *given)
    else:
        stages.project_backward(*given)
    return gradients
