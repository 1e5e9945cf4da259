"""What an attack writes: images that show the change, a splat that loads, a JSON that
explains itself.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.report import summary, write_report
from attacks.dagger.result import Result
from attacks.figures.frame import read_figures
from attacks.objectives.base import Objective
from attacks.objectives.relabel import relabel
from attacks.objectives.suppression import hide
from mi_splat.io import load_splat
from mi_splat.io.errors import SplatFileError
from tests.fakes import ColourDetector, blobs, camera, toy_scene


def run(objective: Objective | None = None, views: int = 1) -> Result:
    scene, mask = toy_scene()
    cameras = [camera(offset=0.4 * i) for i in range(views)]
    config = DaggerConfig(eps=(12.0,), noise_draws=1)
    return attack(
        scene,
        mask,
        cameras,
        ColourDetector(),
        objective or relabel("person"),
        render=blobs,
        config=config,
    )


@pytest.fixture(scope="module")
def result() -> Result:
    return run()


def test_every_file_is_there_and_readable(result: Result, tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    paths = write_report(result, folder)
    names = {
        "before.png",
        "after.png",
        "difference.png",
        "detections.png",
        "attacked.ply",
        "result.json",
    }
    names |= {"rows.csv.xz", "detections.csv.xz", "cameras.json", "figures.csv"}
    assert (
        set(paths)
        == names
        == {path.name for path in folder.iterdir()} - {"manifest.json"}
    )
    sizes = {}
    for name in names:
        if name.endswith(".png"):
            with Image.open(paths[name]) as picture:
                assert picture.mode == "RGB"
                sizes[name] = picture.size
    assert sizes == {
        "before.png": (32, 32),
        "after.png": (32, 32),
        "difference.png": (512, 512),
        "detections.png": (1024, 512),
    }
    for before, after in zip(
        load_splat(paths["attacked.ply"]).tensors(), result.scene.tensors(), strict=True
    ):
        torch.testing.assert_close(before, after)


def test_the_json_is_strict_and_is_the_summary(result: Result, tmp_path: Path) -> None:
    text = write_report(result, tmp_path)["result.json"].read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    values = json.loads(text)
    assert values == json.loads(json.dumps(summary(result)))
    assert values["success"] is True
    confidence = read_figures(tmp_path).value("target_confidence")
    assert confidence is not None
    assert confidence >= 0.7
    assert values["config"]["objective"]["iou"] == 0.5


def test_the_pictures_show_what_they_say(result: Result, tmp_path: Path) -> None:
    paths = write_report(result, tmp_path)
    before, after, difference = (
        np.asarray(Image.open(paths[name])).astype(int)
        for name in ("before.png", "after.png", "difference.png")
    )
    assert np.abs(after - before).max() > 20
    same = np.abs(after - before).max(-1) == 0
    small = difference[8::16, 8::16]  # the image is enlarged sixteen times
    plain = same.copy()
    plain[:4] = False  # where the caption is
    assert (np.abs(small[plain] - 128) <= 1).all()
    assert np.abs(small - 128).max() > 40


def test_views_of_different_sizes_are_stacked(tmp_path: Path) -> None:
    scene, mask = toy_scene()
    cameras = [camera(32), camera(40)]
    result = attack(
        scene,
        mask,
        cameras,
        ColourDetector(),
        hide(),
        render=blobs,
        config=DaggerConfig(noise_draws=0),
    )
    paths = write_report(result, tmp_path)
    with Image.open(paths["before.png"]) as picture:
        assert picture.size == (40, 72)
    values = json.loads(paths["result.json"].read_text())
    assert values["target"] is None
    assert read_figures(tmp_path).find("target_confidence") is None
    assert len(values["views"]) == 2


def test_a_report_replaces_an_older_one_and_leaves_nothing_else(
    result: Result, tmp_path: Path
) -> None:
    write_report(result, tmp_path)
    other = dataclasses.replace(result, seconds=-1.0)
    with pytest.raises(SplatFileError, match="replace this result with force"):
        write_report(other, tmp_path)
    assert json.loads((tmp_path / "result.json").read_text())["seconds"] > 0
    write_report(other, tmp_path, force=True)
    assert json.loads((tmp_path / "result.json").read_text())["seconds"] == -1
    assert len(list(tmp_path.iterdir())) == 11
