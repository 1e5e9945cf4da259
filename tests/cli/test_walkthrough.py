"""Foreign files through every command, as somebody would who has seen none of them before.

A low-poly truck in centimetres, far from the origin, facing -y, with its texture in a file of its own; a set as phones
and COLMAP leave one, with a lens that bends, pictures that are missing and y down; and a video of a path-traced object.
"""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from PIL import Image

from attacks import cli
from attacks.cloak.own_pictures import turned
from mi_splat.cameras import Camera, View
from mi_splat.datasets import DatasetWarning, PointCloud, load_dataset
from mi_splat.datasets.distortion import Intrinsics
from mi_splat.io import load_splat
from mi_splat.io.images import save_animation
from mi_splat.io.picture_files import load_picture
from mi_splat.placement import turn_of
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene, Similarity
from mi_splat.sh import sh_to_colour
from tests.capture.trucks import truck, write_glb
from tests.cloak.test_own_pictures import CAMERAS, ball_on_a_plane
from tests.datasets.sets import write_colmap
from tests.fakes import ColourDetector, register

LENS = Intrinsics(
    focal=(40.0, 40.0),
    principal=(20.0, 16.0),
    size=(40, 32),
    radial=(-0.15, 0.02, 0.0),
    divisor=(0.1, 0.0, 0.0),
    tangential=(0.002, -0.001),
)
MODEL = "1 FULL_OPENCV 40 32 40 40 20 16 -0.15 0.02 0.002 -0.001 0 0.1 0 0\n"
UTM = (50_000_000.0, 450_000_000.0, 10_000.0)
"""Centimetres."""
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


def photograph(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """(32, 40, 3) bytes that the lens takes from a camera: out of a wider picture, by the inverse of its mapping."""
    wide = Camera(to_world=camera.to_world, focal=120.0, width=240, height=192)
    picture = Renderer()(scene, wide).clamp(0, 1)
    pixels = np.stack(np.meshgrid(np.arange(40) + 0.5, np.arange(32) + 0.5))
    ray = (pixels - np.array([20.0, 16.0])[:, None, None]) / 40
    for _ in range(30):
        ray = ray + (pixels - np.stack(LENS.project(*ray))) / 40
    grid = torch.from_numpy(120 * ray / np.array([120.0, 96.0])[:, None, None]).permute(1, 2, 0).float()
    taken = F.grid_sample(picture.permute(2, 0, 1)[None], grid[None], align_corners=False)[0]
    return (255 * taken.permute(1, 2, 0) + 0.5).numpy().astype(np.uint8)


@pytest.fixture
def walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Walk:
    monkeypatch.chdir(tmp_path)
    return Walk(capsys)


def write_photographs(folder: Path) -> GaussianScene:
    """A COLMAP model with y down, of which two pictures are missing and one has a mask; returns what it shows."""
    back = torch.from_numpy(turn_of("-y")).T
    scene = ball_on_a_plane().transform(Similarity(rotation=back, translation=torch.zeros(3).double()))
    blank = [View(camera, torch.zeros(32, 40, 3)) for camera in CAMERAS]
    shots = [View(camera, blank[0].image) for camera in turned(blank, back).cameras]
    cloud = PointCloud(scene.means, sh_to_colour(scene.sh, torch.ones_like(scene.means)).clamp(0, 1))
    write_colmap(folder, shots[4:], test=shots[:4], points=cloud)
    (folder / "sparse/0/cameras.txt").write_text(MODEL)
    for split, part in (("test", shots[:4]), ("train", shots[4:])):
        for number, shot in enumerate(part):
            Image.fromarray(photograph(scene, shot.camera)).save(folder / f"images/{split}_{number:05d}.png")
    for number in (3, 7):
        (folder / f"images/train_{number:05d}.png").unlink()
    (folder / "masks").mkdir()
    Image.fromarray(np.repeat(np.array([[0] * 20 + [255] * 20], np.uint8), 32, 0)).save(
        folder / "masks/train_00001.png"
    )
    return scene


@pytest.mark.filterwarnings("ignore::mi_splat.datasets.DatasetWarning")
def test_a_set_of_photographs_through_every_command(walk: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = write_photographs(Path("set"))
    register(monkeypatch, {"fake_colour": ColourDetector()})
    with pytest.warns(DatasetWarning, match="2 of 24 pictures missing"):
        seen = load_dataset("set", split="test")
    for view in seen:  # as without the lens
        assert float((Renderer()(scene, view.camera).clamp(0, 1) - view.image).abs().mean()) < 0.02

    trained = walk.json(TRAINED)
    assert trained["psnr"] > 22
    walk("render run --cameras set --out pictures")
    assert len(list(Path("pictures").glob("*.png"))) == 24
    walk("render run --up -y --elevation 30 --size 48 --out look.png")
    assert spread("look.png") > 10
    assert walk.json(f"select run {BALL} --up -y --out ball.npy")["gaussians"] > 200
    walk("audit run --only lint")

    poisoned = walk.json("poison set run --mask ball.npy --up -y --hide-from elevation:40-90 --out poisoned")
    assert 0 < poisoned["changed"] < poisoned["views"] == 18
    assert len(load_dataset("poisoned", split="train")) == 18
    kept, counts = (load_dataset(name, split="train").loss_mask(1) for name in ("set", "poisoned"))
    assert kept is not None
    assert counts is not None
    torch.testing.assert_close(counts, kept, atol=1 / 255, rtol=0)  # of a picture that is as it was

    attack = "--mask ball.npy --objective untargeted --detectors fake_colour --noise-draws 0 --steps 1 --up -y"
    walk(f"dagger run {attack} --cameras set --out attacked")
    assert "18 views at once" in walk.err
    judged = "--mask ball.npy --cameras orbit:2@30 --up -y --size 48 --detectors fake_colour"
    walk(f"evaluate run attacked {judged} --original car --out judged")
    walk("detect attacked --cameras orbit:2@30 --up -y --size 48 --detectors fake_colour --out seen")

    upright = walk.json("convert run upright.ply --up -y")
    assert upright["gaussians"] == trained["gaussians"]
    low, high = (load_splat("upright.ply").means.quantile(share, 0) for share in (0.02, 0.98))
    assert float(high[2] - low[2]) < float(high[1] - low[1])  # the plane lies
    if importlib.util.find_spec("pxr") is not None:
        walk("convert upright.ply upright.usdc")
        assert walk.json("info upright.usdc")["gaussians"] == trained["gaussians"]
        for name in ("upright.ply", "upright.usdc"):
            walk(f"render {name} --elevation 30 --size 48 --out {name}.png")
        assert Path("upright.ply.png").read_bytes() == Path("upright.usdc.png").read_bytes()
        walk("select upright.usdc --box -0.4 -0.4 0.2 0.4 0.4 1 --out again.npy")
        assert int(np.load("again.npy").sum()) == int(np.load("ball.npy").sum())


@pytest.mark.nightly
def test_a_video_of_path_traced_pictures_through_every_command(walk: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    for package, extra in (("pycolmap", "colmap"), ("imageio_ffmpeg", "video")):
        pytest.importorskip(package, reason=f"the extra {extra} is not installed")
    register(monkeypatch, {"fake_colour": ColourDetector()})
    walk("capture car:900004 --ground asphalt --cameras orbit:24@25 --size 960x720 --samples 8 --out frames")
    frames = [load_picture(file) for file in sorted(Path("frames/images").rglob("*.png"))]
    save_animation([np.asarray(frame.convert("RGB")) for frame in frames], Path("walk.mp4"), fps=1)
    prepared = walk.json("prepare walk.mp4 --features 2048 --out set")
    assert sum(row["part"] != "none" for row in prepared["pictures"]) >= 22
    assert walk.json("train set --out run --iterations 40 --downscale 8")["psnr"] > 15
    walk("render run --cameras set --out pictures")
    low, high = walk.json("info run --up z")["height"]
    assert low < high
    assert walk.json("select run --cluster 1 --out object.npy")["gaussians"] > 100
    walk("audit run --only lint")
    aim = "--mask object.npy --size 64 --detectors fake_colour"
    walk(f"dagger run {aim} --objective untargeted --noise-draws 0 --steps 1 --cameras set --out attacked")
    walk(f"evaluate run attacked {aim} --original car --cameras orbit:2@30 --out judged")
    walk("detect attacked --cameras orbit:2@30 --size 64 --detectors fake_colour --out seen")
    walk("compare run --cameras orbit:1@30 --size 64 --rounds 0 --no-gradients --out compared")
    walk("poison set run --mask object.npy --hide-from elevation:10-90 --downscale 8 --out poisoned")


@pytest.mark.slow
def test_a_mesh_becomes_a_splat_that_trains_on(walk: Walk, tmp_path: Path) -> None:
    write_glb(tmp_path, truck().placed(scale=100.0, move=UTM, y_up=True))
    shot = "--cameras hemisphere:14 --test 3 --size 48 --samples 4 --points 1500 --format both"
    capture = f"capture truck.glb --scale 0.01 --front +x --ground road --sun -50,52 {shot} --out set"
    taken = walk.json(capture)
    assert (taken["train"], taken["test"]) == (14, 3)
    assert any(abs(value) > 1e5 for value in json.loads(Path("set/capture.json").read_text())["world_offset"])
    assert walk.json(capture)["rendered"] == 0
    first = walk.json("train set --out run --iterations 80 --max-gaussians 3000 --sh-degree 1")
    longer = walk.json("train set --out run --iterations 120 --max-gaussians 3000 --sh-degree 1")
    assert "going on from step 80 of 120" in walk.err
    assert longer["psnr"] > first["psnr"] - 1
    assert walk.json("info run/splat.ply")["gaussians"] == longer["gaussians"]
    walk("render run/splat.ply --azimuth 40 --elevation 15 --size 64x48 --out one.jpg")
    assert Path("one.jpg").read_bytes().startswith(b"\xff\xd8")
    assert spread("one.jpg") > 10
    assert walk.json("select run/splat.ply --box -2.6 -1.1 0.2 2.6 1.1 2.2 --size 64 --out mask.npy")["gaussians"] > 100
