"""Textured triangle meshes, objects made of them, and matrices that move both.

World frame: right-handed, z up, metres. Faces run counter-clockwise seen from outside.
Texture coordinates have v up, so a texture's first row lies at v = 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_splat.errors import InvalidValueError
from mi_splat.maths import srgb
from mi_splat.maths.orientation import axis_turn

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Indices = NDArray[np.uint32]

_Asset = TypeVar("_Asset", bound="Asset")
_SHAPES = "(V, 3), (F, 3), (V, 2), (h, w, 3)"


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """One textured triangle mesh; its arrays are immutable by convention."""

    vertices: Floats  # (V, 3) float32, metres
    faces: Indices  # (F, 3) uint32, counter-clockwise seen from outside
    uvs: Floats  # (V, 2) float32, v up
    # (h, w, 3) float32, sRGB reflectance in [0, 1]; (1, 1, 3) for a plain colour
    texture: Floats
    # None for a diffuse surface, otherwise that of a plastic coat
    roughness: float | None = None
    # whether shading normals are interpolated across edges that are not sharp
    smooth: bool = True

    def __post_init__(self) -> None:
        kinds = {"vertices": "f4", "faces": "u4", "uvs": "f4", "texture": "f4"}
        for name, kind in kinds.items():
            array = np.ascontiguousarray(getattr(self, name), kind)
            object.__setattr__(self, name, array)
        count = len(self.vertices)
        found = [getattr(self, name).shape for name in kinds]
        size = self.texture.shape[:2]
        if found != [(count, 3), (len(self.faces), 3), (count, 2), (*size, 3)]:
            do = "check the arrays"
            raise InvalidValueError.of("mesh", _SHAPES, found, do)
        if self.faces.size and int(self.faces.max()) >= count:
            highest = int(self.faces.max())
            do = "check the faces"
            raise InvalidValueError.of("mesh", "faces of its vertices", highest, do)
        floats = (self.vertices, self.uvs, self.texture)
        if not all(np.isfinite(array).all() for array in floats):
            do = "check the construction"
            raise InvalidValueError.of("mesh", "finite values", "nan or inf", do)


@dataclass(frozen=True, slots=True, eq=False)
class Asset:
    """A named object: meshes in one frame, on the ground at the origin, facing +x."""

    name: str
    meshes: tuple[Mesh, ...]

    @property
    def vertices(self) -> Floats:
        """(V, 3) float32 vertices of all parts."""
        return np.concatenate([mesh.vertices for mesh in self.meshes])

    @property
    def bounds(self) -> Floats:
        """(2, 3) float32 lowest and highest corner."""
        points = self.vertices
        return np.stack([points.min(0), points.max(0)])

    def transformed(self: _Asset, matrix: ArrayLike) -> _Asset:
        """This object with every vertex moved by a (4, 4) affine matrix."""
        moved = tuple(transform(mesh, matrix) for mesh in self.meshes)
        return replace(self, meshes=moved)


def skin(colour: ArrayLike) -> Floats:
    """A texture from a colour (3,), from a grey level, or from a texture (h, w, 3)
    itself; sRGB.
    """
    value = np.asarray(colour, np.float32)
    if value.ndim == 3:
        return value
    return np.broadcast_to(value, (3,)).reshape(1, 1, 3).astype(np.float32)


def translation(x: float, y: float, z: float) -> Floats:
    """(4, 4) matrix that moves by metres."""
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, 3] = x, y, z
    return matrix


def rotation(axis: str, degrees: float) -> Floats:
    """(4, 4) right-handed rotation about "x", "y" or "z"."""
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = axis_turn(axis, degrees)
    return matrix


def scaling(x: float, y: float, z: float) -> Floats:
    """(4, 4) matrix that stretches along the axes; a negative factor mirrors."""
    return np.diag([x, y, z, 1.0]).astype(np.float32)


def transform(mesh: Mesh, matrix: ArrayLike) -> Mesh:
    """`mesh` moved by a (4, 4) affine matrix; mirroring turns the faces so that they
    stay outward.
    """
    pose = np.asarray(matrix, np.float64)
    vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
    faces = mesh.faces
    if np.linalg.det(pose[:3, :3]) <= 0:
        faces = faces[:, ::-1]
    return replace(mesh, vertices=vertices.astype(np.float32), faces=faces)


def to_linear(colour: ArrayLike) -> Floats:
    """Linear intensities from sRGB values."""
    return srgb.to_linear(np.asarray(colour, np.float64)).astype(np.float32)


def to_srgb(intensity: ArrayLike) -> Floats:
    """The sRGB values, clipped to [0, 1], from linear intensities."""
    clipped = np.clip(np.asarray(intensity, np.float64), 0, 1)
    return srgb.to_srgb(clipped).astype(np.float32)
