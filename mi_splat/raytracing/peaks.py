"""Where a ray meets Gaussians: each at its peak, the point of the ray at which it is densest.

The tree is walked without a stack: `trail` counts, as a binary number, which of the two children on the way down have
been visited, so the way up is read from its trailing ones (Hapala et al. 2011 and Binder and Keller 2016 have walks of
this kind). The child that the ray enters first comes first.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.rasterization.projection import CUTOFF
from mi_splat.raytracing.splats import HALF_LOG2_E, LEAF, NODE, RECORD, Splats

AT_ONCE = 8
"""Peaks that one walk finds."""

_LEAST = 1e-12  # a direction's component is at least so large, so that no infinity meets a zero


@dataclass(slots=True, eq=False)
class Stretch:
    """A stretch of a ray: origin, unit direction, and distances between which peaks count.

    Attributes:
        origin: Point3f, world units.
        direction: Vector3f of length 1.
        near: Float, smallest distance.
        far: Float, a peak there or beyond does not count.
    """

    origin: Any
    direction: Any
    near: Any
    far: Any


@dataclass(slots=True, eq=False)
class Peak:
    """A Gaussian on a ray.

    Attributes:
        slot: UInt32, in the order of the tree.
        distance: Float, of its peak.
        level: Float, log2 of the unclamped alpha there.
        offset: Vector3f, from the mean to the peak in the Gaussian's own frame: in standard deviations along its axes.
        mean: Point3f.
    """

    slot: Any
    distance: Any
    level: Any
    offset: Any
    mean: Any


def peak_of(splats: Splats, slot: Any, stretch: Stretch) -> Peak:
    """The peak of the Gaussian in a slot along a ray."""
    v = dr.gather(mi.ArrayXf, splats.records, slot, shape=(RECORD, dr.width(slot)))
    rows = [mi.Vector3f(v[3 * i], v[3 * i + 1], v[3 * i + 2]) for i in range(3)]
    mean = mi.Point3f(v[9], v[10], v[11])
    away = mi.Vector3f(stretch.origin - mean)
    direction = mi.Vector3f(*[dr.dot(row, stretch.direction) for row in rows])
    origin = mi.Vector3f(*[dr.dot(row, away) for row in rows])
    distance = -dr.dot(origin, direction) / dr.squared_norm(direction)
    offset = dr.fma(direction, distance, origin)
    return Peak(slot, distance, v[12] - HALF_LOG2_E * dr.squared_norm(offset), offset, mean)


def walk(
    splats: Splats,
    stretch: Stretch,
    active: Any,
    state: list[Any],
    visit: Callable[[list[Any], Peak, Any], list[Any]],
    limit: Callable[[list[Any]], Any],
) -> list[Any]:
    """Visit every Gaussian whose box a stretch of a ray meets, roughly from near to far."""
    leaves = splats.tree.leaves
    d = stretch.direction
    inverse = dr.rcp(dr.select(dr.abs(d) < _LEAST, dr.copysign(mi.Vector3f(_LEAST), d), d))

    def entry(corners: Any, far: Any) -> tuple[Any, Any]:
        a = (mi.Point3f(corners[0], corners[1], corners[2]) - stretch.origin) * inverse
        b = (mi.Point3f(corners[3], corners[4], corners[5]) - stretch.origin) * inverse
        first, last = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
        return first, (first <= last) & (last >= stretch.near) & (first < far)

    def look(node: Any, state: list[Any]) -> list[Any]:
        leaf = node - leaves
        start, stop = (dr.gather(mi.UInt32, splats.tree.starts, leaf + k) for k in range(2))
        for number in range(LEAF):
            peak = peak_of(splats, start + number, stretch)
            counts = (start + number < stop) & (peak.level >= CUTOFF)
            state = visit(state, peak, counts & (peak.distance < stretch.far))
        return state

    def body(node: Any, trail: Any, state: list[Any]) -> tuple[Any, Any, list[Any]]:
        inner = node < leaves
        v = dr.gather(mi.ArrayXf, splats.tree.nodes, node, inner, shape=(NODE, dr.width(node)))
        far = limit(state)
        (near_0, hit_0), (near_1, hit_1) = entry(v[0:6], far), entry(v[6:12], far)
        second = hit_1 & (~hit_0 | (near_1 < near_0))
        down = inner & (hit_0 | hit_1)
        skip = dr.select(hit_0 & hit_1, mi.UInt32(0), mi.UInt32(1))
        state = dr.if_stmt(
            (mi.UInt32(node), list(state)),
            ~inner,
            lambda node, state: look(node, list(state)),
            lambda node, state: list(state),
        )
        up = trail + 1
        levels = dr.tzcnt(up)
        node = dr.select(down, 2 * node + dr.select(second, mi.UInt32(1), mi.UInt32(0)), (node >> levels) ^ 1)
        return dr.select(limit(state) < 0, 0, node), dr.select(down, (trail << 1) | skip, up >> levels), state

    root = dr.select(active, mi.UInt32(1), mi.UInt32(0))
    _, _, state = dr.while_loop(
        (root, mi.UInt32(0), list(state)), lambda node, trail, state: node != 0, body, label="walk"
    )
    return list(state)


def nearest(splats: Splats, stretch: Stretch, after: tuple[Any, Any], active: Any) -> tuple[list[Any], list[Any]]:
    """Distances and slots of the next `AT_ONCE` peaks, nearest first; infinity where there are fewer.

    Peaks at one distance are in the order of their slots, so that none is lost and none comes twice.
    """
    last, last_slot = after

    def visit(state: list[Any], peak: Peak, counts: Any) -> list[Any]:
        distances, slots = list(state[:AT_ONCE]), list(state[AT_ONCE:])
        distance, slot = peak.distance, mi.UInt32(peak.slot)
        fresh = (distance > last) | ((distance == last) & (slot > last_slot))
        distance = dr.select(counts & fresh & (distance >= stretch.near), distance, math.inf)
        for k in range(AT_ONCE):
            sooner = (distance < distances[k]) | ((distance == distances[k]) & (slot < slots[k]))
            distances[k], distance = (
                dr.select(sooner, distance, distances[k]),
                dr.select(sooner, distances[k], distance),
            )
            slots[k], slot = dr.select(sooner, slot, slots[k]), dr.select(sooner, slots[k], slot)
        return [*distances, *slots]

    start = [*(mi.Float(math.inf) for _ in range(AT_ONCE)), *(mi.UInt32(0) for _ in range(AT_ONCE))]
    here = Stretch(stretch.origin, stretch.direction, dr.maximum(stretch.near, last), stretch.far)
    state = walk(splats, here, active, start, visit, lambda state: dr.minimum(state[AT_ONCE - 1], stretch.far))
    return state[:AT_ONCE], state[AT_ONCE:]
