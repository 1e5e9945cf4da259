"""What a mesh file says and trimesh leaves out: names of pictures, second texture coordinates, how exact it is.

trimesh reads on in silence where a picture is missing, so the names are read here, and `mesh_colours` compares.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_OPTION = re.compile(
    rf"(?:-(?:[ost](?:[ \t]+{_NUMBER.pattern}){{1,3}}|mm(?:[ \t]+{_NUMBER.pattern}){{2}}"
    r"|(?:blendu|blendv|cc|clamp|texres|bm|boost|imfchan|type)[ \t]+\S+))[ \t]+(?=\S)",
    re.IGNORECASE,
)
_USUAL: dict[str, tuple[object, ...]] = {
    **{"-s": (1.0, 1.0, 1.0), "-o": (0.0, 0.0, 0.0), "-t": (0.0, 0.0, 0.0), "-mm": (0.0, 1.0)},
    **{"-clamp": ("off",), "-cc": ("off",), "-type": ()},
}
"""Values of the options of a texture in an MTL file at which they change nothing; others change none of ours."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaterialNotes:
    """What a file says of one material.

    Attributes:
        picture: Name of its texture, None if it has none.
        factor: (3,) linear colour that multiplies the texture and the colours of vertices, None if it is not given.
        uv_transform: (3, 3) matrix that acts on texture coordinates (v down) before they are used; None is none.
        options: What the file wants of the texture and is not done, in the file's words; "" if there is nothing.
    """

    picture: str | None = None
    factor: NDArray[np.float64] | None = None
    uv_transform: NDArray[np.float64] | None = None
    options: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshFileNotes:
    """What a file says of its materials.

    Attributes:
        data: The file's bytes as trimesh shall read them; None is the file itself.
        materials: By the name that trimesh gives them; "" is that of a file with only one.
        faults: What cannot be shown, in words.
        float32: Whether the file holds coordinates as 32-bit numbers.
    """

    data: bytes | None = None
    materials: dict[str, MaterialNotes] = field(default_factory=dict)
    faults: tuple[str, ...] = ()
    float32: bool = False


def obj_notes(path: Path) -> MeshFileNotes:
    """Pictures that the material file of an OBJ file names, and materials that are not to be found."""
    text = _text(path)
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
            materials = _mtl_materials(_text(file))
    missing = [name for name in used if name not in materials]
    if missing and not faults:
        where = libraries[0] if libraries else "the file, which names no material file"
        faults.append(f"material {', '.join(missing[:5])}: not in {where}")
    shown = {name: notes for name, notes in materials.items() if name in used}
    return MeshFileNotes(data=text.encode(), materials=shown, faults=tuple(faults))


def _text(path: Path) -> str:
    """The text of an OBJ or MTL file: UTF-8, or Latin-1 where it is not, as older programs write."""
    data = path.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _mtl_materials(text: str) -> dict[str, MaterialNotes]:
    """The materials of an MTL file and their pictures."""
    materials: dict[str, MaterialNotes] = {}
    name = None
    for line in text.splitlines():
        key, rest = (*line.split(None, 1), "", "")[:2]
        if key.lower() == "newmtl":
            name = " ".join(rest.split())
            materials[name] = MaterialNotes()
        elif key.lower() == "map_kd" and name is not None:
            options, picture = _texture_options(rest.strip())
            materials[name] = MaterialNotes(picture=picture, options=options)
    return materials


def _texture_options(rest: str) -> tuple[str, str]:
    """Options behind `map_Kd` that change the picture, in the file's words, and the name of the picture."""
    asked = []
    while match := _OPTION.match(rest):
        rest = rest[match.end() :]
        tokens = match.group().split()
        numbers = [float(word) for word in tokens[1:] if _NUMBER.fullmatch(word)]
        usual = _USUAL.get(tokens[0].lower())
        if usual is not None and (tuple(numbers) != usual[: len(numbers)] if numbers else tokens[1] not in usual):
            asked.append(" ".join(tokens))
    return ", ".join(asked), rest


def ply_notes(path: Path) -> MeshFileNotes:
    """The picture that a comment in the header of a PLY file names, and how exact its coordinates are."""
    with path.open("rb") as file:
        header = file.read(1 << 16).partition(b"end_header")[0].decode("utf-8", "replace")
    match = re.search(r"^comment[ \t]+texturefile[ \t]+(.*\S)", header, re.IGNORECASE | re.MULTILINE)
    materials = {"": MaterialNotes(picture=match.group(1) if match else None)}
    exact = re.search(r"^property[ \t]+(?:double|float64)[ \t]+x\b", header, re.MULTILINE)
    return MeshFileNotes(materials=materials, float32=exact is None)


def beside(path: Path, name: str) -> Path | None:
    """The file that a mesh file names: under its folder, or by its bare name in it.

    Backslashes may stand for slashes, and letters may differ in case if one file alone is meant.
    """
    folder = path.parent.resolve()
    given = name.strip()
    slashed = given.replace("\\", "/")
    names = dict.fromkeys((given, *(form for text in (given, slashed) for form in (text, text.lstrip("/")))))
    names |= dict.fromkeys((PurePosixPath(given).name, PurePosixPath(slashed).name))
    for find in (Path.joinpath, _but_for_case):
        for candidate in filter(None, names):
            file = find(folder, candidate).resolve()
            if file.is_relative_to(folder) and file.is_file():
                return file
    return None


def lies_outside(path: Path, name: str) -> bool:
    """Whether a file that a mesh file names is there, but not under its folder."""
    return any((path.parent / text).is_file() for text in (name, name.replace("\\", "/")))


def _but_for_case(folder: Path, name: str) -> Path:
    """The path under a folder whose letters differ from a name in case alone; the name's own if not exactly one."""
    path = folder
    for part in PurePosixPath(name).parts:
        candidates = [path / part]
        if part != ".." and not candidates[0].exists() and path.is_dir() and path.resolve().is_relative_to(folder):
            candidates = [file for file in path.iterdir() if file.name.casefold() == part.casefold()]
        if len(candidates) != 1:
            return folder / name
        path = candidates[0]
    return path


def resolver(path: Path) -> Any:
    """What trimesh asks for the files that a mesh file names; needs trimesh."""
    from trimesh.resolvers import FilePathResolver

    class Beside(FilePathResolver):  # type: ignore[misc]  # trimesh may not be installed
        """Finds files as `beside` does, whatever the options before their names."""

        def get(self, name: str) -> bytes:
            """The bytes of a file; of a material file in UTF-8."""
            file = beside(path, name) or beside(path, _texture_options(name)[1])
            if file is None:
                raise FileNotFoundError(f"{name}: no such file in {path.parent}")
            return _text(file).encode() if file.suffix.lower() == ".mtl" else file.read_bytes()

    return Beside(str(path))
