"""`mi-splat select` and `dagger` on a splat without parts, and `render` of many
images.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from attacks import cli
from mi_splat.io import load_splat, save_splat
from tests.fakes import ColourDetector, toy_scene
from tests.selection.bare import CAR, bare_scene, iou

VIEW = ["--azimuth", "40", "--elevation", "25", "--distance", "8", "--size", "96x72"]


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tensor]:
    """The file of a splat without parts, and the owner of each of its Gaussians."""
    scene, owner = bare_scene()
    path = tmp_path_factory.mktemp("bare") / "desk.ply"
    save_splat(scene, path)
    return path, owner


def pixels(path: Path) -> np.ndarray:
    """(H, W, 3) levels of an image."""
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def test_a_click_selects_the_car_and_writes_what_is_asked_for(
    bare: tuple[Path, Tensor], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, owner = bare
    outs = [tmp_path / "new" / name for name in ("tinted.png", "mask.npy", "car.ply")]
    words = [
        "select",
        str(path),
        "--click",
        "45,39",
        *VIEW,
        "--out",
        *map(str, outs),
        "--json",
    ]
    assert cli.main(words) == 0
    captured = capsys.readouterr()
    assert (
        captured.err
        == "mi-splat: up is taken as z (a guess: it stands on a ground); --up -y turns"
        " it\n"
    )
    document = json.loads(captured.out)
    mask = torch.from_numpy(np.load(outs[1]))
    assert iou(mask, owner == CAR) > 0.95
    assert document["gaussians"] == int(mask.sum()) == len(load_splat(outs[2]))
    assert document["box"][0] == pytest.approx([-2.39, -1.0, 0.06], abs=0.1)
    assert document["views"][0]["seen"]
    pink = pixels(outs[0])
    tinted = (pink[..., 0] > pink[..., 1] + 60) & (pink[..., 2] > pink[..., 1] + 30)
    assert float(tinted.mean()) == pytest.approx(
        document["views"][0]["share"], abs=0.03
    )
    assert tinted[39, 45]


def test_a_known_object_is_looked_at(
    bare: tuple[Path, Tensor], capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = bare
    assert (
        cli.main(
            [
                "select",
                str(path),
                "--box",
                "0.2",
                "2.1",
                "0.02",
                "0.5",
                "3.2",
                "2",
                "--size",
                "64x48",
            ]
        )
        == 0
    )
    text = capsys.readouterr().out
    assert text.splitlines()[0].startswith("2,056 of 8,415 Gaussians")
    share = float(text.split("seen by orbit: ")[1].split("%")[0])
    assert share > 15  # of a sign that is a dot in an image of all


def test_doubts_are_told_with_numbers(
    bare: tuple[Path, Tensor], capsys: pytest.CaptureFixture[str]
) -> None:
    path, owner = bare
    assert cli.main(["select", str(path), "--object", "desk", *VIEW]) == 0
    assert (
        f"{len(owner):,} of {len(owner):,} Gaussians: nearly the whole"
        in capsys.readouterr().err
    )
    away = [
        "--centre",
        "50",
        "50",
        "0",
        "--azimuth",
        "210",
        "--distance",
        "5",
        "--size",
        "32",
    ]
    assert cli.main(["select", str(path), "--cluster", "1", *away]) == 0
    captured = capsys.readouterr()
    assert (
        "does not show from orbit (1 of 1 cameras; at most 0% of any pixel is its)"
        in captured.err
    )
    assert "not seen by orbit" in captured.out


def test_dagger_attacks_a_selection_and_its_cameras_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, mask = toy_scene()
    save_splat(scene, tmp_path / "toy.ply")
    np.save(tmp_path / "mask.npy", mask.numpy())
    monkeypatch.setattr(
        "attacks.cli.options.load_detectors", lambda *_: [ColourDetector()]
    )
    out = tmp_path / "out"
    words = [
        "dagger",
        str(tmp_path / "toy.ply"),
        "--mask",
        str(tmp_path / "mask.npy"),
        "--cameras",
        "orbit:2@0",
    ]
    words += [
        "--distance",
        "3",
        "--fov",
        "50",
        "--size",
        "32",
        "--eps",
        "20",
        "--noise-draws",
        "0",
    ]
    assert cli.main([*words, "--out", str(out)]) == 0
    assert capsys.readouterr().out.startswith("The attack succeeded: ")
    # a bare splat has no parts
    assert "attacked.xml" not in {path.name for path in out.iterdir()}
    assert np.array_equal(np.load(out / "mask.npy"), mask.numpy())
    result = json.loads((out / "result.json").read_text())
    assert result["cameras"] == ["orbit-0", "orbit-1"]
    assert result["selection"] == {"mask": str(tmp_path / "mask.npy")}
    assert torch.equal(
        load_splat(out / "attacked.ply").means, load_splat(tmp_path / "toy.ply").means
    )
    again = [
        "render",
        str(out / "attacked.ply"),
        "--cameras",
        str(out / "result.json"),
        "--out",
        str(tmp_path / "r"),
    ]
    assert cli.main(again) == 0
    after = np.concatenate(
        [pixels(tmp_path / "r" / f"orbit-{number}.png") for number in (0, 1)]
    )
    assert np.array_equal(after, pixels(out / "after.png"))
