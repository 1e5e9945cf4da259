"""Textures and colours of other people's meshes: shown right, or refused in words,
never grey in silence.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, features

from mi_splat.capture import mesh_files
from mi_splat.capture.mesh import Asset, to_linear, to_srgb
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.errors import MiSplatError
from mi_splat.io.picture_files import pixel_limit
from tests.capture.trucks import encoded, stripes, truck, write_glb

COUNT = len(truck().vertices)
BASE = {"index": 0}


def corner_colours(asset: Asset) -> np.ndarray[Any, Any]:
    """(V, 3) sRGB bytes at the vertices, as the path tracer looks them up."""
    colours = []
    for mesh in asset.meshes:
        height, width = mesh.texture.shape[:2]
        columns = np.clip((mesh.uvs[:, 0] % 1 * width).astype(int), 0, width - 1)
        rows = np.clip(((1 - mesh.uvs[:, 1]) % 1 * height).astype(int), 0, height - 1)
        colours.append(mesh.texture[rows, columns])
    return np.concatenate(colours) * 255


def material(**words: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": words}


def half_a_picture() -> bytes:
    return encoded(
        Image.fromarray(
            np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
        )
    )[:4000]


TRANSFORM = {"extensions": {"KHR_texture_transform": {"scale": [2, 2]}}}
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "an image of another format": (
        {"picture": b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(60)},
        "that can be read",
    ),
    "half an image": ({"picture": half_a_picture()}, "texture"),
    "a texture without an image": (
        {"texture": {"extensions": {"KHR_texture_basisu": {"source": 0}}}},
        "texture",
    ),
    "a file beside": (
        {"image": {"uri": "truck.png"}},
        "holds its textures itself, got 'truck.png'; pack it",
    ),
    "other coordinates": (
        {"material": material(baseColorTexture={**BASE, "texCoord": 3})},
        "TEXCOORD_0",
    ),
    "moved coordinates": (
        {"material": material(baseColorTexture={**BASE, **TRANSFORM})},
        "TEXCOORD_0",
    ),
    "whole coordinates": (
        {"attributes": {"TEXCOORD_0": np.zeros((COUNT, 2), "u2")}},
        "TEXCOORD_0",
    ),
    "colours of vertices": (
        {"attributes": {"COLOR_0": np.full((COUNT, 3), 0.5, "<f4")}},
        "bake them into a texture",
    ),
    "an old material": (
        {"material": {"extensions": {"KHR_materials_pbrSpecularGlossiness": {}}}},
        "metalrough",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_shown_is_refused(name: str, tmp_path: Path) -> None:
    words, says = REFUSED[name]
    with pytest.raises(MiSplatError, match=rf"truck\.glb.*{says}"):
        load_mesh(write_glb(tmp_path, truck(), **words))


@pytest.mark.parametrize(
    "name",
    ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization"],
)
def test_an_extension_that_changes_the_mesh_is_named(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_glb(tmp_path, truck(), required=(name,))
    found = "mi_splat.capture.mesh_files.find_spec"
    monkeypatch.setattr(found, lambda package: None if package == "DracoPy" else sys)
    with pytest.raises(
        MiSplatError,
        match=(
            rf"{name}; unpack it: npx @gltf-transform/cli dequantize .*truck-unpacked"
        ),
    ):
        load_mesh(path)


@pytest.mark.parametrize("factor", [None, [0.5, 1.0, 0.25, 1.0]])
def test_a_factor_multiplies_a_texture_or_is_the_colour(
    factor: list[float] | None, tmp_path: Path
) -> None:
    words = {"baseColorFactor": factor} if factor else {}
    linear = np.array(factor[:3] if factor else (1.0, 1.0, 1.0))
    shown = load_mesh(
        write_glb(tmp_path, truck(), material=material(baseColorTexture=BASE, **words))
    )
    wanted = 255 * to_srgb(to_linear(truck().colours / 255.0) * linear)
    assert np.abs(corner_colours(shown) - wanted).max() < 1
    plain = load_mesh(write_glb(tmp_path, truck(), material=material(**words)))
    assert (
        np.abs(
            corner_colours(plain) - (255 * to_srgb(linear) if factor else 0.7 * 255)
        ).max()
        < 1
    )


def test_pictures_of_16_bits_keep_their_levels(tmp_path: Path) -> None:
    levels = np.linspace(1000, 60000, 32).astype(np.uint16)[None].repeat(4, axis=0)
    path = write_glb(tmp_path, truck(), picture=encoded(Image.fromarray(levels)))
    reds = np.unique(corner_colours(load_mesh(path))[:, 0])
    assert len(reds) == 4
    assert reds.max() < 240


@pytest.mark.skipif(not features.check("webp"), reason="this Pillow reads no WebP")
def test_webp_is_shown(tmp_path: Path) -> None:
    texture = {"extensions": {"EXT_texture_webp": {"source": 0}}}
    picture = encoded(stripes(), "WEBP", lossless=True)
    path = write_glb(
        tmp_path,
        truck(),
        picture=picture,
        texture=texture,
        required=("EXT_texture_webp",),
    )
    assert (
        np.abs(
            corner_colours(load_mesh(path)) - truck().colours.astype(np.float64)
        ).max()
        < 3
    )


def test_textures_have_few_pixels_in_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_glb(tmp_path, truck())
    pixels = stripes().width * stripes().height
    monkeypatch.setattr(mesh_files, "MOST_PIXELS", pixels)
    load_mesh(path)
    tinted = material(baseColorTexture=BASE, baseColorFactor=[0.5, 1, 1, 1])
    with pytest.raises(MiSplatError, match="textures of more than 128 pixels"):
        load_mesh(write_glb(tmp_path, truck(), material=tinted))


def test_textures_of_too_many_pixels_are_not_decoded(tmp_path: Path) -> None:
    path = write_glb(tmp_path, truck())
    pixels = stripes().width * stripes().height
    with pixel_limit(pixels):
        load_mesh(path)
    with (
        pixel_limit(pixels - 1),
        pytest.raises(MiSplatError, match=r"truck\.glb.*at most 127 pixels"),
    ):
        load_mesh(path)
