"""What a mesh file says of its materials and trimesh leaves out: names of pictures, second texture coordinates.

trimesh reads on in silence where a picture is missing, so the names are read here, and `mesh_colours` compares.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaterialNotes:
    """What a file says of one material.

    Attributes:
        picture: Name of its texture, None if it has none.
        factor: (3,) linear colour that multiplies the texture and the colours of vertices, None if it is not given.
        uv_transform: (3, 3) matrix that acts on texture coordinates (v down) before they are used; None is none.
    """

    picture: str | None = None
    factor: NDArray[np.float64] | None = None
    uv_transform: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshFileNotes:
    """What a file says of its materials.

    Attributes:
        data: The file's bytes as trimesh shall read them; None is the file itself.
        materials: By the name that trimesh gives them; "" is that of a file with only one.
        faults: What cannot be shown, in words.
    """

    data: bytes | None = None
    materials: dict[str, MaterialNotes] = field(default_factory=dict)
    faults: tuple[str, ...] = ()


def obj_notes(path: Path) -> MeshFileNotes:
    """Of an OBJ file: the pictures that its material file names, and materials that are not to be found."""
    text = path.read_text("utf-8", "replace")
    used = list(dict.fromkeys(re.findall(r"^[ \t]*usemtl[ \t]+(.*\S)", text, re.MULTILINE)))
    libraries = list(dict.fromkeys(re.findall(r"^[ \t]*mtllib[ \t]+(.*\S)", text, re.MULTILINE)))
    materials: dict[str, MaterialNotes] = {}
    faults = []
    for number, name in enumerate(libraries):
        file = beside(path, name)
        if file is None:
            faults.append(f"{name} (material file): no such file")
        elif number > 0:
            faults.append(f"{name} (material file): a second one, which is not read")
        else:
            materials = _mtl_materials(file.read_text("utf-8", "replace"))
    missing = [name for name in used if name not in materials]
    if missing and not faults:
        where = libraries[0] if libraries else "the file, which names no material file"
        faults.append(f"material {', '.join(missing[:5])}: not in {where}")
    return MeshFileNotes(
        materials={name: notes for name, notes in materials.items() if name in used}, faults=tuple(faults)
    )


def _mtl_materials(text: str) -> dict[str, MaterialNotes]:
    """The materials of an MTL file and their pictures."""
    found: dict[str, MaterialNotes] = {}
    name = None
    for line in text.splitlines():
        key, _, rest = line.strip().partition(" ")
        if key.lower() == "newmtl":
            name = " ".join(rest.split())
            found[name] = MaterialNotes()
        elif key.lower() == "map_kd" and name is not None:
            found[name] = MaterialNotes(picture=rest.strip())
    return found


def ply_notes(path: Path) -> MeshFileNotes:
    """Of a PLY file: the picture that a comment of its header names."""
    with path.open("rb") as file:
        header = file.read(1 << 16).partition(b"end_header")[0].decode("utf-8", "replace")
    found = re.search(r"^comment[ \t]+texturefile[ \t]+(.*\S)", header, re.IGNORECASE | re.MULTILINE)
    return MeshFileNotes(materials={"": MaterialNotes(picture=found.group(1) if found else None)})


def beside(path: Path, name: str) -> Path | None:
    """The file that a mesh file names, as trimesh looks for it: under its folder, or by its bare name in it."""
    folder = path.parent.resolve()
    for candidate in (name.strip(), name.strip().lstrip("/"), Path(name.strip()).name):
        file = (folder / candidate).resolve()
        if candidate and file.is_relative_to(folder) and file.is_file():
            return file
    return None
