"""How many Gaussians each tile of a picture has to walk through, without making its lists: the memory stays flat.

A Gaussian touches an interval of tiles in each row of tiles. Only its two ends are counted, so a Gaussian that covers
the picture costs one step for each row and not one for each tile.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_splat import variant
from mi_splat.cameras import Camera
from mi_splat.rasterization import binning, layouts
from mi_splat.rasterization.binning import TILE
from mi_splat.rasterization.frozen import aligned, buffer, numbers, run
from mi_splat.rasterization.layouts import Layout
from mi_splat.rasterization.picture import sh_terms, tile_columns
from mi_splat.rasterization.pinhole import KernelCamera, Pinhole
from mi_splat.rasterization.stages import projected
from mi_splat.scene import GaussianScene, check_scene

Layers = NDArray[np.int32]
"""(rows, columns) numbers of Gaussians on the lists of the tiles of a picture, `TILE` x `TILE` pixels each."""


def overdraw(scene: GaussianScene, cameras: Sequence[Camera], *, near: float) -> Iterator[Layers]:
    """How many Gaussians the list of each tile holds, camera by camera: exactly those that `rasterize` would make."""
    check_scene("scene", scene)
    variant.use()
    geometry = [value.detach().float().contiguous().flatten() for value in scene.tensors()[:4]]
    grey = scene.sh.detach().new_zeros(3 * len(scene)).float()  # colours cost time, and hide nothing from a list
    arrays = tuple(aligned(mi.Float(value)) for value in (*geometry, grey))
    for camera in cameras:
        columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
        edges = buffer((columns + 1) * rows, mi.Int32, 0)
        if len(scene):
            index = numbers(mi.variant(), len(scene))
            size = dr.opaque(mi.Int32, camera.width), dr.opaque(mi.Int32, camera.height)
            hole = Pinhole(camera=camera, near=near).for_kernels()
            run(count_edges, layouts.TENSORS, sh_terms(arrays), arrays, index, size, hole, edges)
        yield edges.numpy().reshape(rows, columns + 1).cumsum(axis=1, dtype=np.int32)[:, :-1]


def count_edges(
    layout: Layout,
    terms: int,
    arrays: tuple[Any, ...],
    index: Any,
    size: tuple[Any, Any],
    camera: KernelCamera,
    edges: Any,
) -> None:
    """Add 1 where the tiles of a Gaussian begin in a row, and -1 after they end."""
    splat, extent, _, visible = projected(layout.read(arrays, index, terms), camera)
    width, height = size
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
