"""The derivative of what a stretch of a ray sees: the same walk again, adding to sums for each Gaussian.

For h = alpha dL/dalpha and u from the mean to the peak in the Gaussian's own frame, a slot holds the sums over rays of
h, h u and h u u^T; `splats.gradients` takes them to means, scales, rotations and opacities. Sums are atomic, so their
last bits depend on the order in which threads come.
"""

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.rasterization.blending import MAX_ALPHA
from mi_splat.raytracing.peaks import Peak, Stretch, walk
from mi_splat.raytracing.segments import (
    alpha_of,
    behind,
    coefficients,
    for_each_peak,
    gaussian_in,
    unclamped_colour,
    view_direction,
)
from mi_splat.raytracing.splats import Splats, Sums


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
