"""What commands refuse: in one line, with the right status, and with every file as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from attacks import cli
from mi_splat.io import save_splat
from tests.cli.test_scenes import XML
from tests.fakes import toy_scene

SMALL = ["--size", "24x16"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    scene, _ = toy_scene()
    save_splat(scene, tmp_path / "a.ply")
    save_splat(scene.select(slice(0, 20)), tmp_path / "half.ply")
    (tmp_path / "link.ply").symlink_to("a.ply")
    (tmp_path / "link.png").symlink_to("a.ply")
    (tmp_path / "scene.xml").write_text(XML.replace("cloud.ply", "a.ply"))
    for name, text in {"bad.ply": "ply or not", "scene.csv": "x,y,z", "old.html": "no splat"}.items():
        (tmp_path / name).write_text(text)
    np.save(tmp_path / "m.npy", np.arange(3))
    Image.new("RGB", (8, 8)).save(tmp_path / "photo.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


REFUSED = {
    "select a.ply --cluster 1 --out a.ply": (1, "a.ply: expected another file than the input"),
    "select a.ply --cluster 1 --out link.ply": (1, "another file than the input"),
    "select a.ply --mask m.npy --out m.npy": (1, "another file than the input"),
    "info bad.ply": (1, "bad.ply"),
    "render bad.ply": (1, "bad.ply"),
    "render a.ply --out link.png": (1, "another file than the input"),
    "render a.ply --cameras orbit:3@20 --out w{}.gif": (1, "--out: expected one name"),
    "render a.ply --cameras orbit:2@0 --out a.png": (1, "room for 2 pictures, got a.png; name a folder, a-{}.png"),
    "render a.ply --out a.webp": (1, "a name that ends in .png, .jpg, .exr, .gif or .mp4, or a folder"),
    "render a.ply --out a.gif": (1, "two cameras or more for an animation, got one, a.gif; pass for instance"),
    "render a.ply --cameras orbit:2@0 --out a.ply/b": (1, "a.ply"),
    "render a.ply --out a.ply/b.png": (1, "a.ply"),
    "render scene.xml --camera back": (1, "front, side"),
    "render a.ply --camera back": (1, "no cameras"),
    "render notes.txt": (1, "notes.txt"),
    "render scene.csv": (1, "a name that ends in .ply"),
    "render missing.xml": (1, "missing.xml"),
    "convert a.ply link.ply --force": (1, "another file than the input"),
    "convert a.ply w.sog --spz-version 2": (1, "--spz-version: expected a file to write that ends in .spz, got .sog"),
    "convert a.ply b.ksplat": (1, "create-ksplat"),
    "convert a.ply b.txt": (1, "a name that ends in"),
    "convert none.ply b.spz": (1, "No such file"),
    "convert a.ply a.ply/b.spz": (1, "a.ply"),
    "detect": (2, "pictures, splats or scenes"),
    "detect gone.png --out o": (1, "gone.png"),
    "detect photo.png --cameras orbit:3@20": (2, "pictures only, and --cameras"),
    "evaluate a.ply a.ply": (1, "one that differs from the other"),
    "evaluate a.ply half.ply": (1, "the same Gaussians in both, got 40 and 20"),
    "evaluate a.ply half.ply --target unicorn": (1, "tv, train, suitcase for fasterrcnn_small, got unicorn"),
    "train none --out o --port 8081": (2, "--port: expected --live beside it"),
    "view a.ply --host 0.0.0.0": (1, "host: expected 127.0.0.1"),
    "view a.ply --host 192.168.3.4 --port 0": (1, "SSH tunnel"),
    "view a.ply --export none/page.html": (1, "make the folder first"),
    "view a.ply --export a.ply": (1, "ends in .html"),
    "view a.ply --export old.html": (1, "--force"),
    "view a.ply --export p.html --clean half.ply": (1, "the scenes: expected the same Gaussians in both"),
    "view a.ply --export p.html --detectors fasterrcnn_smal": (1, "fasterrcnn_small"),
    "view a.ply --export p.html --weights w.safetensors": (1, "name it with --detectors"),
    "view a.ply --export p.html --clean none.ply": (1, "none.ply"),
    **{f"view {path} --export p.html": (1, ": expected ") for path in ("none.ply", "none", "old.html", ".")},
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
