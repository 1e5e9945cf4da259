"""The integrator `splat_tile`: the picture that 3DGS trainers optimise, from every `gaussians` shape of a scene.

==========  =======  =========  ======================================================================================
parameter   type     default    meaning
==========  =======  =========  ======================================================================================
background  rgb      0, 0, 0    sRGB colour behind the splat
near        float    (below)    Gaussians whose mean has a smaller camera-space depth are culled, world units
alpha       boolean  false      append opacity (1 - transmittance) as a fourth channel
linear      boolean  false      linear instead of sRGB values (mi.Bitmap and mi.util.write_bitmap expect linear ones)
==========  =======  =========  ======================================================================================

All four can be changed, as attributes of the integrator or through `mi.traverse`, where they are called
`<id of the integrator>.near` and so on ("integrator" without an id); the next picture is made with the new value.

Without a value, near is set at the first picture to what suits the scene's size and its sensors: the 0.2 of 3DGS, or
less for small scenes (`mi_splat.near_plane`). Set it to 0.2 where the picture must equal that of the reference.

One deterministic sample at every pixel centre: sampler, sample count, seed and reconstruction filter have no influence.
Differentiable with respect to `data`, `opacities` and `sh_coeffs` in reverse mode.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.bounds import near_plane
from mi_splat.errors import InvalidValueError, message
from mi_splat.plugins import sensor as sensors
from mi_splat.plugins.gaussian_shapes import GaussianShapes
from mi_splat.plugins.settings import SETTINGS
from mi_splat.rasterization.colour import develop, develop_backward
from mi_splat.rasterization.layouts import ELLIPSOIDS
from mi_splat.rasterization.picture import Picture
from mi_splat.rasterization.pinhole import Pinhole
from mi_splat.rasterization.pipeline import rasterize, rasterize_backward

_DEFAULT_ID = "integrator"  # as in the usual dict; Mitsuba would name an integrator without an id by its address
_CACHED_PICTURES = 2


@dataclass(frozen=True, slots=True, eq=False)
class CachedPicture:
    """A picture with its camera; holding the shapes' arrays keeps their indices, and so the cache's key, taken."""

    held: list[Any]
    camera: Pinhole
    picture: Picture


def _property_of(name: str) -> property:
    """Attribute of the integrator that reads and sets a setting."""
    return property(lambda self: self._values[name], lambda self, value: self._set(name, value))


def integrator_class(variant: str) -> Any:
    """The integrator for one variant; its base class exists only once a variant is set."""
    from mitsuba.python.ad.integrators.common import ADIntegrator

    class SplatTile(ADIntegrator):  # type: ignore[misc]
        """Thin caller of `mi_splat.rasterization`."""

        background = _property_of("background")
        near = _property_of("near")
        alpha = _property_of("alpha")
        linear = _property_of("linear")

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            if not props.id() or props.id().startswith("_unnamed_"):
                self.set_id(_DEFAULT_ID)
            self._values: dict[str, Any] = {}
            # What `mi.traverse` shows. The plain values count: reading these waits for every kernel in flight.
            self._shown = {name: setting.array(setting.default) for name, setting in SETTINGS.items()}
            self.near_is_set = False
            for name, setting in SETTINGS.items():
                if name in props:
                    self._set(name, props[name])
                else:
                    self._values[name] = setting.default
            self._pictures: OrderedDict[Any, CachedPicture] = OrderedDict()
            self._camera: tuple[Any, Any, Pinhole] | None = None

        def _set(self, name: str, value: Any) -> None:
            self._values[name] = SETTINGS[name].checked(value)
            self.near_is_set |= name == "near"
            self._show(name)

        def _show(self, name: str) -> None:
            # In place, as SceneParameters does it: one made before shall show the new value.
            mi.set_property(self._shown[name], SETTINGS[name].array(self._values[name]))

        def traverse(self, callback: Any) -> None:
            for name, array in self._shown.items():
                callback.put(name, array, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: list[str]) -> None:
            """Take over what `mi.traverse` was given; a value that cannot be is refused, and the old one stays."""
            changed = [name for name in SETTINGS if name in keys]
            try:
                values = {name: SETTINGS[name].checked(self._shown[name]) for name in changed}
            except InvalidValueError:
                for name in changed:
                    self._show(name)
                raise
            for name, value in values.items():
                self._set(name, value)

        def _follow(self, scene: Any, shapes: GaussianShapes) -> None:
            """Set near to what suits the scene, unless it has a value."""
            if not self.near_is_set and shapes.arrays:
                cameras = [sensors.camera(sensor) for sensor in scene.sensors() if sensors.is_pinhole(sensor)]
                self._set("near", near_plane(shapes.scene(), cameras))

        def _camera_of(self, sensor: Any) -> Pinhole:
            """The camera of a sensor; the last one is cached, since a gradient is asked for right after its picture."""
            identity, held = sensors.identity(sensor)
            key = identity, self.near
            if self._camera is None or self._camera[0] != key:
                self._camera = key, held, sensors.pinhole(sensor, near=self.near)
            return self._camera[2]

        def _picture(self, shapes: GaussianShapes, sensor: Any) -> CachedPicture:
            """The picture from a sensor; the last few are cached for their gradients.

            Dr.Jit's arrays never change under a given index while someone holds them, so the indices are a safe key.
            """
            camera, held = self._camera_of(sensor), shapes.detached()
            key = tuple(array.index for array in held), camera.key(), self.background
            if key not in self._pictures:
                picture = rasterize(ELLIPSOIDS, shapes.joined(), camera, self.background)
                self._pictures[key] = CachedPicture(held, camera, picture)
                while len(self._pictures) > _CACHED_PICTURES:
                    self._pictures.popitem(last=False)
            return self._pictures[key]

        def clear_cache(self) -> None:
            """Drop the pictures kept for their gradients."""
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
            """The picture as a TensorXf.

            Args:
                scene: A Mitsuba scene whose shapes are `gaussians`.
                sensor: A perspective sensor, or its number in the scene.
                seed: Without influence.
                spp: Without influence.
                develop: Must be True: there is no film to take a picture from afterwards.
                evaluate: Without influence.

            Raises:
                InvalidValueError: The scene holds other shapes, the sensor is another one, or `develop` is False.
            """
            if not develop:
                raise InvalidValueError(message("develop", "True", develop, "take the picture that render() returns"))
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            with dr.suspend_grad():
                shapes = GaussianShapes(scene)
                self._follow(scene, shapes)
                cached = self._picture(shapes, sensor)
                return _develop(cached.picture, cached.camera.size, alpha=self.alpha, linear=self.linear)

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            """Carry the gradient of a picture to the shapes' arrays, for the settings that are in force now.

            Args:
                scene: A Mitsuba scene whose shapes are `gaussians`.
                params: Not needed: the shapes hold their arrays.
                grad_in: TensorXf like the picture, dL/d(picture).
                sensor: A perspective sensor, or its number in the scene.
                seed: Without influence.
                spp: Without influence.

            Raises:
                InvalidValueError: `grad_in` is not of the shape of the picture.
            """
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            shapes = GaussianShapes(scene)
            self._follow(scene, shapes)
            cached = self._picture(shapes, sensor)
            width, height = cached.camera.size
            expected = (height, width, 4 if self.alpha else 3)
            if grad_in.shape != expected:
                do = "render again after a change of alpha or of the film"
                raise InvalidValueError(message("gradient of the picture", f"shape {expected}", grad_in.shape, do))
            grad_picture = develop_backward(cached.picture, grad_in, alpha=self.alpha, linear=self.linear)
            shapes.backward(rasterize_backward(cached.picture, *grad_picture))

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            """Refused.

            Args:
                scene: Not looked at, like all others.
                params: See `scene`.
                sensor: See `scene`.
                seed: See `scene`.
                spp: See `scene`.

            Raises:
                InvalidValueError: Always: there is no forward mode.
            """
            raise InvalidValueError(
                message(
                    "splat_tile",
                    "reverse-mode differentiation",
                    "forward mode",
                    "use dr.backward(), or volprim_rf_basic",
                )
            )

        def to_string(self) -> str:
            values = ", ".join(f"{name} = {value}" for name, value in self._values.items())
            return f"SplatTile[{values}]"

    _develop = develop
    return SplatTile
