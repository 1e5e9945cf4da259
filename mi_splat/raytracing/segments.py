"""What a stretch of a ray sees of Gaussians: their light, nearest peak first, and the transmittance of all of them.

Every Gaussian acts at its peak alone, with alpha = min(0.99, o exp(-p^T Q p / 2)): a stretch counts those whose peak
lies on it. So a ray that is cut in two sees each Gaussian once, and what it lets through does not depend on their
order.
"""

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.rasterization.blending import MAX_ALPHA, MIN_TRANSMITTANCE
from mi_splat.raytracing.peaks import Peak, Stretch, nearest, peak_of, walk
from mi_splat.raytracing.splats import Splats, Sums


def alpha_of(peak: Peak) -> Any:
    """Alpha of a Gaussian at its peak."""
    return dr.minimum(dr.exp2(peak.level), MAX_ALPHA)


def behind(transmittance: Any, alpha: Any) -> Any:
    """Transmittance behind a Gaussian; 0 once it falls below `MIN_TRANSMITTANCE`, where a ray ends."""
    left = dr.fma(-alpha, transmittance, transmittance)
    return dr.select(left < MIN_TRANSMITTANCE, 0.0, left)


def view_direction(peak: Peak, stretch: Stretch, *, to_mean: bool) -> Any:
    """Direction in which a Gaussian's colour is looked up: that of the ray, or from its origin to the mean."""
    return dr.normalize(mi.Vector3f(peak.mean - stretch.origin)) if to_mean else stretch.direction


def coefficients(splats: Splats, gaussian: Any) -> list[Any]:
    """The SH of a Gaussian, a Color3f for each."""
    v = dr.gather(mi.ArrayXf, splats.arrays[-1], gaussian, shape=(3 * splats.terms, dr.width(gaussian)))
    return [mi.Color3f(v[3 * k], v[3 * k + 1], v[3 * k + 2]) for k in range(splats.terms)]


def unclamped_colour(sh: list[Any], direction: Any) -> Any:
    """0.5 + SH in a direction, Color3f in sRGB."""
    colour = mi.Color3f(0.5)
    for factor, coefficient in zip(dr.sh_eval(direction, math.isqrt(len(sh)) - 1), sh, strict=True):
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
    """Go through the peaks on a stretch, nearest first, for as long as light comes through; any number of them."""

    def body(last: Any, slot: Any, more: Any, state: list[Any]) -> tuple[Any, Any, Any, list[Any]]:
        distances, slots = nearest(splats, stretch, (last, slot), more)
        last, slot, full = distances[-1], slots[-1], distances[-1] < math.inf

        def blend(distances: list[Any], slots: list[Any], state: list[Any]) -> tuple[list[Any], list[Any], list[Any]]:
            state = step(list(state), peak_of(splats, slots[0], stretch))
            return [*distances[1:], mi.Float(math.inf)], [*slots[1:], mi.UInt32(0)], state

        _, _, state = dr.while_loop(
            (distances, slots, list(state)),
            lambda distances, slots, state: (distances[0] < math.inf) & (state[0] > 0),
            blend,
            label="blend peaks",
        )
        return last, slot, more & full & (state[0] > 0), list(state)

    start = (mi.Float(-math.inf), mi.UInt32(0), mi.Bool(active), list(state))
    *_, state = dr.while_loop(start, lambda last, slot, more, state: more, body, label="peaks")
    return list(state)


def blend(splats: Splats, stretch: Stretch, active: Any, *, to_mean: bool) -> tuple[Any, Any]:
    """Colour (Color3f, sRGB, multiplied by alpha) and transmittance (Float) of a stretch; 0 and 1 on idle lanes."""

    def step(state: list[Any], peak: Peak) -> list[Any]:
        transmittance, colour = state
        alpha = alpha_of(peak)
        sh = coefficients(splats, gaussian_in(splats, peak.slot))
        splat_colour = dr.maximum(unclamped_colour(sh, view_direction(peak, stretch, to_mean=to_mean)), 0.0)
        return [behind(transmittance, alpha), dr.fma(mi.Color3f(alpha * transmittance), splat_colour, colour)]

    transmittance, colour = for_each_peak(splats, stretch, active, [mi.Float(1.0), mi.Color3f(0.0)], step)
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
    rows += [h * u.x * u.x, h * u.y * u.y, h * u.z * u.z, h * u.x * u.y, h * u.x * u.z, h * u.y * u.z]
    dr.scatter_add(sums.moments, mi.ArrayXf(rows), peak.slot, active)


def _add_colour(sums: Sums, splats: Splats, peak: Peak, stretch: Stretch, grad_own: Any, *, to_mean: bool) -> Any:
    """Add dL/dcolour of a Gaussian to `sums`, and return its colour (Color3f); `to_mean`: see `view_direction`."""
    gaussian = gaussian_in(splats, peak.slot)
    sh = coefficients(splats, gaussian)
    direction = view_direction(peak, stretch, to_mean=to_mean)
    raw = unclamped_colour(sh, direction)
    grad_raw = dr.select(raw > 0.0, grad_own, 0.0)
    basis = dr.sh_eval(direction, math.isqrt(splats.terms) - 1)
    dr.scatter_add(sums.sh, mi.ArrayXf([factor * g for factor in basis for g in grad_raw]), gaussian)
    if to_mean:
        with dr.resume_grad():
            towards = mi.Vector3f(dr.detach(peak.mean - stretch.origin))
            dr.enable_grad(towards)
            dr.backward_from(dr.dot(unclamped_colour(sh, dr.normalize(towards)), dr.detach(grad_raw)))
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
        colour = _add_colour(sums, splats, peak, stretch, mi.Color3f(grad_colour * weight), to_mean=to_mean)
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
        _add_moments(sums, peak, -product * alpha / (1.0 - alpha), counts & (dr.exp2(peak.level) < MAX_ALPHA))
        return state

    # A stretch that lets nothing through has no gradient: product is 0.
    walk(splats, stretch, active & (product != 0.0), [mi.Float(1.0)], visit, lambda state: stretch.far)
