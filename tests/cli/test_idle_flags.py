"""Files that would be their own input, flags that would mean nothing, and `all` of a splat that has no cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from attacks import cli
from mi_splat.io import save_splat
from tests.fakes import toy_scene

SMALL = ["--size", "24x16"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    save_splat(toy_scene()[0], tmp_path / "a.ply")
    (tmp_path / "link.ply").symlink_to("a.ply")
    (tmp_path / "link.png").symlink_to("a.ply")
    np.save(tmp_path / "m.npy", np.arange(3))
    Image.new("RGB", (8, 8)).save(tmp_path / "photo.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


REFUSED = {
    "select a.ply --cluster 1 --out a.ply": (1, "a.ply: expected another file than the input"),
    "select a.ply --cluster 1 --out link.ply": (1, "another file than the input"),
    "select a.ply --mask m.npy --out m.npy": (1, "another file than the input"),
    "render a.ply --out link.png": (1, "another file than the input"),
    "convert a.ply link.ply --force": (1, "another file than the input"),
    "convert a.ply w.sog --spz-version 2": (1, "--spz-version: expected a file to write that ends in .spz, got .sog"),
    "render a.ply --cameras orbit:3@20 --out w{}.gif": (1, "--out: expected one name"),
    "detect photo.png --cameras orbit:3@20": (2, "pictures only, and --cameras"),
}


@pytest.mark.parametrize("line", REFUSED)
def test_refused_with_nothing_lost(line: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    status, words = REFUSED[line]
    assert cli.main(line.split()) == status
    error = capsys.readouterr().err
    assert words in error
    assert len(error.splitlines()) == 1
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_all_cameras_of_a_bare_splat_are_the_usual_one(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["render", "a.ply", *SMALL, "--out", "one.png"]) == 0
    assert cli.main(["render", "a.ply", *SMALL, "--cameras", "all", "--out", "all.png"]) == 0
    assert "no cameras of its own" in capsys.readouterr().err
    assert (folder / "one.png").read_bytes() == (folder / "all.png").read_bytes()


def test_many_cameras_have_a_few_lines_and_a_summary(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["select", "a.ply", "--mask", "m.npy", "--cameras", "orbit:9@10", *SMALL]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + 6 + 1
    assert "of 9 cameras in all" in lines[-1]
