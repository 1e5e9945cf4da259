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

COLOURS = {
    "cab": (200, 30, 30),
    "bed": (30, 60, 180),
    "tyre": (25, 25, 25),
    "glass": (150, 190, 210),
}
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

    def placed(
        self, *, scale: float = 1.0, move: ArrayLike = (0, 0, 0), y_up: bool = False
    ) -> Truck:
        points = self.vertices * scale + np.asarray(move, np.float64)
        if y_up:
            points = np.column_stack([points[:, 0], points[:, 2], -points[:, 1]])
        return replace(self, vertices=points)


def truck() -> Truck:
    """A box of each colour: 5 m long, 48 triangles."""
    boxes = {
        "cab": ((0.95, 0, 1.1), (3.1, 1.8, 1.2)),
        "bed": ((-1.55, 0, 0.85), (1.9, 1.84, 0.7)),
        "tyre": ((0, 0, 0.25), (4.2, 1.6, 0.5)),
        "glass": ((2.51, 0, 0.85), (0.04, 1.5, 0.2)),
    }
    signs = np.array(
        [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64
    )
    quads = [
        (0, 1, 3, 2),
        (4, 6, 7, 5),
        (0, 4, 5, 1),
        (2, 3, 7, 6),
        (0, 2, 6, 4),
        (1, 5, 7, 3),
    ]
    corners = [corner for a, b, c, d in quads for corner in (a, b, c, a, c, d)]
    solids = [
        np.array(middle) + 0.5 * np.array(size) * signs
        for middle, size in (boxes[name] for name in COLOURS)
    ]
    places = (np.arange(len(solids)).repeat(len(corners)) + 0.5) / len(solids)
    return Truck(
        np.concatenate([solid[corners] for solid in solids]),
        np.column_stack([places, 0 * places + 0.5]),
    )


def stripes() -> Image.Image:
    """The texture."""
    return Image.fromarray(
        np.repeat(np.array([list(COLOURS.values())], np.uint8), 4, axis=0).repeat(
            8, axis=1
        )
    )


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
    required: tuple[str, ...] = (),
) -> Path:
    """y up.

    What is given takes the place of the usual: a material whose base colour is texture
    0, a texture whose source is image 0, an image of the bytes of `stripes`, and
    TEXCOORD_0.
    """
    made = made.placed(y_up=True)
    down = (made.uvs * (1, -1) + (0, 1)).astype("<f4")
    arrays: dict[str, NDArray[Any]] = {
        "POSITION": made.vertices.astype("<f4"),
        "TEXCOORD_0": down,
        **(attributes or {}),
    }
    accessors = []
    views = []
    data = b""
    for name, array in arrays.items():
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        data += array.tobytes() + b"\0" * (-array.nbytes % 4)
        kind = {"f": 5126, "u1": 5121, "u2": 5123}[
            "f" if array.dtype.kind == "f" else array.dtype.str[1:]
        ]
        if name == "POSITION":
            ends = {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        else:
            ends = {}
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": kind,
                "count": len(array),
                "type": f"VEC{array.shape[1]}",
                **({"normalized": True} if kind != 5126 else {}),
                **ends,
            }
        )
    picture = encoded(stripes()) if picture is None else picture
    views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(picture)})
    data += picture + b"\0" * (-len(picture) % 4)
    usual = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    primitive = {"attributes": {name: i for i, name in enumerate(arrays)}}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{**primitive, "material": 0, "mode": 4}]}],
        "materials": [dict(usual if material is None else material)],
        "textures": [dict({"source": 0} if texture is None else texture)],
        "images": [
            dict(
                {"bufferView": len(arrays), "mimeType": "image/png"}
                if image is None
                else image
            )
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
        **(
            {"extensionsRequired": list(required), "extensionsUsed": list(required)}
            if required
            else {}
        ),
    }
    (folder / "truck.glb").write_bytes(
        packed(document, struct.pack("<I4s", len(data), b"BIN\0") + data)
    )
    return folder / "truck.glb"


def packed(document: object, rest: bytes) -> bytes:
    """A GLB of a document and the chunks after it."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return (
        struct.pack(
            "<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON"
        )
        + text
        + rest
    )
