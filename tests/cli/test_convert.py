"""`mi-splat convert`, and other commands on splats that are no PLY."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from attacks import cli
from mi_splat.io import load_splat, save_splat
from mi_splat.io.formats.table import FORMATS
from tests.io.closeness import assert_close, tame_scene

WRITTEN = [entry.suffix for entry in FORMATS if entry.writes]


@pytest.fixture
def splat(tmp_path: Path) -> Path:
    save_splat(tame_scene(60, 2), tmp_path / "in.ply")
    return tmp_path / "in.ply"


@pytest.mark.parametrize("suffix", WRITTEN)
def test_convert_there_and_back(suffix: str, splat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other, back = splat.with_name(f"a{suffix}"), splat.with_name("back.ply")
    assert cli.main(["convert", str(splat), str(other)]) == 0
    text = capsys.readouterr().out
    assert "largest change" in text
    assert ("lost: SH above degree 0 dropped: 60 Gaussians" in text) == (suffix == ".splat")
    assert cli.main(["convert", str(other), str(back)]) == 0
    assert_close(load_splat(back), load_splat(other))


def test_convert_as_json(splat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = splat.parent / "new" / "a.compressed.ply"
    assert cli.main(["convert", str(splat), str(out), "--sh-degree", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["sh_degree_before"], found["sh_degree_after"]) == (2, 1)
    assert found["reordered"]
    assert found["bytes_after"] == out.stat().st_size
    assert [loss["what"] for loss in found["lost"]] == ["SH above degree 1 dropped"]
    assert 0 < found["largest_changes"]["means, world units"] < 0.01
    assert found["largest_changes"]["SH coefficients"] == pytest.approx(found["lost"][0]["largest"])


def test_a_file_that_is_there_is_replaced_only_by_force(splat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = splat.with_name("a.spz")
    out.write_bytes(b"mine")
    assert cli.main(["convert", str(splat), str(out)]) == 1
    assert "pass --force" in capsys.readouterr().err
    assert out.read_bytes() == b"mine"
    assert cli.main(["convert", str(splat), str(out), "--force", "--spz-version", "4"]) == 0
    assert out.read_bytes().startswith(b"NGSP")


def test_invalid_gaussians_may_be_left_out(splat: Path) -> None:
    data = bytearray(splat.with_name("in.ply").read_bytes())
    data[-4:] = b"\0\0\xc0\x7f"  # the last component of the last quaternion is not a number
    splat.write_bytes(data)
    out = splat.with_name("a.glb")
    assert cli.main(["convert", str(splat), str(out)]) == 1
    assert not out.exists()
    with pytest.warns(UserWarning, match="1 of 60"):
        assert cli.main(["convert", str(splat), str(out), "--drop-invalid"]) == 0
    assert len(load_splat(out)) == 59


@pytest.mark.parametrize("suffix", WRITTEN)
def test_info_takes_every_format(suffix: str, splat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tame_scene(30, 0)
    save_splat(scene, splat.with_name(f"a{suffix}"))
    assert cli.main(["info", str(splat.with_name(f"a{suffix}")), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["gaussians"] == 30
