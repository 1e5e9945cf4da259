"""Splat files as other programs write them: every one of them is the same scene."""

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from numpy.typing import NDArray

from mi_splat.io import load_splat
from mi_splat.scene import scene_hash
from tests.gaussians import ply_bytes, ply_header, splat_names, splat_rows

ROWS = splat_rows(40, 1)


def text(rows: Iterable[Any]) -> bytes:
    """Rows as lines of decimals that hold a float32 exactly."""
    return b"".join(b" ".join(b"%.9g" % float(value) for value in row) + b"\n" for row in rows)


def reordered(rows: NDArray[np.void], names: list[str]) -> NDArray[np.void]:
    other = np.zeros(len(rows), [(name, rows.dtype[name]) for name in names])
    for name in names:
        other[name] = rows[name]
    return other


@pytest.fixture
def plain(tmp_path: Path) -> str:
    """Hash of the scene in the ordinary form."""
    (tmp_path / "plain.ply").write_bytes(ply_bytes(ROWS))
    return scene_hash(load_splat(tmp_path / "plain.ply"))


def same(data: bytes, plain: str, folder: Path) -> None:
    path = folder / "other.ply"
    path.write_bytes(data)
    assert scene_hash(load_splat(path)) == plain


def test_without_normals(plain: str, tmp_path: Path) -> None:
    same(ply_bytes(reordered(ROWS, splat_names(1, normals=False))), plain, tmp_path)


@hypothesis.settings(suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture], max_examples=15)
@hypothesis.given(names=st.permutations(splat_names(1)))
def test_in_any_order(names: list[str], plain: str, tmp_path: Path) -> None:
    same(ply_bytes(reordered(ROWS, names)), plain, tmp_path)
    rows = reordered(ROWS, names)
    same(ply_header(rows, "ascii") + text(rows), plain, tmp_path)


def test_big_endian(plain: str, tmp_path: Path) -> None:
    data = ply_header(ROWS, "binary_big_endian") + ROWS.astype(ROWS.dtype.newbyteorder(">")).tobytes()
    same(data, plain, tmp_path)


@pytest.mark.parametrize("order", ["<", ">"])
def test_doubles_and_mixtures(order: str, plain: str, tmp_path: Path) -> None:
    encoding = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    doubles = {"all": splat_names(1), "means": ["x", "y", "z"], "one": ["f_rest_4"], "rot": ["rot_2", "opacity"]}
    for names in doubles.values():
        kinds = [(name, f"{order}f{8 if name in names else 4}") for name in splat_names(1)]
        rows = ROWS.astype(kinds)
        same(ply_header(rows, encoding) + rows.tobytes(), plain, tmp_path)


def test_doubles_keep_their_precision_through_the_activation(tmp_path: Path) -> None:
    rows = ROWS.astype([(name, "<f8") for name in splat_names(1)])
    rows["scale_0"] = -7 + 1e-8 * np.arange(len(rows))
    (tmp_path / "a.ply").write_bytes(ply_bytes(rows))
    np.testing.assert_allclose(load_splat(tmp_path / "a.ply").scales[:, 0], np.exp(rows["scale_0"]), 6e-8)


@pytest.mark.parametrize("index", [0, 3, 24])
def test_further_properties_are_passed_over(index: int, plain: str, tmp_path: Path) -> None:
    names = splat_names(1)
    kinds = [(name, "<f4") for name in names]
    kinds[index:index] = [("red", "|u1"), ("segment", "<i2"), ("confidence", "<f8")]
    rows = np.zeros(len(ROWS), kinds)
    for name in names:
        rows[name] = ROWS[name]
    rows["confidence"] = np.nan
    same(ply_bytes(rows), plain, tmp_path)
    same(ply_header(rows, "ascii") + text(rows), plain, tmp_path)


def test_normals_may_be_anything(plain: str, tmp_path: Path) -> None:
    rows = ROWS.copy()
    rows["nx"], rows["ny"] = np.nan, np.inf
    same(ply_bytes(rows), plain, tmp_path)


def elements(before: str, after: str, data_before: bytes, data_after: bytes) -> bytes:
    """The ordinary file with further elements around the vertices."""
    head, _, _ = ply_header(ROWS).partition(b"end_header\n")
    head = head.replace(b"element vertex", before.encode() + b"element vertex")
    return head + after.encode() + b"end_header\n" + data_before + ROWS.tobytes() + data_after


CAMERA = "element camera 2\nproperty float focal\nproperty uchar kind\n"
FACE = "element face 3\nproperty uchar flags\nproperty list uchar int vertex_indices\nproperty float area\n"
FACES = b"".join(bytes([7, n]) + bytes(4 * n) + bytes(4) for n in (3, 0, 4))


@pytest.mark.parametrize(
    "data",
    [
        elements(CAMERA, "", bytes(10), b""),
        elements("", CAMERA, b"", bytes(10)),
        elements(FACE, "", FACES, b""),
        elements("", FACE, b"", FACES),
        elements(CAMERA, FACE, bytes(10), FACES),
        elements("element nothing 0\nproperty list int int indices\n", "", b"", b""),
    ],
    ids=["fixed before", "fixed after", "lists before", "lists after", "both", "empty"],
)
def test_further_elements_are_passed_over(data: bytes, plain: str, tmp_path: Path) -> None:
    same(data, plain, tmp_path)


def test_further_elements_in_text(plain: str, tmp_path: Path) -> None:
    head = ply_header(ROWS, "ascii").replace(b"element vertex", FACE.encode() + b"element vertex")
    head = head.replace(b"end_header", CAMERA.encode() + b"end_header")
    same(head + b"7 3 0 1 2 1.5\n0 0 1\n0 1 5 2\n" + text(ROWS) + b"1 1\n2 2\n\n", plain, tmp_path)


@pytest.mark.parametrize("newline", [b"\r\n", b"\r"])
def test_other_line_endings(newline: bytes, plain: str, tmp_path: Path) -> None:
    same(ply_header(ROWS).replace(b"\n", newline) + ROWS.tobytes(), plain, tmp_path)


def test_crlf_text(plain: str, tmp_path: Path) -> None:
    same((ply_header(ROWS, "ascii") + text(ROWS)).replace(b"\n", b"\r\n"), plain, tmp_path)


def test_text_with_blank_lines_tabs_and_no_last_newline(plain: str, tmp_path: Path) -> None:
    body = text(ROWS).replace(b" ", b"\t ").replace(b"\n", b"\n\n").rstrip()
    same(ply_header(ROWS, "ascii") + body, plain, tmp_path)


def test_comments_anywhere_in_the_header_and_in_any_encoding(plain: str, tmp_path: Path) -> None:
    comments = "comment Größe \u2713\nobj_info end_header or not\n".encode() + b"comment \xff\xfe latin\ncomment\n"
    head = ply_header(ROWS)
    for before in (b"format", b"element", b"property float x\n", b"end_header"):
        same(head.replace(before, comments + before, 1) + ROWS.tobytes(), plain, tmp_path)


def test_sized_names_of_kinds_and_spare_blanks(plain: str, tmp_path: Path) -> None:
    head = ply_header(ROWS).replace(b"property float", b"property  float32").replace(b"end_header\n", b"end_header \n")
    same(head + ROWS.tobytes(), plain, tmp_path)


def test_binary_data_may_begin_with_a_newline(tmp_path: Path) -> None:
    rows = splat_rows(2)
    rows["x"][0] = np.frombuffer(b"\n\n\r\n", "<f4")[0]
    for newline in (b"\n", b"\r\n"):
        (tmp_path / "a.ply").write_bytes(ply_header(rows).replace(b"\n", newline) + rows.tobytes())
        assert load_splat(tmp_path / "a.ply").means[0, 0] == rows["x"][0]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_empty_splats(degree: int, encoding: str, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply_header(splat_rows(0, degree), encoding))
    scene = load_splat(tmp_path / "a.ply")
    assert (len(scene), scene.degree) == (0, degree)


def test_paths_may_be_text_or_relative(plain: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert scene_hash(load_splat("plain.ply")) == plain


def test_large_text_crosses_the_borders_of_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mi_splat.io.ply.with_plyfile.BLOCK_BYTES", 2000)
    (tmp_path / "a.ply").write_bytes(ply_header(ROWS, "ascii") + text(ROWS))
    np.testing.assert_array_equal(load_splat(tmp_path / "a.ply").means[:, 2], ROWS["z"])


def test_text_holds_what_numpy_prints(tmp_path: Path) -> None:
    rows = splat_rows(3)
    lines = io.BytesIO()
    np.savetxt(lines, rows.view("<f4").reshape(3, -1), fmt="%.18e")
    (tmp_path / "a.ply").write_bytes(ply_header(rows, "ascii") + lines.getvalue())
    assert torch.equal(load_splat(tmp_path / "a.ply").means, torch.from_numpy(np.stack([rows[c] for c in "xyz"], 1)))
