"""Splats, scenes, points, images, masks and meshes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from attacks.cloak.kinds.pictures import read_pictures
from mi_splat.audit.linting import lint_file
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.datasets.frames import read_picture
from mi_splat.io.points import load_points
from mi_splat.io.splat_files import SUFFIXES, load_splat
from mi_splat.render.scene_files import open_scene, read_scene
from mi_splat.selection.select import load_mask, save_mask
from tests.campaign.kind import Kind, Make, copied, written
from tests.campaign.mutations import (
    GLB,
    GZIP,
    member_json,
    zipped,
)
from tests.capture.trucks import truck, write_glb
from tests.io.format_files import tame_scene, valid
from tests.io.ply_files import (
    BODY,
    FACE,
    HEAD,
    LINE,
    LISTS,
    ROWS,
    TEXT_HEAD,
    encoded,
    listed,
    with_elements,
)
from tests.io.test_picture_files import many_scans

# Splats


PLY = {
    "a.ply": HEAD + BODY,
    "faces.ply": with_elements(FACE, b"\0\0"),
    "text.ply": TEXT_HEAD + LINE * 40,
    "lists.ply": listed("binary_little_endian", ROWS[:5], LISTS[:5]),
    "lists_in_text.ply": listed("ascii", ROWS[:5], LISTS[:5]),
}
_SPLAT_READERS = (
    "mi_splat.io.splat_files:load_splat",
    "mi_splat.io.splat_files:load_stored",
)
_FORMAT_READERS: dict[str, tuple[str, ...]] = {
    ".compressed.ply": ("mi_splat.io.formats.compressed_ply:read_compressed_ply",),
    ".ply": (
        "mi_splat.io.formats.gaussian_ply:read_ply",
        "mi_splat.io.ply:read_header",
    ),
    ".glb": (
        "mi_splat.io.formats.gltf:read_glb",
        "mi_splat.io.formats.gltf:open_glb",
        "mi_splat.io.parsing:parse",
    ),
    ".sog": (
        "mi_splat.io.formats.sog:read_sog",
        "mi_splat.io.formats.sog:read_picture",
    ),
    ".splat": (
        "mi_splat.io.formats.splat32:read_splat",
        "mi_splat.io.loaded:read_whole",
    ),
    ".spz": ("mi_splat.io.formats.spz:read_spz", "mi_splat.io.loaded:read_whole"),
    **dict.fromkeys((".usdc", ".usda", ".usdz"), ("mi_splat.io.formats.usd:read_usd",)),
}
_LINT = ("mi_splat.audit.linting:lint_file",)
_DOCUMENTS = {".glb": GLB, ".sog": member_json("meta.json")}
_PACKED = {"v2.spz": GZIP, "v3.spz": GZIP}


def _splat_bytes(name: str) -> bytes:
    if name in PLY:
        return PLY[name]
    return valid(name)


def _read_splat(path: Path) -> None:
    load_splat(path, on_invalid="drop")
    lint_file(path)


def splats() -> Iterator[Kind]:
    names = [
        *PLY,
        "a.compressed.ply",
        "a.glb",
        "a.sog",
        "a.splat",
        "v2.spz",
        "v3.spz",
        "v4.spz",
    ]
    names += ["a.usdc", "a.usda", "a.usdz"]
    for name in names:
        suffix = max((end for end in SUFFIXES if name.endswith(end)), key=len)
        is_usd = suffix.startswith(".usd")
        yield Kind(
            name=f"splat {name}",
            make=written(name, partial(_splat_bytes, name)),
            # A process of its own reads OpenUSD, so that one reading is enough.
            read=load_splat if is_usd else _read_splat,
            readers=(
                *_SPLAT_READERS,
                *_FORMAT_READERS[suffix],
                *(() if is_usd else _LINT),
            ),
            document=_DOCUMENTS.get(suffix),
            packing=_PACKED.get(name),
            starts=is_usd,
        )
    yield Kind(
        name="splat in a .zip",
        make=written(
            "a.zip", lambda: zipped({"notes.txt": b"hi", "folder/a.ply": PLY["a.ply"]})
        ),
        read=load_splat,
        readers=(*_SPLAT_READERS, "mi_splat.io.archives"),
    )


# Scenes


_SCENE = [
    f"scenes/stop_sign{part}"
    for part in (".xml", ".json", "_roadside.ply", "_stop_sign.ply")
]
_MESHES = """<scene version="3.0.0">
  <sensor type="perspective"><film type="hdrfilm">
    <integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
  <shape type="ply"><string name="filename" value="mesh.ply"/></shape>
  <shape type="obj"><string name="filename" value="mesh.obj"/></shape>
  <shape type="serialized"><string name="filename" value="mesh.serialized"/></shape>
</scene>"""
_TRIANGLE = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float"
    b" y\nproperty float z\nelement face 1\nproperty list uchar int"
    b" vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
_OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def _serialized() -> bytes:
    """A mesh of three vertices as Mitsuba packs it."""
    import struct
    import zlib

    flags = struct.pack("<I", 0x1000)  # float32
    counts = struct.pack("<QQ", 3, 1)
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
    faces = np.array([0, 1, 2], np.uint32).tobytes()
    content = zlib.compress(flags + b"mesh\0" + counts + points + faces)
    start = struct.pack("<HH", 0x041C, 4)
    return start + content + struct.pack("<QI", 0, 1)


def _mesh_scene(damaged: str) -> Make:
    def make(folder: Path) -> Path:
        (folder / "scene.xml").write_text(_MESHES)
        contents = {
            "mesh.ply": _TRIANGLE,
            "mesh.obj": _OBJ,
            "mesh.serialized": _serialized(),
        }
        for name, data in contents.items():
            (folder / name).write_bytes(data)
        return folder / damaged

    return make


def _read_meshes(path: Path) -> None:
    from mi_splat.capture.path_tracer import FEW_PICTURES, load_scene, tracing_variant

    with tracing_variant(FEW_PICTURES):
        load_scene(path.parent / "scene.xml")


def scenes() -> Iterator[Kind]:
    readers = (
        "mi_splat.render.scene_files:open_scene",
        "mi_splat.render.scene_files:load_mitsuba_scene",
        "mi_splat.io.scene_parts",
    )
    yield Kind(name="scene XML", make=copied(*_SCENE), read=open_scene, readers=readers)
    yield Kind(
        name="scene splat",
        make=_scene_splat,
        read=lambda path: read_scene(_xml_beside(path)),
        readers=("mi_splat.render.scene_files:read_scene",),
    )
    meshes = ("mi_splat.capture.path_tracer:load_scene", "mi_splat.io.mesh_sizes")
    for name in ("scene.xml", "mesh.ply", "mesh.obj", "mesh.serialized"):
        yield Kind(
            name=f"mesh scene {name}",
            make=_mesh_scene(name),
            read=_read_meshes,
            readers=meshes,
        )


def _scene_splat(folder: Path) -> Path:
    copied(*_SCENE)(folder)
    return folder / "stop_sign_stop_sign.ply"


def _xml_beside(path: Path) -> Path:
    return path.with_name("stop_sign.xml")


# Points, images, masks, meshes


def _points(folder: Path) -> Path:
    (folder / "points.ply").write_bytes(encoded(ROWS[:5], "binary_little_endian"))
    return folder / "points.ply"


def picture(name: str, folder: Path) -> Path:
    pixels = np.arange(16 * 12 * 3, dtype=np.uint8).reshape(12, 16, 3)
    Image.fromarray(pixels).save(folder / name)
    return folder / name


def _read_picture(path: Path) -> None:
    read_picture(path, downscale=1, background=(0.0, 0.0, 0.0))


def _mask(folder: Path) -> Path:
    save_mask(torch.arange(20) % 3 == 0, folder / "m.npy")
    return folder / "m.npy"


def _kept_pictures(folder: Path) -> Path:
    Image.fromarray(np.zeros((12, 16, 4), np.uint8)).save(folder / "0.png")
    return folder / "0.png"


def _truck(folder: Path) -> Path:
    write_glb(folder, truck())
    return folder / "truck.glb"


def values() -> Iterator[Kind]:
    points = ("mi_splat.io.points:load_points",)
    yield Kind(name="points points.ply", make=_points, read=load_points, readers=points)
    readers = (
        "mi_splat.datasets.frames:read_picture",
        "mi_splat.io.picture_files:load_picture",
    )
    for name in ("p.png", "p.jpg", "p.webp", "p.bmp", "p.tif"):
        yield Kind(
            name=f"image {name}",
            make=partial(picture, name),
            read=_read_picture,
            readers=readers,
        )
    scans = written("p.jpg", lambda: many_scans(90))
    yield Kind(
        name="image of JPEG scans", make=scans, read=_read_picture, readers=readers
    )
    yield Kind(
        name="mask m.npy",
        make=_mask,
        read=lambda path: load_mask(path, tame_scene(20, 1)),
        readers=(
            "mi_splat.selection.select:load_mask",
            "mi_splat.selection.select:load_array",
        ),
    )
    yield Kind(
        name="image of a job",
        make=_kept_pictures,
        read=lambda path: read_pictures(path.parent),
        readers=("attacks.cloak.kinds.pictures:read_pictures",),
    )
    mesh = ("mi_splat.capture.mesh_files:load_mesh", "mi_splat.capture.gltf")
    yield Kind(
        name="mesh truck.glb", make=_truck, read=load_mesh, readers=mesh, document=GLB
    )
