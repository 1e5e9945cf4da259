"""The integrator `splat_tile`: the image that 3DGS trainers optimise, from every
`gaussians` shape of a scene.

===========  =======  =======  =========================================================
parameter    type     default  meaning
===========  =======  =======  =========================================================
background   rgb      0, 0, 0  sRGB colour behind the splat
near         float    (below)  Gaussians whose mean has a smaller camera-space depth are
                               culled, world units
alpha        boolean  false    append opacity (1 - transmittance) as a fourth channel
linear       boolean  false    linear instead of sRGB values (mi.Bitmap and
                               mi.util.write_bitmap expect linear ones)
antialiased  boolean  false    opacities take the 2D filter of Mip-Splatting into
                               account, see below
===========  =======  =======  =========================================================

All five can be changed, as attributes of the integrator or through `mi.traverse`, where
they are called `<id of the integrator>.near` and so on ("integrator" without an id);
the next image is rendered with the new value.

Without a value, near is set at the first image to what suits the scene's size and its
sensors: the 0.2 of 3DGS, or less for small scenes (`mi_splat.near_plane`). Set it to
0.2 where the image must equal that of the reference.

3DGS widens every Gaussian on the screen by 0.3 px^2, which makes small ones heavier:
far away, or in a small image, thin parts swell. With `antialiased` an opacity is
multiplied by sqrt(det(S) / det(S + 0.3 I)), S the 2D covariance in px^2, and a Gaussian
weighs as much as without the widening. It is the mode that gsplat calls "antialiased";
a splat looks right in the mode that it was trained in.

One deterministic sample at every pixel centre: sampler, sample count, seed and
reconstruction filter have no influence. Differentiable with respect to `data`,
`opacities` and `sh_coeffs` in reverse mode.
"""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import drjit as dr

from mi_splat.cameras.framing import near_plane
from mi_splat.errors import InvalidValueError
from mi_splat.render.plugins import sensor as sensors
from mi_splat.render.plugins.gaussian_shapes import GaussianShapes
from mi_splat.render.plugins.settings import (
    IntegratorSettings,
    common_methods,
    name_integrator,
    setting_property,
)
from mi_splat.render.settings import RenderSettings
from mi_splat.render.tile.colour import develop, develop_backward
from mi_splat.render.tile.frozen import aligned
from mi_splat.render.tile.layouts import ELLIPSOIDS
from mi_splat.render.tile.picture import Picture
from mi_splat.render.tile.pinhole import Pinhole
from mi_splat.render.tile.pipeline import rasterize, rasterize_backward

_CACHED_PICTURES = 2
_SETTINGS = ("background", "near", "alpha", "linear", "antialiased")


@dataclass(frozen=True, slots=True, eq=False)
class CachedPicture:
    """An image with its camera; holding the shapes' arrays keeps their indices, and so
    the cache's key, taken.
    """

    held: list[Any]
    camera: Pinhole
    picture: Picture


def integrator_class(variant: str) -> Any:
    """The integrator for one variant; its base class exists only once a variant is
    set.
    """
    from mitsuba.python.ad.integrators.common import ADIntegrator

    class SplatTile(ADIntegrator):  # type: ignore[misc]
        """Thin caller of `mi_splat.render.tile`."""

        background = setting_property("background")
        near = setting_property("near")
        alpha = setting_property("alpha")
        linear = setting_property("linear")
        antialiased = setting_property("antialiased")
        traverse, parameters_changed, render_forward = common_methods("splat_tile")

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            name_integrator(self, props)
            self.settings = IntegratorSettings(RenderSettings(), _SETTINGS, props)
            self._pictures: OrderedDict[Any, CachedPicture] = OrderedDict()
            self._camera: tuple[Any, Any, Pinhole] | None = None

        def _follow(self, scene: Any, shapes: GaussianShapes) -> None:
            """Set near to what suits the scene, unless it has a value."""
            if "near" not in self.settings.given and shapes.arrays:
                cameras = [
                    sensors.camera(sensor)
                    for sensor in scene.sensors()
                    if sensors.is_pinhole(sensor)
                ]
                self.settings.set(near=near_plane(shapes.scene(), cameras))

        def _camera_of(self, sensor: Any) -> Pinhole:
            """The camera of a sensor; the last one is cached, since a gradient is asked
            for right after its image.
            """
            identity, held = sensors.identity(sensor)
            key = identity, self.near, self.antialiased
            if self._camera is None or self._camera[0] != key:
                pinhole = sensors.pinhole(
                    sensor, near=self.near, antialiased=self.antialiased
                )
                self._camera = key, held, pinhole
            return self._camera[2]

        def _picture(self, shapes: GaussianShapes, sensor: Any) -> CachedPicture:
            """The image from a sensor; the last few are cached for their
            gradients.
            """
            camera = self._camera_of(sensor)
            held = shapes.detached()
            key = tuple(array.index for array in held), camera.key(), self.background
            if key not in self._pictures:
                picture = rasterize(
                    ELLIPSOIDS,
                    tuple(map(aligned, shapes.joined())),
                    camera,
                    self.background,
                )
                self._pictures[key] = CachedPicture(held, camera, picture)
                while len(self._pictures) > _CACHED_PICTURES:
                    self._pictures.popitem(last=False)
            return self._pictures[key]

        def clear_cache(self) -> None:
            """Drop the images kept for their gradients."""
            self._pictures.clear()
            self._camera = None

        def render(
            self,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            """The image as a TensorXf."""
            if not develop:
                raise InvalidValueError.of(
                    "develop", "True", develop, "take the image that render() returns"
                )
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            with dr.suspend_grad():
                shapes = GaussianShapes(scene)
                self._follow(scene, shapes)
                cached = self._picture(shapes, sensor)
                opacity = cached.picture.opacity if self.alpha else None
                return _develop(
                    cached.picture.colour,
                    opacity,
                    cached.camera.size,
                    linear=self.linear,
                )

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
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            shapes = GaussianShapes(scene)
            self._follow(scene, shapes)
            cached = self._picture(shapes, sensor)
            width, height = cached.camera.size
            expected = (height, width, 4 if self.alpha else 3)
            if grad_in.shape != expected:
                do = "render again after a change of alpha or of the film"
                raise InvalidValueError.of(
                    "gradient of the image", f"shape {expected}", grad_in.shape, do
                )
            picture = cached.picture
            grad_picture = develop_backward(
                picture.colour, grad_in, alpha=self.alpha, linear=self.linear
            )
            shapes.backward(rasterize_backward(picture, *grad_picture))

        def to_string(self) -> str:
            return f"SplatTile[{self.settings}]"

    _develop = develop
    return SplatTile
