"""Names of files and options of textures in OBJ and MTL files, as other programs write them."""

from __future__ import annotations

from pathlib import Path

import pytest

from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.settings import MeshSettings
from mi_splat.errors import MiSplatError
from tests.capture.trucks import TEXTURE, truck, write_obj

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
