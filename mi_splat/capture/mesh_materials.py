"""What a mesh file says and trimesh leaves out: names of pictures, second texture coordinates, how exact it is.

trimesh reads on in silence where a picture is missing, so the names are read here, and `mesh_colours` compares.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mi_splat.assets.mesh import Floats, skin, to_linear, to_srgb
from mi_splat.io.picture_files import BROKEN, PictureFileError, check_scans

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
    """What a file says of one material."""

    picture: str | None = None  # name of its texture
    factor: NDArray[np.float64] | None = None  # (3,) linear colour that multiplies texture and colours of vertices
    uv_transform: NDArray[np.float64] | None = None  # (3, 3) matrix that acts on texture coordinates first, v down
    options: str = ""  # what the file wants of the texture and is not done, in the file's words


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshFileNotes:
    """What a file says of its materials."""

    data: bytes | None = None  # the file's bytes as trimesh shall read them; None is the file itself
    materials: dict[str, MaterialNotes] = field(default_factory=dict)  # by trimesh's name; "" is that of an only one
    faults: tuple[str, ...] = ()  # what cannot be shown, in words
    float32: bool = False  # whether the file holds coordinates as 32-bit numbers


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


GREY = 0.7
"""sRGB grey of surfaces without any colour."""

_NEARLY_WHITE = 0.995

Report = Callable[[str], None]
"""Takes what cannot be shown, in words."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """One textured surface in the frame of its file, as `mi_splat.assets.mesh.Mesh` but in float64."""

    vertices: NDArray[np.float64]  # (V, 3) float64, units of the file
    faces: NDArray[np.int64]  # (F, 3) indices
    uvs: NDArray[np.float64]  # (V, 2), v up
    texture: Floats  # (h, w, 3) float32 sRGB


def coloured(
    piece: Any, placed: NDArray[np.float64], path: Path, notes: MeshFileNotes, *, fault: Report, remark: Report
) -> Surface:
    """One of trimesh's meshes in the file's frame, with its colours as a texture."""
    vertices = np.asarray(piece.vertices, np.float64) @ placed[:3, :3].T + placed[:3, 3]
    faces = np.asarray(piece.faces, np.int64)
    if np.linalg.det(placed[:3, :3]) < 0:  # a mirror turns every face around
        faces = faces[:, ::-1]
    material = _material(piece)
    name = str(getattr(material, "name", "") or "")
    stated = notes.materials.get(name) or notes.materials.get("") or MaterialNotes()
    linear = path.suffix.lower() in (".glb", ".gltf")  # as that format lays down
    picture = _picture(material, stated, path, fault)
    colours = _corner_colours(piece, faces)
    if picture is not None:
        if colours is not None:
            what = stated.picture or "a texture"
            (fault if linear else remark)(f"{what}: colours of vertices beside it, which are not multiplied with it")
        # An OBJ's picture stands in for its diffuse colour, which exporters often leave at black or grey.
        shown = stated.factor is None
        texture = picture if shown else to_srgb(to_linear(picture) * np.float32(cast("Any", stated.factor)))
        uvs = _texture_coordinates(piece, stated.uv_transform)
        if uvs is not None:
            return Surface(vertices=vertices, faces=faces, uvs=uvs, texture=texture)
        fault(f"{stated.picture or 'a texture'}: no texture coordinates")
        texture = texture.mean((0, 1), keepdims=True)
    elif colours is not None:
        factor = stated.factor if stated.factor is not None else 1.0
        return _baked(vertices, faces, to_srgb(colours * np.float32(factor)) if linear else colours)
    else:
        texture = _plain(material, stated)
    return Surface(vertices=vertices, faces=faces, uvs=np.zeros((len(vertices), 2)), texture=texture)


def _texture_coordinates(piece: Any, transform: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """(V, 2) texture coordinates, v up; None if there are none."""
    uvs = getattr(piece.visual, "uv", None)
    if uvs is None or len(uvs) != len(piece.vertices):
        return None
    uvs = np.asarray(uvs, np.float64)[:, :2]
    if transform is not None:  # which is meant for v down
        down = np.column_stack([uvs[:, 0], 1 - uvs[:, 1], np.ones(len(uvs))]) @ transform.T
        uvs = np.column_stack([down[:, 0], 1 - down[:, 1]])
    return uvs


def _material(piece: Any) -> Any | None:
    """A mesh's material; None if it has none, or the one that trimesh puts in its place."""
    material = piece.visual.material if piece.visual.kind == "texture" else None
    made_up = getattr(material, "image", None)
    return None if made_up is not None and made_up.format is None else material  # read from no file


def _picture(material: Any | None, stated: MaterialNotes, path: Path, fault: Report) -> Floats | None:
    """(h, w, 3) sRGB picture of a material; None if it has none, or none that can be shown."""
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if picture is None:
        if stated.picture is not None:
            exists = stated.picture.startswith("picture ") or beside(path, stated.picture)
            outside = "lies outside of the mesh's folder, where it is not read"
            lost = outside if lies_outside(path, stated.picture) else "no such file"
            unread = "cannot be read as a picture, has too many pixels, or has no coordinates"
            fault(f"{stated.picture} (texture): {unread if exists else lost}")
        return None
    if stated.options:
        fault(f"{stated.picture} (texture): options {stated.options}, which are not followed")
        return None
    try:
        check_scans(picture, stated.picture or "a texture")
        if picture.mode.startswith("I"):  # 16 bits, which Pillow would clip to 8
            grey = np.asarray(picture, np.float32)[..., None] / np.float32(65535)
            return np.repeat(np.clip(grey, 0, 1), 3, axis=2)
        return np.asarray(picture.convert("RGB"), np.float32) / np.float32(255)
    except (PictureFileError, *BROKEN) as error:
        fault(f"{stated.picture or 'a texture'} (texture): {str(error)[:80]}")
        return None


def _plain(material: Any, stated: MaterialNotes) -> Floats:
    """(1, 1, 3) sRGB colour of a material without a picture.

    glTF's colour factors are linear; those of OBJ's material files are taken as sRGB.
    """
    if stated.factor is not None:
        return skin(to_srgb(stated.factor))
    physical = hasattr(material, "baseColorFactor")
    factor = material.baseColorFactor if physical else getattr(material, "diffuse", None)
    if factor is None:
        return skin(GREY)
    values = _unit(np.asarray(factor).ravel()[:3])
    return skin(to_srgb(values) if physical else values)


def _unit(values: NDArray[Any]) -> Floats:
    """Colours in [0, 1] from integers or from floats."""
    scale = float(np.iinfo(values.dtype).max) if values.dtype.kind in "ui" else 1.0
    colours: Floats = np.clip(values.astype(np.float32) / np.float32(scale), 0, 1).astype(np.float32)
    return colours


def _corner_colours(piece: Any, faces: NDArray[np.int64]) -> Floats | None:
    """(F, 3, 3) colour of every corner of every face; None if there are none, or all are white."""
    if piece.visual.kind == "face":
        colours = np.repeat(_unit(np.asarray(piece.visual.face_colors)[:, :3])[:, None], 3, axis=1)
    elif piece.visual.kind == "vertex":
        colours = _unit(np.asarray(piece.visual.vertex_colors)[:, :3])[faces]
    else:  # beside a material
        values = piece.vertex_attributes.get("color")
        if values is None:
            values = dict(getattr(piece.visual, "vertex_attributes", {})).get("color")
        if values is None or np.shape(values)[:1] != (len(piece.vertices),) or np.shape(values)[1] < 3:
            return None
        colours = _unit(np.asarray(values)[:, :3])[faces]
    return None if colours.min(initial=1) >= _NEARLY_WHITE and piece.visual.kind == "texture" else colours


def _baked(vertices: NDArray[np.float64], faces: NDArray[np.int64], colours: Floats) -> Surface:
    """A surface whose faces each have a square of 2 x 2 texels of their own, between whose centres colours blend.

    Over the half of the square that the triangle takes, bilinear interpolation gives what linear interpolation would.
    """
    count = len(faces)
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    a, b, c = (to_linear(colours[:, k]) for k in range(3))
    squares = np.zeros((rows * columns, 2, 2, 3), np.float32)
    squares[:count] = np.stack([np.stack([a, b], 1), np.stack([c, np.clip(b + c - a, 0, 1)], 1)], 1)
    texture = squares.reshape(rows, columns, 2, 2, 3).transpose(0, 2, 1, 3, 4).reshape(2 * rows, 2 * columns, 3)
    row, column = np.divmod(np.arange(count), columns)
    centres = np.stack([2 * column + 0.5, 2 * row + 0.5], -1)[:, None] + np.array([[0, 0], [1, 0], [0, 1]])
    uvs = centres.reshape(-1, 2) / (2 * columns, 2 * rows)
    uvs[:, 1] = 1 - uvs[:, 1]  # a texture's first row lies at v = 1
    corners = vertices[faces].reshape(-1, 3)
    return Surface(vertices=corners, faces=np.arange(3 * count).reshape(-1, 3), uvs=uvs, texture=to_srgb(texture))
