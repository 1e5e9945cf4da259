"""The integrator `splat_tile`: the picture that 3DGS trainers optimise, from every `gaussians` shape of a scene.

==========  =======  =========  ======================================================================================
parameter   type     default    meaning
==========  =======  =========  ======================================================================================
background  rgb      0, 0, 0    sRGB colour behind the splat
near        float    0.2        Gaussians whose mean has a smaller camera-space depth are culled, world units
alpha       boolean  false      append opacity (1 - transmittance) as a fourth channel
linear      boolean  false      linear instead of sRGB values (mi.Bitmap and mi.util.write_bitmap expect linear ones)
==========  =======  =========  ======================================================================================

One deterministic sample at every pixel centre: sampler, sample count, seed and reconstruction filter have no influence.
Differentiable with respect to `data`, `opacities` and `sh_coeffs` in reverse mode.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_splat.errors import InvalidValueError, message
from mi_splat.plugins import sensor as sensors
from mi_splat.rasterization.colour import develop, develop_backward
from mi_splat.rasterization.layouts import ELLIPSOIDS
from mi_splat.rasterization.pinhole import Pinhole
from mi_splat.rasterization.pipeline import Picture, rasterize, rasterize_backward

_KEYS = ("data", "opacities", "sh_coeffs")
_REMEMBERED = 2  # pictures whose intermediate results are kept for their backward pass


@dataclass(frozen=True, slots=True, eq=False)
class Remembered:
    """A picture with what its gradient needs; holding the shapes' arrays keeps their indices taken."""

    held: list[Any]
    arrays: tuple[Any, ...]
    view: Pinhole
    picture: Picture


class Splats:
    """The `gaussians` shapes of a scene, in file order, as one set of arrays."""

    def __init__(self, scene: Any) -> None:
        shapes = scene.shapes()
        others = [s.id() or s.class_name() for s in shapes if not s.is_ellipsoids()]
        if others:
            raise InvalidValueError(
                message("scene", "gaussians shapes only", f"also {', '.join(others)}", "render it without its meshes")
            )
        self.parts = [self._arrays(shape) for shape in shapes]
        self.degrees = [math.isqrt(len(sh) // (3 * len(opacities))) - 1 for _, opacities, sh in self.parts]
        for shape, (_, opacities, sh), degree in zip(shapes, self.parts, self.degrees, strict=True):
            if len(sh) != 3 * (degree + 1) ** 2 * len(opacities) or not 0 <= degree <= 3:
                raise InvalidValueError(
                    message(f"{shape.id()}.sh_coeffs", "SH of degree 0 to 3", len(sh), "check the splat's coefficients")
                )

    @staticmethod
    def _arrays(shape: Any) -> tuple[Any, ...]:
        params = mi.traverse(shape)
        missing = [key for key in _KEYS if key not in params]
        if missing:
            raise InvalidValueError(
                message(f'shape "{shape.id()}"', "a splat", f"no {', '.join(missing)}", 'use type="gaussians"')
            )
        return tuple(params[key] for key in _KEYS)

    def joined(self) -> tuple[Any, ...]:
        """Detached arrays of all shapes, at the highest SH degree among them."""
        if not self.parts:
            return tuple(mi.Float() for _ in _KEYS)
        top = max(self.degrees)
        parts = [
            (dr.detach(data), dr.detach(opacities), _pad(dr.detach(sh), degree, top))
            for (data, opacities, sh), degree in zip(self.parts, self.degrees, strict=True)
        ]
        joined = parts[0] if len(parts) == 1 else tuple(dr.concat(arrays) for arrays in zip(*parts, strict=True))
        dr.make_opaque(joined)
        return joined

    def backward(self, gradients: tuple[Any, ...]) -> None:
        """Hand each shape its rows of the gradient of `joined()`."""
        top = max(self.degrees, default=0)
        widths = (10, 1, 3 * (top + 1) ** 2)
        row = 0
        for arrays, degree in zip(self.parts, self.degrees, strict=True):
            count = len(arrays[1])
            for array, gradient, width in zip(arrays, gradients, widths, strict=True):
                if not dr.grad_enabled(array):
                    continue
                part = _slice(gradient, row * width, count * width) if len(self.parts) > 1 else gradient
                if len(part) != len(array):
                    part = _pad(part, top, degree)
                dr.backward_from(dr.detach(part) * array)
            row += count


def _slice(array: Any, start: int, count: int) -> Any:
    return dr.gather(mi.Float, array, dr.arange(mi.UInt32, count) + start)


def _pad(sh: Any, degree: int, target: int) -> Any:
    """SH rows of another degree: missing coefficients are 0, surplus ones are cut."""
    if degree == target:
        return sh
    old, new = 3 * (degree + 1) ** 2, 3 * (target + 1) ** 2
    index = dr.arange(mi.UInt32, len(sh) // old * new)
    column = index % new
    return dr.gather(mi.Float, sh, index // new * old + column, column < old)


def _colour(props: Any, name: str) -> tuple[float, float, float]:
    given = props.get(name, [0.0, 0.0, 0.0])
    value = [] if isinstance(given, str) else [float(v) for v in np.ravel(np.array(given, dtype=np.float64))]
    if len(value) == 1:
        value *= 3
    if len(value) != 3 or not all(math.isfinite(v) for v in value):
        raise InvalidValueError(message(name, "three finite numbers", given, "give an <rgb>"))
    return value[0], value[1], value[2]


def integrator_class(variant: str) -> Any:
    """The integrator for one variant; its base class exists only once a variant is set."""
    from mitsuba.python.ad.integrators.common import ADIntegrator

    class SplatTile(ADIntegrator):  # type: ignore[misc]
        """Thin caller of `mi_splat.rasterization`."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.background = _colour(props, "background")
            self.near = float(props.get("near", 0.2))
            self.alpha = bool(props.get("alpha", False))
            self.linear = bool(props.get("linear", False))
            if not (math.isfinite(self.near) and self.near > 0):
                raise InvalidValueError(
                    message("near", "a positive distance", self.near, "pass world units, such as 0.2")
                )
            self.remembered: OrderedDict[Any, Remembered] = OrderedDict()
            self.looked: tuple[Any, Any, Pinhole] | None = None

        def _view(self, sensor: Any) -> Pinhole:
            """The camera of a sensor; the last one is kept, since a gradient is asked for right after its picture."""
            key, held = sensors.identity(sensor)
            if self.looked is None or self.looked[0] != key:
                self.looked = key, held, sensors.pinhole(sensor, near=self.near)
            return self.looked[2]

        def _picture(self, splats: Splats, sensor: Any) -> Remembered:
            """The picture from a sensor; the last few are kept, since a gradient is asked for right after its picture.

            Dr.Jit's arrays never change under a given index while someone holds them, so the indices are a safe key.
            """
            view = self._view(sensor)
            indices = tuple(dr.detach(array).index for arrays in splats.parts for array in arrays)
            key = (indices, view.to_camera.tobytes(), view.focal, view.principal, view.size, view.field)
            if key not in self.remembered:
                held = [dr.detach(array) for arrays in splats.parts for array in arrays]
                arrays = splats.joined()
                self.remembered[key] = Remembered(
                    held, arrays, view, rasterize(ELLIPSOIDS, arrays, view, self.background)
                )
                while len(self.remembered) > _REMEMBERED:
                    self.remembered.popitem(last=False)
            return self.remembered[key]

        def forget(self) -> None:
            """Drop the pictures kept for their gradients."""
            self.remembered.clear()
            self.looked = None

        def render(
            self,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            if not develop:
                raise InvalidValueError(message("develop", "True", develop, "take the picture that render() returns"))
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            with dr.suspend_grad():
                seen = self._picture(Splats(scene), sensor)
                return _develop(seen.picture, seen.view.size, alpha=self.alpha, linear=self.linear)

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            splats = Splats(scene)
            seen = self._picture(splats, sensor)
            grads = develop_backward(seen.picture, grad_in, alpha=self.alpha, linear=self.linear)
            splats.backward(rasterize_backward(ELLIPSOIDS, seen.arrays, seen.picture, *grads))

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            raise InvalidValueError(
                message(
                    "splat_tile",
                    "reverse-mode differentiation",
                    "forward mode",
                    "use dr.backward(), or volprim_rf_basic",
                )
            )

        def to_string(self) -> str:
            return f"SplatTile[background = {self.background}, near = {self.near}, alpha = {self.alpha}]"

    _develop = develop
    return SplatTile
