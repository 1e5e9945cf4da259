"""`mi-splat train` on other people's sets: small scenes, masks, too many points, longer
runs.
"""

import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from attacks import cli
from mi_splat.cli.train import _Pace
from mi_splat.io import load_splat
from tests.training.sets import write_set


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return write_set(tmp_path / "set")


def figures(out: Path) -> Any:
    return json.loads((out / "metrics.json").read_text())


def test_a_small_scene_is_trained_like_a_large_one(tmp_path: Path) -> None:
    scores = []
    for name, factor in (("large", 1.0), ("small", 0.02)):
        folder = write_set(tmp_path / name, factor)
        out = tmp_path / f"{name}-out"
        assert (
            cli.main(["train", str(folder), "--out", str(out), "--iterations", "60"])
            == 0
        )
        scores.append(figures(out)["psnr"])
    assert scores[1] == pytest.approx(scores[0], abs=0.5)
    assert scores[0] > 12


def test_near_is_an_option_and_what_it_culls_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_set(tmp_path / "small", 0.02)
    out = tmp_path / "out"
    assert (
        cli.main(
            [
                "train",
                str(folder),
                "--out",
                str(out),
                "--iterations",
                "3",
                "--near",
                "0.2",
            ]
        )
        == 0
    )
    printed = capsys.readouterr().err
    assert (
        "in 6 of 6 images, up to 50 of 50 Gaussians are nearer than near = 0.2"
        in printed
    )
    # with another near plane
    assert cli.main(["train", str(folder), "--out", str(out), "--iterations", "3"]) == 1
    assert "a run with near 0.2 and not 0.0" in capsys.readouterr().err


def test_a_run_that_goes_on_says_so(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", str(dataset), "--out", str(tmp_path / "out"), "--sh-degree", "1"]
    assert cli.main([*words, "--iterations", "5"]) == 0
    assert "going on" not in capsys.readouterr().err
    assert cli.main([*words, "--iterations", "5"]) == 0
    assert "the run has all its 5 steps" in capsys.readouterr().err
    assert cli.main([*words, "--iterations", "8"]) == 0
    assert "going on from step 5 of 8" in capsys.readouterr().err
    assert [line["iteration"] for line in figures(tmp_path / "out")["history"]] == [
        5,
        8,
    ]
    assert (
        json.loads((tmp_path / "out" / "config.json").read_text())["config"][
            "iterations"
        ]
        == 8
    )
    assert cli.main([*words, "--iterations", "8"]) == 0
    assert cli.main([*words, "--iterations", "7"]) == 1
    assert "a run with iterations 8 and not 7" in capsys.readouterr().err


def test_too_many_points_are_thinned_and_it_is_said(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert (
        cli.main(
            [
                "train",
                str(dataset),
                "--out",
                str(out),
                "--iterations",
                "2",
                "--max-gaussians",
                "20",
            ]
        )
        == 0
    )
    assert "starting on 20 of 50 points" in capsys.readouterr().err
    assert len(load_splat(out / "splat.ply")) == 20


@pytest.mark.filterwarnings("ignore::mi_splat.datasets.DatasetWarning")
def test_a_set_without_points_starts_anywhere_and_it_is_said(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (dataset / "points3D.ply").unlink()
    words = ["train", str(dataset), "--out", str(tmp_path / "out"), "--iterations", "1"]
    assert cli.main([*words, "--max-gaussians", "20"]) == 0
    assert (
        "the set has no points: starting on 20 Gaussians anywhere"
        in capsys.readouterr().err
    )


@pytest.mark.filterwarnings("ignore::mi_splat.datasets.DatasetWarning")
def test_the_images_of_a_set_are_counted(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", str(dataset), "--iterations", "2", "--sh-degree", "0", "--out"]
    (dataset / "images" / "train_00002.png").unlink()
    assert cli.main([*words, str(tmp_path / "few")]) == 0
    printed = capsys.readouterr().err
    assert (
        "6 of 7 listed images there; 5 images for training, 1 held out; 0 with a mask"
        in printed
    )
    assert "5 training views only: 20 to 200 are usual" in printed
    for name in ("IMG_1.JPG", "IMG_2.png"):
        Image.new("RGB", (32, 32)).save(dataset / "images" / name)
    assert cli.main([*words, str(tmp_path / "unlisted")]) == 0
    assert (
        f"7 of 9 images in {dataset} have a camera; find the cameras of the others"
        in capsys.readouterr().err
    )


def test_the_time_that_is_left_is_said_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [0.0]
    monkeypatch.setattr("mi_splat.cli.train.time.monotonic", lambda: clock[0])
    pace = _Pace(1000, downscale=2)
    for iteration in range(1, 30):
        clock[0] += 60.0 if iteration == 1 else 2.5  # the first step compiles
        pace.count(iteration)
    (line,) = capsys.readouterr().err.splitlines()
    assert (
        "a step takes 2.5 s: about 41 min left at this pace; --downscale 4 is faster"
        in line
    )
    pace = _Pace(1000, downscale=1)
    for iteration in range(1, 300):
        clock[0] += 0.1
        pace.count(iteration)
    (line,) = capsys.readouterr().err.splitlines()
    assert "--downscale" not in line
