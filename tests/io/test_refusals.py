"""What is refused, and what its message says to do."""

import gzip
import re
import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_splat.io import SplatFileError, SplatFileWarning, load_splat, save_splat
from mi_splat.io.formats.sog import picture_bytes
from tests.gaussians import ply_bytes, ply_header, splat_names, splat_rows
from tests.io.format_files import gltf_with, rezipped, tame_scene, valid
from tests.io.ply_files import (
    BODY,
    FACE,
    HEAD,
    LINE,
    ROWS,
    TEXT_HEAD,
    listed,
    reordered,
    with_elements,
)


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
    "v5.spz": (
        struct.pack("<4sIIBBBBI12x", b"NGSP", 5, 0, 0, 12, 0, 0, 32),
        "version 4 .*got 5",
    ),
    "sh5.spz": (spz_header(3, 0, 5, 12, 0), "SH degree of 0 to 4"),
    "many.spz": (spz_header(3, 2**32 - 1, 0, 12, 0), "at most 655.* bomb"),
    "long.spz": (
        spz_header(3, 9, 0, 12, 0, body=bytes(181)),
        "180 bytes for 9 Gaussians, got more",
    ),
    "axes.spz": (
        spz_header(3, 0, 0, 12, 2, body=struct.pack("<III", 0xADBE0003, 4, 17)),
        "number up to 16, got 17",
    ),
    "sh_range.spz": (
        spz_header(3, 0, 0, 12, 2, body=struct.pack("<III", 0xADBE0001, 4, 8)),
        "sh_quantization",
    ),
    "window.spz": (
        struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 1, 0, 12, 0, 5, 32)
        + struct.pack("<QQ", 2**63, 9) * 5,
        "9 bytes in section 0",
    ),
    "no_zip.sog": (b"PK\x03\x04" + bytes(100), "a zip archive with its directory"),
    "no_meta.sog": (sog_with(meta_json=None), "meta.json in the archive"),
    "png.sog": (
        sog_with(scales_webp=b"\x89PNG" + bytes(99)),
        "a lossless WebP image",
    ),
    "small.sog": (
        sog_with(scales_webp=picture_bytes(PIXELS)),
        "20 to .* pixels, got 4 x 4",
    ),
    "v1.sog": (sog_with(meta_json=b'{"means": {}}'), "an old SOG.*splat-transform"),
    "deep.sog": (sog_with(meta_json=b"[" * 100_000), "at most 64 levels"),
    "crowd.sog": (sog_with(**{f"x{i}": b"" for i in range(70)}), "at most 64 members"),
    "version.glb": (struct.pack("<4sII", b"glTF", 1, 20) + bytes(8), "version 2"),
    "mesh.glb": (
        gltf_with(lambda d: primitive(d, extensions={})),
        "a primitive with KHR.*1 other primitives",
    ),
    "kernel.glb": (
        gltf_with(
            lambda d: primitive(
                d, extensions={"KHR_gaussian_splatting": {"kernel": "box"}}
            )
        ),
        "'ellipse', got 'box'",
    ),
    "linear.glb": (
        gltf_with(
            lambda d: primitive(
                d,
                extensions={
                    "KHR_gaussian_splatting": {
                        "kernel": "ellipse",
                        "colorSpace": "lin_rec709_display",
                    }
                },
            )
        ),
        "'srgb_rec709_display', got 'lin_rec709_display'",
    ),
    "triangles.glb": (
        gltf_with(lambda d: primitive(d, mode=4)),
        r"0 \(points\), got 4",
    ),
    "required.glb": (
        gltf_with(lambda d: d.update(extensionsRequired=["KHR_draco"])),
        "without it",
    ),
    "sheared.glb": (
        gltf_with(lambda d: d.update(nodes=[{"mesh": 0, "scale": [1, 2, 1]}])),
        "uniform scale",
    ),
    "circle.glb": (
        gltf_with(lambda d: d.update(nodes=[{"mesh": 0, "children": [0]}])),
        "no parent yet",
    ),
    "uri.glb": (
        gltf_with(
            lambda d: d.update(buffers=[{"byteLength": 4, "uri": "/etc/passwd"}])
        ),
        "inside of the file",
    ),
    "half_a_degree.glb": (
        gltf_with(
            lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(
                "KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"
            )
        ),
        "whole degrees of SH",
    ),
    "a.spz": (
        valid("a.glb"),
        "a .spz file, got the mark of a .glb file; rename it to .glb",
    ),
    "a.obj": (b"v 0 0 0", "this is a mesh"),
    "noname": (b"{}", "got no ending"),
}


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:aa\nsize 134\n"
NEEDED = splat_names(1, normals=False)
LISTED = listed("binary_little_endian")
PLY = {
    "empty file": (b"", "first line 'ply'"),
    "Git LFS": (POINTER, "a Git LFS pointer instead of the file; run `git lfs pull`"),
    "header ends early": (HEAD[:100], "none in 100 bytes; write or download it again"),
    "header never ends": (HEAD[:-11] + b"comment x\n" * 10**4, "none in 65536 bytes"),
    "no format": (
        HEAD.replace(b"format binary_little_endian 1.0\n", b"") + BODY,
        "a line 'format'",
    ),
    "unknown format": (
        HEAD.replace(b"little", b"middle") + BODY,
        "got 'format binary_middle_endian 1.0'",
    ),
    "property first": (
        HEAD.replace(b"element vertex 40\n", b"") + BODY,
        "got 'property float x'",
    ),
    "no vertex": (
        HEAD.replace(b"vertex", b"points") + BODY,
        "an element named vertex, got points",
    ),
    "element twice": (
        with_elements(b"element vertex 1\nproperty int i\n", bytes(4)),
        "got 'element vertex 1'",
    ),
    "property twice": (
        HEAD.replace(b"float opacity", b"float x") + BODY,
        "got 'property float x'",
    ),
    "unknown kind": (
        HEAD.replace(b"float opacity", b"half opacity") + BODY,
        "got 'property half opacity'",
    ),
    "list length in floats": (
        with_elements(FACE.replace(b"char", b"float"), b""),
        "property list float int",
    ),
    "count of 5000 digits": (
        HEAD.replace(b"vertex 40", b"vertex " + b"9" * 5000) + BODY,
        "got 'element vertex 9{65}'",
    ),
    "truncated": (
        HEAD + BODY[:-1],
        r"expected \d+ bytes for 40 x vertex, got \d+ bytes; it is truncated",
    ),
    "one byte more": (HEAD + BODY + b"\0", "something was appended"),
    "10^17 vertices": (ply_header(ROWS, count=10**17) + BODY, "it is truncated"),
    "10^12 vertices with lists": (
        LISTED.replace(b"x 40\n", b"x 1000000000000\n"),
        "it is truncated",
    ),
    "10^12 faces": (
        with_elements(FACE.replace(b"2", b"1000000000000"), b"\0\0"),
        "it is truncated",
    ),
    "lists end early": (
        LISTED[:-1],
        "intact rows with lists of vertex, got .*early end-of-file",
    ),
    "more after the lists": (LISTED + b"\0", "the end of the file.*got more"),
    "negative list length": (
        with_elements(b"", b"", FACE, b"\0\xff"),
        "intact rows with lists",
    ),
    "list for a value": (
        HEAD.replace(b"float x", b"list uchar float x") + BODY,
        "a 3DGS splat, got no x",
    ),
    **{
        f"no {name}": (
            ply_bytes(reordered(ROWS, [n for n in NEEDED if n != name])),
            f"got no {name};",
        )
        for name in ("x", "opacity", "rot_3", "scale_1", "f_dc_2")
    },
    "no f_rest_5": (
        ply_bytes(reordered(ROWS, [n for n in NEEDED if n != "f_rest_5"])),
        "properties f_rest.*got 8",
    ),
    "a point cloud": (
        ply_bytes(splat_rows(3, names=["x", "y", "z"])),
        "got a point cloud .no scale_0, .* and 5 more",
    ),
    "integer property": (
        HEAD.replace(b"float f_dc_1", b"int f_dc_1") + BODY,
        r"f_dc_1 as float.*integer \(i4\)",
    ),
    "text too short": (
        TEXT_HEAD + LINE * 39 + b"\n" * 200,
        "40 lines for 40 x vertex, got 39",
    ),
    "text row too short": (
        TEXT_HEAD + LINE * 39 + LINE[4:] + b" " * 99,
        "row 39: .*early end-of-line",
    ),
    "text row too long": (
        TEXT_HEAD + LINE * 39 + b"1 " + LINE,
        "row 39: expected end-of-line",
    ),
    "words in text": (
        TEXT_HEAD + LINE * 39 + LINE.replace(b"0.5", b"red", 1),
        "row 39: .*malformed input",
    ),
    "list too long in text": (
        listed("ascii").replace(b"\n1 0 ", b"\n9 0 ", 1),
        r"row 1: .*early end-of-line",
    ),
    "endless line in text": (
        TEXT_HEAD + LINE * 39 + b"0.5 " * (1 << 19),
        "lines of at most 1048576 bytes",
    ),
}

REFUSED = {**BAD, **{f"{name}.ply": case for name, case in PLY.items()}}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_files_raise_one_error_with_what_was_expected_found_and_to_do(
    name: str, tmp_path: Path
) -> None:
    contents, words = REFUSED[name]
    path = tmp_path / name
    path.write_bytes(contents)
    tracemalloc.start()
    with pytest.raises(SplatFileError, match=words) as caught:
        load_splat(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert re.match(
        rf"{re.escape(str(path))}.*: expected .+, got .+; .+",
        str(caught.value),
        re.DOTALL,
    )
    assert len(str(caught.value)) < len(str(path)) + 400
    assert peak < 12 << 20


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
    with pytest.raises(
        SplatFileError,
        match=r"the package usd-core.*got none; pip install -e '\.\[usd\]'",
    ):
        load_splat(tmp_path / name)
    with pytest.raises(SplatFileError, match="usd-core"):
        save_splat(tame_scene(2, 0), tmp_path / "out.usda")
    assert not (tmp_path / "out.usda").exists()


def test_values_that_are_not_finite_in_gltf_and_compressed_ply(tmp_path: Path) -> None:
    whole = valid("a.glb")
    (size,) = struct.unpack_from("<I", whole, 12)
    start = 20 + size + 8  # the first attribute, POSITION
    (tmp_path / "a.glb").write_bytes(
        whole[:start] + struct.pack("<f", np.nan) + whole[start + 4 :]
    )
    with pytest.raises(
        SplatFileError,
        match=(
            r"1 of 20 that are not \(rows 0; in the first, a coordinate of the mean"
            r" is nan"
        ),
    ):
        load_splat(tmp_path / "a.glb")
    whole = valid("a.compressed.ply")
    # the smallest log-scale of the only chunk
    start = whole.index(b"end_header\n") + 11 + 6 * 4
    (tmp_path / "a.compressed.ply").write_bytes(
        whole[:start] + struct.pack("<f", np.inf) + whole[start + 4 :]
    )
    with pytest.raises(SplatFileError, match=r"of 20 that are not .* a scale is"):
        load_splat(tmp_path / "a.compressed.ply")


def test_the_fourth_band_of_spz_is_left_out(tmp_path: Path) -> None:
    body = struct.pack(
        "<9B4B3B4B", *bytes(9), 255, 0, 128, 255, 160, 160, 160, *bytes(3), 0xC0
    )
    rest = bytes(range(72))
    (tmp_path / "a.spz").write_bytes(spz_header(3, 1, 4, 12, 0, body=body + rest))
    with pytest.warns(
        SplatFileWarning,
        match="SH of degree 0 to 3, got 4; the highest band was left out",
    ):
        scene = load_splat(tmp_path / "a.spz")
    assert scene.degree == 3
    assert scene.rotations.tolist() == [[1, 0, 0, 0]]
    assert scene.scales.tolist() == [[1, 1, 1]]
    assert abs(float(scene.sh[0, 15, 2])) == (128 - 44) / 128
