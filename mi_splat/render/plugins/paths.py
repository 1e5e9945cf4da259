"""Paths through splats and surfaces: radiance along camera rays, and the gradient of it
with respect to the splats.

Splats emit and attenuate; they are not lit, and no light scatters from them. On every
stretch of a path, from one surface to the next, their light is added and what lies
behind is multiplied by their transmittance; shadow rays are multiplied by it, too.
Surfaces are path traced with next-event estimation and multiple importance sampling
(Veach 1997); the gradient replays each path (path replay backpropagation, Vicini et al.
2021).
"""

import math
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import mitsuba as mi

from mi_splat.render.plugins.gaussian_shapes import GaussianShapes
from mi_splat.render.ray import segments
from mi_splat.render.ray.segments import Stretch
from mi_splat.render.ray.splats import Splats, Sums, prepare
from mi_splat.render.tile.colour import linear_derivative, linear_value
from mi_splat.render.tile.layouts import ELLIPSOIDS, check_finite


@dataclass(frozen=True, slots=True, eq=False)
class Mixed:
    """What paths run through."""

    scene: Any  # the Mitsuba scene; its emitters light the surfaces
    # a Mitsuba scene of its surfaces alone, so that no ray stops at a Gaussian; None
    # for none
    surfaces: Any | None
    splats: Splats | None  # its Gaussians; None for none


class MixedCache:
    """The last scene that was prepared, by the indices of its arrays: held ones never
    change under a given index.
    """

    def __init__(self) -> None:
        self._splats: tuple[Any, Any, Splats | None] | None = None
        self._surfaces: tuple[Any, Any, Any] | None = None

    def mixed(self, scene: Any, shapes: GaussianShapes) -> Mixed:
        """The scene, prepared."""
        return Mixed(scene, self._surfaces_of(shapes), self._splats_of(shapes))

    def _splats_of(self, shapes: GaussianShapes) -> Splats | None:
        held = shapes.detached()
        key = _key(held)
        before = self._splats
        if before is not None and before[0] == key:
            return before[2]
        arrays = shapes.joined()
        check_finite(ELLIPSOIDS, arrays)
        if (
            before is not None
            and before[2] is not None
            and _without_colours(before[0]) == _without_colours(key)
        ):
            splats: Splats | None = before[2].with_colours(arrays[-1])
        else:
            splats = prepare(ELLIPSOIDS, arrays)
        self._splats = key, held, splats
        return splats

    def _surfaces_of(self, shapes: GaussianShapes) -> Any | None:
        if not shapes.others:
            return None
        values = [value for shape in shapes.others for _, value in mi.traverse(shape)]
        values = [getattr(value, "matrix", value) for value in values]
        arrays = [dr.detach(value) for value in values if dr.is_array_v(value)]
        plain = tuple(str(value) for value in values if not dr.is_array_v(value))
        key = tuple(id(shape) for shape in shapes.others), _key(_flat(arrays)), plain
        if self._surfaces is None or self._surfaces[0] != key:
            self._surfaces = key, (arrays, shapes.others), _scene_of(shapes.others)
        return self._surfaces[2]


def _scene_of(shapes: list[Any]) -> Any:
    """A Mitsuba scene of shapes that belong to another one, which keep their names
    there.
    """
    names = [shape.id() for shape in shapes]
    scene = mi.load_dict(
        {"type": "scene", **{f"{n}": shape for n, shape in enumerate(shapes)}},
        parallel=False,
    )
    for shape, name in zip(shapes, names, strict=True):
        shape.set_id(name)
    return scene


def _flat(arrays: list[Any]) -> list[Any]:
    """Arrays of one dimension that hold the same numbers."""
    flat = []
    for array in arrays:
        if dr.is_tensor_v(array):
            flat.append(array.array)
        elif dr.depth_v(array) > 1:
            flat += _flat([array[k] for k in range(len(array))])
        else:
            flat.append(array)
    return flat


def _without_colours(key: tuple[int, ...]) -> tuple[int, ...]:
    """The key without the SH of each shape, which has data, opacities and SH: the tree
    does not depend on them.
    """
    return tuple(index for number, index in enumerate(key) if number % 3 != 2)


def _key(arrays: list[Any]) -> tuple[int, ...]:
    return tuple(array.index for array in arrays)


@dataclass(frozen=True, slots=True, eq=False)
class PathSettings:
    """What paths depend on besides the scene."""

    # color3f, radiance of what lies behind everything, where there is no environment
    # emitter
    background: Any
    # whether light adds up in linear values; else in sRGB values, as 3DGS does
    linear: bool
    # whether a Gaussian's colour is looked up towards its mean instead of along the ray
    to_mean: bool
    # longest path, in vertices; 1 sees emitters, backgrounds and splats only
    max_depth: int
    rr_depth: int  # vertices after which paths end at random
    hide_emitters: bool  # whether the camera does not see the environment


@dataclass(slots=True, eq=False)
class Adjoint:
    """What a replay needs: dL/dradiance, dL/dalpha of the camera's ray, and the sums
    that it adds to.
    """

    radiance: Any
    alpha: Any
    sums: Sums


def layer(colour: Any, transmittance: Any, *, linear: bool) -> Any:
    """Radiance of a stretch of splats: its colour is that of a layer with alpha = 1 -
    transmittance, made linear.
    """
    if not linear:
        return mi.Color3f(colour)
    alpha = 1.0 - transmittance
    return dr.select(alpha > 0.0, alpha * linear_value(colour / alpha), 0.0)


def layer_backward(
    colour: Any, transmittance: Any, gradient: Any, *, linear: bool
) -> tuple[Any, Any]:
    """dL/dcolour (Color3f) and dL/dtransmittance (Float) from dL/dradiance."""
    if not linear:
        return mi.Color3f(gradient), mi.Float(0.0)
    alpha = 1.0 - transmittance
    layer_colour = colour / alpha
    slope = linear_derivative(layer_colour)
    grad_alpha = dr.dot(gradient, linear_value(layer_colour) - slope * layer_colour)
    visible = alpha > 0.0
    return dr.select(visible, gradient * slope, 0.0), dr.select(
        visible, -grad_alpha, 0.0
    )


def stretch_of(ray: Any, far: Any) -> Stretch:
    """A ray of Mitsuba's from its origin to a distance."""
    return Stretch(mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.Float(0.0), mi.Float(far))


def seen_on(
    mixed: Mixed, ray: Any, far: Any, active: Any, settings: PathSettings
) -> tuple[Any, Any]:
    """Colour (Color3f, sRGB, multiplied by alpha) and transmittance (Float) of the
    splats on a ray up to a distance.
    """
    if mixed.splats is None:
        return mi.Color3f(0.0), mi.Float(1.0)
    return segments.blend(
        mixed.splats, stretch_of(ray, far), active, to_mean=settings.to_mean
    )


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
    grad_colour, grad_through = layer_backward(
        *seen, gradient.radiance * throughput, linear=settings.linear
    )
    grad_through += dr.select(
        seen[1] > 0.0, dr.dot(gradient.radiance, behind) / seen[1], 0.0
    )
    grad_through -= dr.select((depth == 0) & ~si.is_valid(), gradient.alpha, 0.0)
    far = dr.minimum(dr.select(si.is_valid(), si.t, math.inf), ray.maxt)
    stretch = stretch_of(ray, far)
    of_seen = (grad_colour, grad_through)
    to_mean = settings.to_mean
    segments.blend_backward(
        mixed.splats, stretch, active, seen, of_seen, gradient.sums, to_mean=to_mean
    )


def replay_shadow(
    mixed: Mixed, shadow: Any, shade: Any, product: Any, active: Any, gradient: Any
) -> None:
    """Add what the splats on a shadow ray get."""
    if mixed.splats is not None:
        unshaded = dr.select(shade > 0.0, product / shade, 0.0)
        stretch = stretch_of(shadow, shadow.maxt)
        segments.transmittance_backward(
            mixed.splats, stretch, active, shade, unshaded, gradient.sums
        )


def _mis_weight(pdf: Any, other_pdf: Any) -> Any:
    """Power heuristic of two densities."""
    both = dr.square(pdf) + dr.square(other_pdf)
    return dr.select(both > 0.0, dr.square(pdf) / both, 0.0)


def radiance(
    mixed: Mixed,
    sampler: Any,
    ray: Any,
    settings: PathSettings,
    *,
    total: tuple[Any, Any, Any] | None = None,
    gradient: Adjoint | None = None,
) -> tuple[Any, Any, tuple[Any, Any, Any]]:
    """Radiance along camera rays, or with `gradient` a replay that adds to the sums of
    the splats.
    """
    ray = mi.Ray3f(dr.detach(ray))
    if mixed.surfaces is None:
        hit = None
        far = mi.Float(ray.maxt)
    else:
        hit = mixed.surfaces.ray_intersect_preliminary(ray, coherent=True)
        far = dr.minimum(dr.select(hit.is_valid(), hit.t, math.inf), ray.maxt)
    if total is None:
        first = seen_on(mixed, ray, far, mi.Bool(True), settings)
    else:
        first = total[1:]
    solid = mi.Bool(False) if hit is None else hit.is_valid()
    gathered = mi.Spectrum(0.0) if total is None else mi.Spectrum(total[0])
    if hit is None:
        gathered = _alone(mixed, ray, far, first, gathered, settings, gradient)
    else:
        gathered = _paths(mixed, sampler, ray, hit, first, gathered, settings, gradient)
    return gathered, dr.select(solid, 1.0, 1.0 - first[1]), (gathered, *first)


def _behind_everything(mixed: Mixed, ray: Any, settings: PathSettings) -> Any:
    """Radiance of the background or the environment along rays that meet no surface."""
    environment = mixed.scene.environment()
    if environment is None:
        return settings.background
    if settings.hide_emitters:
        return mi.Color3f(0.0)
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
    si.wi = -ray.d
    si.wavelengths = ray.wavelengths
    return environment.eval(si)


def _alone(
    mixed: Mixed,
    ray: Any,
    far: Any,
    first: tuple[Any, Any],
    gathered: Any,
    settings: PathSettings,
    gradient: Adjoint | None,
) -> Any:
    """Radiance in a scene without surfaces: the splats on the ray, and what is behind
    everything.
    """
    behind = _behind_everything(mixed, ray, settings)
    if gradient is None:
        return layer(*first, linear=settings.linear) + first[1] * behind
    if mixed.splats is not None:
        grad_colour, grad_through = layer_backward(
            *first, gradient.radiance, linear=settings.linear
        )
        grad_through += dr.dot(gradient.radiance, behind) - gradient.alpha
        stretch = stretch_of(ray, far)
        on = mi.Bool(True)
        of_seen = (grad_colour, grad_through)
        sums = gradient.sums
        to_mean = settings.to_mean
        segments.blend_backward(
            mixed.splats, stretch, on, first, of_seen, sums, to_mean=to_mean
        )
    return gathered


@dr.syntax  # type: ignore[untyped-decorator]
def _paths(
    mixed: Mixed,
    sampler: Any,
    ray: Any,
    hit: Any,
    first: tuple[Any, Any],
    gathered: Any,
    settings: PathSettings,
    gradient: Adjoint | None,
) -> Any:
    """Radiance in a scene with surfaces, from the preliminary intersections of camera
    rays.
    """
    scene = mixed.scene
    surfaces = cast(Any, mixed.surfaces)
    replay = gradient is not None
    context = mi.BSDFContext()
    ray = mi.Ray3f(ray)
    hit = mi.PreliminaryIntersection3f(hit)
    gathered = mi.Spectrum(gathered)
    colour = mi.Color3f(first[0])
    through = mi.Float(first[1])
    depth = mi.UInt32(0)
    throughput = mi.Spectrum(1.0)
    eta = mi.Float(1.0)
    before = dr.zeros(mi.SurfaceInteraction3f)
    before_pdf = mi.Float(1.0)
    before_delta = mi.Bool(True)
    active = mi.Bool(True)

    while dr.hint(
        active,
        max_iterations=settings.max_depth,
        label="paths",
        exclude=[mixed, scene, surfaces, settings, gradient, context, replay],
    ):
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, active)

        # ------------------- Splats on the way here -------------------
        from_splats = throughput * layer(colour, through, linear=settings.linear)
        if dr.hint(replay, mode="scalar"):
            gathered = gathered - from_splats
        else:
            gathered = gathered + from_splats
        if dr.hint(replay, mode="scalar"):
            replay_stretch(
                mixed,
                ray,
                si,
                (colour, through),
                (throughput, gathered, depth),
                active,
                settings,
                gradient,
            )
        throughput = throughput * through

        # ------------- Emission of what the ray ends at ---------------
        light = mi.DirectionSample3f(scene, si, before)
        weight = _mis_weight(
            before_pdf, scene.pdf_emitter_direction(before, light, ~before_delta)
        )
        seen = active & (
            si.is_valid() | mi.Bool(not settings.hide_emitters) | (depth > 0)
        )
        emitted = throughput * weight * light.emitter.eval(si, seen)
        if dr.hint(scene.environment() is None, mode="scalar"):
            emitted += dr.select(
                active & ~si.is_valid(), throughput * settings.background, 0.0
            )

        # ------------------ Light that arrives here -------------------
        going = active & si.is_valid() & (depth + 1 < settings.max_depth)
        bsdf = si.bsdf(ray)
        lit = going & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        sample, power = scene.sample_emitter_direction(
            si, sampler.next_2d(), False, lit
        )
        lit &= sample.pdf != 0.0
        shadow = si.spawn_ray_to(sample.p)
        lit &= ~surfaces.ray_test(shadow, lit)
        shade = let_through(mixed, shadow, lit)
        wo = si.to_local(sample.d)
        value, pdf = bsdf.eval_pdf(context, si, wo, lit)
        weight = dr.select(sample.delta, 1.0, _mis_weight(sample.pdf, pdf))
        direct = dr.select(lit, throughput * weight * value * power * shade, 0.0)
        if dr.hint(replay, mode="scalar"):
            replay_shadow(
                mixed,
                shadow,
                shade,
                dr.dot(cast(Any, gradient).radiance, direct),
                lit,
                gradient,
            )
        arrived = emitted + direct
        if dr.hint(replay, mode="scalar"):
            gathered = gathered - arrived
        else:
            gathered = gathered + arrived

        # ------------------------ The next ray ------------------------
        scattered, factor = bsdf.sample(
            context, si, sampler.next_1d(), sampler.next_2d(), going
        )
        ray = si.spawn_ray(si.to_world(scattered.wo))
        throughput *= factor
        eta *= scattered.eta
        before = si
        before_pdf = scattered.pdf
        before_delta = mi.has_flag(scattered.sampled_type, mi.BSDFFlags.Delta)
        largest = dr.max(throughput)
        going &= largest != 0.0
        chance = dr.minimum(largest * dr.square(eta), 0.95)
        late = depth >= settings.rr_depth
        throughput[late] *= dr.rcp(chance)
        going &= ~late | (sampler.next_1d() < chance)

        hit = surfaces.ray_intersect_preliminary(ray, active=going)
        far = dr.select(hit.is_valid(), hit.t, math.inf)
        colour, through = seen_on(mixed, ray, far, going, settings)
        depth[si.is_valid()] += 1
        active = going

    return gathered
