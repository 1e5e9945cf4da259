"""The shipped scenes' recipes: the files are those of the recipes, cameras and seeds keep what the README promises."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import numpy as np
import pytest

from mi_splat import showcase
from mi_splat.cameras import project_box
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.rendering import read_stage
from mi_splat.showcase import RECIPES, SIZE, cameras, make, scene_xml, sensors

SCENES = Path(__file__).parent.parent / "scenes"


@pytest.mark.parametrize("name", RECIPES)
def test_scene_file_is_that_of_the_recipe(name: str) -> None:
    assert (SCENES / f"{name}.xml").read_text() == scene_xml(name, RECIPES[name])


@pytest.mark.parametrize("name", RECIPES)
def test_sensors_come_back_from_the_file(name: str) -> None:
    stage = read_stage(SCENES / f"{name}.xml")
    wanted = sensors(RECIPES[name])
    assert list(stage.cameras) == list(wanted)
    for sensor, camera in stage.cameras.items():
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
        share = float((box[2:] - box[:2]).max()) / SIZE
        assert share > 0.2, f"{sensor}: {share}"


@pytest.mark.parametrize("name", RECIPES)
def test_cameras_keep_to_their_range(name: str) -> None:
    recipe = RECIPES[name]
    spots = cameras(recipe, 40, seed=3)
    offsets = np.stack([camera.position.numpy() for camera in spots]) - np.array(recipe.centre)
    distance = np.linalg.norm(offsets, axis=1)
    assert distance.min() > recipe.distance[0] - 0.4
    assert distance.max() < recipe.distance[1] + 0.4
    assert min(float(camera.position[2]) for camera in spots) >= 0.3
    again = cameras(recipe, 40, seed=3)
    assert all(np.array_equal(a.to_world, b.to_world) for a, b in zip(spots, again, strict=True))
    assert not np.array_equal(spots[0].to_world, cameras(recipe, 40, seed=4)[0].to_world)


def test_asset_seeds_are_kept_out_of_training() -> None:
    tree = ast.parse(Path(showcase.__file__).read_text())
    functions = [n for n in tree.body if isinstance(n, ast.FunctionDef) and f"{n.name[1:]}" in RECIPES]
    assert len(functions) == len(RECIPES)
    numbers = [
        node.args[-1].value
        for function in functions
        for node in ast.walk(function)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("build", "build_street")
        if isinstance(node.args[-1], ast.Constant)
    ]
    assert len(numbers) == 4
    assert all(isinstance(number, int) and number >= 900_000 for number in numbers)


def test_unknown_recipe(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="name: expected one of"):
        make("moon", tmp_path)
