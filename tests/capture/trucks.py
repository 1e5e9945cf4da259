"""A low-poly truck as other people's files have it: a GLB with a texture."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

COLOURS = {"cab": (200, 30, 30), "bed": (30, 60, 180), "tyre": (25, 25, 25), "glass": (150, 190, 210)}
"""The texture's four stripes, from left to right."""


@dataclass(frozen=True, eq=False)
class Truck:
    """z up, facing +x; triangles do not share vertices."""

    vertices: NDArray[np.float64]  # (V, 3)
    uvs: NDArray[np.float64]  # (V, 2), v up

    @property
    def faces(self) -> NDArray[np.int64]:
        return np.arange(len(self.vertices)).reshape(-1, 3)

    @property
    def colours(self) -> NDArray[np.uint8]:
        """(V, 3) the texture's colours as colours of vertices."""
        table = np.array(list(COLOURS.values()), np.uint8)
        painted: NDArray[np.uint8] = table[(self.uvs[:, 0] * len(table)).astype(int)]
        return painted

    def placed(self, *, scale: float = 1.0, move: ArrayLike = (0, 0, 0), y_up: bool = False) -> Truck:
        points = self.vertices * scale + np.asarray(move, np.float64)
        if y_up:
            points = np.column_stack([points[:, 0], points[:, 2], -points[:, 1]])
        return replace(self, vertices=points)


def truck() -> Truck:
    """A pickup with bonnet, cabin, windows, bed, lamps and four round wheels; 5 m long, 276 triangles."""
    boxes = [
        ((1.75, 0, 0.8), (1.5, 1.8, 0.6), "cab"),  # bonnet
        ((0.2, 0, 0.8), (1.6, 1.8, 0.6), "cab"),
        ((-1.55, 0, 0.85), (1.9, 1.84, 0.7), "bed"),
        ((2.51, 0, 0.85), (0.04, 1.5, 0.2), "glass"),  # lamps
    ]
    solids = [(np.array(middle) + 0.5 * np.array(size) * _CORNERS, colour) for middle, size, colour in boxes]
    solids.append((_cabin(1.0), "cab"))
    solids += [
        (_cabin(0.75) * (1, 1.18, 1) + (0, 0, 0.04), "glass"),
        (_cabin(0.8) * (1.12, 0.8, 1) - (0.03, 0, 0), "glass"),
    ]
    triangles = [(points[[a, b, c, a, c, d]], colour) for points, colour in solids for a, b, c, d in _QUADS]
    triangles += [(part, "tyre") for x in (1.65, -1.6) for y in (-0.83, 0.83) for part in _wheel(x, y)]
    places = [(list(COLOURS).index(colour) + 0.5) / len(COLOURS) for _, colour in triangles]
    uvs = [np.full((len(part), 2), (u, 0.5)) for u, (part, _) in zip(places, triangles, strict=True)]
    return Truck(np.concatenate([part for part, _ in triangles]), np.concatenate(uvs))


_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def _cabin(size: float) -> NDArray[np.float64]:
    """(8, 3) corners of a cabin that is narrower above."""
    points = np.array([0.2, 0, 1.4]) + _CORNERS * (0.8, 0.85, 0.3 * size)
    points[_CORNERS[:, 2] > 0] -= _CORNERS[_CORNERS[:, 2] > 0] * (0.35 * size, 0.12 * size, 0)
    return points


def _wheel(x: float, y: float, *, sides: int = 12) -> list[NDArray[np.float64]]:
    """Triangles of a wheel about an axis along y."""
    angles = np.linspace(0, -2 * np.pi, sides + 1)
    rim = np.column_stack([x + 0.38 * np.cos(angles), np.zeros(sides + 1), 0.38 + 0.38 * np.sin(angles)])
    inner, outer = (rim + np.array([0, side, 0]) for side in (y - 0.12, y + 0.12))
    middles = [np.array([x, y + side, 0.38]) for side in (-0.12, 0.12)]
    triangles = []
    for i in range(sides):
        triangles.append(np.stack([inner[i], inner[i + 1], outer[i + 1], inner[i], outer[i + 1], outer[i]])[::-1])
        triangles.append(np.stack([middles[0], inner[i + 1], inner[i]])[::-1])
        triangles.append(np.stack([middles[1], outer[i], outer[i + 1]])[::-1])
    return triangles


def stripes() -> Image.Image:
    """The texture."""
    return Image.fromarray(np.repeat(np.array([list(COLOURS.values())], np.uint8), 4, axis=0).repeat(8, axis=1))


def encoded(picture: Image.Image, kind: str = "PNG", **options: Any) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, kind, **options)
    return buffer.getvalue()


def write_glb(
    folder: Path,
    made: Truck,
    *,
    material: Mapping[str, Any] | None = None,
    picture: bytes | None = None,
    image: Mapping[str, Any] | None = None,
    texture: Mapping[str, Any] | None = None,
    attributes: Mapping[str, NDArray[Any]] | None = None,
    node: Mapping[str, Any] | None = None,
    required: tuple[str, ...] = (),
    mode: int = 4,
) -> Path:
    """y up.

    What is given takes the place of the usual: a material whose base colour is texture 0, a texture whose source is
    image 0, an image of the bytes of `stripes`, and TEXCOORD_0; `node` has more keys of the only node.
    """
    made = made.placed(y_up=True)
    down = (made.uvs * (1, -1) + (0, 1)).astype("<f4")
    arrays: dict[str, NDArray[Any]] = {
        "POSITION": made.vertices.astype("<f4"),
        "TEXCOORD_0": down,
        **(attributes or {}),
    }
    accessors, views, data = [], [], b""
    for name, array in arrays.items():
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        data += array.tobytes() + b"\0" * (-array.nbytes % 4)
        kind = {"f": 5126, "u1": 5121, "u2": 5123}["f" if array.dtype.kind == "f" else array.dtype.str[1:]]
        ends = {"min": array.min(0).tolist(), "max": array.max(0).tolist()} if name == "POSITION" else {}
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": kind, "count": len(array),
             "type": f"VEC{array.shape[1]}", **({"normalized": True} if kind != 5126 else {}), **ends}
        )  # fmt: skip
    picture = encoded(stripes()) if picture is None else picture
    views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(picture)})
    data += picture + b"\0" * (-len(picture) % 4)
    usual = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    primitive = {"attributes": {name: i for i, name in enumerate(arrays)}}
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [{**primitive, "material": 0, "mode": mode}]}],
        "materials": [dict(usual if material is None else material)],
        "textures": [dict({"source": 0} if texture is None else texture)],
        "images": [dict({"bufferView": len(arrays), "mimeType": "image/png"} if image is None else image)],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}],
        **({"extensionsRequired": list(required), "extensionsUsed": list(required)} if required else {}),
    }  # fmt: skip
    (folder / "truck.glb").write_bytes(packed(document, struct.pack("<I4s", len(data), b"BIN\0") + data))
    return folder / "truck.glb"


def packed(document: object, rest: bytes) -> bytes:
    """A GLB of a document and the chunks after it."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest
