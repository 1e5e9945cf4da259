"""The shipped scenes' recipes: the files are those of the recipes, cameras and seeds keep what the README promises."""

import ast
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from attacks import cli
from mi_splat import example_scenes
from mi_splat.assets import recipes
from mi_splat.assets.recipes import RECIPES
from mi_splat.cameras import project_box
from mi_splat.errors import InvalidValueError
from mi_splat.example_scenes import SIZE, belongs, make, nearest, random_cameras, scene_xml, sensors
from mi_splat.io import load_splat
from mi_splat.scene import GaussianScene, merge
from mi_splat.scene_files import read_scene

SCENES = Path(__file__).parents[2] / "scenes"


@pytest.mark.parametrize("name", RECIPES)
def test_scene_file_is_that_of_the_recipe(name: str) -> None:
    assert (SCENES / f"{name}.xml").read_text() == scene_xml(name, RECIPES[name])


@pytest.mark.parametrize("name", RECIPES)
def test_sensors_come_back_from_the_file(name: str) -> None:
    loaded = read_scene(SCENES / f"{name}.xml")
    wanted = sensors(RECIPES[name])
    assert list(loaded.cameras) == list(wanted)
    for sensor, camera in loaded.cameras.items():
        assert np.allclose(camera.to_world, wanted[sensor].to_world, atol=1e-5)
        assert camera.fx == pytest.approx(wanted[sensor].fx, rel=1e-6)
        assert (camera.width, camera.height) == (SIZE, SIZE)


@pytest.mark.parametrize("name", RECIPES)
def test_record_and_bar(name: str) -> None:
    record = json.loads((SCENES / f"{name}.json").read_text())
    recipe = RECIPES[name]
    assert record["psnr_held_out"] >= 24
    assert min(record["psnr_sensors"].values()) >= 24
    assert (record["views"], record["steps"]) == (recipe.views, recipe.steps)
    for shape, count in record["gaussians"].items():
        assert len(load_splat(SCENES / f"{name}_{shape}.ply")) == count


@pytest.mark.parametrize("name", RECIPES)
def test_target_fills_enough_of_the_picture(name: str) -> None:
    recipe = RECIPES[name]
    target = load_splat(SCENES / f"{name}_{recipe.target}.ply")
    for sensor, camera in sensors(recipe).items():
        box = project_box(target.means, camera)
        assert box is not None
        fraction = float((box[2:] - box[:2]).max()) / SIZE
        assert fraction > 0.2, f"{sensor}: {fraction}"


@pytest.mark.parametrize("name", RECIPES)
def test_cameras_keep_to_their_range(name: str) -> None:
    recipe = RECIPES[name]
    cameras = random_cameras(recipe, 40, seed=3)
    offsets = np.stack([camera.position.numpy() for camera in cameras]) - np.array(recipe.centre)
    distance = np.linalg.norm(offsets, axis=1)
    assert distance.min() > recipe.distance[0] - 0.4
    assert distance.max() < recipe.distance[1] + 0.4
    assert min(float(camera.position[2]) for camera in cameras) >= 0.3
    again = random_cameras(recipe, 40, seed=3)
    assert all(np.array_equal(a.to_world, b.to_world) for a, b in zip(cameras, again, strict=True))
    assert not np.array_equal(cameras[0].to_world, random_cameras(recipe, 40, seed=4)[0].to_world)


def test_asset_seeds_are_kept_out_of_training() -> None:
    numbers = [
        node.args[-1].value
        for node in ast.walk(ast.parse(Path(recipes.__file__).read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("build", "build_street")
        if isinstance(node.args[-1], ast.Constant)
    ]
    assert len(numbers) == 4
    assert all(isinstance(number, int) and number >= 900_000 for number in numbers)


def test_unknown_recipe(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="name: expected one of"):
        make("moon", tmp_path)
    for given in ({"steps": 0}, {"views": 0}, {"samples": 0}):
        with pytest.raises(InvalidValueError):
            make("stop_sign", tmp_path, **given)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_the_command_hands_its_options_on_and_prints_the_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record = {"seconds": 3, "psnr_fitted": 31.5, "psnr_held_out": 29.25}
    calls: list[dict[str, Any]] = []

    def fake(name: str, folder: Path, **given: Any) -> dict[str, object]:
        given.pop("on_step")("pictures", 1, 2)
        calls.append({"name": name, "folder": folder, **given})
        return dict(record)

    monkeypatch.setattr("mi_splat.example_scenes.make", fake)
    words = ["example-scenes", "stop_sign", "--out", str(tmp_path), "--views", "5", "--samples", "2", "--steps", "7"]
    assert cli.main([*words, "--seed", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == record
    assert cli.main(["example-scenes", "car_street"]) == 0
    assert "31.5 dB on the pictures fitted to, 29.25 dB on others" in capsys.readouterr().out
    assert calls == [
        {"name": "stop_sign", "folder": tmp_path, "views": 5, "samples": 2, "steps": 7, "seed": 3},
        {"name": "car_street", "folder": Path("scenes"), "views": None, "samples": 16, "steps": None, "seed": 0},
    ]


def _needles(means: list[list[float]], length: float = 0.01, *, upright: bool = False) -> GaussianScene:
    count = len(means)
    half = math.sqrt(0.5)
    turned = [half, 0.0, half, 0.0] if upright else [1.0, 0.0, 0.0, 0.0]  # about y: x to z
    return GaussianScene(
        means=torch.tensor(means),
        scales=torch.tensor([[length, 0.002, 0.002]]).expand(count, 3).contiguous(),
        rotations=torch.tensor([turned]).expand(count, 4).contiguous(),
        opacities=torch.full((count,), 0.5),
        sh=torch.zeros(count, 1, 3),
    )


def test_what_reaches_over_belongs_to_the_surroundings() -> None:
    plate = _needles([[0.1 * i, 0.0, 2.0] for i in range(5)])
    post = _needles([[0.2, 0.0, 0.1 * i] for i in range(19)])
    moved = merge(_needles([[0.13, 0.02, 1.99], [0.2, 0.01, 1.2]]), _needles([[0.2, 0.0, 1.93]], 0.2, upright=True))
    assert belongs(moved, plate, post).tolist() == [True, False, False]
    short = _needles([[0.2, 0.0, 1.93]], 0.02, upright=True)
    assert belongs(short, plate, post).tolist() == [True]


def test_nearest_is_the_same_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(1)
    points, others = torch.rand(50, 3, generator=generator), torch.rand(20, 3, generator=generator)
    whole = nearest(points, others)
    assert torch.equal(whole, torch.cdist(points.double(), others.double()).argmin(1))
    monkeypatch.setattr(example_scenes, "_BLOCK", 60)
    assert torch.equal(nearest(points, others), whole)
