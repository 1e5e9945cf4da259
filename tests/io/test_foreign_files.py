"""Splats as other programs and web sites hand them out: read, or named for what they
are.
"""

import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from mi_splat.io import load_splat
from mi_splat.io.errors import SplatFileError, SplatFileWarning
from tests.gaussians import ply_header, splat_names, splat_rows
from tests.io.ply_files import BODY, HEAD

PLY = HEAD + BODY


def _zip(
    path: Path, members: dict[str, bytes], packing: int = zipfile.ZIP_DEFLATED
) -> Path:
    with zipfile.ZipFile(path, "w", packing) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def _plain(tmp_path: Path) -> Path:
    path = tmp_path / "plain.ply"
    path.write_bytes(PLY)
    return path


def _named(path: Path, names: Sequence[str]) -> Path:
    """A PLY file whose properties have other names."""
    rows = splat_rows(20, names=names)
    path.write_bytes(ply_header(rows) + rows.tobytes())
    return path


# Archives


def test_the_one_splat_of_a_zip_is_read(tmp_path: Path) -> None:
    members = {
        "scan/": b"",
        "scan/point_cloud.ply": PLY,
        "scan/photo.jpg": b"no",
        "__MACOSX/scan/._point_cloud.ply": b"x",
    }
    read = load_splat(_zip(tmp_path / "scan.ZIP", members))
    assert torch.equal(read.means, load_splat(_plain(tmp_path)).means)
    # nothing is unpacked
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plain.ply", "scan.ZIP"]


@pytest.mark.parametrize(
    ("members", "words"),
    [
        (
            {"a.ply": PLY, "b/c.spz": b""},
            r"got a\.ply, b/c\.spz; unpack it, and pass one of these",
        ),
        (
            {"deep.zip": b"PK", "x.jpg": b""},
            r"expected a zip archive with one splat .*, got deep\.zip, x\.jpg",
        ),
        ({}, "got an empty one"),
        ({"a\x1b[31m.ply": PLY, "b.ply": PLY}, r"got a\?\[31m\.ply, b\.ply"),
        ({"a.ply": PLY[:-10]}, r"scan\.zip/a\.ply: expected \d+ bytes"),
        ({"a.ply": bytes(64 << 20)}, "at most .* bytes out of .* decompression bomb"),
        ({f"{number}.txt": b"" for number in range(10_001)}, "at most 10000 members"),
    ],
)
def test_archives_without_one_splat_are_refused(
    members: dict[str, bytes], words: str, tmp_path: Path
) -> None:
    with pytest.raises(SplatFileError, match=words):
        load_splat(_zip(tmp_path / "scan.zip", members))


def test_a_zip_whose_directory_lies_about_sizes_is_refused(tmp_path: Path) -> None:
    path = _zip(tmp_path / "scan.zip", {"a.ply": PLY})
    data = bytearray(path.read_bytes())
    entry = data.rfind(b"PK\x01\x02")
    struct.pack_into("<I", data, entry + 24, len(PLY) // 2)
    path.write_bytes(data)
    with pytest.raises(
        SplatFileError, match=r"scan\.zip/a\.ply: expected an intact member"
    ):
        load_splat(path)


def test_arrays_of_numpy_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "splats.npz", means=np.zeros((3, 3)))
    with pytest.raises(SplatFileError, match=r"arrays of NumPy.*save a \.ply"):
        load_splat(tmp_path / "splats.npz")


# Folders


def test_a_folder_of_3dgs_stands_for_its_newest_iteration(tmp_path: Path) -> None:
    for number, count in ((7000, 5), (30000, 9), (100000, 0)):
        folder = tmp_path / "point_cloud" / f"iteration_{number}"
        folder.mkdir(parents=True)
        rows = splat_rows(count)
        if count:
            (folder / "point_cloud.ply").write_bytes(ply_header(rows) + rows.tobytes())
    (tmp_path / "point_cloud" / "iteration_old").mkdir()
    assert len(load_splat(tmp_path)) == 9


# Names of properties


def test_names_of_cloudcompare_and_3dgsconverter_are_understood(tmp_path: Path) -> None:
    plain = load_splat(_named(tmp_path / "plain.ply", splat_names(1)))
    for prefix in ("scal_", "scalar_"):
        names = [name if name in "xyz" else prefix + name for name in splat_names(1)]
        assert torch.equal(
            load_splat(_named(tmp_path / f"{prefix}.ply", names)).sh, plain.sh
        )


@pytest.mark.parametrize(
    "more", [["t", "scale_t", "rot_r_0"], ["trbf_center", "motion_0"]]
)
def test_splats_that_move_warn(more: list[str], tmp_path: Path) -> None:
    with pytest.warns(
        SplatFileWarning,
        match=rf"got one that moves \(4D: {more[0]}.*all times are drawn at once",
    ):
        load_splat(_named(tmp_path / "four_d.ply", [*splat_names(0), *more]))


def test_what_is_no_splat_is_named_with_a_way_that_exists(tmp_path: Path) -> None:
    anchors = [
        *"xyz",
        "f_offset_0",
        "f_anchor_feat_0",
        "opacity",
        *(f"scale_{i}" for i in range(6)),
    ]
    wanted = {
        "got the anchors of a Scaffold-GS": (anchors, b""),
        r"got a point cloud \(no .*`mi-splat train SET`": ([*"xyz"], b""),
        "got a mesh of 2 faces; save it as .glb, then `mi-splat capture": (
            [*"xyz"],
            b"element face 2\nproperty list uchar int vertex_indices\n",
        ),
        r"got no rot_3; export": (splat_names(0)[:-1], b""),
    }
    for words, (names, more) in wanted.items():
        rows = splat_rows(3, names=names)
        header = ply_header(rows).replace(b"end_header", more + b"end_header")
        (tmp_path / "other.ply").write_bytes(header + rows.tobytes())
        with pytest.raises(SplatFileError, match=words):
            load_splat(tmp_path / "other.ply")
