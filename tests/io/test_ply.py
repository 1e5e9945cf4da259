"""Splats as PLY in every form that programs write: the same scene, or one error with
what was expected and to do.
"""

import os
import socket
import sys
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from mi_splat.audit.linting import lint_file
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io import SplatFileError, SplatFileWarning, load_splat, save_splat
from mi_splat.io.points import PointCloud, load_points, save_points
from mi_splat.scene import GaussianScene, scene_hash
from tests.gaussians import ply_bytes, ply_header, random_scene, splat_names, splat_rows
from tests.io.ply_files import (
    BODY,
    HEAD,
    ROWS,
    TEXT_HEAD,
    encoded,
    listed,
    reordered,
    text,
    widened,
    with_elements,
)

ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]
NEEDED = splat_names(1, normals=False)
NOT_FINITE = ROWS.copy()
NOT_FINITE["nx"], NOT_FINITE["ny"] = np.nan, np.inf


def more_properties(index: int) -> np.ndarray:
    """Rows with properties of other programs."""
    kinds = [(name, "<f4") for name in splat_names(1)]
    kinds[index:index] = [("red", "|u1"), ("segment", "<i2"), ("confidence", "<f8")]
    rows = np.zeros(len(ROWS), kinds)
    for name in splat_names(1):
        rows[name] = ROWS[name]
    rows["confidence"] = np.nan
    return rows


CAMERA = b"element camera 2\nproperty float focal\nproperty uchar kind\n"
FACES = (
    b"element face 3\nproperty uchar flags\nproperty list uchar int"
    b" vertex_indices\nproperty float area\n"
)
FACE_DATA = b"".join(bytes([7, n]) + bytes(4 * n) + bytes(4) for n in (3, 0, 4))
COMMENTS = (
    "comment Größe \u2713\nobj_info end_header or not\n".encode()
    + b"comment \xff\xfe latin\ncomment\n"
)
SAME = {
    "no normals": ply_bytes(reordered(ROWS, NEEDED)),
    "normals not finite": ply_bytes(NOT_FINITE),
    **{
        f"doubles {names[0]} {order}": encoded(widened(ROWS, names, order), encoding)
        for order, encoding in (("<", ENCODINGS[1]), (">", ENCODINGS[2]))
        for names in (splat_names(1), ["z"], ["f_rest_4"], ["rot_2", "opacity"])
    },
    **{
        f"{encoding} with more properties at {index}": encoded(
            more_properties(index), encoding
        )
        for encoding in ENCODINGS[:2]
        for index in (0, 3, 24)
    },
    **{f"{encoding} with lists": listed(encoding) for encoding in ENCODINGS},
    "fixed before": with_elements(b"", b"", CAMERA, bytes(10)),
    "fixed after": with_elements(CAMERA, bytes(10)),
    "lists before": with_elements(b"", b"", FACES, FACE_DATA),
    "lists after": with_elements(FACES, FACE_DATA),
    "both": with_elements(FACES, FACE_DATA, CAMERA, bytes(10)),
    "empty": with_elements(
        b"", b"", b"element nothing 0\nproperty list int int indices\n"
    ),
    "elements in text": (
        ply_header(ROWS, "ascii")
        .replace(b"element vertex", FACES + b"element vertex")
        .replace(b"end_header", CAMERA + b"end_header")
        + b"7 3 0 1 2 1.5\n0 0 1\n0 1 5 2\n"
        + text(ROWS)
        + b"1 1\n2 2\n\n"
    ),
    "CRLF header": HEAD.replace(b"\n", b"\r\n") + BODY,
    "CR header": HEAD.replace(b"\n", b"\r") + BODY,
    "CRLF text": encoded(ROWS, "ascii").replace(b"\n", b"\r\n"),
    "blank lines, tabs, no last newline": (
        TEXT_HEAD + text(ROWS).replace(b" ", b"\t ").replace(b"\n", b"\n\n").rstrip()
    ),
    **{
        f"comments before {line.decode()}": (
            HEAD.replace(line, COMMENTS + line, 1) + BODY
        )
        for line in (b"format", b"element", b"property float x\n", b"end_header")
    },
    "sized kinds and blanks": (
        HEAD.replace(b"property float", b"property  float32").replace(
            b"header\n", b"header \n"
        )
        + BODY
    ),
}


def load(data: bytes, folder: Path) -> GaussianScene:
    (folder / "a.ply").write_bytes(data)
    return load_splat(folder / "a.ply")


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Hash of the scene in the ordinary form."""
    return scene_hash(load(HEAD + BODY, tmp_path_factory.mktemp("plain")))


@pytest.mark.parametrize("form", SAME)
def test_other_forms_are_the_same_scene(form: str, plain: str, tmp_path: Path) -> None:
    assert scene_hash(load(SAME[form], tmp_path)) == plain


@hypothesis.settings(
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],
    max_examples=10,
)
@hypothesis.given(
    names=st.permutations(splat_names(1)), encoding=st.sampled_from(ENCODINGS)
)
def test_properties_in_any_order(
    names: list[str], encoding: str, plain: str, tmp_path: Path
) -> None:
    assert (
        scene_hash(load(encoded(reordered(ROWS, names), encoding), tmp_path)) == plain
    )


def test_doubles_keep_their_precision_through_the_activation(tmp_path: Path) -> None:
    rows = widened(ROWS, splat_names(1))
    rows["scale_0"] = -7 + 1e-8 * np.arange(len(rows))
    np.testing.assert_allclose(
        load(ply_bytes(rows), tmp_path).scales[:, 0], np.exp(rows["scale_0"]), 6e-8
    )


def test_binary_data_may_begin_with_a_newline(tmp_path: Path) -> None:
    rows = splat_rows(2)
    rows["x"][0] = np.frombuffer(b"\n\n\r\n", "<f4")[0]
    for newline in (b"\n", b"\r\n"):
        assert (
            load(
                ply_header(rows).replace(b"\n", newline) + rows.tobytes(), tmp_path
            ).means[0, 0]
            == rows["x"][0]
        )


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_empty_splats(degree: int, encoding: str, tmp_path: Path) -> None:
    scene = load(ply_header(splat_rows(0, degree), encoding), tmp_path)
    assert (len(scene), scene.degree) == (0, degree)


# What other trainers write


def test_a_splat_of_2dgs_is_read_as_flat_gaussians(tmp_path: Path) -> None:
    flat = ply_bytes(
        reordered(ROWS, [name for name in splat_names(1) if name != "scale_2"])
    )
    with pytest.warns(
        SplatFileWarning, match="expected three scales, got two .a 2DGS splat."
    ):
        scene = load(flat, tmp_path)
    torch.testing.assert_close(scene.scales[:, 2], scene.scales[:, :2].amin(1) * 1e-3)


def test_the_fourth_degree_is_left_out_with_a_warning(tmp_path: Path) -> None:
    names = [f"f_rest_{i}" for i in range(72)]
    rows = splat_rows(3, names=[*splat_names(0), *names])
    with pytest.warns(SplatFileWarning, match="SH of degree 0 to 3, got 4"):
        scene = load(ply_bytes(rows), tmp_path)
    np.testing.assert_array_equal(scene.sh[:, 15, 1], rows["f_rest_38"])
    np.testing.assert_array_equal(scene.sh[:, 1, 2], rows["f_rest_48"])


def test_colours_of_nerfstudio_are_read(tmp_path: Path) -> None:
    kinds = [(name, "<f4") for name in NEEDED if "f_" not in name] + [
        (name, "u1") for name in ("red", "green", "blue")
    ]
    rows = np.zeros(2, kinds)
    rows["rot_0"], rows["red"], rows["blue"] = 1, [0, 255], [51, 51]
    np.testing.assert_allclose(
        load(ply_bytes(rows), tmp_path).sh[:, 0, 0] * 0.28209479 + 0.5,
        [0, 1],
        atol=1e-6,
    )


def test_the_filter_of_mip_splatting_is_applied(tmp_path: Path) -> None:
    rows = splat_rows(5, names=[*splat_names(0), "filter_3D"])
    plain = load(ply_bytes(reordered(rows, splat_names(0))), tmp_path)
    with pytest.warns(SplatFileWarning, match="trained with antialiasing"):
        scene = load(ply_bytes(rows), tmp_path)
    squares = plain.scales.double() ** 2
    wider = (
        squares + torch.from_numpy(rows["filter_3D"].astype(np.float64))[:, None] ** 2
    )
    torch.testing.assert_close(scene.scales.double(), wider.sqrt(), rtol=1e-6, atol=0)
    kept = (squares.prod(1) / wider.prod(1)).sqrt()
    torch.testing.assert_close(
        scene.opacities.double(), plain.opacities * kept, rtol=1e-5, atol=0
    )


def test_infinite_logits_and_scales_of_zero_are_read(tmp_path: Path) -> None:
    """As SuperSplat and splat-transform do: opaque, invisible, flat, and a point."""
    rows = splat_rows(5, 1)
    rows["opacity"][:2] = np.inf, -np.inf
    rows["scale_1"][2] = -np.inf
    for axis in range(3):
        rows[f"scale_{axis}"][3] = -np.inf
    plain = load(ply_bytes(splat_rows(5, 1)), tmp_path)
    scene = load(ply_bytes(rows), tmp_path)
    assert scene.opacities[:2].tolist() == [1.0, 0.0]
    assert float(scene.scales[2, 1]) == pytest.approx(
        1e-3 * float(scene.scales[2, [0, 2]].min()), rel=1e-5
    )
    assert scene.scales[3].tolist() == pytest.approx([1e-9] * 3)
    assert torch.equal(scene.scales[4], plain.scales[4])
    assert lint_file(tmp_path / "a.ply").findings[0].rule == "infinite"


# Gaussians that are not valid, and paths that lead to no file


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"x": np.nan}, "a coordinate of the mean is nan"),
        ({"f_rest_8": np.inf}, "an SH coefficient is inf"),
        ({"opacity": np.nan}, "the opacity is nan"),
        ({"scale_2": np.nan}, "a scale is nan"),
        ({"rot_1": np.nan}, "the quaternion is zero or not finite"),
        (
            {"rot_0": 0, "rot_1": 0, "rot_2": 0, "rot_3": 0},
            "the quaternion is zero or not finite",
        ),
        ({"scale_1": 100.0}, "a scale is inf"),
        ({"scale_1": -200.0}, "a scale is 0"),
        ({"z": -2e9}, r"a coordinate of the mean is -2e\+09"),
        ({"f_rest_8": 1e30}, r"an SH coefficient is 1e\+30"),
    ],
)
def test_invalid_gaussians_are_refused_or_dropped(
    change: dict[str, float], words: str, tmp_path: Path
) -> None:
    rows = splat_rows(10, 1)
    for name, value in change.items():
        rows[name][[3, 7]] = value
    message = (
        r"valid Gaussians, got 2 of 10 that are not \(rows 3, 7; in the first,"
        rf" {words}\)"
    )
    with pytest.raises(SplatFileError, match=message + "; repair it, or drop them"):
        load(ply_bytes(rows), tmp_path)
    with pytest.warns(
        SplatFileWarning, match=message + "; they were left out"
    ) as caught:
        scene = load_splat(tmp_path / "a.ply", on_invalid="drop")
    assert caught[0].filename == __file__
    np.testing.assert_array_equal(scene.means[:, 0], np.delete(rows["x"], [3, 7]))
    GaussianScene(*scene.tensors())


def test_all_gaussians_may_be_dropped(tmp_path: Path) -> None:
    rows = splat_rows(9)
    rows["x"] = np.nan
    with pytest.raises(
        SplatFileError,
        match=r"9 of 9 that are not \(rows 0, 1, 2, 3, 4, \.\.\.; in the first",
    ):
        load(ply_bytes(rows), tmp_path)
    with pytest.warns(SplatFileWarning, match="9 of 9"):
        assert len(load_splat(tmp_path / "a.ply", on_invalid="drop")) == 0
    with pytest.raises(
        InvalidValueError, match="on_invalid: expected 'raise' or 'drop', got 'ignore'"
    ):
        load_splat(tmp_path / "a.ply", on_invalid="ignore")  # type: ignore[arg-type]


def test_paths_that_lead_to_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(
        SplatFileError, match="got No such file or directory; check the path"
    ):
        load_splat(tmp_path / "none.ply")
    with pytest.raises(
        SplatFileError, match="got a folder; name a file inside the folder"
    ):
        load_splat(tmp_path)
    # the first two are what an attack and a training write
    for name in ("attacked.ply", "splat.ply", "file"):
        (tmp_path / name).write_bytes(HEAD + BODY)
        assert len(load_splat(tmp_path)) == len(load_splat(tmp_path / "attacked.ply"))
    with pytest.raises(SplatFileError, match="got Not a directory"):
        load_splat(tmp_path / "file" / "a.ply")
    monkeypatch.chdir(tmp_path)
    assert len(load_splat("splat.ply")) == len(ROWS)

    def refuse(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)  # root may read everything
    with pytest.raises(
        SplatFileError, match="got Permission denied; change its permissions"
    ):
        load_splat(tmp_path / "splat.ply")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes on this system")
def test_pipes_devices_and_sockets_are_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(SplatFileError, match="a special file"):
            load_splat(path)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(tmp_path / "socket"))
        with pytest.raises(SplatFileError):
            load_splat(tmp_path / "socket")


class TestWithoutPlyfile:
    """The package is under the GPL: who leaves it out keeps everything but text and
    rows with lists.
    """

    @pytest.fixture(autouse=True)
    def _remove(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "plyfile", None)

    def test_binary_files_are_saved_and_loaded(self, tmp_path: Path) -> None:
        scene = random_scene(30)
        save_splat(scene, tmp_path / "a.ply")
        assert torch.equal(load_splat(tmp_path / "a.ply").means, scene.means)
        save_points(PointCloud(scene.means, torch.zeros(30, 3)), tmp_path / "b.ply")
        assert torch.equal(load_points(tmp_path / "b.ply").points, scene.means)
        assert len(load(with_elements(FACES, FACE_DATA), tmp_path)) == len(ROWS)

    @pytest.mark.parametrize(
        ("data", "what"),
        [(encoded(ROWS, "ascii"), "text"), (listed(ENCODINGS[1]), "rows with lists")],
    )
    def test_text_and_lists_say_what_to_install(
        self, data: bytes, what: str, tmp_path: Path
    ) -> None:
        (tmp_path / "a.ply").write_bytes(data)
        for read in (load_splat, load_points):
            with pytest.raises(
                SplatFileError,
                match=f"plyfile, to read {what}, got none; pip install plyfile",
            ):
                read(tmp_path / "a.ply")


# Points


def test_points_of_text_may_write_integers_with_a_point(tmp_path: Path) -> None:
    head = b"ply\nformat ascii 1.0\nelement vertex 2\n"
    head += b"".join(b"property float %c\n" % axis for axis in b"xyz")
    head += b"".join(
        b"property uchar %s\n" % name for name in (b"red", b"green", b"blue")
    )
    (tmp_path / "a.ply").write_bytes(
        head + b"end_header\n1 2 3 255.0 0 51\n4 5 6 0 0.0 0\n"
    )
    cloud = load_points(tmp_path / "a.ply")
    torch.testing.assert_close(cloud.points, torch.tensor([[1.0, 2, 3], [4, 5, 6]]))
    torch.testing.assert_close(cloud.colours, torch.tensor([[1.0, 0, 0.2], [0, 0, 0]]))


@pytest.mark.parametrize(
    ("kind", "dtype"),
    [("uchar", "<u1"), ("uint8", "<u1"), ("ushort", "<u2"), ("uint16", "<u2")],
)
def test_colours_of_every_unsigned_kind(kind: str, dtype: str, tmp_path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += (
        "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
        + "end_header\n"
    )
    full = np.iinfo(dtype).max
    data = np.zeros(3, "<f4").tobytes() + np.array([full, 0, full], dtype).tobytes()
    (tmp_path / "a.ply").write_bytes(head.encode() + data)
    torch.testing.assert_close(
        load_points(tmp_path / "a.ply").colours, torch.tensor([[1.0, 0.0, 1.0]])
    )


def test_a_text_file_of_gigabytes_is_not_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "huge.ply"
    columns = [
        *(f"float {axis}" for axis in "xyz"),
        *(f"uchar {name}" for name in ("red", "green", "blue")),
    ]
    head = "\n".join(
        [
            "ply",
            "format ascii 1.0",
            "element vertex 1",
            *(f"property {c}" for c in columns),
            "",
        ]
    ).encode()
    path.write_bytes(head + b"end_header\n0 0 0 1 1 1\n")
    with path.open("r+b") as file:
        file.truncate(1 << 36)  # sparse: it takes no disk
    with pytest.raises(MiSplatError, match="at most 1,073,741,824 bytes of text"):
        load_points(path)
