"""The rasteriser's own sorts, against NumPy's."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mi_splat import variant

variant.use()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from mi_splat.rasterization import sorting  # noqa: E402
from mi_splat.rasterization.binning import NO_TILE, bounds_of_tiles  # noqa: E402
from mi_splat.rasterization.blending import exp2_of_alpha  # noqa: E402
from mi_splat.rasterization.projection import CUTOFF  # noqa: E402


def uints(values: NDArray[np.int64]) -> mi.UInt32:
    found = mi.UInt32(values.astype(np.uint32))
    dr.make_opaque(found)
    return found


@pytest.mark.parametrize("tiles", [1, 2, 3, 255, 256, 4096, 25_600, 230_400])
def test_pairs_are_sorted_by_tile_and_keep_their_order(tiles: int) -> None:
    keys = np.random.default_rng(tiles).integers(0, tiles, 3000)
    keys[:2] = 0, tiles - 1
    assert np.array_equal(sorting.order_below(uints(keys), tiles).numpy(), np.argsort(keys, kind="stable"))


@pytest.mark.skipif(not variant.has_cuda(), reason="no GPU was found")
@pytest.mark.parametrize("tiles", [255, 230_400])
def test_pairs_keep_their_order_on_a_gpu(tiles: int) -> None:
    keys = np.random.default_rng(tiles).integers(0, tiles, 3_000_000)
    variant.use("cuda_ad_rgb")
    try:
        assert np.array_equal(sorting.order_below(uints(keys), tiles).numpy(), np.argsort(keys, kind="stable"))
    finally:
        variant.use("llvm_ad_rgb")


@pytest.mark.parametrize("tiles", [1, 255, 256, 230_400])
def test_unused_pairs_come_last(tiles: int) -> None:
    keys = np.array([NO_TILE, tiles - 1, 0, NO_TILE])
    expected = np.argsort(keys, kind="stable")[:2]
    assert np.array_equal(sorting.order_below(uints(keys), tiles).numpy()[:2], expected)


@pytest.mark.parametrize(("columns", "rows"), [(1, 1), (5, 3), (16, 16), (17, 33), (160, 40)])
def test_every_tile_is_worked_on_once_with_its_neighbours(columns: int, rows: int) -> None:
    tiles = sorting.by_block(mi.variant(), columns, rows).numpy()
    assert sorted(tiles) == list(range(columns * rows))
    first = tiles[: min(sorting.BLOCK, columns) * min(sorting.BLOCK, rows)]
    assert (first % columns).max() < sorting.BLOCK
    assert (first // columns).max() < sorting.BLOCK


def test_long_lists_come_before_short_ones_within_a_block() -> None:
    side = sorting.BLOCK * sorting.BLOCK
    lengths = np.random.default_rng(0).integers(0, 400, 2 * side + 10)
    order = sorting.by_length(sorting.length_key(uints(lengths))).numpy()
    for start in range(0, len(lengths), side):
        block = order[start : start + side]
        assert sorted(block) == list(range(start, min(start + side, len(lengths))))
        longest = np.sqrt(lengths[block])  # keys are an eighth of it apart
        assert np.all(longest[1:] <= longest[:-1] + 1 / 8 + 1e-4)


def test_a_list_longer_than_keys_can_tell_comes_first() -> None:
    assert sorting.length_key(uints(np.array([10**9, 10**6]))).numpy().max() == 0


def test_bounds_of_tiles_are_those_of_the_runs() -> None:
    tile = np.array([1, 1, 1, 4, 6, 6, NO_TILE])
    first, last = (dr.zeros(mi.UInt32, 8) for _ in range(2))
    dr.make_opaque(first, last)
    bounds_of_tiles(uints(tile), uints(np.arange(len(tile))), mi.UInt32(len(tile)), (first, last))
    assert list(first.numpy()) == [0, 0, 0, 0, 3, 0, 4, 0]
    assert list(last.numpy()) == [0, 3, 0, 0, 4, 0, 6, 0]


def test_the_exponential_is_right_where_an_alpha_counts() -> None:
    power = np.linspace(CUTOFF, 0.1, 200_001).astype(np.float32)
    expected = np.exp2(power.astype(np.float64))
    assert np.abs(exp2_of_alpha(mi.Float(power)).numpy() / expected - 1).max() < 2e-7
    halves = np.arange(math.floor(CUTOFF) + 1, 1) - 0.5
    assert np.abs(exp2_of_alpha(mi.Float(halves)).numpy() / np.exp2(halves) - 1).max() < 2e-7
