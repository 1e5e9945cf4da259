"""How a splat or a mesh is turned: which way is up. Light, for the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Up = Literal["x", "-x", "y", "-y", "z", "-z"]

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
    j = (i + 1) % 3
    k = (i + 2) % 3
    angle = np.radians(degrees)
    matrix = np.eye(3)
    matrix[j, j] = matrix[k, k] = np.cos(angle)
    matrix[k, j], matrix[j, k] = np.sin(angle), -np.sin(angle)
    return matrix


def turn_of(up: Up) -> NDArray[np.float64]:
    """(3, 3) rotation that takes what is up to z."""
    return axis_turn(*_UPRIGHT[up])
