"""The parts of a GLB file (glTF 2.0): its document, numbers and images, and what its
nodes place.

A file may be anybody's. Only bytes that the file holds are made numbers of, so that
memory follows its size. Where parts do not fit together, a method raises whatever
Python or NumPy raises; `mi_splat.capture.mesh_files` says it in words.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_splat.capture.mesh import Doubles
from mi_splat.errors import MiSplatError
from mi_splat.io.parsing import DocumentReader

Part = Mapping[str, Any]
"""An object of a document, of which nothing is known yet."""
Integers = NDArray[np.int64]

DRACO = "KHR_draco_mesh_compression"
TRIANGLES, STRIP, FAN = 4, 5, 6
FLOAT = 5126

_HEADER = struct.Struct("<4sIII4s")
_CHUNK = struct.Struct("<I4s")
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MOST_ZEROS = 1 << 22
"""Rows of an accessor without a view, which stand for zeros, that are made."""


class MeshFileError(MiSplatError):
    """A mesh file cannot be read; the message names it and says what to do."""


READER = DocumentReader(
    expected="a GLB file (glTF 2.0)",
    do="export it again",
    error=MeshFileError,
    most=1 << 28,
)


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """The triangles of a primitive."""

    positions: NDArray[Any]  # (V, 3)
    faces: Integers  # (F, 3)
    uvs: NDArray[Any] | None  # (V, 2), v down


@dataclass(frozen=True, slots=True, eq=False)
class Glb:
    """A file in memory."""

    document: dict[str, Any]
    binary: bytes  # the chunk after the document

    @classmethod
    def read(cls, path: Path) -> Glb:
        """The document and the binary chunk of a file."""
        data = path.read_bytes()
        header = data.ljust(_HEADER.size, b"\0")
        magic, version, _, length, kind = _HEADER.unpack_from(header)
        end = _HEADER.size + length
        is_glb = magic == b"glTF" and version == 2 and kind == b"JSON"
        if not is_glb or end > len(data):
            got = "no header of a whole GLB file of version 2"
            raise READER.broken(str(path), got)
        document = READER.json_object(data[_HEADER.size : end], str(path))
        chunk = data[end:]
        if len(chunk) < _CHUNK.size:
            return cls(document, b"")
        size, _ = _CHUNK.unpack_from(chunk)
        return cls(document, chunk[_CHUNK.size : _CHUNK.size + size])

    def bytes_of(self, index: int) -> bytes:
        """The bytes of a view of a buffer."""
        view = _entry(self.document["bufferViews"], index)
        buffer = _entry(self.document["buffers"], view["buffer"])
        data = self.binary
        if "uri" in buffer:
            data = _decoded(buffer["uri"])
        start = view.get("byteOffset", 0)
        end = start + view["byteLength"]
        if not 0 <= start <= end <= len(data):
            raise ValueError(f"view {index} of bytes that the file does not hold")
        return data[start:end]

    def numbers(self, index: int) -> NDArray[Any]:
        """(N, k) numbers of an accessor, as they are stored."""
        accessor = _entry(self.document["accessors"], index)
        kind = np.dtype(_DTYPES[accessor["componentType"]])
        shape = (accessor["count"], _WIDTHS[accessor["type"]])
        if "sparse" in accessor:
            raise ValueError(f"accessor {index} of sparse numbers")
        if "bufferView" not in accessor:
            if shape[0] > _MOST_ZEROS:
                words = f"{shape[0]} zeros, which no view holds"
                raise ValueError(f"accessor {index} of {words}")
            return np.zeros(shape, kind)
        view = _entry(self.document["bufferViews"], accessor["bufferView"])
        row = shape[1] * kind.itemsize
        stride = view.get("byteStride", row)
        if stride < row:  # a small view could stand for any number of rows
            raise ValueError(f"accessor {index} of rows that overlap")
        data = self.bytes_of(accessor["bufferView"])
        start = accessor.get("byteOffset", 0)
        return np.ndarray(shape, kind, data, start, (stride, kind.itemsize)).copy()

    def image(self, index: int) -> bytes:
        """The bytes of an encoded image."""
        image = _entry(self.document["images"], index)
        if "uri" in image:
            return _decoded(image["uri"])
        return self.bytes_of(image["bufferView"])

    def placed(self) -> Iterator[tuple[Part, Doubles]]:
        """Each primitive of triangles, and the (4, 4) matrix that places it."""
        nodes = self.document.get("nodes", [])
        scene = _entry(self.document["scenes"], self.document.get("scene", 0))
        waiting = [(root, np.eye(4)) for root in scene.get("nodes", [])]
        seen = set[int]()
        while waiting:
            index, above = waiting.pop()
            if index in seen:  # or few nodes could place a mesh any number of times
                raise ValueError(f"node {index} in two places")
            seen.add(index)
            node = _entry(nodes, index)
            matrix = above @ _matrix(node)
            waiting += [(child, matrix) for child in node.get("children", [])]
            if "mesh" not in node:
                continue
            mesh = _entry(self.document["meshes"], node["mesh"])
            for primitive in mesh["primitives"]:
                if primitive.get("mode", TRIANGLES) in (TRIANGLES, STRIP):
                    yield primitive, matrix

    def geometry(self, primitive: Part) -> Geometry:
        """The triangles of a primitive."""
        packed_by_draco = primitive.get("extensions", {}).get(DRACO)
        if packed_by_draco is not None:
            return _unpacked(self.bytes_of(packed_by_draco["bufferView"]))
        attributes = primitive["attributes"]
        positions = self.numbers(attributes["POSITION"])
        order = np.arange(len(positions))
        if "indices" in primitive:
            indices = self.numbers(primitive["indices"])
            order = indices.ravel().astype(np.int64)
        if primitive.get("mode", TRIANGLES) == STRIP:
            faces = _faces_of_strip(order)
        else:
            faces = order.reshape(-1, 3)
        uvs = None
        if "TEXCOORD_0" in attributes:
            uvs = self.numbers(attributes["TEXCOORD_0"])
        return Geometry(positions, faces, uvs)


def packed(document: Part, binary: bytes) -> bytes:
    """A GLB file of a document and the bytes of its buffer."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunk = _CHUNK.pack(len(binary), b"BIN\0") + binary
    length = _HEADER.size + len(text) + len(chunk)
    header = _HEADER.pack(b"glTF", 2, length, len(text), b"JSON")
    return header + text + chunk


def _unpacked(data: bytes) -> Geometry:
    """What Draco packed."""
    import DracoPy

    mesh = DracoPy.decode(data)
    uvs = mesh.tex_coord
    if uvs is not None and not len(uvs):
        uvs = None
    return Geometry(mesh.points, mesh.faces.astype(np.int64), uvs)


def _decoded(uri: str) -> bytes:
    """The bytes that a `data:` URI holds."""
    return base64.b64decode(uri.partition(",")[2], validate=True)


def _entry(entries: list[Any], index: int) -> Any:
    """An entry that is counted from the front."""
    if index < 0:
        raise LookupError(f"entry {index}")
    return entries[index]


def _faces_of_strip(order: Integers) -> Integers:
    """(F, 3) faces of a strip of triangles, whose every other one is turned around."""
    faces = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
    faces[1::2] = faces[1::2, ::-1]
    return faces


def _matrix(node: Part) -> Doubles:
    """(4, 4) matrix of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    norm = x * x + y * y + z * z + w * w
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], np.float64)
    turn = np.eye(3) + 2 * (w * across + across @ across) / norm
    scale = np.array(node.get("scale", (1.0, 1.0, 1.0)))
    matrix[:3, :3] = turn * scale
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix
