"""Gaussians as rays meet them: a record each, in the order of the tree, and the way
back for gradients.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.render.tile.frozen import aligned, buffer
from mi_splat.render.tile.layouts import Layout
from mi_splat.render.tile.picture import sh_terms
from mi_splat.render.tile.projection import CUTOFF, Gaussians, rotation_matrix

LEAF = 1
"""Most Gaussians of a leaf."""

NODE = 16
"""Floats of an inner node: the boxes of both children (lowest and highest corner each),
and four that are unused.
"""

_BITS = 10  # of each rank in the Morton code
_FAR = 1e30  # both corners of a box that holds nothing: no ray reaches it


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Nodes are numbered as in a heap: 1 is the root, 2 i and 2 i + 1 the children of
    i, leaves come last.
    """

    # float, `NODE` a node; that of a leaf, and of node 0, does not exist or is not used
    nodes: Any
    # UInt32, the Gaussian in each slot; the slots of a leaf follow each other
    order: Any
    starts: Any  # UInt32, first slot of each leaf, and the number of slots
    leaves: Any  # UInt32, number of leaves, a power of two


def build(means: Any, half: Any) -> Tree:
    """The tree of some Gaussians."""
    count = dr.width(means)
    leaves = 1
    while leaves * LEAF < count:
        leaves *= 2
    order = dr.argsort(_morton_code(means, count))
    leaf = mi.UInt64(dr.arange(mi.UInt32, leaves + 1))
    starts = mi.UInt32(
        (leaf * dr.opaque(mi.UInt64, count)) // dr.opaque(mi.UInt64, leaves)
    )
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


def _leaf_boxes(
    means: Any, half: Any, order: Any, starts: Any, leaves: int
) -> tuple[Any, Any]:
    """Lowest and highest corner of each leaf."""
    leaf = dr.arange(mi.UInt32, leaves)
    start = dr.gather(mi.UInt32, starts, leaf)
    stop = dr.gather(mi.UInt32, starts, leaf + 1)
    low = mi.Point3f(_FAR)
    high = mi.Point3f(-_FAR)
    for number in range(LEAF):
        slot = start + number
        gaussian = dr.gather(mi.UInt32, order, slot, slot < stop)
        mean = dr.gather(mi.Point3f, means, gaussian)
        size = dr.gather(mi.Vector3f, half, gaussian)
        valid = (slot < stop) & (size.x >= 0)
        low = dr.select(valid, dr.minimum(low, mean - size), low)
        high = dr.select(valid, dr.maximum(high, mean + size), high)
    dr.eval(low, high)
    return low, high


def _write_level(nodes: Any, low: Any, high: Any, count: int) -> tuple[Any, Any]:
    """Write `count` nodes from the corners of their children; returns the nodes' own
    corners.
    """
    index = dr.arange(mi.UInt32, count)
    corners = [
        [dr.gather(mi.Point3f, corner, 2 * index + child) for corner in (low, high)]
        for child in range(2)
    ]
    rows = []
    for one_low, one_high in corners:
        empty = one_low.x > one_high.x
        rows += [*dr.select(empty, _FAR, one_low), *dr.select(empty, _FAR, one_high)]
    dr.scatter(
        nodes,
        mi.ArrayXf([*rows, *[mi.Float(0)] * (NODE - 12)]),
        index + dr.opaque(mi.UInt32, count),
    )
    low = dr.minimum(corners[0][0], corners[1][0])
    high = dr.maximum(corners[0][1], corners[1][1])
    dr.eval(nodes, low, high)
    return low, high


RECORD = 16
"""Floats of a record: the rows of S^-1 R^T (9), the mean (3), log2 of the opacity, and
three that are unused.
"""

MOMENTS = 10
"""Floats of a gradient in a slot: the sums over rays of h, h u (3) and h u u^T (6), see
`adjoint`.
"""

_SECOND = ((4, 7, 8), (7, 5, 9), (8, 9, 6))  # where the entries of h u u^T are

HALF_LOG2_E = 0.5 * math.log2(math.e)
_LN2 = math.log(2.0)
# no ray meets such a Gaussian; its gradient shall be 0, not infinity times 0
_LEAST_OPACITY = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Splats:
    """What is traced."""

    layout: Layout  # what lies where in `arrays`
    # flat Floats, detached; the last holds SH, the one before it has one opacity a
    # Gaussian
    arrays: tuple[Any, ...]
    tree: Tree  # boxes about them; its slots are the rows of `records`
    records: Any  # Float, `RECORD` a slot
    terms: int  # SH coefficients a Gaussian and channel

    def with_colours(self, sh: Any) -> Splats:
        """The same Gaussians in the same tree with other SH, a Float as the last of
        `arrays`.
        """
        arrays = (*self.arrays[:-1], aligned(sh))
        return replace(self, arrays=arrays, terms=sh_terms(arrays))


def prepare(layout: Layout, arrays: tuple[Any, ...]) -> Splats | None:
    """Gaussians ready to be traced; None where there are none."""
    arrays = tuple(aligned(array) for array in arrays)
    count = len(arrays[-2])
    if count == 0:
        return None
    terms = sh_terms(arrays)
    gaussians = layout.read(arrays, dr.arange(mi.UInt32, count), terms)
    half = _half_boxes(gaussians)
    means = mi.Point3f(gaussians.mean)
    dr.eval(means, half)
    tree = build(means, half)
    records = buffer(RECORD * count)
    rows = _rows(layout.read(arrays, tree.order, terms))
    dr.scatter(
        records,
        mi.ArrayXf([*rows, *[mi.Float(0)] * (RECORD - len(rows))]),
        dr.arange(mi.UInt32, count),
    )
    dr.eval(records)
    return Splats(layout, arrays, tree, records, terms)


def _half_boxes(gaussians: Gaussians) -> Any:
    """Vector3f, half the box outside of which alpha < 1/255; negative where there is no
    such box.
    """
    reach = (dr.log2(gaussians.opacity) - CUTOFF) / HALF_LOG2_E
    axes = rotation_matrix(gaussians.rotation)
    scale = gaussians.scale
    half = [
        dr.sqrt(
            reach
            * sum(dr.square(axes[row, column] * scale[column]) for column in range(3))
        )
        for row in range(3)
    ]
    return dr.select(reach >= 0, mi.Vector3f(*half), mi.Vector3f(-1.0))


def _whitening(gaussians: Gaussians) -> list[Any]:
    """S^-1 R^T, three rows: it takes a Gaussian to the standard normal one."""
    axes = rotation_matrix(gaussians.rotation)
    return [
        mi.Vector3f(axes[0, i], axes[1, i], axes[2, i]) / gaussians.scale[i]
        for i in range(3)
    ]


def _rows(gaussians: Gaussians) -> list[Any]:
    """The numbers of a record."""
    whitening = [value for row in _whitening(gaussians) for value in row]
    return [*whitening, *gaussians.mean, dr.log2(gaussians.opacity)]


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """What `adjoint` adds to."""

    moments: Any  # float, `MOMENTS` a slot
    # float, three a slot: dL/dmean by way of the direction in which a colour is looked
    # up
    pulls: Any
    sh: Any  # float, dL/d(coefficient), as the last of `Splats.arrays`


def zero_sums(splats: Splats) -> Sums:
    """Sums to begin with."""
    count = len(splats.tree.order)
    sizes = (MOMENTS * count, 3 * count, len(splats.arrays[-1]))
    return Sums(*(buffer(size, value=0.0) for size in sizes))


def gradients(splats: Splats, sums: Sums) -> tuple[Any, ...]:
    """Gradient with respect to each of `splats.arrays` from what `adjoint` summed.

    With u = A (x - mean) at the point x of a ray where a Gaussian is densest, A = S^-1
    R^T, log alpha is log o - u^T u / 2. That point moves with the Gaussian, but where
    u^T u is least its motion does not change it: the derivative is A^T u with respect
    to the mean, and -u u^T A^-T with respect to A. The sums are of u, not of x - mean,
    since float32 cannot hold the thickness of a disc beside its width.
    """
    order = splats.tree.order
    arrays = splats.arrays
    grads = tuple(buffer(len(array), value=0.0) for array in arrays)
    slot = dr.arange(mi.UInt32, len(order))
    with dr.resume_grad():
        gaussians = splats.layout.read(arrays, order, splats.terms)
        dr.enable_grad(gaussians.parts())
        rows = _whitening(gaussians)
        inverse = [
            dr.detach(row) * dr.detach(dr.square(gaussians.scale[i]))
            for i, row in enumerate(rows)
        ]
        m = dr.gather(mi.ArrayXf, sums.moments, slot, shape=(MOMENTS, len(order)))
        product = _LN2 * m[0] * dr.log2(dr.maximum(gaussians.opacity, _LEAST_OPACITY))
        pull = mi.Vector3f(dr.gather(mi.Vector3f, sums.pulls, slot))
        for i, row in enumerate(rows):
            pull += dr.detach(row) * m[1 + i]
            for j, column in enumerate(inverse):
                product -= dr.dot(row, column) * m[_SECOND[i][j]]
        product += dr.dot(mi.Vector3f(gaussians.mean), pull)
        dr.backward(product)
        gradient = gaussians.gradient()
    width = 3 * splats.terms
    flat = dr.gather(mi.ArrayXf, sums.sh, order, shape=(width, len(order)))
    gradient.sh[:] = [
        mi.Color3f(flat[3 * k], flat[3 * k + 1], flat[3 * k + 2])
        for k in range(splats.terms)
    ]
    splats.layout.write(grads, order, gradient)
    dr.eval(grads)
    return grads
