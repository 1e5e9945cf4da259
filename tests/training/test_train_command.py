"""`mi-splat train`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from attacks import cli
from mi_splat.datasets import has_tests, load_dataset
from mi_splat.io import load_splat
from tests.training.sets import write_set


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return write_set(tmp_path / "set")


def test_train_command(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    words = ["train", str(dataset), "--out", str(out), "--iterations", "20", "--sh-degree", "1"]
    assert cli.main(words) == 0
    said = capsys.readouterr().out
    assert "splat.ply" in said
    assert "PSNR" in said
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
    assert has_tests(dataset)
    assert not has_tests(alone)
    assert cli.main(["train", str(alone), "--out", str(tmp_path / "out"), "--iterations", "3"]) == 0
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["held_out_views"] == 0
    assert figures["psnr"] is None


def test_a_set_on_the_disk_is_known_by_its_files(dataset: Path) -> None:
    one = load_dataset(dataset)
    assert one.fingerprint == load_dataset(dataset).fingerprint
    assert one.fingerprint != load_dataset(dataset, background=(1.0, 1.0, 1.0)).fingerprint
    assert one.fingerprint != load_dataset(dataset, downscale=2).fingerprint
    assert one.fingerprint != load_dataset(dataset, split="test").fingerprint


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--start", "none.ply"], "none.ply"),
        (["--random", "0"], "count"),
        (["--outliers", "-1"], "count, views and points"),
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
        (["--sh-degree", "7"], "sh_degree"),
        (["--strategy", "none"], "invalid choice"),
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
