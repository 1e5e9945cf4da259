"""`mi-splat convert`, and other commands on splats that are no PLY."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch

from attacks import cli
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.io import load_splat, save_splat
from mi_splat.maths.orientation import Up, turn_of
from mi_splat.render.renderer import Renderer
from tests.gaussians import ply_bytes, splat_names, splat_rows
from tests.io.format_files import WRITTEN, assert_close, tame_scene


@pytest.fixture
def splat(tmp_path: Path) -> Path:
    save_splat(tame_scene(60, 2), tmp_path / "in.ply")
    return tmp_path / "in.ply"


@pytest.mark.parametrize("suffix", WRITTEN)
def test_convert_there_and_back(
    suffix: str, splat: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = splat.with_name(f"a{suffix}")
    back = splat.with_name("back.ply")
    assert cli.main(["convert", str(splat), str(other)]) == 0
    text = capsys.readouterr().out
    assert "largest change" in text
    assert ("lost: SH above degree 0 dropped: 60 Gaussians" in text) == (
        suffix == ".splat"
    )
    assert cli.main(["convert", str(other), str(back)]) == 0
    assert_close(load_splat(back), load_splat(other))


def test_convert_as_json(splat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = splat.parent / "new" / "a.compressed.ply"
    assert (
        cli.main(["convert", str(splat), str(out), "--sh-degree", "1", "--json"]) == 0
    )
    document = json.loads(capsys.readouterr().out)
    assert (document["sh_degree_before"], document["sh_degree_after"]) == (2, 1)
    assert document["reordered"]
    assert document["bytes_after"] == out.stat().st_size
    assert [loss["what"] for loss in document["lost"]] == ["SH above degree 1 dropped"]
    assert 0 < document["largest_changes"]["means, world units"] < 0.01
    assert document["largest_changes"]["SH coefficients"] == pytest.approx(
        document["lost"][0]["largest"]
    )


def test_what_the_new_file_does_not_keep_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = splat_rows(
        5,
        names=[*splat_names(0), "segment_id", *(f"obj_dc_{i}" for i in range(16)), "t"],
    )
    path = tmp_path / "in.ply"
    path.write_bytes(
        ply_bytes(labels).replace(
            b"element", b"comment SplatRenderMode: mip\nelement", 1
        )
    )
    kept = "not kept: segment_id\nnot kept: obj_dc_0 to obj_dc_15\nnot kept: t"
    assert cli.main(["convert", str(path), str(tmp_path / "a.sog")]) == 0
    assert capsys.readouterr().out.endswith(f"{kept}\n")
    assert cli.main(["convert", str(path), str(tmp_path / "a.splat"), "--json"]) == 0
    assert "antialiasing" in json.loads(capsys.readouterr().out)["not_kept"][-1]
    assert cli.main(["info", str(tmp_path / "a.sog"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["mode"] == "antialiased"


def test_info_of_other_formats_needs_no_torch(tmp_path: Path) -> None:
    for suffix in WRITTEN:
        save_splat(tame_scene(5, 0), tmp_path / f"a{suffix}")
    code = (
        "import sys; from mi_splat.io.splat_files import load_stored; [load_stored(p)"
        " for p in sys.argv[1:]]"
    )
    code += "; sys.exit('torch' in sys.modules)"
    subprocess.run(
        [sys.executable, "-c", code, *map(str, tmp_path.iterdir())], check=True
    )


def test_a_file_that_is_there_is_replaced_only_by_force(
    splat: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = splat.with_name("a.spz")
    out.write_bytes(b"mine")
    assert cli.main(["convert", str(splat), str(out)]) == 1
    assert "--force" in capsys.readouterr().err
    assert out.read_bytes() == b"mine"
    assert (
        cli.main(["convert", str(splat), str(out), "--force", "--spz-version", "4"])
        == 0
    )
    assert out.read_bytes().startswith(b"NGSP")


def test_invalid_gaussians_may_be_left_out(splat: Path) -> None:
    data = bytearray(splat.with_name("in.ply").read_bytes())
    # the last component of the last quaternion is not a number
    data[-4:] = b"\0\0\xc0\x7f"
    splat.write_bytes(data)
    out = splat.with_name("a.glb")
    assert cli.main(["convert", str(splat), str(out)]) == 1
    assert not out.exists()
    with pytest.warns(UserWarning, match="1 of 60"):
        assert cli.main(["convert", str(splat), str(out), "--drop-invalid"]) == 0
    assert len(load_splat(out)) == 59


@pytest.mark.parametrize("up", get_args(Up))
def test_a_splat_that_is_turned_looks_the_same_to_a_camera_that_went_with_it(
    up: Up, splat: Path
) -> None:
    out = splat.with_name("turned.ply")
    scale = 2.5
    assert (
        cli.main(["convert", str(splat), str(out), "--up", up, "--scale", repr(scale)])
        == 0
    )
    before = load_splat(splat)
    after = load_splat(out)
    camera = Camera(
        to_world=look_at((0.0, -6.0, 1.0), (0.0, 0.0, 0.0)),
        lens=Lens(focal=60.0, size=(64, 64)),
    )
    there = camera.turned(torch.from_numpy(turn_of(up)))
    pose = there.to_world.clone()
    pose[:3, 3] *= scale
    seen = Renderer()(before, camera)
    assert float(seen.std()) > 0.05
    assert (Renderer()(after, replace(there, to_world=pose)) - seen).abs().max() < 2e-3


def test_a_folder_stands_for_its_splat_and_is_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "trained"
    folder.mkdir()
    save_splat(tame_scene(60, 2), folder / "splat.ply")
    before = (folder / "splat.ply").read_bytes()
    assert cli.main(["convert", str(folder), str(folder / "splat.ply"), "--force"]) == 1
    assert "the input itself" in capsys.readouterr().err
    assert (folder / "splat.ply").read_bytes() == before
    assert cli.main(["convert", str(folder), str(tmp_path / "b.ply"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes_before"] == len(before)
