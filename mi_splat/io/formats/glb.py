"""The binary glTF container: a JSON document, a buffer, and typed arrays in it (glTF 2.0, sections 3.6 and 4.4)."""

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError
from mi_splat.io.fields import Fields, parse
from mi_splat.io.formats.encoded import Array

_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_JSON_LIMIT = 1 << 22
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
_CODES = {kind: code for code, kind in COMPONENTS.items()}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES = {width: name for name, width in _WIDTHS.items()}
_AGAIN = "write or download it again"


@dataclass(frozen=True, slots=True, eq=False)
class Glb:
    """A binary glTF in memory: its document, two lists of it, and the bytes of its one buffer."""

    root: Fields
    accessors: Sequence[Fields]
    views: Sequence[Fields]
    buffer: memoryview

    def count(self, attributes: Fields, name: str) -> int:
        """Number of elements of an attribute."""
        return self._accessor(attributes, name).whole("count", 1, 1 << 31)

    def values(self, attributes: Fields, name: str, width: int, count: int, kinds: tuple[str, ...]) -> Array:
        """(count, width) values of an attribute, as float64; integers that say so are scaled to -1..1 or 0..1."""
        accessor = self._accessor(attributes, name)
        kind = COMPONENTS.get(accessor.whole("componentType", 0, 1 << 16), "")
        elements, form = accessor.whole("count", 1, 1 << 31), accessor.text("type")
        if form != _TYPES[width] or kind not in kinds or elements != count:
            got = f"{elements} {form} of {kind or 'another kind'}"
            raise accessor.bad(name, f"{count} {_TYPES[width]} of {' or '.join(kinds)}", got)
        if "sparse" in accessor.values:
            raise accessor.bad("sparse", "a plain accessor", "a sparse one")
        view = self.views[accessor.whole("bufferView", 0, len(self.views) - 1)]
        view.whole("buffer", 0, 0)
        start = view.whole("byteOffset", 0, len(self.buffer), 0)
        length = view.whole("byteLength", 0, len(self.buffer) - start)
        inside = accessor.whole("byteOffset", 0, length, 0)
        record = np.dtype("<" + kind)
        step = view.whole("byteStride", 1, 252, record.itemsize * width)
        if step < record.itemsize * width or inside + (count - 1) * step + record.itemsize * width > length:
            raise accessor.bad("count", f"elements inside of the {length} bytes of their view", count)
        layout = (count, width), record, self.buffer, start + inside, (step, record.itemsize)
        return _plain(np.ndarray(*layout), kind if accessor.values.get("normalized") is True else "")

    def _accessor(self, attributes: Fields, name: str) -> Fields:
        if name not in attributes.values:
            raise attributes.bad(name, "an attribute", "none")
        return self.accessors[attributes.whole(name, 0, len(self.accessors) - 1)]


def _plain(values: NDArray[np.generic], normalised: str) -> Array:
    wide = values.astype(np.float64)
    if normalised and normalised[0] in "iu":
        wide = np.maximum(wide / np.iinfo(normalised).max, -1.0)
    return wide


def open_glb(data: bytes, path: str) -> Glb:
    """The document and the buffer of a binary glTF."""
    if len(data) < _HEADER.size + _CHUNK.size or not data.startswith(b"glTF"):
        raise SplatFileError.of(path, "a binary glTF", f"{len(data)} bytes, {data[:4]!r}", _AGAIN)
    _, version, length = _HEADER.unpack_from(data)
    if version != 2 or length != len(data):
        got = f"version {version} and {length} bytes"
        raise SplatFileError.of(path, f"glTF of version 2 and {len(data)} bytes", got, _AGAIN)
    offset, chunks = _HEADER.size, list[tuple[bytes, int, int]]()
    while offset < len(data) and len(chunks) < 16:
        size, kind = _CHUNK.unpack_from(data, offset) if len(data) - offset >= _CHUNK.size else (len(data), b"")
        offset += _CHUNK.size
        if size > len(data) - offset:
            raise SplatFileError.of(path, "chunks inside of the file", f"one of {size} bytes", _AGAIN)
        chunks.append((kind, offset, size))
        offset += size
    if not chunks or chunks[0][0] != b"JSON":
        raise SplatFileError.of(path, "a JSON chunk first", chunks[0][0] if chunks else "none", _AGAIN)
    _, start, size = chunks[0]
    root = parse(data[start : start + size], path, limit=_JSON_LIMIT)
    buffers = root.objects("buffers")
    if len(buffers) != 1 or "uri" in buffers[0].values:
        got = f"{len(buffers)}, or another file"
        raise root.bad("buffers", "one buffer inside of the file", got, "pack it into one .glb")
    binary = next(((start, size) for kind, start, size in chunks[1:2] if kind == b"BIN\0"), (0, 0))
    used = buffers[0].whole("byteLength", 1, binary[1])
    values = memoryview(data)[binary[0] : binary[0] + used]
    return Glb(root, root.objects("accessors"), root.objects("bufferViews"), values)


def glb_bytes(columns: Mapping[str, NDArray[np.generic]], extension: str, properties: Mapping[str, str]) -> bytes:
    """A binary glTF with one mesh of points."""
    views, accessors, parts = list[dict[str, object]](), list[dict[str, object]](), list[bytes]()
    offset = 0
    for name, values in columns.items():
        kind = values.dtype.str[1:]
        part = np.ascontiguousarray(values, "<" + kind).tobytes()
        part += bytes(-len(part) % 4)
        accessor: dict[str, object] = {
            "bufferView": len(views),
            "componentType": _CODES[kind],
            "count": len(values),
            "type": _TYPES[values.shape[1]],
        }
        if kind != "f4":
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": 34962})
        accessors.append(accessor)
        parts.append(part)
        offset += len(part)
    primitive = {
        "attributes": {name: number for number, name in enumerate(columns)},
        "mode": 0,
        "extensions": {extension: dict(properties)},
    }
    document = {
        "asset": {"version": "2.0", "generator": "mi-splat"},
        "extensionsUsed": [extension],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = _CHUNK.pack(len(text), b"JSON") + text + _CHUNK.pack(offset, b"BIN\0") + b"".join(parts)
    return _HEADER.pack(b"glTF", 2, _HEADER.size + len(body)) + body
