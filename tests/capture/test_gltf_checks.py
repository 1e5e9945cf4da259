"""glTF files whose parts do not fit together are refused in plain words."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from mi_splat.capture.mesh_files import load_mesh
from mi_splat.errors import MiSplatError
from tests.capture.test_mesh_files import write_glb

pytest.importorskip("trimesh")

PRIMITIVE = ("meshes", 0, "primitives", 0)


def parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """The document of a GLB, and what follows it."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[20 + length :]


def write(path: Path, document: object, rest: bytes) -> None:
    """A GLB of a document and what follows it."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    path.write_bytes(head + text + rest)


@pytest.mark.parametrize(
    ("keys", "value", "says"),
    [
        ((*PRIMITIVE, "attributes", "POSITION"), 99, r"mesh 0 \(POSITION\) that names number 99 of 3 accessors"),
        ((*PRIMITIVE, "indices"), 99, "names number 99 of 3 accessors"),
        ((*PRIMITIVE, "material"), 99, "names number 99 of 1 materials"),
        ((*PRIMITIVE, "attributes"), {}, "without places of its vertices"),
        (("nodes", 0, "mesh"), 7, "names number 7 of 1 meshes"),
        (("scenes", 0, "nodes"), [7], "names number 7 of 1 nodes"),
        (("accessors", 0, "bufferView"), 9, "names number 9 of 4 bufferViews"),
        (("accessors", 0, "count"), 4000, "accessor 0 of 48000 bytes in a view of 48"),
        (("accessors", 0, "componentType"), 7, "component type 7"),
        (
            ("accessors", 0),
            {"componentType": 5126, "type": "VEC3", "count": 10**9},
            "accessor 0 of 1000000000 zeros, which no view holds",
        ),
        (("bufferViews", 0, "byteLength"), 10**7, "ends at byte 10000000 of a buffer of"),
        (("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "index"), 7, "names number 7 of 1 textures"),
        (("accessors",), "x", "accessors that are no list"),
        (("meshes",), [], "no meshes"),
    ],
    ids=lambda value: ".".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_parts_that_do_not_fit_are_named(keys: tuple[Any, ...], value: object, says: str, tmp_path: Path) -> None:
    path = write_glb(tmp_path)
    document, rest = parts(path)
    place: Any = document
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    write(path, document, rest)
    with pytest.raises(MiSplatError, match=rf"m\.glb: expected .*{says}"):
        load_mesh(path)


def test_files_that_are_cut_off_or_empty(tmp_path: Path) -> None:
    path = write_glb(tmp_path)
    whole = path.read_bytes()
    for data, says in ((b"", "an empty file"), (whole[:12], "12 bytes, too short"), (whole[:200], "cut off")):
        path.write_bytes(data)
        with pytest.raises(MiSplatError, match=says):
            load_mesh(path)


def test_faces_of_vertices_that_are_not_there(tmp_path: Path) -> None:
    path = write_glb(tmp_path)
    faces = struct.pack("<6H", 0, 1, 2, 0, 2, 3)
    assert faces in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(faces, struct.pack("<6H", 60000, 1, 2, 0, 2, 3)))
    with pytest.raises(MiSplatError, match="a face with vertex 60000 of 4"):
        load_mesh(path)
