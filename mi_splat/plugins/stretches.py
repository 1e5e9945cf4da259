"""Splats on one stretch of a path, or on a shadow ray: what they add, what they let through, and the replay of both."""

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.plugins.mixed import Mixed
from mi_splat.rasterization.colour import linear_derivative, linear_value
from mi_splat.raytracing import adjoint, segments
from mi_splat.raytracing.peaks import Stretch
from mi_splat.raytracing.splats import Sums


@dataclass(frozen=True, slots=True, eq=False)
class PathSettings:
    """What paths depend on besides the scene.

    Attributes:
        background: Color3f, radiance of what lies behind everything, where there is no environment emitter.
        linear: Whether light adds up in linear values; else in sRGB values, as 3DGS does.
        to_mean: Whether a Gaussian's colour is looked up towards its mean instead of along the ray.
        max_depth: Longest path, in vertices; 1 sees emitters, backgrounds and splats only.
        rr_depth: Vertices after which paths end at random.
        hide_emitters: Whether the camera does not see the environment.
    """

    background: Any
    linear: bool
    to_mean: bool
    max_depth: int
    rr_depth: int
    hide_emitters: bool


@dataclass(slots=True, eq=False)
class Adjoint:
    """What a replay needs: dL/dradiance, dL/dalpha of the camera's ray, and the sums that it adds to."""

    radiance: Any
    alpha: Any
    sums: Sums


def layer(colour: Any, transmittance: Any, *, linear: bool) -> Any:
    """Radiance of a stretch of splats: its colour is that of a layer with alpha = 1 - transmittance, made linear."""
    if not linear:
        return mi.Color3f(colour)
    alpha = 1.0 - transmittance
    return dr.select(alpha > 0.0, alpha * linear_value(colour / alpha), 0.0)


def layer_backward(colour: Any, transmittance: Any, gradient: Any, *, linear: bool) -> tuple[Any, Any]:
    """dL/dcolour (Color3f) and dL/dtransmittance (Float) from dL/dradiance."""
    if not linear:
        return mi.Color3f(gradient), mi.Float(0.0)
    alpha = 1.0 - transmittance
    layer_colour = colour / alpha
    slope = linear_derivative(layer_colour)
    grad_alpha = dr.dot(gradient, linear_value(layer_colour) - slope * layer_colour)
    visible = alpha > 0.0
    return dr.select(visible, gradient * slope, 0.0), dr.select(visible, -grad_alpha, 0.0)


def stretch_of(ray: Any, far: Any) -> Stretch:
    """A ray of Mitsuba's from its origin to a distance."""
    return Stretch(mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Float(0.0), mi.Float(far))


def seen_on(mixed: Mixed, ray: Any, far: Any, active: Any, settings: PathSettings) -> tuple[Any, Any]:
    """Colour (Color3f, sRGB, multiplied by alpha) and transmittance (Float) of the splats on a ray up to a distance."""
    if mixed.splats is None:
        return mi.Color3f(0.0), mi.Float(1.0)
    return segments.blend(mixed.splats, stretch_of(ray, far), active, to_mean=settings.to_mean)


def let_through(mixed: Mixed, ray: Any, active: Any) -> Any:
    """Transmittance of the splats on a shadow ray."""
    if mixed.splats is None:
        return mi.Float(1.0)
    return segments.transmittance(mixed.splats, stretch_of(ray, ray.maxt), active)


def replay_stretch(
    mixed: Mixed,
    ray: Any,
    si: Any,
    seen: tuple[Any, Any],
    path: tuple[Any, Any, Any],
    active: Any,
    settings: PathSettings,
    gradient: Any,
) -> None:
    """Add what the splats on a stretch of a path get."""
    if mixed.splats is None:
        return
    throughput, behind, depth = path
    grad_colour, grad_through = layer_backward(*seen, gradient.radiance * throughput, linear=settings.linear)
    grad_through += dr.select(seen[1] > 0.0, dr.dot(gradient.radiance, behind) / seen[1], 0.0)
    grad_through -= dr.select((depth == 0) & ~si.is_valid(), gradient.alpha, 0.0)
    far = dr.select(si.is_valid(), si.t, math.inf)
    adjoint.blend_backward(
        mixed.splats,
        stretch_of(ray, dr.minimum(far, ray.maxt)),
        active,
        seen,
        (grad_colour, grad_through),
        gradient.sums,
        to_mean=settings.to_mean,
    )


def replay_shadow(mixed: Mixed, shadow: Any, shade: Any, product: Any, active: Any, gradient: Any) -> None:
    """Add what the splats on a shadow ray get."""
    if mixed.splats is not None:
        unshaded = dr.select(shade > 0.0, product / shade, 0.0)
        adjoint.transmittance_backward(
            mixed.splats, stretch_of(shadow, shadow.maxt), active, shade, unshaded, gradient.sums
        )
