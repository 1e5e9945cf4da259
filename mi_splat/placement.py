"""Where a splat or a mesh is put in the world: which way is up, turned, resized, moved. Light, for the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from mi_splat.errors import InvalidValueError
from mi_splat.fields import Box, Metavar, Range, above, between, check

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mi_splat.scene import GaussianScene

Up = Literal["x", "-x", "y", "-y", "z", "-z"]
Turn = Annotated[tuple[float, float, float], between(-360, 360, "degrees"), Metavar("X Y Z")]

_UPRIGHT: dict[Up, tuple[str, float]] = {
    "x": ("y", -90.0),
    "-x": ("y", 90.0),
    "y": ("x", 90.0),
    "-y": ("x", -90.0),
    "z": ("x", 0.0),
    "-z": ("x", 180.0),
}
"""Axis and degrees of the turn that takes what is up to z."""


def axis_turn(axis: str, degrees: float) -> NDArray[np.float64]:
    """(3, 3) right-handed rotation about "x", "y" or "z"."""
    import numpy as np

    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    angle = np.radians(degrees)
    matrix = np.eye(3)
    matrix[j, j] = matrix[k, k] = np.cos(angle)
    matrix[k, j], matrix[j, k] = np.sin(angle), -np.sin(angle)
    return matrix


def turn_of(up: Up, rotate: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> NDArray[np.float64]:
    """(3, 3) rotation that takes what is up to z, and then turns by degrees about x, y and z, which stay in place."""
    matrix = axis_turn(*_UPRIGHT[up])
    for axis, degrees in zip("xyz", rotate, strict=True):
        matrix = axis_turn(axis, degrees) @ matrix
    return matrix


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """How a splat is put: first up, then rotate, then scale, then move, then crop.

    Attributes:
        up: Axis of the file that points up; it is turned to z. None turns nothing.
        rotate: Degrees about x, then about y, then about z; the axes stay where they are.
        scale: What one unit of the file becomes, more than 0.
        move: Added to every position, world units.
        crop: Only Gaussians whose means lie in this box stay: x0 y0 z0 x1 y1 z1, world units, after all else.

    Raises:
        InvalidValueError: A number is out of range, or the box has a first number above its second.
    """

    up: Up | None = None
    rotate: Turn = (0.0, 0.0, 0.0)
    scale: Annotated[float, above(0, do="0.01 makes metres of centimetres"), Metavar("FACTOR")] = 1.0
    move: Annotated[tuple[float, float, float], Range(unit="world units"), Metavar("X Y Z")] = (0.0, 0.0, 0.0)
    crop: Box | None = None

    def __post_init__(self) -> None:
        check(self)
        if self.crop is not None and any(a > b for a, b in zip(self.crop[:3], self.crop[3:], strict=True)):
            do = "give the lower corner first: x0 y0 z0 x1 y1 z1"
            raise InvalidValueError.of("crop", "no first number above its second", self.crop, do)

    def apply(self, scene: GaussianScene) -> GaussianScene:
        """The splat as it is put; its very tensors where nothing is changed."""
        import torch

        from mi_splat.scene import Similarity

        unmoved = Placement(crop=self.crop)
        if self != unmoved:
            turn = torch.from_numpy(turn_of(self.up or "z", self.rotate))
            shift = torch.tensor(self.move, dtype=torch.float64)
            scene = scene.transform(Similarity(rotation=turn, translation=shift, scale=self.scale))
        if self.crop is None:
            return scene
        low, high = (scene.means.new_tensor(corner) for corner in (self.crop[:3], self.crop[3:]))
        inside = ((scene.means >= low) & (scene.means <= high)).all(1)
        if not bool(inside.any()):
            least, most = (scene.means.amin(0).tolist(), scene.means.amax(0).tolist())
            got = f"none; they lie in {' '.join(f'{value:.4g}' for value in (*least, *most))}"
            raise InvalidValueError.of("crop", "a box with Gaussians in it", got, "give another box")
        return scene.select(inside)
