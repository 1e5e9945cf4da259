"""What a mesh file says and trimesh leaves out: names of pictures, and second texture coordinates.

trimesh reads on in silence where a picture is missing, so the names are read here, and `mesh_colours` compares.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mi_splat.assets.mesh import Floats, skin, to_linear, to_srgb
from mi_splat.io.picture_files import BROKEN, PictureFileError, check_scans


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaterialNotes:
    """What a file says of one material."""

    picture: str | None = None  # name of its texture
    factor: NDArray[np.float64] | None = None  # (3,) linear colour that multiplies texture and colours of vertices
    uv_transform: NDArray[np.float64] | None = None  # (3, 3) matrix that acts on texture coordinates first, v down


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshFileNotes:
    """What a file says of its materials."""

    data: bytes  # the file as trimesh shall read it
    materials: dict[str, MaterialNotes] = field(default_factory=dict)  # by trimesh's name
    faults: tuple[str, ...] = ()  # what cannot be shown, in words


def beside(path: Path, name: str) -> Path | None:
    """The file that a mesh file names, under its folder."""
    file = (path.parent / name).resolve()
    return file if file.is_relative_to(path.parent.resolve()) and file.is_file() else None


def resolver(path: Path) -> Any:
    """What trimesh asks for the files that a mesh file names; needs trimesh."""
    from trimesh.resolvers import FilePathResolver

    class Beside(FilePathResolver):  # type: ignore[misc]  # trimesh may not be installed
        """Finds files as `beside` does."""

        def get(self, name: str) -> bytes:
            """The bytes of a file."""
            file = beside(path, name)
            if file is None:
                raise FileNotFoundError(f"{name}: no such file in {path.parent}")
            return file.read_bytes()

    return Beside(str(path))


GREY = 0.7
"""sRGB grey of surfaces without any colour."""

_NEARLY_WHITE = 0.995

Report = Callable[[str], None]
"""Takes what cannot be shown, in words."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """One textured surface in the frame of its file, as `mi_splat.assets.mesh.Mesh` but in float64."""

    vertices: NDArray[np.float64]  # (V, 3) float64, units of the file
    faces: NDArray[np.int64]  # (F, 3) indices
    uvs: NDArray[np.float64]  # (V, 2), v up
    texture: Floats  # (h, w, 3) float32 sRGB


def coloured(piece: Any, placed: NDArray[np.float64], path: Path, notes: MeshFileNotes, *, fault: Report) -> Surface:
    """One of trimesh's meshes in the file's frame, with its colours as a texture."""
    vertices = np.asarray(piece.vertices, np.float64) @ placed[:3, :3].T + placed[:3, 3]
    faces = np.asarray(piece.faces, np.int64)
    if np.linalg.det(placed[:3, :3]) < 0:  # a mirror turns every face around
        faces = faces[:, ::-1]
    material = _material(piece)
    name = str(getattr(material, "name", "") or "")
    stated = notes.materials.get(name, MaterialNotes())
    picture = _picture(material, stated, path, fault)
    colours = _corner_colours(piece, faces)
    if picture is not None:
        if colours is not None:
            what = stated.picture or "a texture"
            fault(f"{what}: colours of vertices beside it, which are not multiplied with it")
        shown = stated.factor is None
        texture = picture if shown else to_srgb(to_linear(picture) * np.float32(cast("Any", stated.factor)))
        uvs = _texture_coordinates(piece, stated.uv_transform)
        if uvs is not None:
            return Surface(vertices=vertices, faces=faces, uvs=uvs, texture=texture)
        fault(f"{stated.picture or 'a texture'}: no texture coordinates")
        texture = texture.mean((0, 1), keepdims=True)
    elif colours is not None:
        factor = stated.factor if stated.factor is not None else 1.0
        return _baked(vertices, faces, to_srgb(colours * np.float32(factor)))
    else:
        texture = _plain(material, stated)
    return Surface(vertices=vertices, faces=faces, uvs=np.zeros((len(vertices), 2)), texture=texture)


def _texture_coordinates(piece: Any, transform: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """(V, 2) texture coordinates, v up; None if there are none."""
    uvs = getattr(piece.visual, "uv", None)
    if uvs is None or len(uvs) != len(piece.vertices):
        return None
    uvs = np.asarray(uvs, np.float64)[:, :2]
    if transform is not None:  # which is meant for v down
        down = np.column_stack([uvs[:, 0], 1 - uvs[:, 1], np.ones(len(uvs))]) @ transform.T
        uvs = np.column_stack([down[:, 0], 1 - down[:, 1]])
    return uvs


def _material(piece: Any) -> Any | None:
    """A mesh's material; None if it has none, or the one that trimesh puts in its place."""
    material = piece.visual.material if piece.visual.kind == "texture" else None
    made_up = getattr(material, "image", None)
    return None if made_up is not None and made_up.format is None else material  # read from no file


def _picture(material: Any | None, stated: MaterialNotes, path: Path, fault: Report) -> Floats | None:
    """(h, w, 3) sRGB picture of a material; None if it has none, or none that can be shown."""
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if picture is None:
        if stated.picture is not None:
            exists = stated.picture.startswith("picture ") or beside(path, stated.picture)
            outside = "lies outside of the mesh's folder, where it is not read"
            lost = outside if (path.parent / stated.picture).is_file() else "no such file"
            unread = "cannot be read as a picture, has too many pixels, or has no coordinates"
            fault(f"{stated.picture} (texture): {unread if exists else lost}")
        return None
    try:
        check_scans(picture, stated.picture or "a texture")
        if picture.mode.startswith("I"):  # 16 bits, which Pillow would clip to 8
            grey = np.asarray(picture, np.float32)[..., None] / np.float32(65535)
            return np.repeat(np.clip(grey, 0, 1), 3, axis=2)
        return np.asarray(picture.convert("RGB"), np.float32) / np.float32(255)
    except (PictureFileError, *BROKEN) as error:
        fault(f"{stated.picture or 'a texture'} (texture): {str(error)[:80]}")
        return None


def _plain(material: Any, stated: MaterialNotes) -> Floats:
    """(1, 1, 3) sRGB colour of a material without a picture, whose factor is linear."""
    if stated.factor is not None:
        return skin(to_srgb(stated.factor))
    factor = getattr(material, "baseColorFactor", None)
    return skin(GREY) if factor is None else skin(to_srgb(_unit(np.asarray(factor).ravel()[:3])))


def _unit(values: NDArray[Any]) -> Floats:
    """Colours in [0, 1] from integers or from floats."""
    scale = float(np.iinfo(values.dtype).max) if values.dtype.kind in "ui" else 1.0
    colours: Floats = np.clip(values.astype(np.float32) / np.float32(scale), 0, 1).astype(np.float32)
    return colours


def _corner_colours(piece: Any, faces: NDArray[np.int64]) -> Floats | None:
    """(F, 3, 3) colour of every corner of every face; None if there are none, or all are white."""
    if piece.visual.kind == "vertex":
        colours = _unit(np.asarray(piece.visual.vertex_colors)[:, :3])[faces]
    else:  # beside a material
        values = piece.vertex_attributes.get("color")
        if values is None:
            values = dict(getattr(piece.visual, "vertex_attributes", {})).get("color")
        if values is None or np.shape(values)[:1] != (len(piece.vertices),) or np.shape(values)[1] < 3:
            return None
        colours = _unit(np.asarray(values)[:, :3])[faces]
    return None if colours.min(initial=1) >= _NEARLY_WHITE and piece.visual.kind == "texture" else colours


def _baked(vertices: NDArray[np.float64], faces: NDArray[np.int64], colours: Floats) -> Surface:
    """A surface whose faces each have a square of 2 x 2 texels of their own, between whose centres colours blend.

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
    return Surface(vertices=corners, faces=np.arange(3 * count).reshape(-1, 3), uvs=uvs, texture=to_srgb(texture))
