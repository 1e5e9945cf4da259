"""How many Gaussians each tile of an image has to walk through, without making its
lists: the memory stays flat.

A Gaussian touches an interval of tiles in each row of tiles. Only its two ends are
counted, so a Gaussian that covers the image costs one step for each row and not one
for each tile.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_splat.cameras.camera import Camera
from mi_splat.render import variant
from mi_splat.render.tile import binning
from mi_splat.render.tile.binning import TILE
from mi_splat.render.tile.frozen import aligned, buffer, numbers, run
from mi_splat.render.tile.layouts import TENSORS
from mi_splat.render.tile.picture import tile_columns
from mi_splat.render.tile.pinhole import KernelCamera, Pinhole
from mi_splat.render.tile.stages import projected
from mi_splat.scene import GaussianScene, check_scene

Layers = NDArray[np.int32]
"""(rows, columns) numbers of Gaussians on the lists of the tiles of an image, `TILE` x
`TILE` pixels each.
"""
_ROUNDING = 1.0001  # in float32 a Gaussian may reach a little beyond its box


def most_layers(
    scene: GaussianScene,
    cameras: Sequence[Camera],
    *,
    near: float,
    stop: float = math.inf,
) -> tuple[int, Layers, int]:
    """Which of some cameras, of one size, has the most layers in the mean; its layers;
    and how many were tried.

    Layers are exactly the lists that `rasterize` would make. The first camera with a
    mean from `stop` is the last.
    """
    check_scene("scene", scene)
    variant.use()
    geometry = [
        value.detach().float().contiguous().flatten() for value in scene.tensors()[:4]
    ]
    # colours cost time, and hide nothing from a list
    grey = scene.sh.detach().new_zeros(3 * len(scene)).float()
    arrays = tuple(aligned(mi.Float(value)) for value in (*geometry, grey))
    index = numbers(mi.variant(), len(scene))
    width = cameras[0].width
    height = cameras[0].height
    columns = -(-width // TILE)
    rows = -(-height // TILE)

    def counted(stage: Callable[..., Any], number: int, *into: Any) -> Any:
        size = dr.opaque(mi.Int32, width), dr.opaque(mi.Int32, height)
        return run(
            stage,
            arrays,
            index,
            size,
            Pinhole(camera=cameras[number], near=near).for_kernels(),
            *into,
        )

    tried = len(cameras)
    counts = [-1] * len(cameras)
    most = [_ROUNDING * counted(count_boxes, number)[0] for number in range(tried)]
    in_order = max(most) >= stop * rows * columns
    for number in sorted(
        range(tried), key=lambda number: number if in_order else -most[number]
    ):
        if most[number] >= max(counts):
            counts[number] = counted(count, number)[0]
        if counts[number] >= stop * rows * columns:
            tried = number + 1
            break
    worst = counts.index(max(counts))
    edges = buffer((columns + 1) * rows, mi.Int32, 0)
    counted(count_edges, worst, edges)
    return (
        worst,
        edges.numpy().reshape(rows, columns + 1).cumsum(axis=1, dtype=np.int32)[:, :-1],
        tried,
    )


def count(
    arrays: tuple[Any, ...], index: Any, size: tuple[Any, Any], camera: KernelCamera
) -> Any:
    """UInt64, how many tiles all Gaussians touch."""
    splat, extent, _, visible = projected(TENSORS.read(arrays, index, 1), camera)
    return dr.sum(mi.UInt64(binning.count_tiles(splat, extent, visible, *size)))


def count_boxes(
    arrays: tuple[Any, ...], index: Any, size: tuple[Any, Any], camera: KernelCamera
) -> Any:
    """UInt64, how many tiles the boxes around them touch: no fewer, in a fraction of
    the time.
    """
    splat, extent, _, visible = projected(TENSORS.read(arrays, index, 1), camera)
    top, bottom = binning.tile_rows(splat, extent, size[1])
    left, right = binning.pixel_span(splat.centre.x, -extent.x, extent.x, size[0])
    box = (bottom - top + 1) * dr.maximum(right // TILE - left // TILE + 1, 0)
    return dr.sum(mi.UInt64(dr.select(visible, box, 0)))


def count_edges(
    arrays: tuple[Any, ...],
    index: Any,
    size: tuple[Any, Any],
    camera: KernelCamera,
    edges: Any,
) -> None:
    """Add 1 where the tiles of a Gaussian begin in a row, and -1 after they end."""
    splat, extent, _, visible = projected(TENSORS.read(arrays, index, 1), camera)
    width, height = size
    stride = tile_columns(width) + 1
    first, last = binning.tile_rows(splat, extent, height)

    def body(row: Any) -> tuple[Any]:
        left, right = binning.tiles_of_row(splat, row, height, width)
        met = left <= right
        dr.scatter_add(edges, mi.Int32(1), mi.UInt32(row * stride + left), met)
        dr.scatter_add(edges, mi.Int32(-1), mi.UInt32(row * stride + right + 1), met)
        return (row + 1,)

    dr.while_loop(
        (mi.Int32(first),), lambda row: visible & (row <= last), body, label="layers"
    )
    dr.eval(edges)
