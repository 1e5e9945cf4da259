"""An object as a GLB file: the same bytes for the same object."""

import io
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mi_splat.capture.gltf import packed
from mi_splat.capture.mesh import Asset, Floats, Mesh
from mi_splat.capture.mesh_files import COAT, FLOATS
from mi_splat.maths import srgb

Entry = dict[str, Any]

_COMPONENTS = {"float32": 5126, "uint16": 5123, "uint32": 5125}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
_PLAIN = (1, 1)
"""Size of the texture of a plain colour."""
_SHORT = 1 << 16
"""Vertices that indices of 16 bits can count."""


def glb_of(asset: Asset, *, exact: bool = True) -> bytes:
    """The file of an object; with `exact`, textures keep their floats to the bit,
    beside the 8 bits that other programs show.
    """
    writer = _Writer(exact=exact)
    primitives = [writer.primitive(mesh) for mesh in asset.meshes]
    document = {
        "asset": {"version": "2.0", "generator": "mi-splat"},
        "extensionsUsed": sorted(writer.extensions),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": asset.name}],
        "meshes": [{"primitives": primitives}],
        "materials": writer.materials,
        "textures": writer.textures,
        "images": writer.images,
        "accessors": writer.accessors,
        "bufferViews": writer.views,
        "buffers": [{"byteLength": len(writer.binary)}],
    }
    # glTF has no empty lists
    filled = {key: value for key, value in document.items() if value != []}
    return packed(filled, bytes(writer.binary))


@dataclass
class _Writer:
    """The parts of a file, each once."""

    exact: bool
    binary: bytearray = field(default_factory=bytearray)
    views: list[Entry] = field(default_factory=list)
    accessors: list[Entry] = field(default_factory=list)
    images: list[Entry] = field(default_factory=list)
    textures: list[Entry] = field(default_factory=list)
    materials: list[Entry] = field(default_factory=list)
    extensions: set[str] = field(default_factory=set)
    known: dict[tuple[Any, ...], int] = field(default_factory=dict)

    def primitive(self, mesh: Mesh) -> Entry:
        """A mesh, y up."""
        y_up = mesh.vertices[:, [0, 2, 1]]
        y_up[:, 2] *= -1
        attributes = {"POSITION": self._positions(y_up)}
        if mesh.texture.shape[:2] != _PLAIN:
            v_down = mesh.uvs.copy()
            v_down[:, 1] = 1 - v_down[:, 1]
            attributes["TEXCOORD_0"] = self._accessor(v_down)
        width = np.uint16 if len(mesh.vertices) < _SHORT else np.uint32
        indices = mesh.faces.reshape(-1, 1).astype(width)
        entry: Entry = {
            "attributes": attributes,
            "indices": self._accessor(indices),
            "material": self._material(mesh),
        }
        if not mesh.smooth:
            entry["extras"] = {"flat": True}
        return entry

    def _material(self, mesh: Mesh) -> int:
        pixels = mesh.texture
        key = ("material", pixels.shape, pixels.tobytes(), mesh.roughness)
        if key not in self.known:
            self.known[key] = len(self.materials)
            self.materials.append(self._new_material(mesh))
        return self.known[key]

    def _new_material(self, mesh: Mesh) -> Entry:
        surface: Entry = {"metallicFactor": 0.0}
        if mesh.texture.shape[:2] == _PLAIN:
            colour = mesh.texture.astype(np.float64).ravel()
            surface["baseColorFactor"] = [*srgb.to_linear(colour).tolist(), 1.0]
        else:
            surface["baseColorTexture"] = {"index": self._texture(mesh.texture)}
        material: Entry = {"pbrMetallicRoughness": surface}
        if mesh.roughness is not None:
            perceived = mesh.roughness**0.5
            coat = {"clearcoatFactor": 1.0, "clearcoatRoughnessFactor": perceived}
            material["extensions"] = {COAT: coat}
            self.extensions.add(COAT)
        return material

    def _texture(self, texture: Floats) -> int:
        key = ("texture", texture.shape, texture.tobytes())
        if key in self.known:
            return self.known[key]
        eight_bits = np.round(texture * 255).astype(np.uint8)
        entry: Entry = {"source": self._image(eight_bits)}
        if self.exact:
            floats = {"source": self._image(bytes_of_floats(texture))}
            entry["extensions"] = {FLOATS: floats}
            self.extensions.add(FLOATS)
        self.known[key] = len(self.textures)
        self.textures.append(entry)
        return self.known[key]

    def _image(self, pixels: NDArray[np.uint8]) -> int:
        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
        view = self._view(buffer.getvalue())
        self.images.append({"bufferView": view, "mimeType": "image/png"})
        return len(self.images) - 1

    def _positions(self, points: Floats) -> int:
        index = self._accessor(points)
        self.accessors[index]["min"] = points.min(0).tolist()
        self.accessors[index]["max"] = points.max(0).tolist()
        return index

    def _accessor(self, values: NDArray[Any]) -> int:
        entry = {
            "bufferView": self._view(values.tobytes()),
            "componentType": _COMPONENTS[values.dtype.name],
            "count": len(values),
            "type": _TYPES[values.shape[1]],
        }
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def _view(self, data: bytes) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        entry = {
            "buffer": 0,
            "byteOffset": len(self.binary),
            "byteLength": len(data),
        }
        self.binary += data
        self.views.append(entry)
        return len(self.views) - 1


def bytes_of_floats(texture: Floats) -> NDArray[np.uint8]:
    """(4 h, 3 w) bytes of (h, w, 3) floats: the highest bytes of all numbers, then the
    next ones, and so on.
    """
    height, width = texture.shape[:2]
    numbers = np.ascontiguousarray(texture, ">f4").view(np.uint8)
    planes = np.moveaxis(numbers.reshape(height, width, 3, 4), -1, 0)
    return planes.reshape(4 * height, 3 * width)
