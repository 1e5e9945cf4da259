"""What is refused, and what its message says to do."""

import gzip
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_splat.io import SplatFileError, SplatFileWarning, load_splat, save_splat
from mi_splat.io.formats.sog import picture_bytes
from tests.io.format_files import gltf_with, rezipped, tame_scene, valid


def sog_with(**contents: bytes | None) -> bytes:
    def change(members: dict[str, bytes]) -> None:
        for name, value in contents.items():
            key = name.replace("_webp", ".webp").replace("_json", ".json")
            if value is None:
                del members[key]
            else:
                members[key] = value

    return rezipped(change)


def spz_header(*fields: int, body: bytes = b"") -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", *fields, 0) + body)


def primitive(document: dict[str, Any], **values: object) -> None:
    document["meshes"][0]["primitives"][0].update(values)


PIXELS = np.zeros((4, 4, 4), np.uint8)
BAD = {
    "empty.splat": (b"", "whole records of 32 bytes, got 0 bytes"),
    "other.spz": (gzip.compress(b"x" * 99), "an SPZ file inside of the gzip stream"),
    "v1.spz": (spz_header(1, 0, 0, 12, 0), "version 2 or 3 .*got 1; convert"),
    "v5.spz": (struct.pack("<4sIIBBBBI12x", b"NGSP", 5, 0, 0, 12, 0, 0, 32), "version 4 .*got 5"),
    "sh5.spz": (spz_header(3, 0, 5, 12, 0), "SH degree of 0 to 4"),
    "many.spz": (spz_header(3, 2**32 - 1, 0, 12, 0), "at most 655.* bomb"),
    "long.spz": (spz_header(3, 9, 0, 12, 0, body=bytes(181)), "180 bytes for 9 Gaussians, got more"),
    "axes.spz": (spz_header(3, 0, 0, 12, 2, body=struct.pack("<III", 0xADBE0003, 4, 17)), "number up to 16, got 17"),
    "sh_range.spz": (spz_header(3, 0, 0, 12, 2, body=struct.pack("<III", 0xADBE0001, 4, 8)), "sh_quantization"),
    "window.spz": (
        struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 1, 0, 12, 0, 5, 32) + struct.pack("<QQ", 2**63, 9) * 5,
        "9 bytes in section 0",
    ),
    "no_zip.sog": (b"PK\x03\x04" + bytes(100), "a zip archive with its directory"),
    "no_meta.sog": (sog_with(meta_json=None), "a member meta.json"),
    "png.sog": (sog_with(scales_webp=b"\x89PNG" + bytes(99)), "a lossless WebP picture"),
    "small.sog": (sog_with(scales_webp=picture_bytes(PIXELS)), "20 to .* pixels, got 4 x 4"),
    "v1.sog": (sog_with(meta_json=b'{"means": {}}'), "an old SOG.*splat-transform"),
    "deep.sog": (sog_with(meta_json=b"[" * 100_000), "at most 64 levels"),
    "crowd.sog": (sog_with(**{f"x{i}": b"" for i in range(70)}), "at most 64 members"),
    "version.glb": (struct.pack("<4sII", b"glTF", 1, 20) + bytes(8), "version 2"),
    "mesh.glb": (gltf_with(lambda d: primitive(d, extensions={})), "a primitive with KHR.*1 other primitives"),
    "kernel.glb": (
        gltf_with(lambda d: primitive(d, extensions={"KHR_gaussian_splatting": {"kernel": "box"}})),
        "'ellipse', got 'box'",
    ),
    "linear.glb": (
        gltf_with(lambda d: primitive(
            d, extensions={"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "lin_rec709_display"}})),
        "'srgb_rec709_display', got 'lin_rec709_display'",
    ),
    "triangles.glb": (gltf_with(lambda d: primitive(d, mode=4)), r"0 \(points\), got 4"),
    "required.glb": (gltf_with(lambda d: d.update(extensionsRequired=["KHR_draco"])), "without it"),
    "sheared.glb": (gltf_with(lambda d: d.update(nodes=[{"mesh": 0, "scale": [1, 2, 1]}])), "uniform scale"),
    "circle.glb": (gltf_with(lambda d: d.update(nodes=[{"mesh": 0, "children": [0]}])), "no parent yet"),
    "uri.glb": (gltf_with(lambda d: d.update(buffers=[{"byteLength": 4, "uri": "/etc/passwd"}])), "inside of the file"),
    "half_a_degree.glb": (
        gltf_with(lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(
            "KHR_gaussian_splatting:SH_DEGREE_1_COEF_1")),
        "whole degrees of SH",
    ),
    "short.ksplat": (bytes(100), "a header of 4096 bytes"),
    "a.spz": (valid("a.glb"), "a .spz file, got the mark of a .glb file; rename it to .glb"),
    "a.obj": (b"v 0 0 0", "this is a mesh"),
    "noname": (b"{}", "got no ending"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_with_what_to_do(name: str, tmp_path: Path) -> None:
    contents, words = BAD[name]
    (tmp_path / name).write_bytes(contents)
    with pytest.raises(SplatFileError, match=words) as caught:
        load_splat(tmp_path / name)
    assert len(str(caught.value)) < len(str(tmp_path)) + 400


def test_the_checksum_of_gzip_is_looked_at(tmp_path: Path) -> None:
    damaged = bytearray(valid("v3.spz"))
    damaged[-6] ^= 1
    (tmp_path / "a.spz").write_bytes(damaged)
    with pytest.raises(SplatFileError, match="an intact gzip stream"):
        load_splat(tmp_path / "a.spz")


@pytest.mark.parametrize("name", ["a.usdc", "b.usd"])
def test_openusd_without_its_package_says_what_to_install(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    (tmp_path / name).write_bytes(b"PXR-USDC" + bytes(99))
    with pytest.raises(SplatFileError, match=r"the package usd-core.*got none; pip install -e '\.\[usd\]'"):
        load_splat(tmp_path / name)
    with pytest.raises(SplatFileError, match="usd-core"):
        save_splat(tame_scene(2, 0), tmp_path / "out.usda")
    assert not (tmp_path / "out.usda").exists()


def test_values_that_are_not_finite_in_gltf_and_compressed_ply(tmp_path: Path) -> None:
    whole = valid("a.glb")
    (size,) = struct.unpack_from("<I", whole, 12)
    start = 20 + size + 8  # the first attribute, POSITION
    (tmp_path / "a.glb").write_bytes(whole[:start] + struct.pack("<f", np.nan) + whole[start + 4 :])
    with pytest.raises(
        SplatFileError, match=r"1 of 20 that are not \(rows 0; in the first, a coordinate of the mean is nan"
    ):
        load_splat(tmp_path / "a.glb")
    whole = valid("a.compressed.ply")
    start = whole.index(b"end_header\n") + 11 + 6 * 4  # the smallest log-scale of the only chunk
    (tmp_path / "a.compressed.ply").write_bytes(whole[:start] + struct.pack("<f", np.inf) + whole[start + 4 :])
    with pytest.raises(SplatFileError, match=r"of 20 that are not .* a scale is"):
        load_splat(tmp_path / "a.compressed.ply")


def test_the_fourth_band_of_spz_is_left_out(tmp_path: Path) -> None:
    body = struct.pack("<9B4B3B4B", *bytes(9), 255, 0, 128, 255, 160, 160, 160, *bytes(3), 0xC0)
    rest = bytes(range(72))
    (tmp_path / "a.spz").write_bytes(spz_header(3, 1, 4, 12, 0, body=body + rest))
    with pytest.warns(SplatFileWarning, match="SH of degree 0 to 3, got 4; the highest band was left out"):
        scene = load_splat(tmp_path / "a.spz")
    assert scene.degree == 3
    assert scene.rotations.tolist() == [[1, 0, 0, 0]]
    assert scene.scales.tolist() == [[1, 1, 1]]
    assert abs(float(scene.sh[0, 15, 2])) == (128 - 44) / 128
