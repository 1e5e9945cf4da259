"""glTF documents (.glb, .gltf): what they say of materials, and what trimesh needs to be told to read them right."""

import json
import math
import shlex
import struct
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from mi_splat.capture.mesh_materials import MaterialNotes, MeshFileNotes
from mi_splat.errors import MiSplatError
from mi_splat.io.parsing import DocumentReader

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
    return MeshFileNotes(data=data, materials=notes, faults=(unread,) if unread else (), float32=True)


def _read(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """The JSON document, and of a GLB the chunks after it."""
    data = path.read_bytes()
    if not data:
        raise GltfError.of(str(path), "a glTF 2.0 file", "an empty file", "export it again")
    rest = None
    try:
        if path.suffix.lower() == ".glb":
            if len(data) < _HEADER:
                raise ValueError(f"a file of {len(data)} bytes, too short for a GLB")
            magic, version, _, length, kind = struct.unpack_from("<4sIII4s", data)
            if magic != b"glTF" or version != 2 or kind != b"JSON":
                raise ValueError("no header of a GLB file of version 2")
            if _HEADER + length > len(data):
                raise ValueError("a file that is cut off")
            data, rest = data[_HEADER : _HEADER + length], data[_HEADER + length :]
    except ValueError as error:
        raise GltfError.of(str(path), "a glTF 2.0 file", str(error)[:160], "export it again") from error
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
    texture = _base_colour(material)
    transform = None if texture is None else _uv_transform(texture)
    return MaterialNotes(
        picture=None if texture is None else _picture(document, texture),
        factor=None if factor is None else np.clip(np.asarray(factor[:3], np.float64), 0, 1),
        uv_transform=transform,
    )


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
