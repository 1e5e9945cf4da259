"""The `gaussians` shapes of a Mitsuba scene as one set of arrays for the rasteriser,
and gradients back to them.
"""

import functools
import math
import warnings
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import torch

from mi_splat.errors import InvalidValueError, message
from mi_splat.io.errors import SplatFileWarning
from mi_splat.render.plugins.sensor import own_values
from mi_splat.scene import GaussianScene, merge

_SHOW_SPLATS = {
    "SplatRay",
    "BasicVolumetricPrimitiveRadianceFieldIntegrator",
    "AOVIntegrator",
    "DepthIntegrator",
}
_KEYS = ("data", "opacities", "sh_coeffs")


class GaussianShapes:
    """The `gaussians` shapes of a scene, in file order: `data`, `opacities` and
    `sh_coeffs` as `mi.traverse` has them.

    `among` says what else the scene may hold: "nothing", or "surfaces" that a path
    tracer knows, which are `others`.
    """

    def __init__(
        self, scene: Any, *, among: Literal["nothing", "surfaces"] = "nothing"
    ) -> None:
        self.others = [shape for shape in scene.shapes() if not shape.is_ellipsoids()]
        shapes = [shape for shape in scene.shapes() if shape.is_ellipsoids()]
        _check_others(self.others, among)
        self.names = [str(shape.id()) for shape in shapes]
        self.arrays = [self._arrays_of(shape) for shape in shapes]
        self.degrees = [
            math.isqrt(len(sh) // (3 * len(opacities))) - 1
            for _, opacities, sh in self.arrays
        ]
        for shape, (_, opacities, sh), degree in zip(
            shapes, self.arrays, self.degrees, strict=True
        ):
            if (
                len(sh) != 3 * (degree + 1) ** 2 * len(opacities)
                or not 0 <= degree <= 3
            ):
                do = "check the splat's coefficients"
                raise InvalidValueError.of(
                    f"{shape.id()}.sh_coeffs", "SH of degree 0 to 3", len(sh), do
                )

    @staticmethod
    def _arrays_of(shape: Any) -> tuple[Any, ...]:
        values = own_values(shape)
        missing = ", ".join(key for key in _KEYS if key not in values)
        if missing:
            raise InvalidValueError.of(
                f'shape "{shape.id()}"',
                "a splat",
                f"no {missing}",
                'use type="gaussians"',
            )
        return tuple(values[key] for key in _KEYS)

    def detached(self) -> list[Any]:
        """All arrays of all shapes, without their gradients."""
        return [dr.detach(array) for arrays in self.arrays for array in arrays]

    def joined(self) -> tuple[Any, ...]:
        """Detached `data`, `opacities` and `sh_coeffs` of all shapes together, at the
        highest SH degree among them.
        """
        if not self.arrays:
            return tuple(mi.Float() for _ in _KEYS)
        top = max(self.degrees)
        parts = [
            (
                dr.detach(data),
                dr.detach(opacities),
                _with_degree(dr.detach(sh), degree, top),
            )
            for (data, opacities, sh), degree in zip(
                self.arrays, self.degrees, strict=True
            )
        ]
        if len(parts) == 1:
            return parts[0]
        return tuple(dr.concat(arrays) for arrays in zip(*parts, strict=True))

    def scenes(self) -> list[GaussianScene]:
        """The Gaussians of each shape as values, copied."""
        return [
            _scene_of(*(torch.from_numpy(a.numpy().copy()) for a in arrays))
            for arrays in self.arrays
        ]

    def scene(self) -> GaussianScene:
        """All Gaussians as one value, copied, shape after shape; at least one shape has
        to be there.
        """
        return merge(*self.scenes())

    def backward(self, gradients: tuple[Any, ...]) -> None:
        """Hand each shape its rows of the gradient of `joined()`."""
        top = max(self.degrees, default=0)
        widths = (10, 1, 3 * (top + 1) ** 2)
        row = 0
        for arrays, degree in zip(self.arrays, self.degrees, strict=True):
            count = len(arrays[1])
            for array, gradient, width in zip(arrays, gradients, widths, strict=True):
                if not dr.grad_enabled(array):
                    continue
                part = gradient
                if len(self.arrays) > 1:
                    part = dr.gather(
                        mi.Float,
                        gradient,
                        dr.arange(mi.UInt32, count * width) + row * width,
                    )
                if len(part) != len(array):
                    part = _with_degree(part, top, degree)
                dr.backward_from(dr.detach(part) * array)
            row += count


def watch_rendering() -> None:
    """Let `mi.render` check what it is given from now on, as its own errors say no more
    than "(see above)".
    """
    original = mi.render
    if hasattr(original, "__wrapped__"):
        return

    @functools.wraps(original)
    def render(
        scene: Any,
        params: Any = None,
        sensor: Any = 0,
        integrator: Any = None,
        *rest: Any,
        **more: Any,
    ) -> Any:
        _check_render(scene, scene.integrator() if integrator is None else integrator)
        return original(scene, params, sensor, integrator, *rest, **more)

    mi.render = render


def _check_render(scene: Any, integrator: Any) -> None:
    """Warn of an integrator that shows splats as grey shells, and raise where
    `splat_tile` cannot show a scene.
    """
    kinds = {kind.__name__ for kind in type(integrator).__mro__} | {
        integrator.class_name()
    }
    splats = [shape for shape in scene.shapes() if shape.is_ellipsoids()]
    if "SplatTile" in kinds:
        _check_others(
            [shape for shape in scene.shapes() if not shape.is_ellipsoids()], "nothing"
        )
    elif splats and not kinds & _SHOW_SPLATS:
        got = f"{integrator.class_name()}, which shows them as grey shells"
        do = "splat_tile, or splat_ray among meshes"
        text = message(
            f"splat {_name(splats[0])}",
            "an integrator that shows splats",
            got,
            f"use {do}",
        )
        warnings.warn(text, SplatFileWarning, stacklevel=3)


def _check_others(shapes: list[Any], among: str) -> None:
    """Refuse what an integrator cannot show beside splats."""
    if shapes and among == "nothing":
        got = f"also {', '.join(_name(shape) for shape in shapes)}"
        do = (
            'use the integrator "splat_ray", which knows meshes, or render it without'
            " them"
        )
        raise InvalidValueError.of("scene", "gaussians shapes only", got, do)
    media = [_name(shape) for shape in shapes if shape.is_medium_transition()]
    if media:
        got = f"a medium inside or outside of {', '.join(media)}"
        raise InvalidValueError.of(
            "scene", "surfaces and gaussians shapes", got, "remove the medium"
        )


def _name(shape: Any) -> str:
    return str(shape.id() or shape.class_name())


def _scene_of(
    data: torch.Tensor, opacities: torch.Tensor, sh: torch.Tensor
) -> GaussianScene:
    """The value that a shape's arrays hold: rows of mean, scale and quaternion x, y, z,
    w.
    """
    rows = data.reshape(len(opacities), 10)
    x, y, z, w = rows[:, 6:].unbind(1)
    return GaussianScene(
        rows[:, :3].contiguous(),
        rows[:, 3:6].contiguous(),
        torch.stack([w, x, y, z], dim=1),
        opacities,
        sh.reshape(len(opacities), -1, 3),
    )


def _with_degree(sh: Any, degree: int, target: int) -> Any:
    """SH rows of another degree: missing coefficients are 0, surplus ones are cut."""
    if degree == target:
        return sh
    old = 3 * (degree + 1) ** 2
    new = 3 * (target + 1) ** 2
    index = dr.arange(mi.UInt32, len(sh) // old * new)
    column = index % new
    return dr.gather(mi.Float, sh, index // new * old + column, column < old)
