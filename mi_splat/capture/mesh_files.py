"""Mesh files (GLB) as assets, with the textures and colours of their materials; needs
the extra `meshes`.

trimesh reads on in silence where a colour cannot be shown, so the document is checked
here first: what would come out in other colours than in the program that wrote it is
refused.
"""

import io
import json
import logging
import shlex
import struct
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_splat.assets.mesh import Asset, Floats, Mesh, skin, to_linear, to_srgb
from mi_splat.capture.settings import MeshSettings
from mi_splat.errors import InvalidValueError, MiSplatError, install
from mi_splat.io.parsing import DocumentReader
from mi_splat.io.picture_files import (
    BROKEN,
    PictureFileError,
    check_scans,
    pixels_bounded,
)
from mi_splat.maths.orientation import turn_of

SUFFIX = ".glb"
GREY = 0.7
"""sRGB grey of surfaces without a material."""
FARTHEST = 10.0
"""Largest coordinate of a mesh's middle, in radii: rays then start at most a thousandth
of the radius off a surface.
"""
_READ = {"EXT_texture_webp", "KHR_lights_punctual"}
_UNPACKED = {
    "KHR_draco_mesh_compression",
    "EXT_meshopt_compression",
    "KHR_mesh_quantization",
}
"""What glTF Transform's command takes out of a file."""
_OLD = "KHR_materials_pbrSpecularGlossiness"
_FLOAT = 5126
_FAN = 6
_HEADER = struct.Struct("<4sIII4s")
_MOST_ZEROS = 1 << 22
"""Values of an accessor without a view, which stand for zeros, that are made."""


class MeshFileError(MiSplatError):
    """A mesh file cannot be read; the message names it and says what to do."""


_DOCUMENT = DocumentReader(
    expected="a GLB file (glTF 2.0)",
    do="export it again",
    error=MeshFileError,
    most=1 << 28,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Material:
    """What a file says of the base colour of a material."""

    has_texture: bool = False
    # (3,) linear colour that multiplies the texture
    factor: NDArray[np.float64] | None = None


@np.errstate(all="ignore")  # numbers that are not finite are refused where they end up
def load_mesh(path: Path, settings: MeshSettings | None = None) -> Asset:
    """All meshes of a file as one asset, with z up, metres."""
    settings = settings or MeshSettings()
    if path.suffix.lower() != SUFFIX:
        do = "let trimesh convert it: trimesh.load_scene('mesh.obj').export('mesh.glb')"
        raise MeshFileError.of(
            str(path), f"a file that ends in {SUFFIX}", path.suffix, do
        )
    if find_spec("trimesh") is None:
        what = "the package, to read mesh files"
        do = install("meshes")
        raise InvalidValueError.of("trimesh", what, "not installed", do)
    if not path.is_file():
        raise MeshFileError.of(
            str(path), "a mesh file", "no such file", "check the path"
        )
    data, materials = _checked(path)
    turn = settings.scale * turn_of(settings.up or "y")  # to z up, and metres
    try:
        meshes = tuple(
            _mesh(piece, placed, turn, materials) for piece, placed in _pieces(data)
        )
    except (MeshFileError, PictureFileError, InvalidValueError) as error:
        raise MeshFileError.of(
            str(path), "faces and colours that can be shown", error, "repair it"
        ) from error
    except Exception as error:  # what trimesh and Pillow raise has no common base
        got = " ".join(str(error).split())[:160] or type(error).__name__
        raise MeshFileError.of(
            str(path), "a mesh that can be read", got, "export it again"
        ) from error
    if not meshes:
        raise MeshFileError.of(
            str(path),
            "a mesh with faces",
            "no faces",
            "export the surface, not the points alone",
        )
    asset = Asset(path.stem, meshes)
    low, high = asset.bounds.astype(np.float64)
    if np.abs(low + high).max() > FARTHEST * np.linalg.norm(high - low):
        got = f"one at {((low + high) / 2).tolist()}"
        raise MeshFileError.of(
            str(path), "a mesh around its origin", got, "move it there"
        )
    return asset


def _checked(path: Path) -> tuple[bytes, dict[str, Material]]:
    """A file as trimesh shall read it, in which materials are called by their indices,
    and what it says of them.
    """
    data = path.read_bytes()
    magic, version, _, length, kind = _HEADER.unpack_from(
        data.ljust(_HEADER.size, b"\0")
    )
    if (
        magic != b"glTF"
        or version != 2
        or kind != b"JSON"
        or _HEADER.size + length > len(data)
    ):
        raise _DOCUMENT.broken(str(path), "no header of a whole GLB file of version 2")
    document = _DOCUMENT.json_object(
        data[_HEADER.size : _HEADER.size + length], str(path)
    )
    try:
        _check_document(document, path)
        materials = {
            str(number): _material(entry)
            for number, entry in enumerate(document["materials"])
        }
    except (
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
    ) as error:
        got = f"{type(error).__name__}: {error}"[:160]
        raise _DOCUMENT.broken(
            str(path), got, "a glTF file whose parts fit together"
        ) from error
    text = json.dumps(document).encode()
    rest = data[_HEADER.size + length :]
    text += b" " * (-len(text) % 4)
    return (
        _HEADER.pack(magic, 2, _HEADER.size + len(text) + len(rest), len(text), kind)
        + text
        + rest,
        materials,
    )


def _check_document(document: dict[str, Any], path: Path) -> None:
    """Raise where a file cannot be shown as it is; of one whose parts are of other
    kinds than glTF's, any error.
    """
    read = _READ | ({"KHR_draco_mesh_compression"} if find_spec("DracoPy") else set())
    needed = [
        name for name in document.get("extensionsRequired", []) if name not in read
    ]
    unread = [name for name in needed if not name.startswith("KHR_materials_")]
    if unread:
        do = "export it without"
        if set(unread) <= _UNPACKED:
            names = map(str, (path, path.with_stem(f"{path.stem}-unpacked")))
            do = f"unpack it: npx @gltf-transform/cli dequantize {shlex.join(names)}"
        raise MeshFileError.of(
            str(path),
            "a glTF file without extensions that change the mesh",
            unread[0],
            do,
        )
    for entry in (*document.get("images", []), *document.get("buffers", [])):
        if not entry.get("uri", "data:").startswith("data:"):
            do = "pack it: npx @gltf-transform/cli copy IN.gltf OUT.glb"
            raise MeshFileError.of(
                str(path),
                "a file that holds its textures itself",
                f"{entry['uri']!r:.60}",
                do,
            )
    accessors = document.get("accessors", [])
    materials = document.setdefault("materials", [])
    for number, accessor in enumerate(accessors):
        if "bufferView" not in accessor and not accessor["count"] <= _MOST_ZEROS:
            got = f"accessor {number} of {accessor['count']} zeros, which no view holds"
            raise MeshFileError.of(
                str(path), "values that the file holds", got, "export it again"
            )
    for number, material in enumerate(materials):
        material["name"] = str(number)
        if _OLD in material.get("extensions", {}):
            do = "convert it: npx @gltf-transform/cli metalrough IN.glb OUT.glb"
            raise MeshFileError.of(str(path), "metallic-roughness materials", _OLD, do)
    for primitive in (
        primitive
        for mesh in document.get("meshes", [])
        for primitive in mesh["primitives"]
    ):
        attributes = primitive["attributes"]
        if primitive.get("mode") == _FAN:
            raise MeshFileError.of(
                str(path), "triangles, or strips of them", "a fan", "export triangles"
            )
        if "COLOR_0" in attributes:
            do = "bake them into a texture"
            raise MeshFileError.of(
                str(path),
                "colours in textures and materials",
                "colours of vertices",
                do,
            )
        texture = _base_texture(
            materials[primitive["material"]] if "material" in primitive else {}
        )
        if texture is not None:
            moved = texture.get(
                "texCoord", 0
            ) or "KHR_texture_transform" in texture.get("extensions", {})
            if moved or accessors[attributes["TEXCOORD_0"]]["componentType"] != _FLOAT:
                got = "others, transformed ones or integers"
                do = "bake its textures with one set of coordinates"
                raise MeshFileError.of(
                    str(path),
                    "the first texture coordinates (TEXCOORD_0), of floats",
                    got,
                    do,
                )


def _base_texture(material: dict[str, Any]) -> dict[str, Any] | None:
    """The reference to the texture of a material's base colour."""
    texture: dict[str, Any] | None = material.get("pbrMetallicRoughness", {}).get(
        "baseColorTexture"
    )
    return texture


def _material(material: dict[str, Any]) -> Material:
    factor = material.get("pbrMetallicRoughness", {}).get("baseColorFactor")
    if factor is None:
        factor = None
    else:
        factor = np.clip(np.asarray(factor[:3], np.float64), 0, 1)
    return Material(has_texture=_base_texture(material) is not None, factor=factor)


def _pieces(data: bytes) -> list[tuple[Any, NDArray[np.float64]]]:
    """Trimesh's meshes with faces, and the (3, 4) matrix that places each."""
    import trimesh

    # what it would print, is said here
    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    with pixels_bounded():
        scene = trimesh.load_scene(
            io.BytesIO(data), file_type=SUFFIX[1:], process=False
        )
    placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    pieces = [
        (scene.geometry[name], np.asarray(matrix, np.float64)[:3])
        for matrix, name in placed
    ]
    return [
        (piece, matrix) for piece, matrix in pieces if len(getattr(piece, "faces", ()))
    ]


def _mesh(
    piece: Any,
    placed: NDArray[np.float64],
    turn: NDArray[np.float64],
    materials: dict[str, Material],
) -> Mesh:
    """One of trimesh's meshes, placed in its file and turned, with its colour as a
    texture.
    """
    vertices = (
        np.asarray(piece.vertices, np.float64) @ placed[:, :3].T + placed[:, 3]
    ) @ turn.T
    faces = np.asarray(piece.faces, np.int64)
    highest = int(faces.max())
    if highest >= len(vertices):
        raise MeshFileError(f"a face with vertex {highest} of {len(vertices)}")
    if np.linalg.det(placed[:, :3]) < 0:  # a mirror turns every face around
        faces = faces[:, ::-1]
    material = piece.visual.material if piece.visual.kind == "texture" else None
    stated = materials.get(str(getattr(material, "name", "")), Material())
    if not stated.has_texture:
        texture = skin(GREY) if stated.factor is None else skin(to_srgb(stated.factor))
        uvs = np.zeros((len(vertices), 2))
    else:
        texture = _texture(material)
        uvs = np.asarray(piece.visual.uv, np.float64)[:, :2]
        if stated.factor is not None:
            texture = to_srgb(to_linear(texture) * np.float32(stated.factor))
    return Mesh(
        vertices.astype(np.float32),
        faces.astype(np.uint32),
        uvs.astype(np.float32),
        texture,
    )


def _texture(material: Any) -> Floats:
    """(h, w, 3) sRGB picture of a material."""
    picture = getattr(material, "baseColorTexture", None)
    if picture is None:
        raise MeshFileError(
            "a texture that cannot be read as a picture, or has too many pixels"
        )
    try:
        check_scans(picture, "a texture")
        if picture.mode.startswith("I"):  # 16 bits, which Pillow would clip to 8
            grey = np.asarray(picture, np.float32)[..., None] / np.float32(65535)
            return np.repeat(np.clip(grey, 0, 1), 3, axis=2)
        return np.asarray(picture.convert("RGB"), np.float32) / np.float32(255)
    except BROKEN as error:
        raise MeshFileError(f"a broken texture: {str(error)[:80]}") from error
