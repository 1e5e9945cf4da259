"""Text and rows with lists, which plyfile reads behind our bounds; and everything else without it."""

import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mi_splat.io import SplatFileError, load_splat, save_splat
from mi_splat.io.points import PointCloud, load_points, save_points
from mi_splat.scene import scene_hash
from tests.gaussians import ply_bytes, ply_header, random_scene, splat_names, splat_rows

ROWS = splat_rows(40, 1)
LISTS = [list(range(i % 4)) for i in range(len(ROWS))]


def listed(encoding: str, order: str = "<", rows: Any = ROWS, lists: Any = LISTS) -> bytes:
    """A splat whose vertices carry a list of shorts before their other properties."""
    head = ply_header(rows, encoding).replace(b"property", b"property list char short seen\nproperty", 1)
    data = b""
    for row, values in zip(rows, lists, strict=True):
        if encoding == "ascii":
            numbers = [len(values), *values, *(float(value) for value in row)]
            data += b" ".join(b"%.9g" % number for number in numbers) + b"\n"
        else:
            floats = row.astype(rows.dtype.newbyteorder(order)).tobytes()
            data += struct.pack(f"{order}b{len(values)}h", len(values), *values) + floats
    return head + data


@pytest.fixture
def plain(tmp_path: Path) -> str:
    """Hash of the scene in the ordinary form."""
    (tmp_path / "plain.ply").write_bytes(ply_bytes(ROWS))
    return scene_hash(load_splat(tmp_path / "plain.ply"))


@pytest.mark.parametrize(
    ("encoding", "order"), [("ascii", ""), ("binary_little_endian", "<"), ("binary_big_endian", ">")]
)
@pytest.mark.parametrize("block", [1, 500, 1 << 20])
def test_lists_of_vertices_are_passed_over(
    encoding: str, order: str, block: int, plain: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("with_plyfile", "body"):
        monkeypatch.setattr(f"mi_splat.io.ply.{module}.BLOCK_BYTES", block)
    (tmp_path / "a.ply").write_bytes(listed(encoding, order))
    assert scene_hash(load_splat(tmp_path / "a.ply")) == plain


@pytest.mark.parametrize(
    ("byte", "says"),
    [
        (b"\xff", "list lengths >= 0 for 40 x vertex, got -1 in row 39"),
        (b"\x7f", "the end of the file in row 39"),
        (b"\x00", "something was appended"),
    ],
)
def test_damaged_list_lengths_are_refused_before_plyfile_sees_them(
    byte: bytes, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = bytearray(listed("binary_little_endian", lists=[[1, 2]] * 40))
    whole[-ROWS.dtype.itemsize - 5] = byte[0]
    (tmp_path / "a.ply").write_bytes(whole)
    monkeypatch.setitem(sys.modules, "plyfile", None)  # an import of it would fail with another message
    with pytest.raises(SplatFileError, match=says):
        load_splat(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (b"-1 1 2 ", "numbers in row 0 of vertex, got '-1 1 2 "),
        (b"9 1 2 ", "numbers in row 0 of vertex, got '9 1 2 "),
        (b"999 1 2 ", "list lengths in rows 0 to 39 of vertex, got .*999"),
        (b"0 1 2 ", "numbers in row 0 of vertex, got '0 1 2 "),
        (b"two 1 2 ", "numbers in row 0 of vertex, got 'two 1 2 "),
    ],
)
def test_damaged_lists_in_text(line: bytes, says: str, tmp_path: Path) -> None:
    whole = listed("ascii", lists=[[1, 2]] * 40).replace(b"\n2 1 2 ", b"\n" + line, 1)
    (tmp_path / "a.ply").write_bytes(whole)
    with pytest.raises(SplatFileError, match=says):
        load_splat(tmp_path / "a.ply")


def test_a_header_that_claims_too_much_costs_no_memory(tmp_path: Path) -> None:
    for encoding, order in (("ascii", ""), ("binary_little_endian", "<")):
        whole = listed(encoding, order).replace(b"vertex 40\n", b"vertex 4000000000\n")
        (tmp_path / "a.ply").write_bytes(whole)
        tracemalloc.start()
        with pytest.raises(SplatFileError, match="truncated"):
            load_splat(tmp_path / "a.ply")
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 1 << 20


def test_a_carriage_return_within_a_line_is_a_blank(plain: str, tmp_path: Path) -> None:
    text = listed("ascii", lists=[[]] * 40).replace(b"\n0 ", b"\n0\r")
    (tmp_path / "a.ply").write_bytes(text)
    assert scene_hash(load_splat(tmp_path / "a.ply")) == plain


def test_text_may_write_integers_with_a_point(tmp_path: Path) -> None:
    head = b"ply\nformat ascii 1.0\nelement vertex 2\n"
    head += b"".join(b"property float %c\n" % axis for axis in b"xyz")
    head += b"".join(b"property uchar %s\n" % name for name in (b"red", b"green", b"blue"))
    (tmp_path / "a.ply").write_bytes(head + b"end_header\n1 2 3 255.0 0 51\n4 5 6 0 0.0 0\n")
    cloud = load_points(tmp_path / "a.ply")
    torch.testing.assert_close(cloud.points, torch.tensor([[1.0, 2, 3], [4, 5, 6]]))
    torch.testing.assert_close(cloud.colours, torch.tensor([[1.0, 0, 0.2], [0, 0, 0]]))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_points_whose_vertices_carry_lists(encoding: str, tmp_path: Path) -> None:
    rows = splat_rows(40, names=["x", "y", "z"])
    (tmp_path / "a.ply").write_bytes(listed(encoding, "<", rows))
    np.testing.assert_array_equal(load_points(tmp_path / "a.ply").points[:, 1], rows["y"])


def test_colours_that_are_lists_are_no_colours(tmp_path: Path) -> None:
    rows = splat_rows(4, names=["x", "y", "z", "green", "blue"])
    data = listed("binary_little_endian", "<", rows, LISTS[:4]).replace(b"short seen", b"short red")
    (tmp_path / "a.ply").write_bytes(data)
    assert (load_points(tmp_path / "a.ply").colours == 0.5).all()


class TestWithoutPlyfile:
    """The package is under the GPL: who leaves it out keeps everything but text and rows with lists."""

    @pytest.fixture(autouse=True)
    def _remove(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "plyfile", None)

    def test_splats_and_points_are_saved_and_loaded(self, tmp_path: Path) -> None:
        scene = random_scene(30)
        save_splat(scene, tmp_path / "a.ply")
        assert torch.equal(load_splat(tmp_path / "a.ply").means, scene.means)
        save_points(PointCloud(scene.means, torch.zeros(30, 3)), tmp_path / "b.ply")
        assert torch.equal(load_points(tmp_path / "b.ply").points, scene.means)

    def test_lists_of_other_elements_are_passed_over(self, tmp_path: Path) -> None:
        face = b"element face 1\nproperty list uchar int indices\nend_header"
        head = ply_header(ROWS).replace(b"end_header", face)
        (tmp_path / "a.ply").write_bytes(head + ROWS.tobytes() + b"\3" + bytes(12))
        assert len(load_splat(tmp_path / "a.ply")) == len(ROWS)

    def test_text_says_what_to_install(self, tmp_path: Path) -> None:
        text = ply_header(ROWS, "ascii") + b"".join(b"0.5 " * len(splat_names(1)) + b"\n" for _ in ROWS)
        for load in (load_splat, load_points):
            (tmp_path / "a.ply").write_bytes(text)
            with pytest.raises(
                SplatFileError, match="the package plyfile, to read text, got none; pip install plyfile"
            ):
                load(tmp_path / "a.ply")

    def test_rows_with_lists_say_what_to_install(self, tmp_path: Path) -> None:
        (tmp_path / "a.ply").write_bytes(listed("binary_little_endian"))
        with pytest.raises(SplatFileError, match="plyfile, to read rows of vertex with lists, got none; pip install"):
            load_splat(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("kind", "largest"), [("uchar", "<u1"), ("uint8", "<u1"), ("ushort", "<u2"), ("uint16", "<u2")]
)
def test_colours_of_every_unsigned_kind(kind: str, largest: str, tmp_path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    full = np.iinfo(largest).max
    data = np.zeros(3, "<f4").tobytes() + np.array([full, 0, full], largest).tobytes()
    (tmp_path / "a.ply").write_bytes(head.encode() + data)
    torch.testing.assert_close(load_points(tmp_path / "a.ply").colours, torch.tensor([[1.0, 0.0, 1.0]]))
