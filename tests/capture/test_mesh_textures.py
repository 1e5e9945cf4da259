"""Textures and colours of other people's meshes: shown right, or named and refused, never grey in silence."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, features

from mi_splat.assets.mesh import to_srgb
from mi_splat.capture.mesh_files import LoadedMesh, load_mesh
from mi_splat.capture.settings import MeshSettings
from mi_splat.errors import MiSplatError
from mi_splat.io.picture_files import pixel_limit
from tests.capture.trucks import COLOURS, TEXTURE, truck, write_glb

pytest.importorskip("trimesh")

WARN = MeshSettings(missing_textures="warn")
COUNT = len(truck().vertices)


def corner_colours(loaded: LoadedMesh) -> np.ndarray[Any, Any]:
    """(V, 3) sRGB bytes at the vertices, as the path tracer looks them up."""
    colours = []
    for mesh in loaded.asset.meshes:
        height, width = mesh.texture.shape[:2]
        columns = np.clip((mesh.uvs[:, 0] % 1 * width).astype(int), 0, width - 1)
        rows = np.clip(((1 - mesh.uvs[:, 1]) % 1 * height).astype(int), 0, height - 1)
        colours.append(mesh.texture[rows, columns])
    return np.concatenate(colours) * 255


def expected() -> np.ndarray[Any, Any]:
    return truck().colours.astype(np.float64)


def blue_is_at_the_back(loaded: LoadedMesh) -> bool:
    """Whether the bed, which is blue, lies towards -x and the red cab towards +x."""
    points, colours = loaded.asset.vertices, corner_colours(loaded)
    bed, cab = (np.abs(colours - np.array(COLOURS[name])).max(1) < 3 for name in ("bed", "cab"))
    return bool(bed.any() and cab.any() and points[bed, 0].max() < points[cab, 0].min() + 0.1)


def test_a_texture_in_a_file_of_its_own_is_shown(tmp_path: Path) -> None:
    loaded = load_mesh(write_glb(tmp_path, truck()))
    assert loaded.warnings == ()
    assert blue_is_at_the_back(loaded)


def no_texture(path: Path) -> None:
    path.with_name(TEXTURE).unlink()


def no_picture(path: Path) -> None:
    path.with_name(TEXTURE).write_bytes(b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(60))


def half_a_picture(path: Path) -> None:
    texture = path.with_name(TEXTURE)
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)).save(texture)
    texture.write_bytes(texture.read_bytes()[:4000])


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (no_texture, f"{TEXTURE}.*no such file"),
        (no_picture, f"{TEXTURE}.*cannot be read as a picture"),
        (half_a_picture, TEXTURE),
    ],
)
def test_a_texture_that_cannot_be_shown_is_named(spoil: Callable[[Path], None], says: str, tmp_path: Path) -> None:
    path = write_glb(tmp_path, truck())
    spoil(path)
    with pytest.raises(MiSplatError, match=rf"{path.name}.*{says}.*let missing textures warn"):
        load_mesh(path)
    loaded = load_mesh(path, WARN)
    assert len(loaded.warnings) == 1
    assert np.ptp(corner_colours(loaded), axis=0).max() == 0  # one plain colour


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ({"image": {"uri": TEXTURE, "mimeType": "image/ktx2"}}, TEXTURE),
        ({"texture": {"extensions": {"KHR_texture_basisu": {"source": 0}}}}, TEXTURE),
        ({"material": {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 3}}}}, "TEXCOORD_3"),
        ({"attributes": {"TEXCOORD_0": np.zeros((COUNT, 2), "u2")}}, "integers"),
        ({"attributes": {"COLOR_0": np.full((COUNT, 3), 0.5, "<f4")}}, "colours of vertices"),
    ],
    ids=["ktx2", "basisu", "no such coordinates", "integers", "colours over a texture"],
)
def test_what_cannot_be_read_of_a_gltf_file_is_named(words: dict[str, Any], says: str, tmp_path: Path) -> None:
    path = write_glb(tmp_path, truck(), **words)
    with pytest.raises(MiSplatError, match=rf"truck\.glb.*{says}"):
        load_mesh(path)
    assert [text for text in load_mesh(path, WARN).warnings if says in text]


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization"])
def test_an_extension_that_changes_the_mesh_is_named(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mi_splat.capture.mesh_files.find_spec", lambda package: None)  # as if DracoPy were not there
    with pytest.raises(MiSplatError, match=rf"{name}; unpack it: npx @gltf-transform/cli dequantize .*truck-unpacked"):
        load_mesh(write_glb(tmp_path, truck(), required=(name,)))


def test_second_texture_coordinates_are_used(tmp_path: Path) -> None:
    down = (truck().uvs * (1, -1) + (0, 1)).astype("<f4")
    attributes = {"TEXCOORD_0": np.full_like(down, 0.1), "TEXCOORD_1": down}
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}}}
    loaded = load_mesh(write_glb(tmp_path, truck(), material=material, attributes=attributes))
    assert np.abs(corner_colours(loaded) - expected()).max() < 3


def test_texture_transforms_are_used(tmp_path: Path) -> None:
    down = truck().uvs * (1, -1) + (0, 1)
    transform = {"offset": [0.25, 0.5], "scale": [0.5, 2.0], "rotation": np.pi / 2}
    # uv' = offset + R(rotation) (scale * uv), R = [[cos, sin], [-sin, cos]]: u' = 0.25 + 2 v, v' = 0.5 - 0.5 u
    given = np.column_stack([(0.5 - down[:, 1]) / 0.5, (down[:, 0] - 0.25) / 2.0]).astype("<f4")
    base = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    material = {"pbrMetallicRoughness": {"baseColorTexture": base}}
    path = write_glb(
        tmp_path, truck(), material=material, attributes={"TEXCOORD_0": given}, required=("KHR_texture_transform",)
    )
    assert np.abs(corner_colours(load_mesh(path)) - expected()).max() < 3


@pytest.mark.parametrize("kind", ["<f4", "u1", "u2"])
def test_colours_of_vertices_are_those_of_the_surface(kind: str, tmp_path: Path) -> None:
    linear = np.random.default_rng(1).random((COUNT, 4))
    top = 1.0 if kind == "<f4" else float(np.iinfo(kind).max)
    attributes = {"COLOR_0": (linear * top).astype(kind)}
    for factor in (None, [0.5, 1.0, 0.25, 1.0]):
        material = {"pbrMetallicRoughness": {"baseColorFactor": factor} if factor else {}}
        loaded = load_mesh(write_glb(tmp_path, truck(), material=material, attributes=attributes))
        assert loaded.warnings == ()
        wanted = 255 * to_srgb(linear[:, :3] * (factor[:3] if factor else 1))
        assert np.abs(corner_colours(loaded) - wanted).max() < (
            14 if kind == "u1" else 1
        )  # 8 bits of a dark linear value


def test_pictures_of_16_bits_and_names_with_spaces(tmp_path: Path) -> None:
    path = write_glb(tmp_path, truck(), image={"uri": "my%20truck.png"})
    levels = np.linspace(1000, 60000, 32).astype(np.uint16)[None].repeat(4, axis=0)
    Image.fromarray(levels).save(tmp_path / "my truck.png")
    reds = np.unique(corner_colours(load_mesh(path))[:, 0])
    assert len(reds) == 4
    assert reds.max() < 240


@pytest.mark.skipif(not features.check("webp"), reason="this Pillow reads no WebP")
def test_webp_is_shown_and_named_when_it_is_missing(tmp_path: Path) -> None:
    image, texture = {"uri": "truck.webp"}, {"extensions": {"EXT_texture_webp": {"source": 0}}}
    path = write_glb(tmp_path, truck(), image=image, texture=texture, required=("EXT_texture_webp",))
    Image.open(tmp_path / TEXTURE).save(tmp_path / "truck.webp", lossless=True)
    assert np.abs(corner_colours(load_mesh(path)) - expected()).max() < 3
    (tmp_path / "truck.webp").unlink()
    with pytest.raises(MiSplatError, match=r"truck\.webp.*no such file"):
        load_mesh(path)


def test_textures_of_too_many_pixels_are_not_decoded(tmp_path: Path) -> None:
    path = write_glb(tmp_path, truck())
    with Image.open(tmp_path / TEXTURE) as texture:
        pixels = texture.width * texture.height
    with pixel_limit(pixels):
        load_mesh(path)
    with pixel_limit(pixels - 1), pytest.raises(MiSplatError, match=r"truck\.png.*too many pixels"):
        load_mesh(path)
