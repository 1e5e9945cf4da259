"""A Mitsuba scene as `splat_ray` sees it: its splats ready to be traced, and its surfaces as a scene of their own."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_splat.plugins.gaussian_shapes import GaussianShapes
from mi_splat.rasterization.layouts import ELLIPSOIDS, check_finite
from mi_splat.raytracing.splats import Splats, prepare


@dataclass(frozen=True, slots=True, eq=False)
class Mixed:
    """What paths run through.

    Attributes:
        scene: The Mitsuba scene; its emitters light the surfaces.
        surfaces: A Mitsuba scene of its surfaces alone, so that no ray stops at a Gaussian; None where it has none.
        splats: Its Gaussians; None where it has none.
    """

    scene: Any
    surfaces: Any | None
    splats: Splats | None


class MixedCache:
    """The last scene that was prepared; it is prepared again as soon as an array of one of its shapes is another one.

    Dr.Jit's arrays never change under a given index while someone holds them, so the indices are a safe key.
    """

    def __init__(self) -> None:
        self._splats: tuple[Any, Any, Splats | None] | None = None
        self._surfaces: tuple[Any, Any, Any] | None = None

    def mixed(self, scene: Any, shapes: GaussianShapes) -> Mixed:
        """The scene, prepared."""
        return Mixed(scene, self._surfaces_of(shapes), self._splats_of(shapes))

    def _splats_of(self, shapes: GaussianShapes) -> Splats | None:
        held = shapes.detached()
        key, before = _key(held), self._splats
        if before is not None and before[0] == key:
            return before[2]
        arrays = shapes.joined()
        check_finite(ELLIPSOIDS, arrays)
        if before is not None and before[2] is not None and _without_colours(before[0]) == _without_colours(key):
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

    def clear(self) -> None:
        """Drop what was prepared."""
        self._splats = self._surfaces = None


def _scene_of(shapes: list[Any]) -> Any:
    """A Mitsuba scene of shapes that belong to another one, which keep their names there."""
    names = [shape.id() for shape in shapes]
    scene = mi.load_dict({"type": "scene", **{f"{n}": shape for n, shape in enumerate(shapes)}}, parallel=False)
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
    """The key without the SH of each shape, which has data, opacities and SH: the tree does not depend on them."""
    return tuple(index for number, index in enumerate(key) if number % 3 != 2)


def _key(arrays: list[Any]) -> tuple[int, ...]:
    return tuple(array.index for array in arrays)
