"""glTF documents (.glb, .gltf): what they say of materials, and what trimesh needs to be told to read them right."""

import json
import math
import shlex
import struct
from collections.abc import Iterator
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
_HEADER, _CHUNK_HEADER = 20, 8
"""Bytes of a GLB before its JSON, and before what each chunk after it holds."""


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
    if fault := document_fault(document, None if rest is None else max(0, len(rest) - _CHUNK_HEADER)):
        raise GltfError.of(str(path), "a glTF file whose parts fit together", fault, "export it again")
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


# What is wrong with a document, in plain words, before trimesh reads it: names and sizes are those of the glTF 2.0
# specification, sections 3.6 (buffers, views and accessors) and 5 (properties).

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MOST_ZEROS = 1 << 26
"""Bytes that an accessor without a view, which stands for zeros, may take."""
_LISTS = ("scenes", "nodes", "meshes", "accessors", "bufferViews", "buffers", "materials", "textures", "images")


def document_fault(document: dict[str, Any], binary: int | None) -> str | None:
    """What keeps a document from being read, in words; None if nothing is found."""
    for name in _LISTS:
        entries = document.get(name, [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            return f"{name} that are no list of objects"
    if not document.get("meshes"):
        return "no meshes in it"
    for check in (_primitive_faults, _index_faults, _view_faults, _accessor_faults):
        faults = check(document, binary)
        if (fault := next(faults, None)) is not None:
            return fault
    return None


def _primitive_faults(document: dict[str, Any], _: int | None) -> Iterator[str]:
    """Meshes without primitives, or without places of their vertices."""
    for number, mesh in enumerate(document["meshes"]):
        primitives = mesh.get("primitives")
        if not isinstance(primitives, list) or not all(isinstance(item, dict) for item in primitives):
            yield f"mesh {number} without a list of primitives"
        elif any("POSITION" not in _object(primitive, "attributes") for primitive in primitives):
            yield f"mesh {number} without places of its vertices (POSITION)"


def _index_faults(document: dict[str, Any], _: int | None) -> Iterator[str]:
    """Indices that name nothing."""
    for where, index, name in _references(document):
        count = len(document.get(name, []))
        if not isinstance(index, int) or not 0 <= index < count:
            yield f"{where} that names number {index!r} of {count} {name}"


def _references(document: dict[str, Any]) -> Iterator[tuple[str, Any, str]]:
    """Who names something by its index, the index, and the list that it is of."""
    if "scene" in document:
        yield "a document", document["scene"], "scenes"
    keys = {"nodes": {"mesh": "meshes"}, "accessors": {"bufferView": "bufferViews"}, "textures": {"source": "images"}}
    keys |= {"bufferViews": {"buffer": "buffers"}, "images": {"bufferView": "bufferViews"}}
    for kind, named in keys.items():
        for number, entry in enumerate(document.get(kind, [])):
            yield from ((f"{kind} {number}", entry[key], name) for key, name in named.items() if key in entry)
    for kind, key in (("scenes", "nodes"), ("nodes", "children")):
        for number, entry in enumerate(document.get(kind, [])):
            yield from ((f"{kind} {number}", index, "nodes") for index in entry.get(key, []))
    for number, material in enumerate(document.get("materials", [])):
        texture = _object(_object(material, "pbrMetallicRoughness"), "baseColorTexture")
        if texture:
            yield f"material {number}", texture.get("index"), "textures"
    for number, mesh in enumerate(document["meshes"]):
        for primitive in mesh["primitives"]:
            yield from ((f"mesh {number} ({name})", i, "accessors") for name, i in primitive["attributes"].items())
            if "indices" in primitive:
                yield f"mesh {number} (indices)", primitive["indices"], "accessors"
            if "material" in primitive:
                yield f"mesh {number}", primitive["material"], "materials"


def _view_faults(document: dict[str, Any], binary: int | None) -> Iterator[str]:
    """Views that are longer than their buffers."""
    sizes = [buffer.get("byteLength", 0) for buffer in document.get("buffers", [])]
    if binary is not None and sizes and "uri" not in document["buffers"][0]:
        sizes[0] = binary
    for number, view in enumerate(document.get("bufferViews", [])):
        end = view.get("byteOffset", 0) + view.get("byteLength", 0)
        size = sizes[view.get("buffer", 0)]
        if end > size:
            yield f"buffer view {number} that ends at byte {end} of a buffer of {size}; the file may be cut off"


def _accessor_faults(document: dict[str, Any], _: int | None) -> Iterator[str]:
    """Accessors of unknown kinds, with more values than their views hold, or of many values without a view."""
    for number, accessor in enumerate(document.get("accessors", [])):
        kind, component, count = (accessor.get(key) for key in ("type", "componentType", "count"))
        if kind not in _COMPONENTS or component not in _COMPONENT_BYTES or not isinstance(count, int) or count < 1:
            yield f"accessor {number} of type {kind!r}, component type {component!r} and count {count!r}"
        elif "bufferView" not in accessor:
            if count * _COMPONENTS[kind] * _COMPONENT_BYTES[component] > _MOST_ZEROS:
                yield f"accessor {number} of {count} zeros, which no view holds"
        else:
            view = document["bufferViews"][accessor["bufferView"]]
            each = _COMPONENTS[kind] * _COMPONENT_BYTES[component]
            needed = accessor.get("byteOffset", 0) + (count - 1) * view.get("byteStride", each) + each
            if needed > view.get("byteLength", 0):
                yield f"accessor {number} of {needed} bytes in a view of {view.get('byteLength', 0)}"


def _object(entry: dict[str, Any], key: str) -> dict[str, Any]:
    """The object under a key; an empty one if there is none."""
    value = entry.get(key)
    return value if isinstance(value, dict) else {}
