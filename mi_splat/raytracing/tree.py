"""A tree of boxes about Gaussians, built by Dr.Jit: a complete binary tree over their order along a Morton curve.

The curve runs through the ranks of their coordinates, not the coordinates themselves, so that a few far Gaussians do
not squeeze all others into one cell. A leaf holds at most `LEAF` of them.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.rasterization.frozen import buffer

LEAF = 1
"""Most Gaussians of a leaf."""

NODE = 16
"""Floats of an inner node: the boxes of both children (lowest and highest corner each), and four that are unused."""

_BITS = 10  # of each rank in the Morton code
_FAR = 1e30  # both corners of a box that holds nothing: no ray reaches it


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Nodes are numbered as in a heap: 1 is the root, 2 i and 2 i + 1 the children of i, leaves come last.

    Attributes:
        nodes: Float, `NODE` a node; that of a leaf, and of node 0, does not exist or is not used.
        order: UInt32, the Gaussian in each slot; the slots of a leaf follow each other.
        starts: UInt32, first slot of each leaf, and the number of slots.
        leaves: UInt32, number of leaves, a power of two.
    """

    nodes: Any
    order: Any
    starts: Any
    leaves: Any


def build(means: Any, half: Any) -> Tree:
    """The tree of some Gaussians."""
    count = dr.width(means)
    leaves = 1
    while leaves * LEAF < count:
        leaves *= 2
    order = dr.argsort(_morton_code(means, count))
    leaf = mi.UInt64(dr.arange(mi.UInt32, leaves + 1))
    starts = mi.UInt32((leaf * dr.opaque(mi.UInt64, count)) // dr.opaque(mi.UInt64, leaves))
    dr.eval(starts)
    low, high = _leaf_boxes(means, half, order, starts, leaves)
    nodes = buffer(NODE * leaves)
    level = leaves // 2
    while level >= 1:
        low, high = _write_level(nodes, low, high, level)
        level //= 2
    return Tree(nodes, order, starts, dr.opaque(mi.UInt32, leaves))


def _morton_code(means: Any, count: int) -> Any:
    """UInt32 place of each point along the curve."""
    code = mi.UInt32(0)
    for axis in range(3):
        rank = dr.empty(mi.UInt32, count)
        index = dr.arange(mi.UInt32, count)
        dr.scatter(rank, index, dr.argsort(means[axis]))
        cell = mi.UInt32(mi.Float(rank) * dr.opaque(mi.Float, (1 << _BITS) / count))
        cell = dr.minimum(cell, (1 << _BITS) - 1)
        for bit in range(_BITS):
            code |= ((cell >> bit) & 1) << (3 * bit + axis)
    return code


def _leaf_boxes(means: Any, half: Any, order: Any, starts: Any, leaves: int) -> tuple[Any, Any]:
    """Lowest and highest corner of each leaf."""
    leaf = dr.arange(mi.UInt32, leaves)
    start, stop = dr.gather(mi.UInt32, starts, leaf), dr.gather(mi.UInt32, starts, leaf + 1)
    low, high = mi.Point3f(_FAR), mi.Point3f(-_FAR)
    for number in range(LEAF):
        slot = start + number
        gaussian = dr.gather(mi.UInt32, order, slot, slot < stop)
        mean, size = dr.gather(mi.Point3f, means, gaussian), dr.gather(mi.Vector3f, half, gaussian)
        valid = (slot < stop) & (size.x >= 0)
        low = dr.select(valid, dr.minimum(low, mean - size), low)
        high = dr.select(valid, dr.maximum(high, mean + size), high)
    dr.eval(low, high)
    return low, high


def _write_level(nodes: Any, low: Any, high: Any, count: int) -> tuple[Any, Any]:
    """Write `count` nodes from the corners of their children; returns the nodes' own corners."""
    index = dr.arange(mi.UInt32, count)
    corners = []
    for child in range(2):
        one_low, one_high = (dr.gather(mi.Point3f, corner, 2 * index + child) for corner in (low, high))
        corners.append((one_low, one_high))
    rows = []
    for one_low, one_high in corners:
        empty = one_low.x > one_high.x
        rows += [*dr.select(empty, _FAR, one_low), *dr.select(empty, _FAR, one_high)]
    dr.scatter(nodes, mi.ArrayXf([*rows, *[mi.Float(0)] * (NODE - 12)]), index + dr.opaque(mi.UInt32, count))
    low, high = dr.minimum(corners[0][0], corners[1][0]), dr.maximum(corners[0][1], corners[1][1])
    dr.eval(nodes, low, high)
    return low, high
