"""`mi-splat compare`, end to end on a shipped scene, and what it refuses before it works."""

import json
from pathlib import Path

import pytest
from PIL import Image

pytest.importorskip("jinja2", reason="pages need the extra report")
pytest.importorskip("matplotlib", reason="pages need the extra report")

from attacks import cli
from attacks.report.results import read_section
from mi_splat.io import save_splat
from tests.fakes import toy_scene
from tests.project.layers import ROOT

SCENE = str(ROOT / "scenes" / "car_street.xml")
SMALL = ["--cameras", "front", "--size", "40x32"]


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    save_splat(toy_scene()[0], tmp_path / "toy.ply")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "wedding.jpg").write_text("dear")
    (tmp_path / "theirs").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.nightly
def test_a_shipped_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["render", SCENE, *SMALL, "--cameras", "front", "side", "--out", "theirs"]) == 0
    capsys.readouterr()
    words = ["compare", SCENE, *SMALL, "--methods", "tile,ray", "folder:theirs", "--rounds", "1", "--out", "compared"]
    assert cli.main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    kept = json.loads((tmp_path / "compared" / "result.json").read_text())
    assert document == {**kept, "out": "compared"}
    assert {"versions", "commit", "variant", "scene_hash", "near", "background"} <= set(kept)
    pairs = {tuple(pair["methods"]): pair for pair in kept["pairs"]}
    assert set(pairs) == {("tile", "ray"), ("tile", "theirs"), ("ray", "theirs")}
    assert pairs["tile", "theirs"]["psnr"] is None
    assert pairs["tile", "ray"]["psnr"] == pytest.approx(pairs["ray", "theirs"]["psnr"], abs=0.1)
    assert pairs["tile", "ray"]["psnr"] < 40
    assert 0 < pairs["tile", "ray"]["gradients"]["sh"]["cosine"] < 1
    assert kept["methods"]["ray"]["picture"]["ratio"] > 0
    with Image.open(tmp_path / "compared" / "front.png") as sheet:
        assert sheet.size == (3 * 280 + 8, 2 * 224 + 4)
    with Image.open(tmp_path / "compared" / "pictures" / "ray" / "front.png") as picture:
        assert picture.size == (40, 32)

    text = (tmp_path / "compared" / "compare.html").read_text("utf-8")
    assert "SSIM" in text
    assert ".tmp" not in text  # the folder is named as it is called now
    section = read_section(tmp_path / "compared")
    assert [one.path.name for one in section.pictures] == ["front.png"]
    assert cli.main(["report", "compared", "--out", "again.html"]) == 0
    assert "renderers compared" in (tmp_path / "again.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["--methods", "tile"], 1, "expected two or more, got tile"),
        (["--methods", "tile,folder:theirs"], 1, "orbit.png for the camera orbit, got an empty folder"),
        (["--rounds", "-1"], 2, "--rounds: expected"),
        (["--amplify", "0"], 2, "--amplify: expected"),
        (["--out", "taken"], 1, "a new or an empty folder"),
        (["--out", "taken", "--force"], 1, "an older result (result.json)"),
    ],
)
def test_refused_in_one_line_with_nothing_written(
    words: list[str], status: int, message: str, toy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(toy.rglob("*"))
    assert cli.main(["compare", "toy.ply", "--size", "16", *words]) == status
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    assert sorted(toy.rglob("*")) == before


def test_without_the_packages_of_pages_there_is_no_page(
    toy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("attacks.report.page.missing_packages", lambda: ["Jinja2"])
    words = ["compare", "toy.ply", "--size", "16", "--no-gradients", "--rounds", "0", "--out", "compared"]
    assert cli.main(words) == 0
    captured = capsys.readouterr()
    assert "no page: Jinja2 not installed" in captured.err
    assert captured.out.startswith("tile and ray: ")
    assert "| pair | PSNR | SSIM | bits |" in captured.out
    assert not (toy / "compared" / "compare.html").exists()
