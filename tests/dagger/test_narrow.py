"""DAGGER around a chosen camera: a quiet search on changed images, a ladder of levels,
and a limit on each part of the object.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.cli.dagger import DaggerOptions
from attacks.dagger.attack import attack_views, problem_of
from attacks.dagger.config import NARROW, NARROW_CHANGES, DaggerConfig
from attacks.dagger.result import Result
from attacks.dagger.views import DrawnViews
from attacks.objectives.relabel import relabel
from attacks.transformations.config import (
    CameraCone,
    ImageTransformations,
    Transformations,
)
from mi_splat.errors import InvalidValueError
from tests.fakes import ColourDetector, blobs, camera, toy_scene

REACHED = 9.0
"""dB at which the toy object can become another one: its detector knows only
colours.
"""
QUICK: dict[str, Any] = {
    "eps": (9.0,),
    "step_factor": 2.4,
    "steps": 30,
    "batch": 2,
    "pool": 4,
    "validation": 3,
    "validate_every": 5,
    "held_out": 6,
}


def views(**changes: Any) -> DrawnViews:
    scene, mask = toy_scene(degree=0)
    drawn = Transformations(
        cameras=CameraCone(angle=8.0, margin=0.05),
        images=ImageTransformations(**changes),
    )
    return DrawnViews(scene, mask, camera(), drawn, render=blobs)


def run(**settings: Any) -> Result:
    around = views(blur=0.3, plain=0.5)
    return attack_views(
        around,
        ColourDetector(),
        relabel("person", strict=True),
        config=DaggerConfig.for_narrow(**{**QUICK, **settings}),
        evaluation=around.drawn_from(around.transformations.plain),
    )


def test_held_out_views_with_plain_images_judge_the_attack() -> None:
    result = run(object_psnr=REACHED, local_gap=None)
    assert result.rate.total == 6
    assert result.rate.fraction >= 0.8
    assert result.transformations != result.evaluation
    assert result.evaluation is not None
    assert result.evaluation.images == ImageTransformations()
    psnr = result.image.psnr_object
    assert psnr is not None
    assert psnr == pytest.approx(REACHED, abs=0.8)
    assert result.figures.rate("success", splat="noise").successes == 0


def test_the_answer_of_a_ladder_is_its_quietest_level_that_works() -> None:
    result = run(object_psnr=40.0, ladder=(40.0, 30.0, REACHED, 4.0), local_gap=None)
    assert [level.object_psnr for level in result.levels] == [40.0, 30.0, REACHED]
    assert [level.success for level in result.levels] == [False, False, True]
    assert result.config.object_psnr == REACHED
    assert result.success
    runs = [line.restart for line in result.trace]
    assert runs == sorted(runs)
    assert max(runs) == 2
    assert result.best.restart == 2


def test_a_ladder_without_a_level_that_works_ends_at_its_last() -> None:
    result = run(object_psnr=50.0, ladder=(50.0, 45.0), local_gap=None)
    assert [level.success for level in result.levels] == [False, False]
    assert result.config.object_psnr == 45.0
    assert not result.success


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"ladder": (30.0, 40.0)}, "the highest PSNR first"),
        ({"ladder": (40.0, 30.0), "object_psnr": None}, "object_psnr as well"),
    ],
)
def test_a_ladder_is_checked(settings: dict[str, Any], named: str) -> None:
    with pytest.raises(InvalidValueError, match=named):
        DaggerConfig.for_narrow(**settings)


def test_no_part_of_the_object_carries_the_whole_change() -> None:
    """A change of one corner is as large as its window says, and not its mean."""
    around = views()
    (view,) = around.views(0, 1)
    config = DaggerConfig.for_narrow(local_gap=6.0)
    problem = problem_of(around, (ColourDetector(),), relabel("person"), config)
    clean = around.picture(view.camera)
    rows, columns = view.on_object.nonzero(as_tuple=True)
    corner = clean.clone()
    corner[rows[:4], columns[:4]] += 0.5
    spread = clean + 0.02
    mean = dataclasses.replace(problem, local_gap=None)
    assert float(mean.image_error(corner, view)) < float(
        problem.image_error(corner, view)
    )
    assert float(mean.image_error(spread, view)) == pytest.approx(
        float(problem.image_error(spread, view)), rel=1e-3
    )


def test_the_limit_on_parts_holds_in_the_result() -> None:
    with_limit = run(object_psnr=20.0, local_gap=1.0, steps=10)
    without = run(object_psnr=20.0, local_gap=None, steps=10)
    assert with_limit.image.psnr_object is not None
    assert without.image.psnr_object is not None
    assert with_limit.image.psnr_object > without.image.psnr_object + 0.5


def parsed(words: str) -> DaggerOptions:
    options = cli.parse("dagger", ["a.ply", *words.split()])
    assert isinstance(options, DaggerOptions)
    return options


def test_around_implies_the_quiet_profile() -> None:
    options = parsed("--around 10 --ladder 40 38 35")
    assert options.around == 10.0
    assert options.config == DaggerConfig.for_narrow(ladder=(40.0, 38.0, 35.0))
    assert options.config.object_psnr == NARROW["object_psnr"]
    assert options.images == ImageTransformations(**NARROW_CHANGES)
    changed = parsed("--around 10 --jpeg 0 --plain 1 --object-psnr 30")
    assert changed.images.jpeg == 0
    assert changed.config.object_psnr == 30.0
    with_image = parsed("--around 10 --image-psnr 40")
    assert with_image.config.object_psnr is None
    assert with_image.config.local_gap is None


def test_images_change_only_around_a_camera() -> None:
    with pytest.raises(InvalidValueError, match="--around as well"):
        DaggerOptions(scene=Path("a.ply"), images=ImageTransformations(jpeg=50))


@pytest.mark.slow
def test_the_command_attacks_around_a_camera(tmp_path: Path) -> None:
    words = (
        "example:car_street --object car --cameras rear --around 5 --steps 4 --pool 4"
        " --validation 2 --held-out 3 --sizes 1 1 --ladder 30 20 --target person"
    )
    out = tmp_path / "narrow"
    assert cli.main(["dagger", *words.split(), "--out", str(out)]) == 0
    record = json.loads((out / "result.json").read_text())
    assert record["config"]["transformations"]["cameras"]["angle"] == 5.0
    assert record["config"]["evaluation"]["images"]["jpeg"] == 0
    assert len(record["levels"]) in (1, 2)
    assert record["reference"]["name"] == "rear"
    assert (out / "held_out.png").is_file()
