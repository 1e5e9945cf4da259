"""A foreign mesh and a foreign splat through every command, as somebody would who has neither seen before.

The mesh is a low-poly truck in centimetres, far from the origin, facing -y, with its texture in a file of its own. The
splat is a .splat file, as a web viewer has it, of one object on a floor, written here byte by byte.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from attacks import cli
from tests.capture.trucks import truck, write_glb

pytestmark = pytest.mark.slow
UTM = (50_000_000.0, 450_000_000.0, 10_000.0)
"""Centimetres."""


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


@pytest.fixture
def walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Walk:
    monkeypatch.chdir(tmp_path)
    return Walk(capsys)


def spread(path: str) -> float:
    """How much a picture varies: a black one not at all."""
    with Image.open(path) as picture:
        return float(np.asarray(picture.convert("RGB"), np.float64).std())


def test_a_foreign_mesh_through_every_command(walk: Walk, tmp_path: Path) -> None:
    write_glb(tmp_path, truck().placed(scale=100.0, move=UTM, y_up=True))
    shot = "--cameras hemisphere:14 --test 3 --size 48 --samples 4 --points 1500 --format both"
    turned = "--scale 0.01 --front +x --ground road --sun -50,52"
    taken = walk.json(f"capture truck.glb {turned} {shot} --out set")
    assert (taken["train"], taken["test"]) == (14, 3)
    assert any(abs(value) > 1e5 for value in json.loads(Path("set/capture.json").read_text())["world_offset"])
    again = walk.json(f"capture truck.glb {turned} {shot} --out set")
    assert again["rendered"] == 0

    first = walk.json("train set --out run --iterations 80 --max-gaussians 3000 --sh-degree 1")
    longer = walk.json("train set --out run --iterations 120 --max-gaussians 3000 --sh-degree 1")
    assert "going on from step 80 of 120" in walk.err
    assert longer["psnr"] > first["psnr"] - 1
    facts = walk.json("info run/splat.ply")
    assert facts["gaussians"] == longer["gaussians"]

    walk("render run/splat.ply --cameras orbit:3@20 --size 48 --out orbit.gif")
    walk("render run/splat.ply --azimuth 40 --elevation 15 --size 64x48 --out one.jpg")
    assert Path("one.jpg").read_bytes().startswith(b"\xff\xd8")
    assert spread("one.jpg") > 10
    walk("render run/splat.ply --cameras set --size 48 --out pictures")

    low, high = ("{:.3f} {:.3f} {:.3f}".format(*corner) for corner in facts["bounds"])
    assert low < high
    chosen = walk.json("select run/splat.ply --box -2.6 -1.1 0.2 2.6 1.1 2.2 --size 64 --out picked.png mask.npy")
    assert chosen["gaussians"] > 100
    attack = "--azimuth 40 --elevation 20 --distance 8 --size 96 --steps 2 --noise-draws 1"
    result = walk.json(f"dagger run/splat.ply --mask mask.npy {attack} --target person --out attacked")
    assert result["changed_gaussians"] <= chosen["gaussians"]
    judged = "--cameras orbit:3@20 --size 96 --target person --detectors fasterrcnn_small"
    assert walk.json(f"evaluate run/splat.ply attacked/attacked.ply {judged} --out judged")
    walk("detect attacked/attacked.ply one.jpg --size 96 --out seen")
