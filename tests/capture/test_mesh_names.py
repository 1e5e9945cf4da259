"""Names of files and options of textures in OBJ and MTL files, as other programs write them."""

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.settings import MeshSettings
from mi_splat.errors import MiSplatError
from tests.capture.test_mesh_files import write_glb
from tests.capture.trucks import TEXTURE, packed, truck, write_obj

pytest.importorskip("trimesh")


def truck_file(folder: Path, material: str, *, encoding: str = "utf-8", name: str = "paint") -> Path:
    """The truck with a material file of this text; {t} is the name of its texture."""
    path = write_obj(folder, truck())
    path.with_name("truck.mtl").write_bytes(f"newmtl {name}\n{material.format(t=TEXTURE)}\n".encode(encoding))
    path.write_bytes(path.read_text().replace("usemtl paint", f"usemtl {name}").encode(encoding))
    return path


def is_textured(path: Path) -> bool:
    """Whether a file is read with its texture, and without a warning."""
    loaded = load_mesh(path)
    assert loaded.warnings == ()
    return any(mesh.texture.shape[:2] != (1, 1) for mesh in loaded.asset.meshes)


@pytest.mark.parametrize(
    "options", ["-s 2 2 1", "-o 0.5 0", "-t .1 .1 .1", "-mm 0.1 0.9", "-clamp on", "-blendu off -s 2 2 1 -cc off"]
)
def test_options_that_are_not_followed_are_named(options: str, tmp_path: Path) -> None:
    path = truck_file(tmp_path, f"map_Kd {options} {{t}}")
    named = next(word for word in ("-s", "-o", "-t", "-mm", "-clamp") if word in options)
    with pytest.raises(MiSplatError, match=f"{TEXTURE}.*options {named} [^-]*, which are not followed"):
        load_mesh(path)
    loaded = load_mesh(path, MeshSettings(missing_textures="warn"))
    assert "not followed" in loaded.warnings[0]
    assert all(mesh.texture.shape[:2] == (1, 1) for mesh in loaded.asset.meshes)


@pytest.mark.parametrize("options", ["-s 1 1 1", "-o 0 0 0 -s 1.0 1 1", "-blendu on", "-texres 512", "-clamp off"])
def test_options_that_change_nothing_are_skipped(options: str, tmp_path: Path) -> None:
    assert is_textured(truck_file(tmp_path, f"map_Kd {options} {{t}}"))


@pytest.mark.parametrize("where", ["..\\{folder}\\{t}", ".\\{t}", "C:\\pictures\\{t}", "maps\\{t}"])
def test_backslashes_part_folders(where: str, tmp_path: Path) -> None:
    path = truck_file(tmp_path, f"map_Kd {where.format(folder=tmp_path.name, t=TEXTURE)}")
    if where.startswith("maps"):
        (tmp_path / "maps").mkdir()
        path.with_name(TEXTURE).rename(tmp_path / "maps" / TEXTURE)
    assert is_textured(path)


def test_one_file_that_differs_in_case_is_taken(tmp_path: Path) -> None:
    path = truck_file(tmp_path, "map_Kd Maps/{t}")
    (tmp_path / "maps").mkdir()
    upper = path.with_name(TEXTURE).rename(tmp_path / "maps" / TEXTURE.upper())
    path.with_name("truck.mtl").rename(path.with_name("Truck.MTL"))
    assert is_textured(path)
    upper.with_name(TEXTURE.capitalize()).write_bytes(upper.read_bytes())
    if len(list(upper.parent.iterdir())) == 2:  # where the file system tells them apart
        with pytest.raises(MiSplatError, match="no such file"):
            load_mesh(path)


def test_files_in_latin_1_are_read(tmp_path: Path) -> None:
    path = truck_file(tmp_path, "map_Kd größe.png", encoding="latin-1", name="Lack_weiß")
    path.with_name(TEXTURE).rename(tmp_path / "größe.png")
    assert is_textured(path)


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
        (("accessors", 0), {"componentType": 5126, "type": "VEC3", "count": 10**9}, "1000000000 zeros"),
        (("bufferViews", 0, "byteLength"), 10**7, ""),
        (("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "index"), 7, ""),
        (("accessors",), "x", ""),
        (("meshes",), [], "no faces"),
    ],
    ids=lambda value: ".".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_parts_that_do_not_fit_are_refused(keys: tuple[Any, ...], value: object, says: str, tmp_path: Path) -> None:
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
    path.write_bytes(path.read_bytes().replace(faces, struct.pack("<6H", 60000, 1, 2, 0, 2, 3)))
    with pytest.raises(MiSplatError, match="a face with vertex 60000 of 4"):
        load_mesh(path)
