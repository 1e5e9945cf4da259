"""Textured triangle meshes, assets made of them, and matrices that move both.

World frame: right-handed, z up, metres. Faces run counter-clockwise seen from outside.
Texture coordinates have v up, so a texture's first row lies at v = 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_splat.errors import InvalidValueError
from mi_splat.maths import srgb
from mi_splat.maths.orientation import axis_turn

Floats = NDArray[np.float32]
Indices = NDArray[np.uint32]


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
        shapes = []
        for name in ("vertices", "faces", "uvs", "texture"):
            array = np.ascontiguousarray(
                getattr(self, name), np.uint32 if name == "faces" else np.float32
            )
            object.__setattr__(self, name, array)
            shapes.append(array.shape)
        count = len(self.vertices)
        faces = len(self.faces)
        texture = self.texture.shape[:2]
        if shapes != [(count, 3), (faces, 3), (count, 2), (*texture, 3)]:
            raise InvalidValueError.of(
                "mesh", "(V, 3), (F, 3), (V, 2), (h, w, 3)", shapes, "check the arrays"
            )
        if self.faces.size and int(self.faces.max()) >= count:
            raise InvalidValueError.of(
                "mesh",
                "faces of its vertices",
                int(self.faces.max()),
                "check the faces",
            )
        if not all(
            np.isfinite(array).all()
            for array in (self.vertices, self.uvs, self.texture)
        ):
            raise InvalidValueError.of(
                "mesh", "finite values", "nan or inf", "check the construction"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Asset:
    """A named object: meshes in a common frame, on the ground at the origin, facing +x.

    COCO's boxes leave out what only holds an object up: a stop sign is its plate, not
    its post.
    """

    name: str  # COCO name of the object, or any other word for surroundings
    meshes: tuple[Mesh, ...]
    supports: int = 0  # how many of the last meshes only hold the object up

    @property
    def body(self) -> Asset:
        """The asset without what holds it up: what a box is drawn around."""
        return replace(
            self, meshes=self.meshes[: len(self.meshes) - self.supports], supports=0
        )

    @property
    def support(self) -> tuple[Mesh, ...]:
        """What holds it up."""
        return self.meshes[len(self.meshes) - self.supports :]

    @property
    def vertices(self) -> Floats:
        """(V, 3) float32 vertices of all parts."""
        return np.concatenate([mesh.vertices for mesh in self.meshes])

    @property
    def bounds(self) -> Floats:
        """(2, 3) float32 lowest and highest corner."""
        points = self.vertices
        return np.stack([points.min(0), points.max(0)])

    def transformed(self, matrix: ArrayLike) -> Asset:
        """This asset with every vertex moved by a (4, 4) affine matrix."""
        return replace(
            self, meshes=tuple(transform(mesh, matrix) for mesh in self.meshes)
        )


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
    faces = mesh.faces if np.linalg.det(pose[:3, :3]) > 0 else mesh.faces[:, ::-1]
    return replace(mesh, vertices=vertices.astype(np.float32), faces=faces)


def join(*meshes: Mesh) -> Mesh:
    """One mesh from parts that share texture, roughness and shading (those of the first
    are taken).
    """
    start = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    faces = [
        mesh.faces + np.uint32(offset)
        for mesh, offset in zip(meshes, start, strict=False)
    ]
    return replace(
        meshes[0],
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate(faces),
        uvs=np.concatenate([mesh.uvs for mesh in meshes]),
    )


def to_linear(colour: ArrayLike) -> Floats:
    """Linear intensities from sRGB values."""
    return srgb.to_linear(np.asarray(colour, np.float64)).astype(np.float32)


def to_srgb(intensity: ArrayLike) -> Floats:
    """The sRGB values, clipped to [0, 1], from linear intensities."""
    return srgb.to_srgb(np.clip(np.asarray(intensity, np.float64), 0, 1)).astype(
        np.float32
    )
