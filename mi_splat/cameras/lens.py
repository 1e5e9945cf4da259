"""Lenses: which ray of camera space each point of an image sees.

Camera space has x to the right, y down and z forward. A point of the image plane is
(u, v) = (pixel - principal point) / focal length; the projection says which ray it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

from mi_splat.attributes import LARGEST
from mi_splat.errors import InvalidValueError
from mi_splat.fields import between, check
from mi_splat.registry import Registry

_Focal = Annotated[
    float, between(1 / LARGEST, LARGEST, "pixels", "check the intrinsics")
]
_Coordinate = Annotated[float, between(-LARGEST, LARGEST, do="check the intrinsics")]
_Pixels = Annotated[int, between(1, 1 << 15, "pixels", "check the image size")]

Triple = tuple[Any, Any, Any]
"""x, y and z: numbers, or arrays of NumPy, torch or Dr.Jit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Projection:
    """How a lens maps camera space to its image plane. Another package brings one as an
    entry point of the group `mi_splat.projections`.

    Both functions take and give numbers or arrays of NumPy, torch and Dr.Jit, so that
    they hold arithmetic and nothing else.

    Attributes:
        name: Its name; of an entry point, the name of that.
        ray: From (u, v) of the image plane, where the ray begins in camera space and
            where it points; its z grows by 1.
        place: From x, y, z of camera space, (u, v).
    """

    name: str
    ray: Callable[[Any, Any], tuple[Triple, Triple]]
    place: Callable[[Any, Any, Any], tuple[Any, Any]]


PERSPECTIVE = Projection(
    name="perspective",
    ray=lambda u, v: ((0.0, 0.0, 0.0), (u, v, 1.0)),
    place=lambda x, y, z: (x / z, y / z),
)
"""All rays begin in one point: a pinhole camera."""
ORTHOGRAPHIC = Projection(
    name="orthographic",
    ray=lambda u, v: ((u, v, 0.0), (0.0, 0.0, 1.0)),
    place=lambda x, y, z: (x, y),
)
"""All rays are parallel; the focal length is pixels for each world unit."""
PROJECTIONS: Registry[Projection] = Registry(
    "mi_splat.projections",
    "a Projection",
    lambda value: isinstance(value, Projection),
    what="projection",
)
"""Projections by their names."""
for _projection in (PERSPECTIVE, ORTHOGRAPHIC):
    PROJECTIONS.add(_projection.name, _projection)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """Intrinsics of a camera without distortion, and the size of its images.

    Attributes:
        focal: Focal length in pixels, one number or (fx, fy).
        size: Width and height of the image in pixels.
        principal: Principal point (cx, cy) in pixels; the image centre if None.
        projection: Name of a projection, one of `PROJECTIONS`.

    Raises:
        InvalidValueError: A number is not positive and finite, or larger than
            `mi_splat.attributes.LARGEST`, or no projection has that name.
    """

    focal: _Focal | tuple[_Focal, _Focal]
    size: tuple[_Pixels, _Pixels]
    principal: tuple[_Coordinate, _Coordinate] | None = None
    projection: str = PERSPECTIVE.name

    def __post_init__(self) -> None:
        check(self)
        PROJECTIONS.chosen(self.projection)

    @property
    def model(self) -> Projection:
        """The projection that `projection` names."""
        return PROJECTIONS[self.projection]

    @classmethod
    def with_view(cls, degrees: float, size: tuple[int, int]) -> Lens:
        """A perspective lens whose shorter side spans an angle of view.

        Args:
            degrees: Angle of view of the shorter side.
            size: Width and height of the image in pixels.

        Returns:
            The lens, with its principal point in the middle.
        """
        return cls(focal=focal_of(math.radians(degrees), min(size)), size=size)

    @property
    def scale(self) -> tuple[float, float]:
        """(x, y) pixels for each unit of the image plane, of any projection."""
        if isinstance(self.focal, tuple):
            return self.focal
        return self.focal, self.focal

    @property
    def fx(self) -> float:
        """Horizontal focal length in pixels, of a perspective lens."""
        self.require_perspective()
        return self.scale[0]

    @property
    def fy(self) -> float:
        """Vertical focal length in pixels, of a perspective lens."""
        self.require_perspective()
        return self.scale[1]

    @property
    def cx(self) -> float:
        """Horizontal principal point in pixels."""
        if self.principal is None:
            return self.size[0] / 2
        return self.principal[0]

    @property
    def cy(self) -> float:
        """Vertical principal point in pixels."""
        if self.principal is None:
            return self.size[1] / 2
        return self.principal[1]

    @property
    def is_perspective(self) -> bool:
        """Whether it is that of a pinhole camera."""
        return self.projection == PERSPECTIVE.name

    def require_perspective(self) -> None:
        """Raise unless it is that of a pinhole camera.

        Code that reads `fx` or `fy` computes with a pinhole camera: other projections
        are refused there, so that nothing drops them in silence.

        Raises:
            InvalidValueError: It has another projection.
        """
        if not self.is_perspective:
            do = "use a perspective camera here, or render it with method ray"
            raise InvalidValueError.of(
                "camera", "a perspective projection", self.projection, do
            )


def focal_of(angle: float, pixels: int) -> float:
    """Focal length in pixels with which so many pixels span an angle of view,
    radians.
    """
    return pixels / 2 / math.tan(angle / 2)


def angle_of(focal: float, pixels: int) -> float:
    """Angle of view of so many pixels, radians; the inverse of `focal_of`."""
    return 2 * math.atan(pixels / 2 / focal)
