"""The integrator `splat_ray`: `gaussians` shapes among meshes and lights, ray traced.

==============  =======  =======  ======================================================
parameter       type     default  meaning
==============  =======  =======  ======================================================
background      rgb      0, 0, 0  sRGB colour behind everything, in a scene without an
                                  environment emitter
alpha           boolean  false    append the opacity of the camera's ray as a channel: 1
                                  - transmittance, 1 where it meets a surface
linear          boolean  true     light adds up in linear values; false, for scenes of
                                  splats alone: in sRGB values, as in 3DGS, and the
                                  image is in sRGB
colour_to_mean  boolean  false    look a Gaussian's colour up in the direction from the
                                  ray's origin to its mean, as 3DGS does, instead of
                                  along the ray
max_depth       integer  6        longest path in vertices; -1 is no limit
rr_depth        integer  5        vertices after which a path may end at random
hide_emitters   boolean  false    the camera does not see the environment emitter
==============  =======  =======  ======================================================

The first four can be changed, as attributes of the integrator or through `mi.traverse`,
where they are called `<id of the integrator>.linear` and so on ("integrator" without an
id).

The model. A Gaussian meets a ray in one point, its *peak*, where it is densest along
the ray. It covers alpha = min(0.99, o exp(-p^T Q p / 2)) there, p from its mean to the
peak and Q the inverse of its covariance, and nothing where alpha < 1/255. Peaks are
blended nearest first, on each ray by itself. A Gaussian whose peak lies behind a
surface is hidden by it. Splats emit and attenuate: they cast shadows, and a mirror or a
pane shows them, but no light falls on them. Light of a surface is attenuated on its way
to the camera, to the next surface and from the emitter.

Any sensor, sampler and reconstruction filter, and any surface: meshes, spheres,
rectangles with any BSDF. Participating media are refused. Differentiable with respect
to `data`, `opacities` and `sh_coeffs` in reverse mode, through reflections, panes and
shadows; not with respect to surfaces and lights. Derivatives do not include edges:
where a Gaussian's peak passes behind a surface or before another peak, the image
jumps.
"""

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.errors import InvalidValueError
from mi_splat.render.plugins.gaussian_shapes import GaussianShapes
from mi_splat.render.plugins.paths import (
    Adjoint,
    Mixed,
    MixedCache,
    PathSettings,
    radiance,
)
from mi_splat.render.plugins.settings import (
    IntegratorSettings,
    common_methods,
    name_integrator,
    setting_property,
)
from mi_splat.render.ray.splats import gradients, zero_sums
from mi_splat.render.settings import RenderSettings
from mi_splat.render.tile.binning import TILE, by_block
from mi_splat.render.tile.colour import linear_value

_SETTINGS = ("background", "alpha", "linear", "colour_to_mean")


def integrator_class(variant: str) -> Any:
    """The integrator for one variant; its base class exists only once a variant is
    set.
    """
    from mitsuba.python.ad.integrators.common import RBIntegrator

    class SplatRay(RBIntegrator):  # type: ignore[misc]
        """Thin caller of `mi_splat.render.ray`."""

        background = setting_property("background")
        alpha = setting_property("alpha")
        linear = setting_property("linear")
        colour_to_mean = setting_property("colour_to_mean")
        traverse, parameters_changed, render_forward = common_methods("splat_ray")

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            name_integrator(self, props)
            self.settings = IntegratorSettings(
                RenderSettings(method="ray", linear=True), _SETTINGS, props
            )
            self._hide = bool(props.get("hide_emitters", False))
            self._cache = MixedCache()
            self._sums: Any = None

        def aov_names(self) -> list[str]:
            if self.alpha:
                return ["alpha"]
            return []

        def _mixed(self, scene: Any) -> Mixed:
            shapes = GaussianShapes(scene, among="surfaces")
            if not self.linear and shapes.others:
                got = f"linear = false with {len(shapes.others)} surfaces"
                do = "light adds up in linear values only: leave linear true"
                raise InvalidValueError.of(
                    "splat_ray", "only splats for an image in sRGB values", got, do
                )
            if scene.environment() is not None and "background" in self.settings.given:
                do = "remove one of them"
                raise InvalidValueError.of(
                    "splat_ray", "a background or an environment emitter", "both", do
                )
            return self._cache.mixed(scene, shapes)

        def _path_settings(self) -> PathSettings:
            background = mi.Color3f(self.background)
            return PathSettings(
                background=linear_value(background) if self.linear else background,
                linear=self.linear,
                to_mean=self.colour_to_mean,
                max_depth=self.max_depth,
                rr_depth=self.rr_depth,
                hide_emitters=self._hide,
            )

        def sample(
            self, mode: Any, scene: Any, sampler: Any, ray: Any, **given: Any
        ) -> Any:
            """Radiance along rays, or its gradient; see Mitsuba's
            `ADIntegrator.sample`.
            """
            mixed = self._mixed(scene)
            settings = self._path_settings()
            total = gradient = None
            if mode == dr.ADMode.Backward:
                on_alpha = mi.Float(given["δaovs"][0]) if self.alpha else mi.Float(0.0)
                gradient = Adjoint(mi.Color3f(given["δL"]), on_alpha, self._sums)
                total = given["state_in"]
            light, alpha, state = radiance(
                mixed, sampler, ray, settings, total=total, gradient=gradient
            )
            return light, mi.Bool(True), [alpha] if self.alpha else [], state

        def sample_rays(self, scene: Any, sensor: Any, sampler: Any) -> Any:
            """Camera rays; with alpha, their weight is one number, since Mitsuba's
            gradient multiplies it to alpha.
            """
            ray, weight, position = super().sample_rays(scene, sensor, sampler)
            samples = sampler.sample_count()
            if samples < TILE * TILE:  # else all lanes of a packet are in one pixel
                order = _by_blocks_of_pixels(sensor.film(), samples)
                ray = mi.Ray3f(
                    *(
                        _gathered(field, order)
                        for field in (ray.o, ray.d, ray.maxt, ray.time)
                    ),
                    ray.wavelengths,
                )
                weight = _gathered(weight, order)
                position = _gathered(position, order)
            return ray, mi.Float(dr.mean(weight)) if self.alpha else weight, position

        def render_backward(
            self,
            scene: Any,
            params: Any,
            grad_in: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
        ) -> None:
            """Carry the gradient of an image to the shapes' arrays, for the settings
            that are in force now.
            """
            shapes = GaussianShapes(scene, among="surfaces")
            _check_differentiable(params, shapes)
            with dr.suspend_grad():
                mixed = self._mixed(scene)
            if mixed.splats is None:
                return
            self._sums = zero_sums(mixed.splats)
            try:
                super().render_backward(scene, params, grad_in, sensor, seed, spp)
                with dr.suspend_grad():
                    grads = gradients(mixed.splats, self._sums)
            finally:
                self._sums = None
            shapes.backward(grads)

        def to_string(self) -> str:
            return (
                f"SplatRay[{self.settings}, max_depth = {self.max_depth}, rr_depth ="
                f" {self.rr_depth}]"
            )

    return SplatRay


def _by_blocks_of_pixels(film: Any, samples: int) -> Any:
    """UInt32, the samples of a film block after block of pixels, in place of row after
    row as Mitsuba has them.
    """
    border = 2 * film.rfilter().border_size() if film.sample_border() else 0
    width, height = (int(side) + border for side in film.crop_size())
    lane = dr.arange(mi.UInt32, width * height * samples)
    pixel = dr.gather(
        mi.UInt32, by_block(mi.variant(), width, height, TILE), lane // samples
    )
    return pixel * samples + lane % samples


def _gathered(values: Any, order: Any) -> Any:
    """Values in another order; one value for all lanes stays so."""
    if dr.width(values) == 1:
        return values
    return dr.gather(type(values), values, order)


def _check_differentiable(params: Any, shapes: GaussianShapes) -> None:
    """Refuse gradients that would silently be 0."""
    if not isinstance(params, mi.SceneParameters):
        return
    splats = {dr.detach(array).index for arrays in shapes.arrays for array in arrays}
    for key, value in params:
        array = value.array if dr.is_tensor_v(value) else value
        if not dr.is_diff_v(array) or not dr.grad_enabled(array):
            continue
        if dr.depth_v(array) > 1 or dr.detach(array).index not in splats:
            expected = "gradients of data, opacities and sh_coeffs of splats"
            do = (
                "disable its gradient, or use the integrator prb for scenes without"
                " splats"
            )
            raise InvalidValueError.of("splat_ray", expected, f"one of {key}", do)
