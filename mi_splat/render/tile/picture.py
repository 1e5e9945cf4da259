"""What passes between the stages: the buffers of an image, the finished image, and
what its derivative needs.
"""

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.render.tile.binning import TILE, by_block
from mi_splat.render.tile.frozen import buffer, numbers
from mi_splat.render.tile.layouts import Layout
from mi_splat.render.tile.pinhole import KernelCamera


@dataclass(eq=False)  # not frozen: dr.freeze assigns the fields again
class PictureBuffers:
    """The image that is made: its size, its tiles, and the arrays that it is written
    to.
    """

    size: tuple[Any, Any]  # Int32, width and height
    tiles: Any  # UInt32, numbers of the tiles, neighbours together
    pixels: Any  # UInt32, 0, 1, 2, ...
    # UInt32, where each pixel lies tile after tile, see `tiled_index`
    tiled_indices: Any
    background: Any  # Float, 3 values
    colour: Any  # Float, row-major, 3 a pixel
    opacity: Any  # Float, row-major
    # nothing, or Floats, row-major: expected depth, median depth, sum of weights
    depths: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class BackwardState:
    """What the backward pass needs of the forward pass; pairs and rows are explained in
    README.md.
    """

    buffers: PictureBuffers
    camera: KernelCamera
    records: tuple[Any, ...]
    depth_order: Any  # UInt32, Gaussians from near to far
    # first and one-past-last row of each Gaussian that holds a pair, in depth order
    row_ranges: tuple[Any, Any]
    # in tile order: Gaussian, and row (place before the sort by tile)
    pairs: tuple[Any, Any]
    pair_ranges: tuple[Any, Any]  # first and one-past-last pair of each tile
    # UInt32, keys for `binning.by_length`: how much of its list each tile has walked
    walked: Any


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """What the forward pass returns and the backward pass takes.

    The depths are nothing, or three: the mean of the Gaussians' camera-space depths by
    their weights, the depth of the Gaussian at which the transmittance falls to one
    half or below (both 0 where there is none), and the sum of weights. That is the
    opacity again, with a small relative error where 1 - transmittance has a large one.
    """

    colour: Any  # Float, height x width x 3 values, row-major, background blended in
    opacity: Any  # Float, height x width values of 1 - transmittance
    depths: tuple[Any, ...]  # Floats, height x width values each
    layout: Layout  # what lies where in `arrays`
    arrays: tuple[Any, ...]  # the Gaussians, as the stages read them
    state: BackwardState | None  # the stages' results, or None where nothing is visible


def new_buffers(
    size: tuple[int, int],
    background: tuple[float, float, float],
    *,
    depths: bool = False,
) -> PictureBuffers:
    """Buffers for an image of (width, height) pixels, and for its depths."""
    width, height = size
    pixels = width * height
    return PictureBuffers(
        size=(dr.opaque(mi.Int32, width), dr.opaque(mi.Int32, height)),
        tiles=by_block(mi.variant(), -(-width // TILE), -(-height // TILE)),
        pixels=numbers(mi.variant(), pixels),
        tiled_indices=_pixel_indices(mi.variant(), width, pixels),
        background=mi.Float(background),
        colour=buffer(3 * pixels),
        opacity=buffer(pixels, value=0.0),
        depths=tuple(buffer(pixels, value=0.0) for _ in range(3 if depths else 0)),
    )


@functools.lru_cache(maxsize=16)
def _pixel_indices(variant: str, width: int, pixels: int) -> Any:
    """The places of all pixels in memory: two integer divisions a pixel cost more than
    reading the result.
    """
    index = tiled_index(mi.Int32(numbers(variant, pixels)), mi.Int32(width))
    dr.make_opaque(index)
    return index


def sh_terms(arrays: tuple[Any, ...]) -> int:
    """SH coefficients a Gaussian and channel: in every layout the last array holds SH,
    the one before it opacities.
    """
    return len(arrays[-1]) // (3 * len(arrays[-2]))


def tile_columns(width: Any) -> Any:
    """Tiles beside each other in an image of this width."""
    return (width + (TILE - 1)) // TILE


def tiled_index(pixel: Any, width: Any) -> Any:
    """Where a row-major pixel (Int32) lies in a buffer that holds the tiles one after
    another, 16 pixels each.
    """
    x = pixel % width
    y = pixel // width
    tile = (y // TILE) * tile_columns(width) + x // TILE
    return mi.UInt32(tile * TILE * TILE + (y % TILE) * TILE + x % TILE)
