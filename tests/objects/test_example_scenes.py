"""The shipped scenes' recipes: the files are those of the recipes, cameras and seeds
keep what the README promises.
"""

import ast
import json
from pathlib import Path

import pytest

from mi_splat.cameras.camera import project_box
from mi_splat.io import load_splat
from scenes.recipes.example_scenes import RECIPES, SIZE, make, scene_xml, sensors
from scenes.recipes.objects import examples

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
        for node in ast.walk(ast.parse(Path(examples.__file__).read_text()))
        if isinstance(node, ast.Call)
        and getattr(node.func, "id", "") in ("build", "build_street")
        if isinstance(node.args[-1], ast.Constant)
    ]
    assert len(numbers) == 3
    numbers.append(examples.SEED)
    assert all(isinstance(number, int) and number >= 900_000 for number in numbers)


@pytest.mark.nightly
def test_the_recipe_makes_a_scene(tmp_path: Path) -> None:
    record = make("stop_sign", tmp_path, views=2, samples=1, steps=1)
    assert {path.suffix for path in tmp_path.iterdir()} == {".ply", ".xml", ".json"}
    assert json.loads((tmp_path / "stop_sign.json").read_text()) == record
