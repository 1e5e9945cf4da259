"""Mesh files (glTF) as assets, with their textures and colours; reading them needs the extra `meshes`."""

import io
import json
import logging
import math
import shlex
import struct
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from mi_splat.assets.mesh import Asset, Mesh
from mi_splat.capture.mesh_materials import (
    MaterialNotes,
    MeshFileNotes,
    Surface,
    coloured,
    resolver,
)
from mi_splat.capture.settings import Front, MeshSettings
from mi_splat.errors import InvalidValueError, MiSplatError, install
from mi_splat.io.parsing import DocumentReader
from mi_splat.io.picture_files import pixels_bounded
from mi_splat.placement import Up, axis_turn, turn_of

_READ = {"EXT_texture_webp", "KHR_texture_basisu", "KHR_texture_transform", "KHR_lights_punctual"}
_UNPACKED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization"}
"""What glTF Transform's command takes out of a file."""
_FLOAT, _FAN = 5126, 6
_HEADER = 20
"""Bytes of a GLB before its JSON."""
_MOST_ZEROS = 1 << 22
"""Values of an accessor without a view, which stand for zeros, that are made."""


class GltfError(MiSplatError):
    """A glTF file cannot be read."""


_DOCUMENT = DocumentReader(expected="a glTF 2.0 file", do="export it again", error=GltfError, most=1 << 28)


def gltf_notes(path: Path) -> MeshFileNotes:
    """Materials of a glTF file by their index, and the document as trimesh shall read it.

    There, names of materials are their indices, and the texture coordinates of a base colour are always the first.
    """
    document, rest = _read(path)
    try:
        return _noted(document, rest, path)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        got = f"{type(error).__name__}: {error}"[:160]
        raise _DOCUMENT.broken(str(path), got, "a glTF file whose parts fit together") from error


def _noted(document: dict[str, Any], rest: bytes | None, path: Path) -> MeshFileNotes:
    """What a document says; of one whose parts are of other kinds than glTF's, any error of Python."""
    _check_extensions(document, path)
    for number, accessor in enumerate(document.get("accessors", [])):
        if "bufferView" not in accessor and not accessor["count"] <= _MOST_ZEROS:
            got = f"accessor {number} of {accessor['count']} zeros, which no view holds"
            raise GltfError.of(str(path), "values that the file holds", got, "export it again")
    for entry in (*document.get("images", []), *document.get("buffers", [])):
        if "uri" in entry and not entry["uri"].startswith("data:"):
            entry["uri"] = unquote(entry["uri"])  # as URIs have spaces, but no files
    materials = document.setdefault("materials", [])
    notes = {str(index): _material(document, material) for index, material in enumerate(materials)}
    for index, material in enumerate(materials):
        material["name"] = str(index)
    faults: list[str] = []
    bare = len(materials)  # of primitives without a material
    for mesh in document.get("meshes", []):
        for primitive in mesh["primitives"]:
            if primitive.get("mode") == _FAN:
                raise GltfError.of(str(path), "triangles, or strips of them", "a fan", "export triangles")
            faults += _prepare(document, primitive, bare)
    materials.append({"name": str(bare)})
    unread = ", ".join(dict.fromkeys(faults))
    data = _packed(document, rest)
    return MeshFileNotes(data=data, materials=notes, faults=(unread,) if unread else ())


def _read(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """The JSON document, and of a GLB the chunks after it."""
    data, rest = path.read_bytes(), None
    if path.suffix.lower() == ".glb":
        magic, version, _, length, kind = struct.unpack_from("<4sIII4s", data.ljust(_HEADER, b"\0"))
        if magic != b"glTF" or version != 2 or kind != b"JSON":
            raise _DOCUMENT.broken(str(path), "no header of a GLB file of version 2")
        if _HEADER + length > len(data):
            raise _DOCUMENT.broken(str(path), "a file that is cut off")
        data, rest = data[_HEADER : _HEADER + length], data[_HEADER + length :]
    document = _DOCUMENT.json_object(data, str(path))
    if "asset" not in document:
        raise _DOCUMENT.broken(str(path), "no object with the key asset")
    return document, rest


def _packed(document: dict[str, Any], rest: bytes | None) -> bytes:
    """The bytes of a document, as a GLB if it came from one."""
    text = json.dumps(document).encode()
    if rest is None:
        return text
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, _HEADER + len(text) + len(rest), len(text), b"JSON") + text + rest


def _check_extensions(document: dict[str, Any], path: Path) -> None:
    """Raise where the file cannot be read without something that is not there."""
    read = _READ | ({"KHR_draco_mesh_compression"} if find_spec("DracoPy") else set())
    needed = [name for name in document.get("extensionsRequired", []) if name not in read]
    if unread := [name for name in needed if not name.startswith("KHR_materials_")]:
        do = "export it without"
        if set(unread) <= _UNPACKED:
            names = map(str, (path, path.with_stem(f"{path.stem}-unpacked")))
            do = f"unpack it: npx @gltf-transform/cli dequantize {shlex.join(names)}"
        raise GltfError.of(str(path), "a glTF file without extensions that change the mesh", unread[0], do)


def _base_colour(material: dict[str, Any]) -> dict[str, Any] | None:
    """The reference to the texture of a material's base colour."""
    specular = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    texture: dict[str, Any] | None = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    return texture or specular.get("diffuseTexture")


def _material(document: dict[str, Any], material: dict[str, Any]) -> MaterialNotes:
    """What a material says."""
    factor = material.get("pbrMetallicRoughness", {}).get("baseColorFactor")
    factor = None if factor is None else np.clip(np.asarray(factor[:3], np.float64), 0, 1)
    texture = _base_colour(material)
    if texture is None:
        return MaterialNotes(factor=factor)
    return MaterialNotes(picture=_picture(document, texture), factor=factor, uv_transform=_uv_transform(texture))


def _picture(document: dict[str, Any], reference: dict[str, Any]) -> str:
    """The name of a texture's picture, for messages."""
    texture = document.get("textures", [])[reference["index"]]
    sources = [part.get("source") for part in texture.get("extensions", {}).values() if isinstance(part, dict)]
    index = next((source for source in (texture.get("source"), *sources) if source is not None), None)
    if index is None:
        return f"texture {reference['index']}"
    image = document.get("images", [])[index]
    uri = str(image.get("uri", ""))
    if uri and not uri.startswith("data:"):
        return uri
    labels = [str(image[key]) for key in ("name", "mimeType") if key in image]
    return f"picture {index} in the file" + (f" ({', '.join(labels)})" if labels else "")


def _uv_transform(texture: dict[str, Any]) -> NDArray[np.float64] | None:
    """The matrix of KHR_texture_transform: scaling, then rotation, then translation, v down."""
    values = texture.get("extensions", {}).get("KHR_texture_transform")
    if not values:
        return None
    (x, y), (right, down), angle = values.get("offset", (0, 0)), values.get("scale", (1, 1)), values.get("rotation", 0)
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c * right, s * down, x], [-s * right, c * down, y], [0, 0, 1]], np.float64)


def _prepare(document: dict[str, Any], primitive: dict[str, Any], bare: int) -> list[str]:
    """Make a primitive's first texture coordinates those of its base colour; returns what cannot be read of it."""
    attributes = primitive["attributes"]
    primitive.setdefault("material", bare)
    material = document["materials"][primitive["material"]] if primitive["material"] != bare else {}
    texture = _base_colour(material)
    if texture is None:
        return []
    transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
    name = f"TEXCOORD_{transform.get('texCoord', texture.get('texCoord', 0))}"
    if name not in attributes:
        return [f"{_picture(document, texture)}: no texture coordinates {name}"]
    attributes["TEXCOORD_0"] = attributes[name]
    if document["accessors"][attributes[name]]["componentType"] != _FLOAT:
        return [f"{_picture(document, texture)}: texture coordinates of integers, which are not read"]
    return []


SUFFIXES = (".glb", ".gltf")

FARTHEST = 1000.0
"""Largest coordinate of a mesh's middle, in radii, that is kept. A float32, as splat files and point clouds hold, then
still resolves a sixteen-thousandth of the radius; farther away the mesh is moved to the origin."""

COARSE = 1e-3
"""Steps between coordinates of a file, as a part of its mesh's size, from which it is warned of."""

_TURNS: dict[Front, float] = {"+x": 0.0, "-x": 180.0, "+y": -90.0, "-y": 90.0}
"""Degrees about z that turn a front to +x."""


class MeshFileError(MiSplatError):
    """A mesh file cannot be read; the message names it and says what to do."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoadedMesh:
    """A mesh file as an asset.

    The offset, in metres, is what to add to get the file's coordinates as `MeshSettings` turn and scale them; zero
    unless the mesh lies so far from the file's origin that float32 cannot hold it.
    """

    asset: Asset  # the surfaces, z up, metres
    world_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    warnings: tuple[str, ...] = ()  # what of the file's colours is not shown


@np.errstate(all="ignore")  # numbers that are not finite are refused where they end up
def load_mesh(path: Path, settings: MeshSettings | None = None) -> LoadedMesh:
    """All meshes of a file as one asset, with z up."""
    settings = settings or MeshSettings()
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        do = "let trimesh convert it: trimesh.load_scene('mesh.obj').export('mesh.glb')"
        raise MeshFileError.of(str(path), f"a file that ends in {', '.join(SUFFIXES)}", path.suffix, do)
    surfaces, faults, remarks = _surfaces(path)
    if not surfaces:
        raise MeshFileError.of(str(path), "a mesh with faces", "no faces", "export the surface, not the points alone")
    if faults and settings.missing_textures == "refuse":
        do = "put it where the mesh names it, without options, or let missing textures warn, for plain colours"
        error = MeshFileError.of(str(path), "textures and colours that can be shown", "; ".join(faults), do)
        raise error.hinted("--missing-textures warn")
    turn = turning(settings, up=settings.up or "y")
    placed = [surface.vertices @ turn.T for surface in surfaces]
    try:
        offset = _world_offset(placed)
        meshes = tuple(_mesh(surface, vertices - offset) for surface, vertices in zip(surfaces, placed, strict=True))
    except InvalidValueError as error:
        raise _not_finite(path, error) from error
    x, y, z = offset.tolist()
    warnings = tuple(f"{path}: {text}" for text in (*faults, *remarks))
    return LoadedMesh(asset=Asset(path.stem, meshes), world_offset=(x, y, z), warnings=warnings)


def turning(settings: MeshSettings, *, up: Up) -> NDArray[np.float64]:
    """(3, 3) matrix from the file's axes and unit to z up, the front to +x, and metres."""
    front = axis_turn("z", _TURNS[settings.front or "+x"])
    return settings.scale * (front @ turn_of(up, settings.rotate))


def _surfaces(path: Path) -> tuple[list[Surface], list[str], list[str]]:
    """The surfaces of a file, and what of its colours cannot be shown and what need not be."""
    pieces, notes = _pieces(path)
    faults = list(notes.faults)
    try:
        surfaces = [coloured(piece, placed, path, notes, fault=faults.append) for piece, placed in pieces]
    except Exception as error:
        raise _not_finite(path, error) from error
    remarks = _too_coarse(pieces, surfaces)
    return surfaces, list(dict.fromkeys(faults)), list(dict.fromkeys(remarks))


def _pieces(path: Path) -> tuple[list[tuple[Any, NDArray[np.float64]]], MeshFileNotes]:
    """The meshes of a file with faces and where each is placed in it, and what it says of materials."""
    try:
        import trimesh
    except ImportError as error:
        what, do = "the package, to read mesh files", install("meshes")
        raise InvalidValueError.of("trimesh", what, "not installed", do) from error
    if not path.is_file():
        raise MeshFileError.of(str(path), "a mesh file", "no such file", "check the path")
    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # what it would print, is said here
    suffix = path.suffix.lower()
    try:
        notes = gltf_notes(path)
        with pixels_bounded():
            scene = trimesh.load_scene(
                io.BytesIO(notes.data), file_type=suffix[1:], resolver=resolver(path), process=False
            )
        placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    except GltfError as error:
        raise MeshFileError(str(error)) from error
    except Exception as error:
        got = " ".join(str(error).split())[:160] or type(error).__name__
        raise MeshFileError.of(str(path), "a mesh that can be read", got, "export it again") from error
    geometries = [(scene.geometry[name], np.asarray(matrix, np.float64)) for matrix, name in placed]
    pieces = [(piece, matrix) for piece, matrix in geometries if len(getattr(piece, "faces", ()))]
    for piece, _ in pieces:
        highest, count = int(np.max(piece.faces)), len(piece.vertices)
        if highest >= count:
            got = f"a face with vertex {highest} of {count}"
            raise MeshFileError.of(str(path), "faces of vertices from 0 on", got, "export it again")
    return pieces, notes


def _too_coarse(pieces: list[tuple[Any, NDArray[np.float64]]], surfaces: list[Surface]) -> list[str]:
    """A warning if float32 steps at a file's own coordinates are large beside its mesh, units of the file."""
    points = np.concatenate([surface.vertices for surface in surfaces]) if surfaces else np.zeros((1, 3))
    size, coarsest, where = float(np.ptp(points, axis=0).max()), 0.0, 0.0
    for piece, placed in pieces:
        farthest = float(np.abs(piece.vertices).max())
        step = float(np.spacing(np.float32(farthest)) * np.linalg.norm(placed[:3, :3], axis=0).max())
        coarsest, where = max((coarsest, where), (step, farthest))
    if not coarsest > COARSE * size > 0:
        return []
    extent = f"coordinates up to {where:.7g} in steps of {coarsest:.3g} (float32), which tear a mesh of size {size:.3g}"
    return [f"{extent}; export it around its own origin"]


def _world_offset(pieces: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """(3,) middle of all vertices if they are far from the origin, otherwise zero."""
    low = np.min([piece.min(0) for piece in pieces], axis=0)
    high = np.max([piece.max(0) for piece in pieces], axis=0)
    middle = (low + high) / 2
    radius = float(np.linalg.norm(high - low)) / 2
    return middle if np.abs(middle).max() > FARTHEST * radius > 0 else np.zeros(3)


def _mesh(surface: Surface, vertices: NDArray[np.float64]) -> Mesh:
    """A surface's mesh in float32."""
    faces, uvs = surface.faces.astype(np.uint32), surface.uvs.astype(np.float32)
    return Mesh(vertices.astype(np.float32), faces, uvs, surface.texture)


def _not_finite(path: Path, error: Exception) -> MeshFileError:
    """The error for arrays that are no mesh."""
    got = " ".join(str(error).split())[:200]
    return MeshFileError.of(str(path), "finite vertices, faces and colours", got, "repair it")
