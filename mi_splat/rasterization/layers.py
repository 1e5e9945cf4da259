"""How many Gaussians each tile of a picture has to walk through, without making its lists: the memory stays flat.

A Gaussian touches an interval of tiles in each row of tiles. Only its two ends are counted, so a Gaussian that covers
the picture costs one step for each row and not one for each tile.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_splat.rasterization import binning, pinhole
from mi_splat.rasterization.binning import TILE
from mi_splat.rasterization.frozen import buffer, numbers, run
from mi_splat.rasterization.layouts import Layout
from mi_splat.rasterization.picture import sh_terms, tile_columns, width_and_height
from mi_splat.rasterization.pinhole import Pinhole, StageCamera
from mi_splat.rasterization.stages import projected


def layers_of_tiles(layout: Layout, arrays: tuple[Any, ...], camera: Pinhole) -> NDArray[np.int64]:
    """(rows, columns) lengths of the lists of all tiles of `TILE` x `TILE` pixels that `rasterize` would make."""
    width, height = camera.size
    columns, rows = -(-width // TILE), -(-height // TILE)
    edges = buffer((columns + 1) * rows, mi.Int32, 0)
    count = len(arrays[-2])
    if count:
        index, size = numbers(mi.variant(), count), mi.Int32([width, height])
        run(count_edges, layout, sh_terms(arrays), arrays, index, size, camera.for_stages(), edges)
    steps: NDArray[np.int64] = edges.numpy().reshape(rows, columns + 1).astype(np.int64)
    return steps.cumsum(axis=1)[:, :-1]


def count_edges(
    layout: Layout,
    terms: int,
    arrays: tuple[Any, ...],
    index: Any,
    size: Any,
    stage_camera: StageCamera,
    edges: Any,
) -> None:
    """Add 1 where the tiles of a Gaussian begin in a row, and -1 after they end."""
    camera = pinhole.unpack(stage_camera.numbers, antialiased=stage_camera.antialiased)
    splat, extent, _, visible = projected(layout.read(arrays, index, terms), camera)
    width, height = width_and_height(size)
    stride = tile_columns(width) + 1
    first, last = binning.tile_rows(splat, extent, height)

    def body(row: Any) -> tuple[Any]:
        left, right = binning.tiles_of_row(splat, row, height, width)
        met = left <= right
        dr.scatter_add(edges, mi.Int32(1), mi.UInt32(row * stride + left), met)
        dr.scatter_add(edges, mi.Int32(-1), mi.UInt32(row * stride + right + 1), met)
        return (row + 1,)

    dr.while_loop((mi.Int32(first),), lambda row: visible & (row <= last), body, label="layers")
    dr.eval(edges)
