"""The shipped scenes' recipes: the files are those of the recipes, cameras and seeds keep what the README promises."""

import ast
import json
import math
from pathlib import Path

import pytest
import torch

from mi_splat.cameras import project_box
from mi_splat.capture import sources
from mi_splat.io import load_splat
from mi_splat.scene import GaussianScene, merge
from scenes.recipes.example_scenes import RECIPES, SIZE, belongs, make, scene_xml, sensors

SCENES = Path(__file__).parents[2] / "scenes"


@pytest.mark.parametrize("name", RECIPES)
def test_scene_file_is_that_of_the_recipe(name: str) -> None:
    assert (SCENES / f"{name}.xml").read_text() == scene_xml(name, RECIPES[name])


@pytest.mark.parametrize("name", RECIPES)
def test_target_fills_enough_of_the_picture(name: str) -> None:
    recipe = RECIPES[name]
    target = load_splat(SCENES / f"{name}_{recipe.target}.ply")
    for sensor, camera in sensors(recipe).items():
        box = project_box(target.means, camera)
        assert box is not None
        fraction = float((box[2:] - box[:2]).max()) / SIZE
        assert fraction > 0.2, f"{sensor}: {fraction}"


def test_asset_seeds_are_kept_out_of_training() -> None:
    numbers = [
        node.args[-1].value
        for node in ast.walk(ast.parse(Path(sources.__file__).read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("build", "build_street")
        if isinstance(node.args[-1], ast.Constant)
    ]
    assert len(numbers) == 4
    assert all(isinstance(number, int) and number >= 900_000 for number in numbers)


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


@pytest.mark.slow
def test_the_recipe_makes_a_scene(tmp_path: Path) -> None:
    record = make("stop_sign", tmp_path, views=2, samples=1, steps=1)
    assert {path.suffix for path in tmp_path.iterdir()} == {".ply", ".xml", ".json"}
    assert json.loads((tmp_path / "stop_sign.json").read_text()) == record
