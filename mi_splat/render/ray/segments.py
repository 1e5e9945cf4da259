"""What a stretch of a ray sees of Gaussians: their light, nearest peak first, and the
transmittance of all of them.

Every Gaussian acts at its peak alone, with alpha = min(0.99, o exp(-p^T Q p / 2)): a
stretch counts those whose peak lies on it. So a ray that is cut in two sees each
Gaussian once, and what it lets through does not depend on their order.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.render.ray.splats import HALF_LOG2_E, LEAF, NODE, RECORD, Splats, Sums
from mi_splat.render.tile.blending import MAX_ALPHA, MIN_TRANSMITTANCE
from mi_splat.render.tile.projection import CUTOFF

AT_ONCE = 8
"""Peaks that one walk finds."""

# a direction's component is at least so large, so that no infinity meets a zero
_LEAST = 1e-12


@dataclass(slots=True, eq=False)
class Stretch:
    """A stretch of a ray: origin, unit direction, and distances between which peaks
    count.
    """

    origin: Any  # point3f, world units
    direction: Any  # vector3f of length 1
    near: Any  # float, smallest distance
    far: Any  # float, a peak there or beyond does not count


@dataclass(slots=True, eq=False)
class Peak:
    """A Gaussian on a ray."""

    slot: Any  # UInt32, in the order of the tree
    distance: Any  # Float, of its peak
    level: Any  # Float, log2 of the unclamped alpha there
    # Vector3f from the mean to the peak, in standard deviations along the Gaussian's
    # own axes
    offset: Any
    mean: Any  # Point3f


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
    return Peak(
        slot, distance, v[12] - HALF_LOG2_E * dr.squared_norm(offset), offset, mean
    )


def walk(
    splats: Splats,
    stretch: Stretch,
    active: Any,
    state: list[Any],
    visit: Callable[[list[Any], Peak, Any], list[Any]],
    limit: Callable[[list[Any]], Any],
) -> list[Any]:
    """Visit every Gaussian whose box a stretch of a ray meets, roughly from near to
    far.
    """
    leaves = splats.tree.leaves
    d = stretch.direction
    inverse = dr.rcp(
        dr.select(dr.abs(d) < _LEAST, dr.copysign(mi.Vector3f(_LEAST), d), d)
    )

    def entry(corners: Any, far: Any) -> tuple[Any, Any]:
        a = (mi.Point3f(corners[0], corners[1], corners[2]) - stretch.origin) * inverse
        b = (mi.Point3f(corners[3], corners[4], corners[5]) - stretch.origin) * inverse
        first = dr.max(dr.minimum(a, b))
        last = dr.min(dr.maximum(a, b))
        return first, (first <= last) & (last >= stretch.near) & (first < far)

    def look(node: Any, state: list[Any]) -> list[Any]:
        leaf = node - leaves
        start, stop = (
            dr.gather(mi.UInt32, splats.tree.starts, leaf + k) for k in range(2)
        )
        for number in range(LEAF):
            peak = peak_of(splats, start + number, stretch)
            counts = (start + number < stop) & (peak.level >= CUTOFF)
            state = visit(state, peak, counts & (peak.distance < stretch.far))
        return state

    def body(node: Any, trail: Any, state: list[Any]) -> tuple[Any, Any, list[Any]]:
        inner = node < leaves
        v = dr.gather(
            mi.ArrayXf, splats.tree.nodes, node, inner, shape=(NODE, dr.width(node))
        )
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
        node = dr.select(
            down,
            2 * node + dr.select(second, mi.UInt32(1), mi.UInt32(0)),
            (node >> levels) ^ 1,
        )
        return (
            dr.select(limit(state) < 0, 0, node),
            dr.select(down, (trail << 1) | skip, up >> levels),
            state,
        )

    root = dr.select(active, mi.UInt32(1), mi.UInt32(0))
    _, _, state = dr.while_loop(
        (root, mi.UInt32(0), list(state)),
        lambda node, trail, state: node != 0,
        body,
        label="walk",
    )
    return list(state)


def nearest(
    splats: Splats, stretch: Stretch, after: tuple[Any, Any], active: Any
) -> tuple[list[Any], list[Any]]:
    """Distances and slots of the next `AT_ONCE` peaks, nearest first; infinity where
    there are fewer.

    Peaks at one distance are in the order of their slots, so that none is lost and none
    comes twice.
    """
    last, last_slot = after

    def visit(state: list[Any], peak: Peak, counts: Any) -> list[Any]:
        distances = list(state[:AT_ONCE])
        slots = list(state[AT_ONCE:])
        distance = peak.distance
        slot = mi.UInt32(peak.slot)
        fresh = (distance > last) | ((distance == last) & (slot > last_slot))
        distance = dr.select(
            counts & fresh & (distance >= stretch.near), distance, math.inf
        )
        for k in range(AT_ONCE):
            sooner = (distance < distances[k]) | (
                (distance == distances[k]) & (slot < slots[k])
            )
            distances[k], distance = (
                dr.select(sooner, distance, distances[k]),
                dr.select(sooner, distances[k], distance),
            )
            slots[k], slot = (
                dr.select(sooner, slot, slots[k]),
                dr.select(sooner, slots[k], slot),
            )
        return [*distances, *slots]

    start = [
        *(mi.Float(math.inf) for _ in range(AT_ONCE)),
        *(mi.UInt32(0) for _ in range(AT_ONCE)),
    ]
    here = Stretch(
        stretch.origin, stretch.direction, dr.maximum(stretch.near, last), stretch.far
    )
    state = walk(
        splats,
        here,
        active,
        start,
        visit,
        lambda state: dr.minimum(state[AT_ONCE - 1], stretch.far),
    )
    return state[:AT_ONCE], state[AT_ONCE:]


def alpha_of(peak: Peak) -> Any:
    """Alpha of a Gaussian at its peak."""
    return dr.minimum(dr.exp2(peak.level), MAX_ALPHA)


def behind(transmittance: Any, alpha: Any) -> Any:
    """Transmittance behind a Gaussian; 0 once it falls below `MIN_TRANSMITTANCE`, where
    a ray ends.
    """
    left = dr.fma(-alpha, transmittance, transmittance)
    return dr.select(left < MIN_TRANSMITTANCE, 0.0, left)


def view_direction(peak: Peak, stretch: Stretch, *, to_mean: bool) -> Any:
    """Direction in which a Gaussian's colour is looked up: that of the ray, or from its
    origin to the mean.
    """
    if to_mean:
        return dr.normalize(mi.Vector3f(peak.mean - stretch.origin))
    return stretch.direction


def coefficients(splats: Splats, gaussian: Any) -> list[Any]:
    """The SH of a Gaussian, a Color3f for each."""
    v = dr.gather(
        mi.ArrayXf,
        splats.arrays[-1],
        gaussian,
        shape=(3 * splats.terms, dr.width(gaussian)),
    )
    return [
        mi.Color3f(v[3 * k], v[3 * k + 1], v[3 * k + 2]) for k in range(splats.terms)
    ]


def unclamped_colour(sh: list[Any], direction: Any) -> Any:
    """0.5 + SH in a direction, Color3f in sRGB."""
    colour = mi.Color3f(0.5)
    for factor, coefficient in zip(
        dr.sh_eval(direction, math.isqrt(len(sh)) - 1), sh, strict=True
    ):
        colour = dr.fma(mi.Color3f(factor), coefficient, colour)
    return colour


def gaussian_in(splats: Splats, slot: Any) -> Any:
    """UInt32 number of the Gaussian in a slot."""
    return dr.gather(mi.UInt32, splats.tree.order, slot)


def for_each_peak(
    splats: Splats,
    stretch: Stretch,
    active: Any,
    state: list[Any],
    step: Callable[[list[Any], Peak], list[Any]],
) -> list[Any]:
    """Go through the peaks on a stretch, nearest first, for as long as light comes
    through; any number of them.
    """

    def body(
        last: Any, slot: Any, more: Any, state: list[Any]
    ) -> tuple[Any, Any, Any, list[Any]]:
        distances, slots = nearest(splats, stretch, (last, slot), more)
        last = distances[-1]
        slot = slots[-1]
        full = distances[-1] < math.inf

        def blend(
            distances: list[Any], slots: list[Any], state: list[Any]
        ) -> tuple[list[Any], list[Any], list[Any]]:
            state = step(list(state), peak_of(splats, slots[0], stretch))
            return (
                [*distances[1:], mi.Float(math.inf)],
                [*slots[1:], mi.UInt32(0)],
                state,
            )

        _, _, state = dr.while_loop(
            (distances, slots, list(state)),
            lambda distances, slots, state: (distances[0] < math.inf) & (state[0] > 0),
            blend,
            label="blend peaks",
        )
        return last, slot, more & full & (state[0] > 0), list(state)

    start = (mi.Float(-math.inf), mi.UInt32(0), mi.Bool(active), list(state))
    *_, state = dr.while_loop(
        start, lambda last, slot, more, state: more, body, label="peaks"
    )
    return list(state)


def blend(
    splats: Splats, stretch: Stretch, active: Any, *, to_mean: bool
) -> tuple[Any, Any]:
    """Colour (Color3f, sRGB, multiplied by alpha) and transmittance (Float) of a
    stretch; 0 and 1 on idle lanes.
    """

    def step(state: list[Any], peak: Peak) -> list[Any]:
        transmittance, colour = state
        alpha = alpha_of(peak)
        sh = coefficients(splats, gaussian_in(splats, peak.slot))
        splat_colour = dr.maximum(
            unclamped_colour(sh, view_direction(peak, stretch, to_mean=to_mean)), 0.0
        )
        return [
            behind(transmittance, alpha),
            dr.fma(mi.Color3f(alpha * transmittance), splat_colour, colour),
        ]

    transmittance, colour = for_each_peak(
        splats, stretch, active, [mi.Float(1.0), mi.Color3f(0.0)], step
    )
    return colour, transmittance


def transmittance(splats: Splats, stretch: Stretch, active: Any) -> Any:
    """Float, what a stretch lets through; 1 on idle lanes."""

    def visit(state: list[Any], peak: Peak, counts: Any) -> list[Any]:
        counts &= peak.distance >= stretch.near
        return [dr.select(counts, behind(state[0], alpha_of(peak)), state[0])]

    def limit(state: list[Any]) -> Any:
        return dr.select(state[0] > 0, stretch.far, -1.0)

    return walk(splats, stretch, active, [mi.Float(1.0)], visit, limit)[0]


def _add_moments(sums: Sums, peak: Peak, h: Any, active: Any) -> None:
    """Add h, h u and h u u^T of a ray to the sums of a slot."""
    u = peak.offset
    rows = [h, h * u.x, h * u.y, h * u.z]
    rows += [
        h * u.x * u.x,
        h * u.y * u.y,
        h * u.z * u.z,
        h * u.x * u.y,
        h * u.x * u.z,
        h * u.y * u.z,
    ]
    dr.scatter_add(sums.moments, mi.ArrayXf(rows), peak.slot, active)


def _add_colour(
    sums: Sums,
    splats: Splats,
    peak: Peak,
    stretch: Stretch,
    grad_own: Any,
    *,
    to_mean: bool,
) -> Any:
    """Add dL/dcolour of a Gaussian to `sums`, and return its colour (Color3f);
    `to_mean`: see `view_direction`.
    """
    gaussian = gaussian_in(splats, peak.slot)
    sh = coefficients(splats, gaussian)
    direction = view_direction(peak, stretch, to_mean=to_mean)
    raw = unclamped_colour(sh, direction)
    grad_raw = dr.select(raw > 0.0, grad_own, 0.0)
    basis = dr.sh_eval(direction, math.isqrt(splats.terms) - 1)
    dr.scatter_add(
        sums.sh,
        mi.ArrayXf([factor * g for factor in basis for g in grad_raw]),
        gaussian,
    )
    if to_mean:
        with dr.resume_grad():
            towards = mi.Vector3f(dr.detach(peak.mean - stretch.origin))
            dr.enable_grad(towards)
            dr.backward_from(
                dr.dot(unclamped_colour(sh, dr.normalize(towards)), dr.detach(grad_raw))
            )
            dr.scatter_add(sums.pulls, dr.grad(towards), peak.slot)
    return dr.maximum(raw, 0.0)


def blend_backward(
    splats: Splats,
    stretch: Stretch,
    active: Any,
    total: tuple[Any, Any],
    gradient: tuple[Any, Any],
    sums: Sums,
    *,
    to_mean: bool,
) -> None:
    """Add a stretch's share of the gradient."""
    grad_colour, grad_transmittance = gradient
    rest = dr.dot(grad_colour, total[0]) + grad_transmittance * total[1]

    def step(state: list[Any], peak: Peak) -> list[Any]:
        transmittance, rest = state
        alpha = alpha_of(peak)
        weight = alpha * transmittance
        colour = _add_colour(
            sums,
            splats,
            peak,
            stretch,
            mi.Color3f(grad_colour * weight),
            to_mean=to_mean,
        )
        gain = dr.dot(grad_colour, colour)
        rest = dr.fma(-weight, gain, rest)
        # alpha dL/dalpha = weight gain - rest alpha / (1 - alpha)
        h = dr.fma(weight, gain, -rest * alpha / (1.0 - alpha))
        _add_moments(sums, peak, h, dr.exp2(peak.level) < MAX_ALPHA)
        return [behind(transmittance, alpha), rest]

    for_each_peak(splats, stretch, active, [mi.Float(1.0), mi.Float(rest)], step)


def transmittance_backward(
    splats: Splats, stretch: Stretch, active: Any, total: Any, gradient: Any, sums: Sums
) -> None:
    """Add the share of a stretch of which only the transmittance counts."""
    product = gradient * total

    def visit(state: list[Any], peak: Peak, counts: Any) -> list[Any]:
        counts &= peak.distance >= stretch.near
        alpha = alpha_of(peak)
        _add_moments(
            sums,
            peak,
            -product * alpha / (1.0 - alpha),
            counts & (dr.exp2(peak.level) < MAX_ALPHA),
        )
        return state

    # A stretch that lets nothing through has no gradient: product is 0.
    walk(
        splats,
        stretch,
        active & (product != 0.0),
        [mi.Float(1.0)],
        visit,
        lambda state: stretch.far,
    )
