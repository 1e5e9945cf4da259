"""Mesh files (OBJ, PLY, glTF) as assets, with their textures and colours; reading them needs the extra `meshes`.

Surfaces come out diffuse: of a material, its base colour and its texture are taken, and cut-outs are filled.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mi_splat.assets.mesh import Asset, Floats, Mesh, rotation, scaling, skin
from mi_splat.assets.srgb import to_linear, to_srgb
from mi_splat.errors import InvalidValueError, MiSplatError, message

SUFFIXES = (".obj", ".ply", ".glb", ".gltf")
UP: dict[str, Literal["y", "z"]] = {".obj": "y", ".ply": "z", ".glb": "y", ".gltf": "y"}
"""Which axis points up in a file, unless told otherwise; only glTF's is laid down."""

GREY = 0.7
"""sRGB grey of surfaces without any colour."""

# What trimesh raises for files that are broken in one way or another.
_BROKEN = (OSError, ValueError, TypeError, KeyError, IndexError, AttributeError, NotImplementedError, ArithmeticError)


class MeshFileError(MiSplatError):
    """A mesh file cannot be read; the message names it and says what to do."""


def load_mesh(path: Path, *, up: Literal["y", "z"] | None = None, scale: float = 1.0) -> Asset:
    """All meshes of a file as one asset, with z up.

    Args:
        path: An OBJ, PLY, GLB or glTF file; textures are found from it.
        up: The file's axis that points up; None takes the one in `UP`.
        scale: What one unit of the file is in metres.

    Raises:
        MeshFileError: The file is missing, broken, or has no faces.
        InvalidValueError: trimesh is not installed, or the scale is not positive.
    """
    if path.suffix.lower() not in SUFFIXES:
        do = "export it in one of these formats"
        raise MeshFileError(message(str(path), f"a file that ends in {', '.join(SUFFIXES)}", path.suffix, do))
    if not 0 < scale < float("inf"):
        raise InvalidValueError(message("scale", "a positive number", scale, "1 keeps the size"))
    meshes = tuple(mesh for piece, placed in _pieces(path) for mesh in _meshes(piece, placed, path))
    if not meshes:
        do = "export the surface, not the points alone"
        raise MeshFileError(message(str(path), "a mesh with faces", "no faces", do))
    turned = rotation("x", 90) if (up or UP[path.suffix.lower()]) == "y" else np.eye(4, dtype=np.float32)
    return Asset(path.stem, meshes).transformed(scaling(scale, scale, scale) @ turned)


def _pieces(path: Path) -> list[tuple[Any, NDArray[np.float64]]]:
    """The meshes of a file with faces, and where each is placed in it."""
    try:
        import trimesh
    except ImportError as error:
        do = "pip install 'mi-splat[meshes]'"
        raise InvalidValueError(message("trimesh", "the package, to read mesh files", "not installed", do)) from error
    if not path.is_file():
        raise MeshFileError(message(str(path), "a mesh file", "no such file", "check the path"))
    try:
        scene = trimesh.load_scene(str(path), process=False)
        placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    except _BROKEN as error:
        found = " ".join(str(error).split())[:160] or type(error).__name__
        raise MeshFileError(message(str(path), "a mesh that can be read", found, "export it again")) from error
    found_pieces = [(scene.geometry[name], np.asarray(matrix, np.float64)) for matrix, name in placed]
    return [(piece, matrix) for piece, matrix in found_pieces if len(getattr(piece, "faces", ()))]


def _meshes(piece: Any, placed: NDArray[np.float64], path: Path) -> list[Mesh]:
    """One of trimesh's meshes in the file's frame, with its colours as a texture."""
    vertices = np.asarray(piece.vertices, np.float64) @ placed[:3, :3].T + placed[:3, 3]
    faces = np.asarray(piece.faces, np.int64)
    if np.linalg.det(placed[:3, :3]) < 0:  # a mirror turns every face around
        faces = faces[:, ::-1]
    try:
        uvs = getattr(piece.visual, "uv", None)
        if piece.visual.kind == "texture" and uvs is not None and len(uvs) == len(vertices):
            return [_mesh(vertices, faces, np.asarray(uvs)[:, :2], _texture(piece.visual.material))]
        if piece.visual.kind in ("vertex", "face"):
            colours = _corner_colours(piece, faces)
            linear = path.suffix.lower() in (".glb", ".gltf")  # as that format lays down
            return [_baked(vertices, faces, to_srgb(colours) if linear else colours)]
        colour = _texture(piece.visual.material) if piece.visual.kind == "texture" else skin(GREY)
        plain = colour.mean((0, 1), keepdims=True)  # without coordinates a texture is only its mean colour
        return [_mesh(vertices, faces, np.zeros((len(vertices), 2)), plain)]
    except (InvalidValueError, *_BROKEN) as error:
        found = " ".join(str(error).split())[:200]
        raise MeshFileError(message(str(path), "finite vertices, faces and colours", found, "repair it")) from error


def _mesh(vertices: NDArray[Any], faces: NDArray[Any], uvs: NDArray[Any], texture: Floats) -> Mesh:
    """A mesh from arrays of any number type."""
    return Mesh(vertices.astype(np.float32), faces.astype(np.uint32), uvs.astype(np.float32), texture)


def _texture(material: Any) -> Floats:
    """(h, w, 3) sRGB: a material's picture times its colour, either of which may be missing.

    glTF's colour factors are linear; those of OBJ's material files are taken as sRGB.
    """
    physical = hasattr(material, "baseColorFactor")
    picture = material.baseColorTexture if physical else getattr(material, "image", None)
    factor = material.baseColorFactor if physical else getattr(material, "diffuse", None)
    values = None if factor is None else _unit(np.asarray(factor).ravel()[:3])
    if picture is None:
        if values is None:
            return skin(GREY)
        return skin(to_srgb(values) if physical else values)
    texture = np.asarray(picture.convert("RGB"), np.float32) / np.float32(255)
    # An OBJ's picture stands in for its diffuse colour, which exporters often leave at black or grey.
    return to_srgb(to_linear(texture) * values) if physical and values is not None else texture


def _unit(values: NDArray[Any]) -> Floats:
    """Colours in [0, 1] from bytes or from floats."""
    scale = 255.0 if values.dtype.kind in "ui" else 1.0
    colours: Floats = np.clip(values.astype(np.float32) / scale, 0, 1).astype(np.float32)
    return colours


def _corner_colours(piece: Any, faces: NDArray[np.int64]) -> Floats:
    """(F, 3, 3) sRGB colour of every corner of every face."""
    if piece.visual.kind == "vertex":
        corners: Floats = _unit(np.asarray(piece.visual.vertex_colors)[:, :3])[faces]
        return corners
    colours = _unit(np.asarray(piece.visual.face_colors)[:, :3])
    return np.repeat(colours[:, None], 3, axis=1)


def _baked(vertices: NDArray[np.float64], faces: NDArray[np.int64], colours: Floats) -> Mesh:
    """A mesh whose faces each have a square of 2 x 2 texels of their own, between whose centres colours blend.

    Over the half of the square that the triangle takes, bilinear interpolation gives what linear interpolation would.
    """
    count = len(faces)
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    a, b, c = (to_linear(colours[:, k]) for k in range(3))
    squares = np.zeros((rows * columns, 2, 2, 3), np.float32)
    squares[:count] = np.stack([np.stack([a, b], 1), np.stack([c, np.clip(b + c - a, 0, 1)], 1)], 1)
    texture = squares.reshape(rows, columns, 2, 2, 3).transpose(0, 2, 1, 3, 4).reshape(2 * rows, 2 * columns, 3)
    row, column = np.divmod(np.arange(count), columns)
    centres = np.stack([2 * column + 0.5, 2 * row + 0.5], -1)[:, None] + np.array([[0, 0], [1, 0], [0, 1]])
    uvs = centres.reshape(-1, 2) / (2 * columns, 2 * rows)
    uvs[:, 1] = 1 - uvs[:, 1]  # a texture's first row lies at v = 1
    corners = vertices[faces].reshape(-1, 3)
    return _mesh(corners, np.arange(3 * count).reshape(-1, 3), uvs, to_srgb(texture))
