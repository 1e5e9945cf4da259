"""Bad splat files: one error type that says what was expected, found and to do, and no large allocation."""

import os
import re
import socket
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io import SplatFileError, SplatFileWarning, load_splat
from mi_splat.scene import GaussianScene
from tests.gaussians import ply_bytes, ply_header, splat_names, splat_rows

ROWS = splat_rows(10, 1)
HEAD = ply_header(ROWS)
BODY = ROWS.tobytes()
TEXT_HEAD = ply_header(ROWS, "ascii")
LINE = b" ".join([b"0.5"] * len(splat_names(1))) + b"\n"
FACE = b"element face 2\nproperty list char int indices\n"


def with_elements(after: bytes, data: bytes) -> bytes:
    return HEAD.replace(b"end_header", after + b"end_header") + BODY + data


def without(name: str) -> bytes:
    names = [other for other in splat_names(1) if other != name]
    return ply_bytes(splat_rows(3, names=names))


BAD = {
    "empty file": (b"", "an empty file"),
    "no PLY": (b"solid cube\n" * 50, r"first line 'ply'.*b'solid cu'"),
    "an image": (b"\x89PNG\r\n\x1a\n" + bytes(1000), "first line 'ply'"),
    "ply without newline": (b"ply", "first line 'ply'"),
    "plyx": (b"plyx\nformat ascii 1.0\nend_header\n", "first line 'ply'"),
    "byte order mark": (b"\xef\xbb\xbf" + HEAD + BODY, "first line 'ply'"),
    "header ends early": (HEAD[:100], "end of the file after 100 bytes; the file is truncated"),
    "header without end": (HEAD.replace(b"end_header\n", b"") + BODY, "ends with end_header"),
    "header never ends": (HEAD[:-11] + b"comment x\n" * 10**4, "no end_header in the first 65536 bytes"),
    "header is zeros": (b"ply\n" + bytes(10**5), "no end_header"),
    "no format": (HEAD.replace(b"format binary_little_endian 1.0\n", b"") + BODY, "'format' with ascii.*got 'element"),
    "format twice": (HEAD.replace(b"element", b"format ascii 1.0\nelement", 1) + BODY, "got 'format ascii 1.0'"),
    "unknown format": (HEAD.replace(b"little", b"middle") + BODY, "got 'format binary_middle_endian 1.0'"),
    "unknown version": (HEAD.replace(b"1.0", b"2.0") + BODY, "got 'format binary_little_endian 2.0'"),
    "nothing in the header": (b"ply\nformat ascii 1.0\nend_header\n", "elements in the header, got none"),
    "only the first line": (b"ply\nend_header\n", "got no such line"),
    "unknown line": (HEAD.replace(b"element", b"elephant", 1) + BODY, "got 'elephant vertex 10'"),
    "property first": (HEAD.replace(b"element vertex 10\n", b"") + BODY, "'element' and then 'property'"),
    "no vertex": (HEAD.replace(b"vertex", b"points") + BODY, "an element named vertex, got points"),
    "no properties": (b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n", "properties of vertex.*got none"),
    "element twice": (with_elements(b"element vertex 1\nproperty int i\n", bytes(4)), "vertex twice"),
    "property twice": (HEAD.replace(b"float opacity", b"float x") + BODY, "x twice"),
    "unknown kind": (HEAD.replace(b"float opacity", b"half opacity") + BODY, "got 'property half opacity'"),
    "property without name": (HEAD.replace(b"float opacity", b"float") + BODY, "got 'property float'"),
    "name in Latin-1": (HEAD.replace(b"nx", b"n\xe9") + BODY, r"names in ASCII, got b'n\\xe9'"),
    "list length in floats": (with_elements(FACE.replace(b"char", b"float"), b""), "an integer list length"),
    "unknown list": (with_elements(FACE.replace(b"char", b"half"), b""), "property list KIND KIND NAME"),
    "negative count": (HEAD.replace(b"vertex 10", b"vertex -1") + BODY, "not negative, got 'element vertex -1'"),
    "count in words": (HEAD.replace(b"vertex 10", b"vertex ten") + BODY, "got 'element vertex ten'"),
    "count with a point": (HEAD.replace(b"vertex 10", b"vertex 10.0") + BODY, "got 'element vertex 10.0'"),
    "count of 5000 digits": (HEAD.replace(b"vertex 10", b"vertex " + b"9" * 5000) + BODY, "got 'element vertex 9{65}'"),
    "no count": (HEAD.replace(b"vertex 10", b"vertex") + BODY, "got 'element vertex'"),
    "truncated by a byte": (HEAD + BODY[:-1], r"expected \d+ bytes for 10 x vertex, got \d+ bytes; it is truncated"),
    "truncated by a row": (HEAD + BODY[: -len(BODY) // 10], "it is truncated"),
    "no data": (HEAD, "it is truncated"),
    "one byte more": (HEAD + BODY + b"\0", "something was appended"),
    "count too small": (ply_header(ROWS, count=9) + BODY, "or the count is wrong"),
    "count too large": (ply_header(ROWS, count=11) + BODY, "it is truncated"),
    "10^12 vertices": (ply_header(ROWS, count=10**12) + BODY, r"bytes for 1000000000000 x vertex"),
    "10^17 vertices": (ply_header(ROWS, count=10**17) + BODY, "it is truncated"),
    "10^12 vertices in text": (TEXT_HEAD.replace(b"x 10\n", b"x 1000000000000\n") + LINE * 10, "it is truncated"),
    "10^12 of another element": (with_elements(b"element e 1000000000000\nproperty int i\n", b""), "it is truncated"),
    "10^12 faces": (with_elements(FACE.replace(b"2", b"1000000000000"), b"\0\0"), "at least 10{12} bytes.*truncated"),
    "faces end early": (with_elements(FACE, b"\1" + bytes(4)), "end of the file in row 1"),
    "face ends early": (with_elements(FACE, b"\0\1" + bytes(3)), "end of the file in row 1"),
    "negative list length": (with_elements(FACE, b"\0\xff"), "list lengths >= 0.*got -1 in row 1"),
    "long list": (with_elements(FACE.replace(b"char", b"uint"), b"\xff" * 4 + bytes(40)), "end of the file in row 0"),
    "more after the faces": (with_elements(FACE, bytes(3)), "something was appended"),
    "list in vertex": (HEAD.replace(b"float nx", b"list uchar float nx") + BODY, "something was appended|truncated"),
    "list for a value": (HEAD.replace(b"float x", b"list uchar float x") + BODY, "a single number, got the list x"),
    "no x": (without("x"), "properties of a 3DGS splat, got no x;"),
    "no opacity": (without("opacity"), "got no opacity;"),
    "no rot_3": (without("rot_3"), "got no rot_3;"),
    "no scale_1": (without("scale_1"), "got no scale_1;"),
    "no f_dc_2": (without("f_dc_2"), "got no f_dc_2;"),
    "no f_rest_5": (without("f_rest_5"), "0, 9, 24 or 45 properties f_rest.*got 8"),
    "f_rest misnamed": (HEAD.replace(b"f_rest_8", b"f_rest_9") + BODY, "got no f_rest_8;"),
    "a point cloud": (ply_bytes(splat_rows(3, names=["x", "y", "z"])), "got no scale_0, .* and 6 more"),
    "integer property": (HEAD.replace(b"float f_dc_1", b"int f_dc_1") + BODY, r"f_dc_1 as float.*integer \(i4\)"),
    "text too short": (TEXT_HEAD + LINE * 9 + b"\n" * 100, "10 rows of vertex, got 9"),
    "text of the shortest rows, one too few": (
        TEXT_HEAD + (b"0 " * 25 + b"0\n") * 9,
        rf"at least {len(TEXT_HEAD) + 10 * 52 - 1} bytes of text",
    ),
    "text too long": (TEXT_HEAD + LINE * 11, "more lines"),
    "text row too short": (TEXT_HEAD + LINE * 9 + LINE[4:] + b" " * 99, "26 numbers in row 9 of vertex, got 25"),
    "text row too long": (TEXT_HEAD + LINE * 9 + b"1 " + LINE, "26 numbers in row 9 of vertex, got 27"),
    "words in text": (TEXT_HEAD + LINE * 9 + LINE.replace(b"0.5", b"red", 1), "numbers in row 9 of vertex, got.*red"),
    "bytes in text": (TEXT_HEAD + LINE * 9 + LINE.replace(b"0.5", b"\xff\xfe", 1), "numbers in row 9 of vertex"),
    "endless line in text": (TEXT_HEAD + b"0.5 " * (1 << 19), "lines under 1048576 bytes"),
    "text for binary": (HEAD + LINE * 11, "something was appended|truncated"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_raise_one_error_with_what_was_expected_found_and_to_do(name: str, tmp_path: Path) -> None:
    data, words = BAD[name]
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    tracemalloc.start()
    with pytest.raises(SplatFileError, match=words) as caught:
        load_splat(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert re.fullmatch(rf"{re.escape(str(path))}: expected .+, got .+; .+", str(caught.value), re.DOTALL)
    assert len(str(caught.value)) < len(str(path)) + 300
    assert isinstance(caught.value, MiSplatError)
    assert peak < 4 << 20


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"x": np.nan}, "x is nan"),
        ({"f_rest_8": np.inf}, "f_rest_8 is inf"),
        ({"f_dc_0": -np.inf}, "f_dc_0 is -inf"),
        ({"opacity": np.inf}, "opacity is inf"),
        ({"scale_2": np.nan}, "scale_2 is nan"),
        ({"rot_1": np.nan}, "rot_1 is nan"),
        ({"rot_0": 0, "rot_1": 0, "rot_2": 0, "rot_3": 0}, "the quaternion is zero"),
        ({"scale_1": 100.0}, r"log-scales \[.*100.0.*\] are scales outside of float32's range or above 1e\+09"),
        ({"scale_1": -200.0}, r"log-scales \[.*-200.0.*\] are scales outside.*"),
        ({"x": 1e30}, r"x is 1e\+30"),
        ({"z": -2e9}, r"z is -2e\+09"),
        ({"f_rest_8": 1e30}, r"f_rest_8 is 1e\+30"),
        ({"scale_1": 21.0}, r"log-scales \[.*21.0.*\] are scales.*"),
    ],
)
def test_invalid_gaussians_are_refused_or_dropped(change: dict[str, float], words: str, tmp_path: Path) -> None:
    rows, path = splat_rows(10, 1), tmp_path / "a.ply"
    for name, value in change.items():
        rows[name][[3, 7]] = value
    path.write_bytes(ply_bytes(rows))
    message = rf"valid Gaussians, got 2 of 10 that are not \(rows 3, 7; in the first, {words}\)"
    with pytest.raises(SplatFileError, match=message + "; repair it, or drop them"):
        load_splat(path)
    with pytest.warns(SplatFileWarning, match=message + "; they were left out") as caught:
        scene = load_splat(path, on_invalid="drop")
    assert caught[0].filename == __file__
    np.testing.assert_array_equal(scene.means[:, 0], np.delete(rows["x"], [3, 7]))
    GaussianScene(*scene.tensors())


def test_doubles_that_leave_float32_are_invalid(tmp_path: Path) -> None:
    rows = splat_rows(4).astype([(name, "<f8") for name in splat_names(0)])
    rows["x"][1], rows["f_dc_0"][2] = 1e200, -1e200
    (tmp_path / "a.ply").write_bytes(ply_bytes(rows))
    with pytest.raises(SplatFileError, match="2 of 4 that are not"):
        load_splat(tmp_path / "a.ply")


def test_many_invalid_gaussians_in_many_blocks_are_counted_in_order(tmp_path: Path) -> None:
    rows = splat_rows(50_000, 1)
    rows["z"][::2] = np.nan
    (tmp_path / "a.ply").write_bytes(ply_bytes(rows))
    with pytest.raises(SplatFileError, match=r"25000 of 50000 that are not \(rows 0, 2, 4, 6, 8, \.\.\.; in the first"):
        load_splat(tmp_path / "a.ply")
    with pytest.warns(SplatFileWarning):
        scene = load_splat(tmp_path / "a.ply", on_invalid="drop")
    np.testing.assert_array_equal(scene.means[:, 0], rows["x"][1::2])


def test_all_gaussians_may_be_dropped(tmp_path: Path) -> None:
    rows = splat_rows(5)
    rows["x"] = np.nan
    (tmp_path / "a.ply").write_bytes(ply_bytes(rows))
    with pytest.warns(SplatFileWarning, match="5 of 5"):
        assert len(load_splat(tmp_path / "a.ply", on_invalid="drop")) == 0


def test_nan_in_text(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(TEXT_HEAD + LINE * 9 + LINE.replace(b"0.5", b"nan", 1))
    with pytest.raises(SplatFileError, match=r"1 of 10 .*rows 9; in the first, x is nan"):
        load_splat(tmp_path / "a.ply")


def test_on_invalid_has_two_values(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="on_invalid: expected 'raise' or 'drop', got 'ignore'"):
        load_splat(tmp_path / "a.ply", on_invalid="ignore")  # type: ignore[arg-type]


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(SplatFileError, match="got No such file or directory; check the path"):
        load_splat(tmp_path / "none.ply")
    with pytest.raises(SplatFileError, match="got Is a directory; name a file inside the folder"):
        load_splat(tmp_path)
    (tmp_path / "file").write_bytes(HEAD + BODY)
    for name in ("attacked.ply", "splat.ply"):  # of an attack, and of a training
        (tmp_path / name).write_bytes(HEAD + BODY)
        assert len(load_splat(tmp_path)) == len(load_splat(tmp_path / name))
    with pytest.raises(SplatFileError, match="got Not a directory"):
        load_splat(tmp_path / "file" / "a.ply")


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.ply").write_bytes(HEAD + BODY)

    def refuse(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)  # root may read everything
    with pytest.raises(SplatFileError, match="got Permission denied; change its permissions"):
        load_splat(tmp_path / "a.ply")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything")
def test_no_permission_for_real(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(HEAD + BODY)
    (tmp_path / "a.ply").chmod(0)
    with pytest.raises(SplatFileError, match="Permission denied"):
        load_splat(tmp_path / "a.ply")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes on this system")
def test_pipes_devices_and_sockets_are_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SplatFileError, match="a special file"):
        load_splat(tmp_path / "pipe")
    with pytest.raises(SplatFileError, match="a special file"):
        load_splat("/dev/zero")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(tmp_path / "socket"))
        with pytest.raises(SplatFileError):
            load_splat(tmp_path / "socket")


def test_a_file_that_shrinks_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.ply").write_bytes(HEAD + BODY)
    real = os.fstat

    def longer(descriptor: int) -> os.stat_result:
        status = real(descriptor)
        return os.stat_result([*status[:6], len(ply_header(ROWS, count=11)) + len(BODY) * 11 // 10, *status[7:]])

    (tmp_path / "a.ply").write_bytes(ply_header(ROWS, count=11) + BODY)
    monkeypatch.setattr("mi_splat.io.ply.body.os.fstat", longer)
    with pytest.raises(SplatFileError, match="it shrank"):
        load_splat(tmp_path / "a.ply")


def test_a_disk_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.ply").write_bytes(HEAD + BODY)

    def fail(*_: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("mi_splat.io.ply.body._fill", fail)
    with pytest.raises(SplatFileError, match="got Input/output error; check the disk and try again"):
        load_splat(tmp_path / "a.ply")
