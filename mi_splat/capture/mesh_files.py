"""Mesh files (GLB) as objects, with the textures and colours of their materials.

What would come out in other colours than in the program that wrote it is refused.
Beyond plain glTF a file may say three things: a clear coat (KHR_materials_clearcoat)
is a gloss of its roughness, a primitive with `"flat": true` among its extras has no
smooth shading, and a texture may hold its floats to the bit (`FLOATS`).
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from mi_splat.capture.gltf import (
    DRACO,
    FAN,
    FLOAT,
    READER,
    Glb,
    MeshFileError,
    Part,
)
from mi_splat.capture.mesh import (
    Asset,
    Doubles,
    Floats,
    Mesh,
    skin,
    to_linear,
    to_srgb,
)
from mi_splat.capture.objects import SUFFIX
from mi_splat.capture.settings import MeshSettings
from mi_splat.errors import MiSplatError
from mi_splat.io.picture_files import load_picture
from mi_splat.maths.orientation import turn_of

GREY = 0.7
"""sRGB grey of surfaces without a material."""
FARTHEST = 10.0
"""Largest coordinate of a mesh's middle, in radii: rays then start at most a thousandth
of the radius off a surface."""
MOST_TRIANGLES = 1 << 24
"""Triangles that a file may place in all: its nodes may place one mesh often."""
MOST_PIXELS = 1 << 28
"""Pixels of all textures of a file, each of which has at most those of an image."""
COAT = "KHR_materials_clearcoat"
FLOATS = "MISPLAT_texture_floats"
"""Extension of a texture that names an image with its floats, see `floats_of`."""

_WEBP = "EXT_texture_webp"
_READ = {_WEBP, "KHR_lights_punctual", FLOATS}
_UNPACKED = {DRACO, "EXT_meshopt_compression", "KHR_mesh_quantization"}
"""What glTF Transform's command takes out of a file."""
_OLD = "KHR_materials_pbrSpecularGlossiness"
_MOVED = "KHR_texture_transform"
_UNPACK = "unpack it: npx @gltf-transform/cli dequantize "


@np.errstate(all="ignore")  # numbers that are not finite are refused where they end up
def load_mesh(path: Path, settings: MeshSettings | None = None) -> Asset:
    """All meshes of a file as one object, with z up, metres."""
    settings = settings or MeshSettings()
    name = str(path)
    if path.suffix.lower() != SUFFIX:
        expected = f"a file that ends in {SUFFIX}"
        do = "let trimesh convert it: trimesh.load_scene('mesh.obj').export('mesh.glb')"
        raise MeshFileError.of(name, expected, path.suffix, do)
    if not path.is_file():
        raise MeshFileError.of(name, "a mesh file", "no such file", "check the path")
    glb = Glb.read(path)
    quarter_turn = np.rint(turn_of(settings.up or "y"))  # without what cosines leave
    to_metres = settings.scale * quarter_turn
    try:
        _check_extensions(glb.document, path)
        _check_surfaces(glb.document, path)
        meshes = tuple(_meshes(glb, to_metres))
    except MeshFileError:
        raise
    except MiSplatError as error:
        expected = "faces and colours that can be shown"
        raise MeshFileError.of(name, expected, error, "repair it") from error
    except Exception as error:  # of parts of other kinds than those of glTF
        got = str(error)
        if not isinstance(error, ValueError):
            got = f"{type(error).__name__}: {error}"
        expected = "a glTF file whose parts fit together"
        raise READER.broken(name, got[:160], expected) from error
    if not meshes:
        do = "export the surface, not only the points"
        raise MeshFileError.of(name, "a mesh with faces", "no faces", do)
    asset = Asset(path.stem, meshes)
    low, high = asset.bounds.astype(np.float64)
    if np.abs(low + high).max() > FARTHEST * np.linalg.norm(high - low):
        got = f"one at {((low + high) / 2).tolist()}"
        raise MeshFileError.of(name, "a mesh around its origin", got, "move it there")
    return asset


def _check_extensions(document: dict[str, Any], path: Path) -> None:
    """Raise where a file needs what is not read, or another file."""
    read = set(_READ)
    if find_spec("DracoPy"):
        read.add(DRACO)
    unread = [
        name
        for name in document.get("extensionsRequired", [])
        if name not in read and not name.startswith("KHR_materials_")
    ]
    if unread:
        do = "export it without"
        if set(unread) <= _UNPACKED:
            target = path.with_stem(f"{path.stem}-unpacked")
            do = _UNPACK + shlex.join([str(path), str(target)])
        expected = "a glTF file without extensions that change the mesh"
        raise MeshFileError.of(str(path), expected, unread[0], do)
    for entry in (*document.get("images", []), *document.get("buffers", [])):
        uri = entry.get("uri", "data:")
        if not uri.startswith("data:"):
            expected = "a file that holds its textures itself"
            do = "pack it: npx @gltf-transform/cli copy IN.gltf OUT.glb"
            raise MeshFileError.of(str(path), expected, f"{uri!r:.60}", do)


def _check_surfaces(document: dict[str, Any], path: Path) -> None:
    """Raise where a surface cannot be shown as it is."""
    for material in document.get("materials", []):
        if _OLD in material.get("extensions", {}):
            expected = "metallic-roughness materials"
            do = "convert it: npx @gltf-transform/cli metalrough IN.glb OUT.glb"
            raise MeshFileError.of(str(path), expected, _OLD, do)
    for mesh in document.get("meshes", []):
        for primitive in mesh["primitives"]:
            _check_primitive(document, primitive, path)


def _check_primitive(document: dict[str, Any], primitive: Part, path: Path) -> None:
    attributes = primitive["attributes"]
    if primitive.get("mode") == FAN:
        expected = "triangles, or strips of them"
        raise MeshFileError.of(str(path), expected, "a fan", "export triangles")
    if "COLOR_0" in attributes:
        expected = "colours in textures and materials"
        do = "bake them into a texture"
        raise MeshFileError.of(str(path), expected, "colours of vertices", do)
    if "material" not in primitive:
        return
    texture = _base_texture(document["materials"][primitive["material"]])
    if texture is None:
        return
    coordinates = document["accessors"][attributes["TEXCOORD_0"]]
    is_moved = texture.get("texCoord", 0) or _MOVED in texture.get("extensions", {})
    if is_moved or coordinates["componentType"] != FLOAT:
        expected = "the first texture coordinates (TEXCOORD_0), of floats"
        got = "others, transformed ones or integers"
        do = "bake its textures with one set of coordinates"
        raise MeshFileError.of(str(path), expected, got, do)


def _base_texture(material: Part) -> Part | None:
    """The reference to the texture of a material's base colour."""
    surface = material.get("pbrMetallicRoughness", {})
    texture: Part | None = surface.get("baseColorTexture")
    return texture


@dataclass(slots=True, eq=False)
class _Textures:
    """The textures of a file, each decoded once."""

    glb: Glb
    pixels: int = 0
    decoded: dict[int, Floats] = field(default_factory=dict)

    def numbered(self, index: int) -> Floats:
        """(h, w, 3) sRGB of a texture."""
        if index not in self.decoded:
            entry = self.glb.document["textures"][index]
            self.decoded[index] = self.counted(_texture(self.glb, entry))
        return self.decoded[index]

    def counted(self, texture: Floats) -> Floats:
        """A texture, whose pixels are added to those of all."""
        height, width = texture.shape[:2]
        self.pixels += height * width
        if self.pixels > MOST_PIXELS:
            raise ValueError(f"textures of more than {MOST_PIXELS:,} pixels")
        return texture


@dataclass(frozen=True, eq=False)
class Material:
    """What a file says of a surface."""

    textures: _Textures
    entry: Part = field(default_factory=dict)

    @cached_property
    def texture(self) -> Floats:
        """(h, w, 3) sRGB of the base colour; (1, 1, 3) of a plain one."""
        surface = self.entry.get("pbrMetallicRoughness", {})
        factor = surface.get("baseColorFactor")
        if factor is not None:
            factor = np.clip(np.asarray(factor[:3], np.float64), 0, 1)
        reference = _base_texture(self.entry)
        if reference is None:
            return skin(GREY if factor is None else to_srgb(factor))
        texture = self.textures.numbered(reference["index"])
        if factor is None:
            return texture
        product = to_linear(texture) * np.float32(factor)
        return self.textures.counted(to_srgb(product))

    @cached_property
    def roughness(self) -> float | None:
        """Roughness of a clear coat, as microfacet models have it; None without one."""
        coat = self.entry.get("extensions", {}).get(COAT, {})
        if not coat.get("clearcoatFactor", 0):
            return None
        perceived = coat.get("clearcoatRoughnessFactor", 0.0)
        return float(np.clip(round(perceived**2, 9), 1e-3, 1.0))


def _meshes(glb: Glb, to_metres: Doubles) -> Iterator[Mesh]:
    """The meshes of a file, each placed in it and turned."""
    textures = _Textures(glb)
    entries = glb.document.get("materials", [])
    materials = [Material(textures, entry) for entry in entries]
    triangles = 0
    for primitive, placed in glb.placed():
        geometry = glb.geometry(primitive)
        faces = geometry.faces
        if not len(faces):
            continue
        triangles += len(faces)
        if triangles > MOST_TRIANGLES:
            raise ValueError(f"more than {MOST_TRIANGLES:,} triangles")
        count = len(geometry.positions)
        if int(faces.max()) >= count:
            raise ValueError(f"a face with vertex {int(faces.max())} of {count}")
        if np.linalg.det(placed[:3, :3]) < 0:  # a mirror turns every face around
            faces = faces[:, ::-1]
        in_file = geometry.positions.astype(np.float64) @ placed[:3, :3].T
        vertices = (in_file + placed[:3, 3]) @ to_metres.T
        material = Material(textures)
        if "material" in primitive:
            material = materials[primitive["material"]]
        uvs = np.zeros((count, 2), np.float32)
        if geometry.uvs is not None and _base_texture(material.entry) is not None:
            uvs = geometry.uvs.astype(np.float32)
            uvs[:, 1] = 1 - uvs[:, 1]  # to v up
        is_flat = primitive.get("extras", {}).get("flat", False)
        yield Mesh(
            vertices.astype(np.float32),
            faces.astype(np.uint32),
            uvs,
            material.texture,
            material.roughness,
            smooth=not is_flat,
        )


def _texture(glb: Glb, texture: Part) -> Floats:
    """(h, w, 3) sRGB of a texture."""
    extensions = texture.get("extensions", {})
    if FLOATS in extensions:
        return floats_of(glb.image(extensions[FLOATS]["source"]))
    source = extensions.get(_WEBP, texture).get("source")
    if source is None:
        raise ValueError("a texture that cannot be read as an image")
    return image_floats(glb.image(source))


def image_floats(image: Path | bytes) -> Floats:
    """(h, w, 3) sRGB of an encoded image."""
    what = "a texture" if isinstance(image, bytes) else str(image)
    picture = load_picture(image, what)
    if picture.mode.startswith("I"):  # 16 bits, which Pillow would clip to 8
        grey = np.asarray(picture, np.float32)[..., None] / np.float32(65535)
        return np.repeat(np.clip(grey, 0, 1), 3, axis=2)
    return np.asarray(picture.convert("RGB"), np.float32) / np.float32(255)


def floats_of(image: bytes) -> Floats:
    """(h, w, 3) float32 of a grey image of 4 h rows of 3 w pixels: the highest bytes of
    all numbers, then the next ones, and so on.
    """
    pixels = np.asarray(load_picture(image, "a texture").convert("L"))
    rows, columns = pixels.shape
    planes = pixels.reshape(4, rows // 4, columns // 3, 3)
    numbers = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view(">f4")
    return np.clip(numbers[..., 0].astype(np.float32), 0, 1)
