"""A stranger's phone photographs go from files to a splat, an attack and an audit, by
the commands of one page.
"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from attacks import cli
from mi_splat.datasets import load_dataset
from scenes.recipes.real_demo import commands
from tests.preparation.phone import COUNT, MASKED, SIZE, write_photographs
from tests.project.documented_commands import lines

PAGE = "docs/how-to/photographs.md"
FEWER = {"3000": "700", "100000": "20000"}
"""Iterations and Gaussians of the page, and of this test."""


@pytest.mark.nightly
def test_the_page_takes_phone_photographs_to_an_audit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both orientations, a lens that bends and a mask; every command of the page, in
    its order.
    """
    pytest.importorskip("pycolmap", reason="the extra photos is not installed")
    monkeypatch.chdir(tmp_path)
    write_photographs(tmp_path / "YOUR_PHOTOS")
    said: dict[str, str] = {}
    commands = [
        line for line in lines() if line.page == PAGE and line.program == "mi-splat"
    ]
    assert [line.command for line in commands] == [
        *("prepare", "train", "render", "select", "dagger", "audit"),
    ]
    for line in commands:
        status = cli.main([FEWER.get(word, word) for word in line.words[1:]])
        captured = capsys.readouterr()
        assert status == 0, f"{line}: {captured.err}"
        said[line.command] = captured.out + captured.err

    assert f"{COUNT} of {COUNT} images placed" in said["prepare"]
    placed(tmp_path / "out" / "photos")
    assert "1 with a mask" in said["train"]
    assert f"{COUNT} of {COUNT} listed images there" in said["train"]
    metrics = json.loads(
        (tmp_path / "out" / "photos-splat" / "metrics.json").read_text()
    )
    assert metrics["psnr"] > 24
    assert "its images do not look like" not in said["render"]
    assert (
        like_the_photographs(
            tmp_path / "out" / "photos-views", tmp_path / "YOUR_PHOTOS"
        )
        > 0.9
    )
    (share,) = re.findall(r"seen by IMG_0008: ([\d.]+)% of the pixels", said["select"])
    assert 5 < float(share) < 25  # the car
    attack: dict[str, Any] = json.loads(
        (tmp_path / "out" / "photos-attack" / "result.json").read_text()
    )
    assert attack["target"] == "person"
    assert "consistent" in said["audit"]


STAND_INS = {
    "nanodet_coco": "fasterrcnn_small",
    "centernet_coco": "yolov8n_small",
    "banana": "car",
    "teddy bear": "person",
    "640x426": "256x192",
    "752x500": "267x200",
    "3000": "700",
    "4": "3",
}
"""Words of the tutorial, and those for photographs of the car of an example scene."""


@pytest.mark.nightly
def test_the_tutorial_takes_phone_photographs_to_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every command of the page that `make demo-real` runs, too, in its order."""
    pytest.importorskip("pycolmap", reason="the extra photos is not installed")
    monkeypatch.chdir(tmp_path)
    photographs = tmp_path / "photographs"
    write_photographs(photographs)
    said: dict[str, str] = {}
    for words in commands(photographs, tmp_path / "out"):
        if words[:2] == ["detectors", "--get"]:
            continue  # others' weights, from a registry of packages
        here = [STAND_INS.get(word, word) for word in words]
        here = [word.replace("DSC_0424", "IMG_0008") for word in here]
        status = cli.main(here)
        captured = capsys.readouterr()
        assert status in (0, 3), f"{words}: {captured.err}"
        said[words[0]] = captured.out + captured.err
    ((least, most),) = re.findall(
        r"in all, ([\d.]+)% to ([\d.]+)% of the pixels", said["select"]
    )
    assert 3 < float(least) < float(most) < 30  # the car
    attack = json.loads((tmp_path / "out" / "attack" / "result.json").read_text())
    assert attack["target"] == "person"
    assert (tmp_path / "out" / "report.html").is_file()
    assert "fasterrcnn_small: detected, clean" in said["evaluate"]


def placed(folder: Path) -> None:
    """Both orientations are in the set and upright, the lens is known, and one image
    has a mask.
    """
    views = load_dataset(folder, split=None)
    assert len(views) == COUNT
    sizes = {camera.width > camera.height for camera in views.cameras}
    assert sizes == {True, False}
    lenses = {frame.lens for frame in views.frames}
    assert len(lenses) == 2
    for lens in lenses:
        assert lens is not None
        assert max(lens.size) == SIZE[0]
        assert lens.distortion[0] == pytest.approx(-0.08, abs=0.02)
    rights = np.stack([camera.to_world[:3, 0].numpy() for camera in views.cameras])
    assert np.abs(rights[:, 2]).max() < 0.05  # z is up, and no camera lies on its side
    masked = [index for index in range(COUNT) if views.frames[index].mask is not None]
    assert masked == [MASKED]
    mask = views.loss_mask(MASKED)
    assert mask is not None
    pink = np.array([200, 40, 160]) / 255
    shown = np.abs(views[MASKED].image.numpy() - pink).max(-1) < 0.1
    assert shown.sum() > 10_000
    assert float(mask.numpy()[shown].mean()) < 0.02


def like_the_photographs(views: Path, photographs: Path) -> float:
    """The smallest correlation of a rendering with its photograph as a phone shows it,
    of those without a mask.
    """
    from PIL import ImageOps

    correlations = []
    for number in range(COUNT):
        if number == MASKED:
            continue
        photograph = ImageOps.exif_transpose(
            Image.open(photographs / f"IMG_{number:04d}.JPG")
        )
        rendering = Image.open(views / f"IMG_{number:04d}.png")
        small = [
            np.asarray(
                image.convert("L").resize((32, 32), Image.Resampling.BOX), float
            ).ravel()
            for image in (photograph, rendering)
        ]
        correlations.append(float(np.corrcoef(np.stack(small))[0, 1]))
    return min(correlations)
