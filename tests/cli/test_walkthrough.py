"""Foreign files through every command, as somebody would who has seen none of them
before.

A set as phones and COLMAP leave one, with pictures that are missing and y down.
"""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from attacks import cli
from mi_splat.cameras.camera import View
from mi_splat.datasets import DatasetWarning, PointCloud, load_dataset
from mi_splat.io import load_splat
from mi_splat.maths.orientation import turn_of
from mi_splat.maths.sh import sh_to_colour
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene, Similarity
from tests.cloak.test_own_pictures import CAMERAS, ball_on_a_plane
from tests.datasets.sets import write_colmap
from tests.fakes import ColourDetector, register

BALL = "--box -0.4 -1 -0.4 0.4 -0.2 0.4"
"""Where the ball is with y down."""
TRAINED = "train set --out run --iterations 20 --max-gaussians 1300 --sh-degree 1"


class Walk:
    """Runs commands and keeps what they print."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.err = ""

    def __call__(self, line: str) -> str:
        status = cli.main(line.split())
        captured = self._capsys.readouterr()
        self.err = captured.err
        assert status == 0, f"{line}: {captured.err}"
        return captured.out

    def json(self, line: str) -> Any:
        return json.loads(self(f"{line} --json"))


def spread(path: str) -> float:
    """How much a picture varies: a black one not at all."""
    with Image.open(path) as picture:
        return float(np.asarray(picture.convert("RGB"), np.float64).std())


@pytest.fixture
def walk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Walk:
    monkeypatch.chdir(tmp_path)
    return Walk(capsys)


def write_photographs(folder: Path) -> GaussianScene:
    """A COLMAP model with y down, of which two pictures are missing; returns what it
    shows.
    """
    back = torch.from_numpy(turn_of("-y")).T
    scene = ball_on_a_plane().transform(
        Similarity(rotation=back, translation=torch.zeros(3).double())
    )
    cameras = [camera.turned(back) for camera in CAMERAS]
    shots = [View(camera, Renderer()(scene, camera).clamp(0, 1)) for camera in cameras]
    cloud = PointCloud(
        scene.means, sh_to_colour(scene.sh, torch.ones_like(scene.means)).clamp(0, 1)
    )
    write_colmap(folder, shots[4:], test=shots[:4], points=cloud)
    for number in (3, 7):
        (folder / f"images/train_{number:05d}.png").unlink()
    return scene


@pytest.mark.filterwarnings("ignore::mi_splat.datasets.DatasetWarning")
def test_a_set_of_photographs_through_every_command(
    walk: Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = write_photographs(Path("set"))
    register(monkeypatch, {"fake_colour": ColourDetector()})
    with pytest.warns(DatasetWarning, match="2 of 24 images missing"):
        seen = load_dataset("set", split="test")
    for view in seen:
        assert (
            float(
                (Renderer()(scene, view.camera).clamp(0, 1) - view.image).abs().mean()
            )
            < 0.02
        )

    trained = walk.json(TRAINED)
    assert trained["psnr"] > 22
    walk("render run --cameras set --out pictures")
    assert len(list(Path("pictures").glob("*.png"))) == 24
    walk("render run --up -y --elevation 30 --size 48 --out look.png")
    assert spread("look.png") > 10
    assert walk.json(f"select run {BALL} --up -y --out ball.npy")["gaussians"] > 200
    walk("audit run --only lint")

    poisoned = walk.json(
        "poison set run --mask ball.npy --up -y --hide-from elevation:40-90 --out"
        " poisoned"
    )
    assert 0 < poisoned["changed"] < poisoned["views"] == 18
    assert len(load_dataset("poisoned", split="train")) == 18

    attack = (
        "--mask ball.npy --objective untargeted --detectors fake_colour --noise-draws 0"
        " --steps 1 --up -y"
    )
    walk(f"dagger run {attack} --cameras set --out attacked")
    judged = (
        "--mask ball.npy --cameras orbit:2@30 --up -y --size 48 --detectors fake_colour"
    )
    walk(f"evaluate run attacked {judged} --original car --out judged")
    walk(
        "detect attacked --cameras orbit:2@30 --up -y --size 48 --detectors fake_colour"
        " --out seen"
    )

    upright = walk.json("convert run upright.ply --up -y")
    assert upright["gaussians"] == trained["gaussians"]
    low, high = (
        load_splat("upright.ply").means.quantile(share, 0) for share in (0.02, 0.98)
    )
    assert float(high[2] - low[2]) < float(high[1] - low[1])  # the plane lies
    if importlib.util.find_spec("pxr") is not None:
        walk("convert upright.ply upright.usdc")
        assert walk.json("info upright.usdc")["gaussians"] == trained["gaussians"]
        for name in ("upright.ply", "upright.usdc"):
            walk(f"render {name} --elevation 30 --size 48 --out {name}.png")
        assert (
            Path("upright.ply.png").read_bytes()
            == Path("upright.usdc.png").read_bytes()
        )
        walk("select upright.usdc --box -0.4 -0.4 0.2 0.4 0.4 1 --out again.npy")
        assert int(np.load("again.npy").sum()) == int(np.load("ball.npy").sum())
