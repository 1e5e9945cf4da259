"""Studies of captured splats: scenes made of a splat and a mask, and attacks within the
PSNR of the object's pixels.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from attacks.observe.rows import ATTACKED, CLEAN, NOISE, OPERATING
from attacks.studies.attack import cameras_in
from mi_splat.cameras.camera import project_points
from mi_splat.cameras.framing import bounds
from mi_splat.datasets import load_dataset
from mi_splat.io import save_splat
from mi_splat.ledger import Done
from mi_splat.render.scene_files import read_scene
from scenes.recipes.captured_scene import AXES, COUNT, make
from tests.datasets.sets import VIEWS, write_transforms
from tests.fakes import toy_scene
from tests.studies.toy import done, settings, work_of, write_toy


def made(folder: Path, **changes: Any) -> Path:
    """The scene of the toy splat, whose object is red; the path of its cameras."""
    scene, mask = toy_scene()
    save_splat(scene, folder / "toy.ply")
    np.save(folder / "mask.npy", mask.numpy())
    options: dict[str, Any] = {
        "splat": folder / "toy.ply",
        "mask": folder / "mask.npy",
        "object": "teddy bear",
        "set": None,
        "up": "z",
        "background": [0.0, 0.0, 0.0],
        "side": 64,
        "seed": 1,
        "out": folder / "scenes" / "toy.xml",
    }
    return make(argparse.Namespace(**{**options, **changes}))


def test_the_object_and_its_surroundings_are_parts(tmp_path: Path) -> None:
    made(tmp_path)
    scene, mask = toy_scene()
    loaded = read_scene(tmp_path / "scenes" / "toy.xml")
    assert list(loaded.objects) == ["teddy_bear", "surroundings"]
    part = loaded.scene.select(loaded.objects["teddy_bear"])
    assert torch.equal(part.means, scene.select(mask).means)
    assert len(loaded.scene) == len(scene)


def test_a_whole_splat_has_one_part(tmp_path: Path) -> None:
    made(tmp_path, mask=None)
    loaded = read_scene(tmp_path / "scenes" / "toy.xml")
    assert list(loaded.objects) == ["teddy_bear"]


@pytest.mark.parametrize("up", ["z", "-y"])
def test_cameras_stand_around_the_object_and_look_at_it(
    tmp_path: Path, up: str
) -> None:
    path = made(tmp_path, up=up)
    cameras = cameras_in(path)
    scene, mask = toy_scene()
    centre, radius = bounds(scene.select(mask))
    assert len(cameras) == COUNT
    axis = torch.tensor(AXES[up]).double()
    for camera in cameras.values():
        away = camera.position - torch.tensor(centre).double()
        assert 2 * radius < float(away.norm()) < 5 * radius
        height = float(away @ axis / away.norm())
        assert 3 <= np.degrees(np.arcsin(height)) <= 25
        # upright: what is above in the world is above in the image
        assert float(camera.to_world[:3, 1].double() @ axis) < 0
        pixels, _ = project_points(torch.tensor([centre]).double(), camera)
        assert pixels[0].tolist() == pytest.approx([camera.cx, camera.cy], abs=1e-3)
    assert path.read_text() == made(tmp_path, up=up).read_text()
    assert path.read_text() != made(tmp_path, up=up, seed=2).read_text()


def test_cameras_stand_by_photographs_that_show_the_object(tmp_path: Path) -> None:
    write_transforms(tmp_path / "set", VIEWS)
    path = made(tmp_path, set=tmp_path / "set")
    photographs = load_dataset(tmp_path / "set", split=None).cameras
    places = torch.stack([camera.position for camera in photographs])
    centre = torch.tensor(bounds(toy_scene()[0].select(toy_scene()[1]))[0]).double()
    for camera in cameras_in(path).values():
        assert max(camera.width, camera.height) == 64
        gaps = (places - camera.position).norm(dim=1)
        away = float((camera.position - centre).norm())
        # within 8 degrees aside, 5 up and a factor of 1.15
        assert float(gaps.min()) < 0.3 * away
        assert float(gaps.min()) > 0
    assert len(json.loads(path.read_text())["cameras"]) == COUNT


QUIET = {
    "eps": [9.0],
    "norm": "linf",
    "object_psnr": 9.0,
    "steps": 40,
    "optimiser": "adam",
    "momentum": 0.8,
    "schedule": "linear",
    "sh_degree": 0,
    "validate_every": 10,
    "noise_draws": 2,
}


@pytest.mark.parametrize(("name", "is_detected"), [("car", True), ("rest", False)])
def test_a_study_attacks_what_is_detected_within_a_psnr(
    tmp_path: Path, toys: None, name: str, is_detected: bool
) -> None:
    write_toy(tmp_path)
    table = settings(
        tmp_path,
        object=name,
        attack=QUIET,
        objective={"strict": True, "confidence": "none"},
        only_detected=True,
    )
    (result,) = done(work_of(table), tmp_path / "store").values()
    assert isinstance(result, Done)
    splats = [row["splat"] for row in result.rows]
    assert {CLEAN, ATTACKED} <= set(splats)
    assert splats.count(NOISE) == (2 if is_detected else 0)
    attacked = next(row for row in result.rows if row["splat"] == ATTACKED)
    assert attacked[OPERATING] == attacked["threshold"] == 0.5
    assert attacked["success"] is is_detected
    if is_detected:
        assert attacked["object_psnr"] == pytest.approx(9.0, abs=0.15)
