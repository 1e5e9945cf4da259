"""`mi-splat train`."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from attacks import cli
from attacks.cli import parse
from mi_splat.cli.train import TrainOptions
from mi_splat.io import load_splat
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import MCMCConfig
from tests.training.sets import write_set


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return write_set(tmp_path / "set")


def test_train_command(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    words = ["train", str(dataset), "--out", str(out), "--iterations", "20", "--sh-degree", "1"]
    assert cli.main(words) == 0
    printed = capsys.readouterr().out
    assert "splat.ply" in printed
    assert "PSNR" in printed
    splat = load_splat(out / "splat.ply")
    assert splat.degree == 1
    names = PlyData.read(str(out / "splat.ply"))["vertex"].data.dtype.names
    assert names[:9] == ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
    assert cli.main([*words, "--json"]) == 0  # nothing is left to do
    assert json.loads(capsys.readouterr().out)["gaussians"] == len(splat)
    assert np.isfinite(json.loads((out / "metrics.json").read_text())["ssim"])


def test_a_set_without_test_pictures_can_be_trained_on(dataset: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone"
    shutil.copytree(dataset, alone)
    (alone / "transforms_test.json").unlink()
    assert cli.main(["train", str(alone), "--out", str(tmp_path / "out"), "--iterations", "3"]) == 0
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["held_out_views"] == 0
    assert figures["psnr"] is None


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--start", "none.ply"], "none.ply"),
        (["--random", "60", "--max-gaussians", "50"], "start: expected at most max_gaussians = 50 Gaussians, got 60"),
        (["--random-background", "--background", "1", "1", "1"], "--background: expected black"),
        (["--outliers", "5", "--random", "9"], "--outliers: expected a start on the points of the set"),
    ],
)
def test_train_says_what_is_wrong(
    words: list[str], says: str, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert cli.main(["train", str(dataset), "--out", str(out), *words]) == 1
    captured = capsys.readouterr()
    assert says in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--trainable", "sh"], "strategy"),
        (["--sh-degree", "7"], "--sh-degree"),
        (["--strategy", "none"], "--strategy: expected one of"),
        (["--strategy", "fixed", "--densify-from", "3"], "--densify-from"),
    ],
)
def test_train_says_what_is_wrong_usage(
    words: list[str], says: str, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert cli.main(["train", str(dataset), "--out", str(out), *words]) == 2
    assert says in capsys.readouterr().err
    assert not out.exists()


def test_flags_become_the_configs() -> None:
    plain = parse("train", ["set", "--out", "out"])
    assert isinstance(plain, TrainOptions)
    assert plain.fit == FitConfig()
    words = ["--strategy", "mcmc", "--noise-lr", "3", "--max-gaussians", "7", "--lr-sh", "0.1", "--iterations", "9"]
    given = parse("train", ["set", "--out", "out", *words])
    assert isinstance(given, TrainOptions)
    assert given.fit == FitConfig(strategy=MCMCConfig(noise_lr=3.0, max_gaussians=7), lr_sh=0.1, iterations=9)
