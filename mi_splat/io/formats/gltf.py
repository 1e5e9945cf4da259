"""Binary glTF with KHR_gaussian_splatting, the extension that Khronos ratified.

Source: extensions/2.0/Khronos/KHR_gaussian_splatting/README.md of
github.com/KhronosGroup/glTF. A splat is a mesh of points with the attributes POSITION,
ROTATION (quaternion x, y, z, w), SCALE (standard deviations), OPACITY and
SH_DEGREE_l_COEF_n. The basis of SH is that of 3DGS. glTF's y points up where the PLY's
points down: the scene is turned by half a turn about z, as splat-transform does.
"""

from __future__ import annotations

import dataclasses
import io
import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats import axes
from mi_splat.io.formats.format import Format, Saving
from mi_splat.io.loaded import (
    Array,
    Arrays,
    Encoded,
    Loaded,
    Values,
    bytes_of,
    check_count,
    read_whole,
    validated,
)
from mi_splat.io.parsing import Fields, parse
from mi_splat.maths.srgb import to_linear

EXTENSION = "KHR_gaussian_splatting"
COLOUR_SPACE = "srgb_rec709_display"
_PROPERTIES = {"kernel": "ellipse", "colorSpace": COLOUR_SPACE}
_PROPERTIES |= {"sortingMethod": "cameraDistance", "projection": "perspective"}
_MOST_PARTS = 1000
_LEAST_BYTES = 4
"""Bytes that a Gaussian takes at the least, however often nodes place the same mesh."""

_KNOWN = (EXTENSION, "KHR_mesh_quantization")
_KINDS = {
    "POSITION": ("f4", "i1", "u1", "i2", "u2"),
    "SCALE": ("f4", "u1", "u2"),
    "ROTATION": ("f4", "i1", "i2"),
    "OPACITY": ("f4", "u1", "u2"),
}
GENERATOR = "mi-splat"
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")
_JSON_LIMIT = 1 << 22
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
_CODES = {kind: code for code, kind in COMPONENTS.items()}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES = {width: name for name, width in _WIDTHS.items()}
_AGAIN = "write or download it again"


def read_glb(file: io.FileIO, path: str) -> Loaded:
    """Read the splats of a binary glTF, each placed by its node."""
    data = read_whole(file)
    document = open_glb(data, path)
    needed = [
        name for name in document.root.texts("extensionsRequired") if name not in _KNOWN
    ]
    if needed:
        do = "export the splat without it"
        raise document.root.bad(
            "extensionsRequired", f"only {', '.join(_KNOWN)}", needed, do
        )
    meshes = document.root.objects("meshes")
    parts: list[Loaded] = []
    total = others = 0
    for number, matrix in placements(document.root, len(meshes)):
        for primitive in meshes[number].objects("primitives"):
            extensions = primitive.object("extensions", {})
            if EXTENSION not in extensions.values:
                others += 1
                continue
            total += document.count(primitive.object("attributes"), "POSITION")
            check_count(total, len(data) // _LEAST_BYTES, path)
            if len(parts) == _MOST_PARTS:
                raise SplatFileError.of(
                    path, f"at most {_MOST_PARTS} splats", "more", "merge them"
                )
            parts.append(
                axes.transformed(
                    _primitive(document, primitive, extensions.object(EXTENSION)),
                    matrix,
                    path,
                )
            )
    if not parts:
        got = f"none, but {others} other primitives" if others else "none"
        raise SplatFileError.of(
            path, f"a primitive with {EXTENSION}", got, "export the splat again"
        )
    loaded = axes.concatenated(parts)
    notices: tuple[tuple[str, str, str], ...] = ()
    if others:
        notices = (("splats only", f"{others} other primitives", "they were left out"),)
    arrays = axes.flipped(loaded.arrays, axes.Z)
    # What this program wrote has the axes of its own scenes.
    is_own = document.root.object("asset", {}).values.get("generator") == GENERATOR
    up = None if is_own else axes.Y_UP
    return dataclasses.replace(
        loaded, arrays=arrays, notices=notices, document=document, format_up=up
    )


def _primitive(document: Glb, primitive: Fields, extension: Fields) -> Loaded:
    if primitive.whole("mode", 0, 6, 4) != 0:
        raise primitive.bad("mode", "0 (points)", primitive.values.get("mode", 4))
    for name, known in (("kernel", "ellipse"), ("colorSpace", COLOUR_SPACE)):
        if extension.text(name) != known:
            raise extension.bad(
                name,
                repr(known),
                extension.text(name),
                f"export the splat with {known}",
            )
    if extension.object("extensions", {}).values:
        got = ", ".join(extension.object("extensions").values)[:60]
        raise extension.bad(
            "extensions", "none", got, "export the splat without compression"
        )
    attributes = primitive.object("attributes")
    count = document.count(attributes, "POSITION")

    def read(name: str, width: int, kinds: tuple[str, ...]) -> Array:
        return document.values(attributes, name, width, count, kinds)

    values = {
        name: read(f"{EXTENSION}:{name}", width, _KINDS[name])
        for name, width in (("SCALE", 3), ("ROTATION", 4), ("OPACITY", 1))
    }
    names = [
        _sh_name(degree, order)
        for degree in range(4)
        for order in range(2 * degree + 1)
    ]
    present = [name in attributes.values for name in names]
    coefficients = next((n for n in (16, 9, 4) if all(present[:n])), 1)
    if any(present[coefficients:]):
        expected = "whole degrees of SH, and all lower ones"
        raise attributes.bad(
            EXTENSION,
            expected,
            names[max(i for i, is_there in enumerate(present) if is_there)],
        )
    sh = np.empty((count, coefficients, 3), np.float32)
    for column, name in enumerate(names[:coefficients]):
        sh[:, column] = read(name, 3, ("f4",))
    means = read("POSITION", 3, _KINDS["POSITION"])
    quaternions = values["ROTATION"][:, [3, 0, 1, 2]]
    return validated(means, values["SCALE"], quaternions, values["OPACITY"][:, 0], sh)


def _sh_name(degree: int, order: int) -> str:
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"


def write_glb(arrays: Arrays, saving: Saving) -> Encoded:
    """A scene as a binary glTF; nothing is rounded.

    COLOR_0 is there for programs that draw points: linear light of the first SH
    coefficient, and the opacity.
    """
    values = Values.of(arrays)
    means, scales, rotations, opacities, sh = axes.flipped(arrays, axes.Z).values()
    shown = np.concatenate(
        [to_linear(np.clip(values.colours, 0, 1)), values.opacities[:, None]], axis=1
    )
    columns: dict[str, NDArray[np.generic]] = {
        "POSITION": means,
        "COLOR_0": bytes_of(shown * 255),
        f"{EXTENSION}:ROTATION": rotations[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacities[:, None],
    }
    for degree in range(values.degree + 1):
        for order in range(2 * degree + 1):
            columns[_sh_name(degree, order)] = sh[:, degree**2 + order]
    return Encoded(_glb_bytes(columns), ())


def placements(root: Fields, meshes: int) -> Iterator[tuple[int, Array]]:
    """Index of a mesh and its (4, 4) matrix to the world, for each node of the first
    scene that has one.
    """
    nodes = root.objects("nodes")
    scenes = root.objects("scenes")
    if not nodes or not scenes:
        return
    scene = scenes[root.whole("scene", 0, len(scenes) - 1, 0)]
    waiting = [(number, np.eye(4)) for number in scene.indices("nodes", len(nodes))]
    seen = {number for number, _ in waiting}
    while waiting:
        number, above = waiting.pop(0)
        node = nodes[number]
        local = _matrix(node)
        matrix = above if local is None else above @ local
        if "mesh" in node.values:
            yield node.whole("mesh", 0, meshes - 1), matrix
        children = node.indices("children", len(nodes))
        if seen & set(children):
            raise node.bad(
                "children",
                "nodes that have no parent yet",
                sorted(seen & set(children)),
            )
        seen |= set(children)
        waiting += [(child, matrix) for child in children]


def _matrix(node: Fields) -> Array | None:
    if "matrix" in node.values:
        # columns come first
        return np.array(node.numbers("matrix", 16, 16)).reshape(4, 4).T
    if not {"translation", "rotation", "scale"} & set(node.values):
        return None
    x, y, z, w = node.numbers("rotation", 4, 4, (0, 0, 0, 1))
    if not 0.5 < w * w + x * x + y * y + z * z < 2:
        raise node.bad("rotation", "a unit quaternion", [x, y, z, w])
    import torch

    from mi_splat.maths.rotation import normalise, to_matrix

    matrix = np.eye(4)
    turn = to_matrix(normalise(torch.tensor([w, x, y, z], dtype=torch.float64))).numpy()
    matrix[:3, :3] = turn * np.array(node.numbers("scale", 3, 3, (1, 1, 1)))
    matrix[:3, 3] = node.numbers("translation", 3, 3, (0, 0, 0))
    return matrix


# The container: a JSON document, a buffer, and typed arrays in it (glTF 2.0, sections
# 3.6 and 4.4).


@dataclass(frozen=True, slots=True, eq=False)
class Glb:
    """A binary glTF in memory: its document, two lists of it, and the bytes of its one
    buffer.
    """

    root: Fields
    accessors: Sequence[Fields]
    views: Sequence[Fields]
    buffer: memoryview

    def count(self, attributes: Fields, name: str) -> int:
        """Number of elements of an attribute."""
        return self._accessor(attributes, name).whole("count", 1, 1 << 31)

    def values(
        self,
        attributes: Fields,
        name: str,
        width: int,
        count: int,
        kinds: tuple[str, ...],
    ) -> Array:
        """(count, width) values of an attribute, as float64; integers that say so are
        scaled to -1..1 or 0..1.
        """
        accessor = self._accessor(attributes, name)
        kind = COMPONENTS.get(accessor.whole("componentType", 0, 1 << 16), "")
        elements = accessor.whole("count", 1, 1 << 31)
        form = accessor.text("type")
        if form != _TYPES[width] or kind not in kinds or elements != count:
            got = f"{elements} {form} of {kind or 'another kind'}"
            raise accessor.bad(
                name, f"{count} {_TYPES[width]} of {' or '.join(kinds)}", got
            )
        if "sparse" in accessor.values:
            raise accessor.bad("sparse", "a plain accessor", "a sparse one")
        view = self.views[accessor.whole("bufferView", 0, len(self.views) - 1)]
        view.whole("buffer", 0, 0)
        start = view.whole("byteOffset", 0, len(self.buffer), 0)
        length = view.whole("byteLength", 0, len(self.buffer) - start)
        inside = accessor.whole("byteOffset", 0, length, 0)
        record = np.dtype("<" + kind)
        step = view.whole("byteStride", 1, 252, record.itemsize * width)
        if (
            step < record.itemsize * width
            or inside + (count - 1) * step + record.itemsize * width > length
        ):
            raise accessor.bad(
                "count", f"elements inside of the {length} bytes of their view", count
            )
        layout = (
            (count, width),
            record,
            self.buffer,
            start + inside,
            (step, record.itemsize),
        )
        values = np.ndarray(*layout).astype(np.float64)
        if accessor.values.get("normalized") is True and kind[0] in "iu":
            values = np.maximum(values / np.iinfo(kind).max, -1.0)
        return values

    def _accessor(self, attributes: Fields, name: str) -> Fields:
        if name not in attributes.values:
            raise attributes.bad(name, "an attribute", "none")
        return self.accessors[attributes.whole(name, 0, len(self.accessors) - 1)]


def open_glb(data: bytes, path: str) -> Glb:
    """The document and the buffer of a binary glTF."""
    if len(data) < _HEADER.size + _CHUNK.size or not data.startswith(b"glTF"):
        raise SplatFileError.of(
            path, "a binary glTF", f"{len(data)} bytes, {data[:4]!r}", _AGAIN
        )
    _, version, length = _HEADER.unpack_from(data)
    if version != 2 or length != len(data):
        got = f"version {version} and {length} bytes"
        raise SplatFileError.of(
            path, f"glTF of version 2 and {len(data)} bytes", got, _AGAIN
        )
    offset = _HEADER.size
    chunks = list[tuple[bytes, int, int]]()
    while offset < len(data) and len(chunks) < 16:
        size, kind = (
            _CHUNK.unpack_from(data, offset)
            if len(data) - offset >= _CHUNK.size
            else (len(data), b"")
        )
        offset += _CHUNK.size
        if size > len(data) - offset:
            raise SplatFileError.of(
                path, "chunks inside of the file", f"one of {size} bytes", _AGAIN
            )
        chunks.append((kind, offset, size))
        offset += size
    if not chunks or chunks[0][0] != b"JSON":
        raise SplatFileError.of(
            path, "a JSON chunk first", chunks[0][0] if chunks else "none", _AGAIN
        )
    _, start, size = chunks[0]
    root = parse(data[start : start + size], path, limit=_JSON_LIMIT)
    buffers = root.objects("buffers")
    if len(buffers) != 1 or "uri" in buffers[0].values:
        got = f"{len(buffers)}, or another file"
        raise root.bad(
            "buffers", "one buffer inside of the file", got, "pack it into one .glb"
        )
    binary = next(
        ((start, size) for kind, start, size in chunks[1:2] if kind == b"BIN\0"), (0, 0)
    )
    used = buffers[0].whole("byteLength", 1, binary[1])
    values = memoryview(data)[binary[0] : binary[0] + used]
    return Glb(root, root.objects("accessors"), root.objects("bufferViews"), values)


def _glb_bytes(columns: Mapping[str, NDArray[np.generic]]) -> bytes:
    views = list[dict[str, object]]()
    accessors = list[dict[str, object]]()
    parts = list[bytes]()
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
            accessor |= {
                "min": values.min(axis=0).tolist(),
                "max": values.max(axis=0).tolist(),
            }
        views.append(
            {
                "buffer": 0,
                "byteOffset": offset,
                "byteLength": values.nbytes,
                "target": 34962,
            }
        )
        accessors.append(accessor)
        parts.append(part)
        offset += len(part)
    primitive = {
        "attributes": {name: number for number, name in enumerate(columns)},
        "mode": 0,
        "extensions": {EXTENSION: _PROPERTIES},
    }
    document = {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "extensionsUsed": [EXTENSION],
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
    body = (
        _CHUNK.pack(len(text), b"JSON")
        + text
        + _CHUNK.pack(offset, b"BIN\0")
        + b"".join(parts)
    )
    return _HEADER.pack(b"glTF", 2, _HEADER.size + len(body)) + body


GLB = Format(
    name="glb",
    suffixes=(".glb",),
    magic=(b"glTF",),
    read=read_glb,
    write=write_glb,
    keeps_nothing=False,
    in_archives=True,
)
