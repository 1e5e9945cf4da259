"""`mi-splat detect` and `mi-splat evaluate`, with a detector that sees colours."""

import json
from pathlib import Path

import pytest
import torch
from PIL import ExifTags, Image

from attacks import cli
from attacks.figures.frame import read_figures
from attacks.figures.rate import Rate, pooled
from attacks.observe.comparison import classes_of
from attacks.observe.rows import read_rows
from mi_splat.io import load_splat, save_splat
from mi_splat.maths.sh import colour_to_dc
from mi_splat.scene import GaussianScene, scene_hash
from tests.fakes import CoarseDetector, ColourDetector, toy_scene

VIEW = ["--cameras", "orbit:12@0", "--distance", "3", "--fov", "50", "--size", "32"]


def painted(
    scene: GaussianScene, mask: torch.Tensor, colour: tuple[float, float, float]
) -> GaussianScene:
    """The scene with its object in one colour."""
    sh = scene.sh.clone()
    sh[mask, 0] = colour_to_dc(torch.tensor(colour))
    return scene.replace(sh=sh)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A red object (a car), the same in green (a person), and the detector in the place
    of all others.
    """
    scene, mask = toy_scene()
    save_splat(scene, tmp_path / "clean.ply")
    save_splat(painted(scene, mask, (0.1, 0.9, 0.1)), tmp_path / "attacked.ply")
    monkeypatch.setattr(
        "attacks.cli.options.load_detectors", lambda *_: [ColourDetector()]
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_pictures_and_splats_are_looked_at(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["render", "clean.ply", *VIEW, "--out", "views"]) == 0
    capsys.readouterr()
    words = [
        "detect",
        "views/orbit-00.png",
        "clean.ply",
        *VIEW,
        "--out",
        "detected",
        "--json",
    ]
    assert cli.main(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert (
        json.loads((folder / "detected" / "result.json").read_text())["pictures"]
        == document["pictures"]
    )
    assert len(document["pictures"]) == 13
    picture, *rendered = document["pictures"]
    assert picture["camera"] is None
    # the same pixels, from the file or from the splat
    assert picture["detections"] == rendered[0]["detections"]
    assert rendered[0]["camera"]["name"] == "orbit-00"
    assert picture["detections"][0]["label"] == "car"
    x0, y0, x1, y1 = picture["detections"][0]["box"]
    assert x0 < 16 < x1
    assert y0 < 16 < y1
    for row in document["pictures"]:
        with Image.open(folder / "detected" / row["picture"]) as drawn:
            assert drawn.width >= 512
    assert cli.main(words) == 1
    assert "--force" in capsys.readouterr().err
    assert (
        cli.main(
            ["detect", "clean.ply", "--min-confidence", "1", *VIEW, "--out", "none"]
        )
        == 0
    )
    assert "clean-orbit-00-fake_colour: nothing" in capsys.readouterr().out


def test_the_images_of_a_folder_are_looked_at_upright(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["render", "clean.ply", *VIEW, "--out", "views"]) == 0
    photos = folder / "photos"
    photos.mkdir()
    upright = Image.open(folder / "views" / "orbit-00.png")
    upright.save(photos / "b.png")
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    upright.transpose(Image.Transpose.ROTATE_90).save(photos / "a.PNG", exif=exif)
    (photos / "c.jpg").write_bytes(b"no image")
    (photos / "notes.txt").write_text("no image either")
    capsys.readouterr()
    assert cli.main(["detect", "photos", "--out", "detected", "--json"]) == 0
    captured = capsys.readouterr()
    assert "c.jpg" in captured.err
    assert "going on without it" in captured.err
    first, second = json.loads(captured.out)["pictures"]
    assert [Path(row["source"]).name for row in (first, second)] == ["a.PNG", "b.png"]
    assert first["detections"] == second["detections"] != []
    assert cli.main(["detect", "photos", "--fov", "30", "--out", "again"]) == 2
    assert "images only, and --fov" in capsys.readouterr().err


def test_a_folder_of_too_many_images(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("attacks.cli.detect.MOST_IMAGES", 1)
    (folder / "photos").mkdir()
    for name in ("a.png", "b.png"):
        Image.new("RGB", (8, 8)).save(folder / "photos" / name)
    assert cli.main(["detect", "photos", "--out", "detected"]) == 2
    assert "at most 1 images, got 2" in capsys.readouterr().err
    assert not (folder / "detected").exists()


def test_a_clean_and_an_attacked_splat_are_compared(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "evaluate",
        "clean.ply",
        "attacked.ply",
        *VIEW,
        "--target",
        "person",
        "--out",
        "judged",
    ]
    assert cli.main([*words, "--json"]) == 0
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert document["object_gaussians"] == 30
    assert {"versions", "variant", "commit", "near", "background"} <= set(document)
    assert document["attacked_hash"] == scene_hash(load_splat(folder / "attacked.ply"))
    figures = read_figures(folder / "judged")
    assert document["figures"] == figures.as_dicts()
    rates = figures.where(detector="fake_colour")
    found = rates.rate("found_clean")
    assert found.total == 12
    assert found.successes >= 9
    assert rates.rate("found_attacked").successes == 0
    missed = rates.rate("missed")
    assert missed.successes == missed.total == found.successes
    assert missed.interval[0] > 0.6
    assert rates.rate("target_clean") == Rate(successes=0, total=12)
    assert rates.rate("target_attacked").successes >= 9
    psnr = rates.value("psnr")
    assert psnr is not None
    assert psnr < 30
    rows = read_rows(folder / "judged" / "rows.csv.xz")
    assert len(rows) == 24
    assert classes_of(rows)["fake_colour"] == ("car", "person")
    with Image.open(folder / "judged" / "fake_colour.png") as drawn:
        assert drawn.size == (1024, 8 * 512)
    assert cli.main(["artifact-check", "judged"]) == 0
    assert "missed, detector fake_colour: " in capsys.readouterr().out
    assert cli.main([*words[:-1], "again"]) == 0
    text = capsys.readouterr().out
    assert "fake_colour: target class detected, attacked" in text
    assert "missed when attacked, of those detected clean" in text


def test_what_is_left_of_an_attack_is_shown_for_each_condition(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evaluate", "clean.ply", "attacked.ply", *VIEW, "--target", "person"]
    conditions = ["--conditions", "JPEG 75", "2 x distance", "majority of 3 views"]
    assert cli.main([*words, *conditions, "--out", "judged"]) == 0
    told = capsys.readouterr().out
    assert "| JPEG 75 | fake_colour |" in told
    assert "| majority of 3 views | fake_colour |" in told
    figures = read_figures(folder / "judged")
    own = figures.rate("missed", detector="fake_colour")
    assert own == figures.rate(
        "missed", detector="fake_colour", condition="own renderer"
    )
    assert figures.rate("found_clean", detector="fake_colour").total == 12
    assert cli.main(["artifact-check", "judged"]) == 0
    assert cli.main([*words, "--conditions", "JPG 75", "--out", "wrong"]) == 1
    assert "condition" in capsys.readouterr().err
    assert not (folder / "wrong").exists()


def test_a_judge_s_contradictions_are_shown(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = {"fasterrcnn_small": ColourDetector, "fake_coarse": CoarseDetector}
    monkeypatch.setattr(
        "attacks.cli.options.load_detectors",
        lambda names, *_: [kinds[name]() for name in names],
    )
    words = [
        "evaluate",
        "clean.ply",
        "attacked.ply",
        *VIEW,
        "--cross-check",
        "fake_coarse",
        "--out",
        "judged",
    ]
    assert cli.main(words) == 0
    told = capsys.readouterr().out
    assert "fake_coarse contradicts fake_colour, clean" in told
    rates = read_figures(folder / "judged").rates("contradicted")
    assert told.count("| orbit-") == pooled(rates).successes
    assert cli.main(["artifact-check", "judged"]) == 0


def test_reasons_for_doubt_are_told(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "evaluate",
        "attacked.ply",
        "clean.ply",
        *VIEW[2:],
        "--cameras",
        "orbit:2@0",
        "--original",
        "stop sign",
    ]
    assert cli.main([*words, "--images", "0", "--out", "first"]) == 0
    told = capsys.readouterr().err
    assert "the object shows in 2 of 2 views: few" in told
    assert "finds the clean object in 0 of 2 views only" in told
    names = [
        "detections.csv.xz",
        "figures.csv",
        "manifest.json",
        "result.json",
        "rows.csv.xz",
    ]
    assert sorted(path.name for path in (folder / "first").iterdir()) == names
    cameras = json.loads((folder / "first" / "result.json").read_text())["cameras"]
    (folder / "result.json").write_text(
        json.dumps({"views": [{"camera": camera} for camera in cameras[:1]]})
    )
    assert cli.main([*words, "--images", "0", "--out", "second"]) == 0
    assert "1 of 2 cameras are those that were attacked" in capsys.readouterr().err
    # drawn about it
    (folder / "result.json").write_text(
        json.dumps({"views": [], "reference": cameras[0]})
    )
    assert cli.main([*words, "--images", "0", "--out", "third"]) == 0
    assert "those that were attacked" not in capsys.readouterr().err
