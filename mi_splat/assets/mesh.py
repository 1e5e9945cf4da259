"""Textured triangle meshes, assets made of them, and the few primitives from which every asset is built.

World frame: right-handed, z up, metres. Faces run counter-clockwise seen from outside. Texture coordinates have v up,
so a texture's first row lies at v = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_splat.errors import InvalidValueError, message

Floats = NDArray[np.float32]
Indices = NDArray[np.uint32]


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """One textured triangle mesh; its arrays are immutable by convention.

    Attributes:
        vertices: (V, 3) float32, metres.
        faces: (F, 3) uint32, counter-clockwise seen from outside.
        uvs: (V, 2) float32, v up.
        texture: (h, w, 3) float32, sRGB reflectance in [0, 1]; (1, 1, 3) for a plain colour.
        roughness: None for a diffuse surface, otherwise the roughness of a plastic coat (paint, glass, screens).
        smooth: Whether shading normals are interpolated across edges that are not sharp.

    Raises:
        InvalidValueError: shapes do not agree, values are not finite, or an index is out of range.
    """

    vertices: Floats
    faces: Indices
    uvs: Floats
    texture: Floats
    roughness: float | None = None
    smooth: bool = True

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, np.float32)
        faces = np.ascontiguousarray(self.faces, np.uint32)
        uvs = np.ascontiguousarray(self.uvs, np.float32)
        texture = np.ascontiguousarray(self.texture, np.float32)
        shapes = (vertices.shape, faces.shape, uvs.shape, texture.shape)
        right = vertices.ndim == faces.ndim == uvs.ndim == 2 and texture.ndim == 3
        if not (right and vertices.shape[1] == faces.shape[1] == texture.shape[2] == 3 and uvs.shape[1] == 2):
            raise InvalidValueError(message("mesh", "(V, 3), (F, 3), (V, 2), (h, w, 3)", shapes, "check the arrays"))
        if len(vertices) != len(uvs) or (faces.size and int(faces.max()) >= len(vertices)):
            raise InvalidValueError(message("mesh", "indices and uvs for its vertices", shapes, "check the faces"))
        if not all(np.isfinite(a).all() for a in (vertices, uvs, texture)):
            raise InvalidValueError(message("mesh", "finite values", "nan or inf", "check the construction"))
        for name, value in (("vertices", vertices), ("faces", faces), ("uvs", uvs), ("texture", texture)):
            object.__setattr__(self, name, value)


@dataclass(frozen=True, slots=True, eq=False)
class Asset:
    """A named object: meshes in a common frame, on the ground at the origin, facing +x.

    Attributes:
        name: COCO name of the object, or any other word for surroundings.
        meshes: The parts.
        supports: How many of the last parts only hold the object up. COCO's boxes leave them out: a stop sign is its
            plate, not its post.
    """

    name: str
    meshes: tuple[Mesh, ...]
    supports: int = 0

    @property
    def body(self) -> Asset:
        """The asset without what holds it up: what a box is drawn around."""
        return replace(self, meshes=self.meshes[: len(self.meshes) - self.supports], supports=0)

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
        return replace(self, meshes=tuple(transform(mesh, matrix) for mesh in self.meshes))


def skin(colour: ArrayLike) -> Floats:
    """A texture from a colour (3,), from a grey level, or from a texture (h, w, 3) itself; sRGB."""
    value = np.asarray(colour, np.float32)
    if value.ndim == 3:
        return value
    return np.broadcast_to(value, (3,)).reshape(1, 1, 3).astype(np.float32)


def _mesh(
    vertices: ArrayLike, faces: ArrayLike, uvs: ArrayLike, colour: ArrayLike, roughness: float | None, smooth: bool
) -> Mesh:
    """A mesh from arrays of any number type."""
    return Mesh(
        np.asarray(vertices, np.float32),
        np.asarray(faces, np.uint32),
        np.asarray(uvs, np.float32),
        skin(colour),
        roughness,
        smooth,
    )


def translation(x: float, y: float, z: float) -> Floats:
    """(4, 4) matrix that moves by metres."""
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, 3] = x, y, z
    return matrix


def rotation(axis: str, degrees: float) -> Floats:
    """(4, 4) right-handed rotation about "x", "y" or "z"."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    angle = np.radians(degrees)
    matrix = np.eye(4, dtype=np.float32)
    matrix[j, j] = matrix[k, k] = np.cos(angle)
    matrix[k, j], matrix[j, k] = np.sin(angle), -np.sin(angle)
    return matrix


def scaling(x: float, y: float, z: float) -> Floats:
    """(4, 4) matrix that stretches along the axes; a negative factor mirrors."""
    return np.diag([x, y, z, 1.0]).astype(np.float32)


def transform(mesh: Mesh, matrix: ArrayLike) -> Mesh:
    """`mesh` moved by a (4, 4) affine matrix; mirroring turns the faces so that they stay outward."""
    pose = np.asarray(matrix, np.float64)
    vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
    faces = mesh.faces if np.linalg.det(pose[:3, :3]) > 0 else mesh.faces[:, ::-1]
    return replace(mesh, vertices=vertices.astype(np.float32), faces=faces)


def quad(corners: ArrayLike, colour: ArrayLike, *, roughness: float | None = None) -> Mesh:
    """A flat quadrilateral from (4, 3) corners: bottom left, bottom right, top right, top left seen from its front."""
    uvs = [[0, 0], [1, 0], [1, 1], [0, 1]]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return _mesh(np.asarray(corners), faces, np.array(uvs), colour, roughness, False)


def box(
    size: Sequence[float],
    colour: ArrayLike,
    *,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    roughness: float | None = None,
) -> Mesh:
    """A box with edge lengths `size`; each face shows the whole texture, upright on the four sides."""
    sides = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1)):
        normal = np.eye(3)[axis] * sign
        up = np.array([0.0, 0.0, 1.0]) if axis < 2 else np.array([1.0, 0.0, 0.0])
        right = np.cross(up, normal)
        sides.append(np.array([normal - right - up, normal + right - up, normal + right + up, normal - right + up]))
    vertices = np.concatenate(sides) * np.asarray(size) / 2 + np.asarray(centre)
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(6)])
    uvs = np.tile([[0, 0], [1, 0], [1, 1], [0, 1]], (6, 1))
    return _mesh(vertices, faces, uvs, colour, roughness, False)


def sheet(
    points: ArrayLike,
    colour: ArrayLike,
    *,
    repeat: tuple[float, float] = (1.0, 1.0),
    roughness: float | None = None,
    smooth: bool = True,
) -> Mesh:
    """A surface through an (n, m, 3) grid of points; u runs along m (right) and v along n (up)."""
    grid = np.asarray(points, np.float64)
    n, m = grid.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    flat = grid.reshape(-1, 3)
    corner = flat[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    v, u = np.meshgrid(np.linspace(0, repeat[1], n), np.linspace(0, repeat[0], m), indexing="ij")
    uvs = np.stack([u, v], -1).reshape(-1, 2)
    return _mesh(flat, faces[area > 1e-12], uvs, colour, roughness, smooth)


def join(*meshes: Mesh) -> Mesh:
    """One mesh from parts that share texture, roughness and shading (those of the first are taken)."""
    start = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    faces = [mesh.faces + np.uint32(offset) for mesh, offset in zip(meshes, start, strict=False)]
    return replace(
        meshes[0],
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate(faces),
        uvs=np.concatenate([mesh.uvs for mesh in meshes]),
    )


def loft(
    sections: ArrayLike,
    colour: ArrayLike,
    *,
    caps: bool = True,
    roughness: float | None = None,
    smooth: bool = True,
) -> Mesh:
    """A closed body through (S, P, 3) cross sections of P points each.

    Points run counter-clockwise seen against the direction from the first section to the last. u runs once around and
    v from the first section to the last; the caps are fans about the centre of the end sections.
    """
    rings = np.asarray(sections, np.float64)
    rings = np.concatenate([rings, rings[:, :1]], 1)
    body = sheet(rings, colour, roughness=roughness, smooth=smooth)
    if not caps:
        return body
    parts = [body]
    count = rings.shape[1] - 1
    fan = np.array([[0, i + 1, (i + 1) % count + 1] for i in range(count)])
    for ring, faces, v in ((rings[0, :-1], fan[:, ::-1], 0.0), (rings[-1, :-1], fan, 1.0)):
        if np.ptp(ring, axis=0).max() < 1e-6:
            continue
        vertices = np.concatenate([ring.mean(0, keepdims=True), ring])
        uvs = np.stack([np.r_[0.5, np.arange(count) / count], np.full(count + 1, v)], 1)
        parts.append(_mesh(vertices, faces, uvs, colour, roughness, smooth))
    return join(*parts)


def lathe(
    profile: ArrayLike,
    colour: ArrayLike,
    *,
    segments: int = 24,
    roughness: float | None = None,
    smooth: bool = True,
) -> Mesh:
    """A body of revolution about z from a (P, 2) profile of (radius, z), from the bottom up along the outside."""
    radius, z = np.asarray(profile, np.float64).T
    angle = 2 * np.pi * np.arange(segments) / segments
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    rings = np.concatenate(
        [radius[:, None, None] * ring, np.broadcast_to(z[:, None, None], (len(z), segments, 1))], axis=-1
    )
    return loft(rings, colour, roughness=roughness, smooth=smooth)


def sweep(
    path: ArrayLike,
    radii: ArrayLike,
    colour: ArrayLike,
    *,
    segments: int = 12,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    roughness: float | None = None,
    smooth: bool = True,
) -> Mesh:
    """A tube along an (n, 3) polyline with closed ends.

    Args:
        path: (n, 3) points, metres.
        radii: (n,) or (n, 2) radii; the second column is the one along `up` where the two differ.
        colour: Colour or texture; v runs along the path.
        segments: Points around.
        up: Direction that fixes the roll of the cross sections.
        roughness: As in `Mesh`.
        smooth: As in `Mesh`.
    """
    points = np.asarray(path, np.float64)
    size = np.broadcast_to(np.asarray(radii, np.float64).reshape(len(np.atleast_1d(radii)), -1), (len(points), 2))
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    hint = np.asarray(up, np.float64)
    if np.abs(tangent @ hint).max() > 0.99 * np.linalg.norm(hint):
        hint = np.array([1.0, 0.0, 0.0]) if abs(tangent[0, 0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = np.cross(hint, tangent)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tangent, first)
    angle = 2 * np.pi * np.arange(segments) / segments
    rings = (
        points[:, None]
        + (size[:, 0, None] * np.cos(angle))[..., None] * first[:, None]
        + (size[:, 1, None] * np.sin(angle))[..., None] * second[:, None]
    )
    return loft(rings, colour, roughness=roughness, smooth=smooth)


def ellipsoid(
    size: Sequence[float],
    colour: ArrayLike,
    *,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    segments: int = 20,
    roughness: float | None = None,
) -> Mesh:
    """An ellipsoid with the three diameters `size`."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    profile = np.stack([np.maximum(np.cos(angle), 0) / 2, np.sin(angle) / 2], -1)
    profile[[0, -1], 0] = 0
    return transform(
        lathe(profile, colour, segments=segments, roughness=roughness), translation(*centre) @ scaling(*size)
    )


def extrude(
    polygon: ArrayLike,
    depth: float,
    colour: ArrayLike,
    *,
    roughness: float | None = None,
    smooth: bool = False,
) -> Mesh:
    """A prism over a simple (P, 2) polygon (concave allowed) in the x-y plane, from z = 0 to `depth`.

    The texture covers the polygon's bounding box on the two ends; the sides take the colour at the outline.
    """
    outline = np.asarray(polygon, np.float64)
    x, y = outline.T
    if np.dot(x, np.roll(y, -1)) < np.dot(y, np.roll(x, -1)):
        outline = outline[::-1]
    count = len(outline)
    low, span = outline.min(0), np.maximum(np.ptp(outline, axis=0), 1e-9)
    uvs = (outline - low) / span
    levels = [np.concatenate([outline, np.full((count, 1), z)], 1) for z in (0.0, depth)]
    i, j = np.arange(count), (np.arange(count) + 1) % count
    sides = np.concatenate([np.stack([i, j, j + count], 1), np.stack([i, j + count, i + count], 1)])
    ends = triangulate(outline)
    faces = np.concatenate([sides, ends[:, ::-1] + 2 * count, ends + 3 * count])
    return _mesh(np.concatenate(levels * 2), faces, np.tile(uvs, (4, 1)), colour, roughness, smooth)


def triangulate(polygon: ArrayLike) -> NDArray[np.int64]:
    """(P - 2, 3) triangles of a simple counter-clockwise (P, 2) polygon, by cutting off ears.

    Raises:
        InvalidValueError: the outline crosses itself or runs clockwise.
    """
    points = np.asarray(polygon, np.float64)
    left = list(range(len(points)))
    triangles = []

    def cross(o: int, a: int, b: int) -> float:
        u, v = points[a] - points[o], points[b] - points[o]
        return float(u[0] * v[1] - u[1] * v[0])

    while len(left) > 3:
        for position in range(len(left)):
            a, b, c = left[position - 1], left[position], left[(position + 1) % len(left)]
            if cross(a, b, c) <= 0:
                continue
            others = [p for p in left if p not in (a, b, c)]
            if not any(cross(a, b, p) >= 0 and cross(b, c, p) >= 0 and cross(c, a, p) >= 0 for p in others):
                triangles.append((a, b, c))
                del left[position]
                break
        else:
            flat = [k for k in range(len(left)) if abs(cross(left[k - 1], left[k], left[(k + 1) % len(left)])) < 1e-12]
            if not flat:
                raise InvalidValueError(
                    message("polygon", "a simple outline", "one that crosses itself", "check the order of its points")
                )
            del left[flat[0]]
    triangles.append((left[0], left[1], left[2]))
    return np.array(triangles, np.int64)
