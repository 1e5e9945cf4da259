"""Mesh files: geometry, axes, textures the right way up, colours, and what is wrong
with a file.
"""

import io
import json
import random
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mi_splat.capture.mesh import Asset
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.settings import MeshSettings
from mi_splat.errors import MiSplatError
from tests.capture.trucks import packed

# A square in the plane x = 0 of a y-up file: the corners in order of (z right to left,
# y up).
SQUARE = [[0, 0, 0], [0, 0, -1], [0, 1, -1], [0, 1, 0]]
FACES = [[0, 1, 2], [0, 2, 3]]
UVS = [[0, 0], [1, 0], [1, 1], [0, 1]]


def picture() -> Image.Image:
    """Red and green above blue and white."""
    values = np.array(
        [[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8
    )
    return Image.fromarray(values)


def colour_at(asset: Asset, corner: int) -> list[float]:
    """Colour of the texel at a corner of the only mesh, as the path tracer looks it up
    (first row at v = 1).
    """
    (mesh,) = asset.meshes
    height, width = mesh.texture.shape[:2]
    u, v = mesh.uvs[corner]
    row = int(np.clip((1 - v) * height, 0, height - 1))
    column = int(np.clip(u * width, 0, width - 1))
    return [float(value) for value in mesh.texture[row, column]]


def write_glb(folder: Path, *, move: float = 0.0) -> Path:
    """A GLB written by hand: in glTF, v runs down from the top of the image."""
    buffer = io.BytesIO()
    picture().save(buffer, format="PNG")
    parts = [
        np.array(SQUARE, "<f4").tobytes(),
        (np.array(UVS, "<f4") * (1, -1) + (0, 1)).astype("<f4").tobytes(),
        np.array(FACES, "<u2").tobytes(),
        buffer.getvalue(),
    ]
    views = []
    data = b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(part)})
        data += part + b"\0" * (-len(part) % 4)
    accessors = [
        {
            "bufferView": 0,
            "componentType": 5126,
            "count": 4,
            "type": "VEC3",
            "min": [0, 0, -1],
            "max": [0, 1, 0],
        },
        {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
        {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
    ]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [move, 0, 0]}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "TEXCOORD_0": 1},
                        "indices": 2,
                        "material": 0,
                    }
                ]
            }
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    (folder / "m.glb").write_bytes(
        packed(document, struct.pack("<I4s", len(data), b"BIN\0") + data)
    )
    return folder / "m.glb"


def test_textures_are_the_right_way_up(tmp_path: Path) -> None:
    asset = load_mesh(write_glb(tmp_path))
    (mesh,) = asset.meshes
    corners = {
        tuple(np.round(vertex, 5).tolist()): i for i, vertex in enumerate(mesh.vertices)
    }
    # y up becomes z up: (x, y, z) -> (x, -z, y)
    assert set(corners) == {(0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1)}
    # the first texel is at the top, where y is 0
    assert colour_at(asset, corners[0, 0, 1]) == [1, 0, 0]
    assert colour_at(asset, corners[0, 1, 1]) == [0, 1, 0]
    assert colour_at(asset, corners[0, 0, 0]) == [0, 0, 1]
    assert colour_at(asset, corners[0, 1, 0]) == [1, 1, 1]
    assert asset.name == "m"


def test_axes_scale_and_placement(tmp_path: Path) -> None:
    path = write_glb(tmp_path, move=3.0)
    for asset, bounds in (
        (load_mesh(path), [[3, 0, 0], [3, 1, 1]]),
        (load_mesh(path, MeshSettings(scale=2.0)), [[6, 0, 0], [6, 2, 2]]),
        (load_mesh(path, MeshSettings(up="z")), [[3, 0, -1], [3, 1, 0]]),
    ):
        assert np.allclose(asset.bounds, bounds, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("m.obj", b"", "ends in .glb.*let trimesh convert it"),
        ("m.glb", None, "no such file"),
        ("m.glb", b"glTF", r"m\.glb"),
        ("m.glb", b"", r"m\.glb"),
    ],
)
def test_files_that_are_no_mesh(
    name: str, content: bytes | None, says: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(MiSplatError, match=says):
        load_mesh(tmp_path / name)


def broken(kind: str, data: bytes) -> Iterator[bytes]:
    """A file with words, bytes and lines that are changed, cut off or left out."""
    dice = random.Random(kind)
    words = (
        b"99999999999",
        b"-1",
        b"nan",
        b"1e400",
        b"",
        b"null",
        b"[]",
        b"double",
        b"face",
    )
    for number in range(60):
        first, last = dice.choice(
            [one.span() for one in re.finditer(rb"[\w.+-]+", data[:2000])]
        )
        cut = dice.randrange(len(data))
        yield (
            data[:first] + dice.choice(words) + data[last:],
            data[:cut],
            data[:cut] + bytes([dice.randrange(256)]) + data[cut + 1 :],
            b"\n".join(
                line
                for i, line in enumerate(data.split(b"\n"))
                if i != number % (data.count(b"\n") + 1)
            ),
        )[number % 4]


def test_broken_files_are_meshes_or_refused(tmp_path: Path) -> None:
    path = write_glb(tmp_path)
    errors = []
    for mutant in broken(path.suffix, path.read_bytes()):
        path.write_bytes(mutant)
        try:
            load_mesh(path)
        except MiSplatError as error:
            errors.append(str(error))
    assert len(errors) > 10
    assert all(path.name in error for error in errors)


# glTF files whose parts do not fit together are refused in plain words


PRIMITIVE = ("meshes", 0, "primitives", 0)


def parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """The document of a GLB, and what follows it."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[20 + length :]


@pytest.mark.parametrize(
    ("keys", "value", "says"),
    [
        ((*PRIMITIVE, "attributes", "POSITION"), 99, ""),
        ((*PRIMITIVE, "attributes"), {}, ""),
        (("nodes", 0, "mesh"), 7, ""),
        (("accessors", 0, "count"), 4000, ""),
        (
            ("accessors", 0),
            {"componentType": 5126, "type": "VEC3", "count": 10**9},
            "1000000000 zeros",
        ),
        (("bufferViews", 0, "byteLength"), 10**7, ""),
        (("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "index"), 7, ""),
        (("accessors",), "x", ""),
        (("meshes",), [], ""),
        (("scenes", 0, "nodes"), [], "no faces"),
        (("scenes", 0, "nodes"), [0, 0], "node 0 in two places"),
        (("nodes", 0, "children"), [0], "node 0 in two places"),
        (("bufferViews", 0, "byteStride"), 0, "rows that overlap"),
        (("accessors", 0, "sparse"), {"count": 1}, "sparse numbers"),
        (("accessors", 0, "count"), -1, ""),
        (("accessors", 2, "bufferView"), -1, ""),
    ],
    ids=lambda value: ".".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_parts_that_do_not_fit_are_refused(
    keys: tuple[Any, ...], value: object, says: str, tmp_path: Path
) -> None:
    path = write_glb(tmp_path)
    document, rest = parts(path)
    node: Any = document
    for key in keys[:-1]:
        node = node[key]
    node[keys[-1]] = value
    path.write_bytes(packed(document, rest))
    with pytest.raises(MiSplatError, match=rf"m\.glb: expected .*{says}"):
        load_mesh(path)


def test_faces_of_vertices_that_are_not_there(tmp_path: Path) -> None:
    path = write_glb(tmp_path)
    faces = struct.pack("<6H", 0, 1, 2, 0, 2, 3)
    assert faces in path.read_bytes()
    path.write_bytes(
        path.read_bytes().replace(faces, struct.pack("<6H", 60000, 1, 2, 0, 2, 3))
    )
    with pytest.raises(MiSplatError, match="a face with vertex 60000 of 4"):
        load_mesh(path)


def test_a_mesh_far_from_its_origin_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MiSplatError, match="around its origin"):
        load_mesh(write_glb(tmp_path, move=500.0))
