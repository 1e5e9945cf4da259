"""What is wrong with a glTF document, in plain words, before trimesh reads it.

Names and sizes are those of the glTF 2.0 specification, sections 3.6 (buffers, views and accessors) and 5 (properties).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MOST_ZEROS = 1 << 26
"""Bytes that an accessor without a view, which stands for zeros, may take."""
_LISTS = ("scenes", "nodes", "meshes", "accessors", "bufferViews", "buffers", "materials", "textures", "images")


def document_fault(document: dict[str, Any], binary: int | None) -> str | None:
    """What keeps a document from being read, in words; None if nothing is found.

    Args:
        document: The JSON of the file.
        binary: Bytes of the binary part of a GLB, which is its first buffer; None if there is none.
    """
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
