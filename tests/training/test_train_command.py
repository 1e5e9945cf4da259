"""`mi-splat train`."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from attacks import cli
from mi_splat.io import load_splat
from tests.training.sets import write_set


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return write_set(tmp_path / "set")


def test_train_command(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = [
        "train",
        str(dataset),
        "--out",
        str(out),
        "--iterations",
        "20",
        "--sh-degree",
        "1",
    ]
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


def test_a_set_without_test_pictures_can_be_trained_on(
    dataset: Path, tmp_path: Path
) -> None:
    alone = tmp_path / "alone"
    shutil.copytree(dataset, alone)
    (alone / "transforms_test.json").unlink()
    words = [
        "train",
        str(alone),
        "--out",
        str(tmp_path / "out"),
        "--iterations",
        "3",
        "--strategy",
        "mcmc",
    ]
    assert cli.main([*words, "--renderer", "ray"]) == 0
    assert cli.main(words) == 1  # the run is one with the other renderer
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["held_out_views"] == 0
    assert figures["psnr"] is None


@pytest.mark.parametrize(
    ("words", "status", "says"),
    [
        (["--start", "none.ply"], 1, "none.ply"),
        (
            ["--random", "60", "--max-gaussians", "50"],
            1,
            "expected at most max_gaussians = 50 Gaussians, got 60",
        ),
        (
            ["--renderer", "ray", "--strategy", "classic"],
            1,
            'expected the method "tile", got "ray"',
        ),
        (
            ["--random", "9", "--start", "a.ply"],
            1,
            "--random: expected no other start, got --start a.ply",
        ),
        (["--trainable", "sh"], 2, "strategy"),
        (["--strategy", "fixed", "--densify-from", "3"], 2, "--densify-from"),
    ],
)
def test_train_says_what_is_wrong(
    words: list[str],
    status: int,
    says: str,
    dataset: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    assert cli.main(["train", str(dataset), "--out", str(out), *words]) == status
    assert says in capsys.readouterr().err
    assert not out.exists()
