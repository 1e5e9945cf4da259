"""What is left of an attack under other conditions, and after what a defender does."""

from __future__ import annotations

from functools import partial

import polars as pl
import pytest
import torch

from attacks.observe.comparison import compared_cells, compared_rows, figures
from attacks.observe.conditions import FORMS, OWN, Viewing, check_condition
from attacks.observe.repairs import median_of_neighbours
from attacks.observe.rows import ATTACKED, CLEAN, ROWS
from attacks.observe.survival import (
    STANDARD,
    VOTE,
    named_conditions,
    survival_figures,
    survived,
    together,
    voted,
)
from attacks.observe.views import detect_scenes
from mi_splat.errors import InvalidValueError
from mi_splat.maths.sh import colour_to_dc, sh_basis
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.fakes import ColourDetector, camera, toy_scene

SCENE, MASK = toy_scene(degree=1)
CAMERAS = [camera(offset=x) for x in (-0.3, 0.0, 0.3)]
RENDER = Renderer(RenderSettings(near=0.1))
VIEWING = Viewing(
    settings=RENDER.settings, centre=(0.0, 0.0, 0.0), alone=lambda scene: scene
)


def person() -> GaussianScene:
    """The object in green, which is a person."""
    sh = SCENE.sh.clone()
    sh[MASK, 0] = colour_to_dc(torch.tensor([0.1, 0.9, 0.1]))
    return SCENE.replace(sh=sh)


def person_from_the_front() -> GaussianScene:
    """The object in green from the cameras, by coefficients of degree 1 alone."""
    towards = torch.tensor([[0.0, 1.0, 0.0]])
    basis = sh_basis(towards, 1)[0]
    wanted = torch.tensor([0.1, 0.9, 0.1]) - torch.tensor([0.9, 0.1, 0.1])
    first = basis[1:] / basis[1:].square().sum()
    sh = SCENE.sh.clone()
    sh[MASK, 1:] = first[:, None] * wanted
    return SCENE.replace(sh=sh)


def rows_under(attacked: GaussianScene, *names: str) -> pl.DataFrame:
    scenes = {CLEAN: SCENE, ATTACKED: attacked}
    detectors = [ColourDetector()]
    plain = compared_rows(
        detect_scenes(scenes, MASK, CAMERAS, detectors, render=RENDER),
        original="car",
        target="person",
        min_confidence=0.5,
    )
    seen = survived(
        scenes,
        MASK,
        CAMERAS,
        detectors,
        named_conditions(names),
        viewing=VIEWING,
        render=RENDER,
        new_cells=partial(compared_cells, {"fake_colour": "car"}, target="person"),
    )
    return together(plain, [part for _, part in seen]).rows


def test_an_attack_by_view_dependent_colours_does_not_survive_a_cut() -> None:
    attacked = person_from_the_front()
    rows = rows_under(attacked, "SH of degree 0", "JPEG 90")
    record = {"min_confidence": 0.5}
    counted = figures(record, {ROWS: rows}).having("condition")
    replaced = {
        name: counted.rate("replaced", condition=name, detector="fake_colour").counts
        for name in (OWN, "SH of degree 0", "JPEG 90")
    }
    assert replaced == {
        OWN: "3 of 3",
        "SH of degree 0": "0 of 3",
        "JPEG 90": "3 of 3",
    }
    missed = counted.rate("missed", condition="SH of degree 0", detector="fake_colour")
    assert missed.counts == "0 of 3"


def test_boxes_follow_cameras_and_sizes() -> None:
    rows = rows_under(person(), "2 x size", "1.5 x distance")
    widths = {
        str(name): float((seen["x1"] - seen["x0"]).mean() or 0)  # type: ignore[arg-type]
        for (name,), seen in rows.group_by("condition")
    }
    assert widths["2 x size"] == pytest.approx(2 * widths[OWN], rel=0.15)
    assert widths["1.5 x distance"] < widths[OWN]


def test_a_splat_goes_through_a_condition_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many cameras look at it: a format is a file that is written and read."""
    made = list[str]()

    def counting(scene: GaussianScene) -> GaussianScene:
        made.append("once")
        return scene

    monkeypatch.setitem(FORMS, ".splat", counting)
    rows = rows_under(person(), ".splat")
    assert len(rows.filter(condition=".splat")) == 2 * len(CAMERAS)
    assert len(made) == 2


def test_a_vote_has_the_medians_of_three_views() -> None:
    rows = rows_under(person(), VOTE)
    assert set(rows["condition"]) == {OWN, "5 degrees", "-5 degrees"}
    three = rows.filter(splat=ATTACKED, view=1)["target_score"]
    (vote,) = voted(rows).filter(splat=ATTACKED, view=1)["target_score"]
    assert vote == three.median()
    counted = survival_figures(rows, 0.5)
    assert counted.rate("found_clean", detector="fake_colour", condition=VOTE).total


def test_one_camera_in_three_loses_the_vote() -> None:
    rows = rows_under(SCENE, VOTE)
    own = (pl.col("condition") == OWN) & (pl.col("splat") == ATTACKED)
    one_view = rows.with_columns(
        target_score=pl.when(own).then(1.0).otherwise("target_score")
    )
    assert voted(one_view).filter(splat=ATTACKED)["target_score"].max() == 0.0


def test_standard_stands_for_conditions_that_there_are() -> None:
    every = named_conditions(["standard", "JPEG 75"])
    assert {*every, VOTE} == set(STANDARD)
    assert len(every) == len(STANDARD) - 1
    for name in every:
        check_condition(name, None)


def test_a_median_of_neighbours_takes_away_what_jumps_and_keeps_what_is_smooth() -> (
    None
):
    place = torch.stack(
        torch.meshgrid(*[torch.arange(4.0)] * 3, indexing="ij"), dim=-1
    ).reshape(-1, 3)
    count = len(place)
    ramp = colour_to_dc(place / 4)[:, None]
    turns = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1)
    scene = GaussianScene(
        place, torch.ones(count, 3), turns, torch.full((count,), 0.5), ramp
    )
    smooth = median_of_neighbours(scene, 8)
    assert float((smooth.sh - ramp).abs().mean()) < 0.35 * float(ramp.std())
    spike = ramp.clone()
    spike[21] += 3.0
    repaired = median_of_neighbours(scene.replace(sh=spike), 8)
    assert float((repaired.sh - smooth.sh).abs().max()) < 0.5 * 3.0
    with pytest.raises(InvalidValueError):
        median_of_neighbours(scene, count)


def test_an_attacker_can_differentiate_a_median() -> None:
    sh = SCENE.sh.clone().requires_grad_()
    smooth = median_of_neighbours(SCENE.replace(sh=sh), 4)
    (gradient,) = torch.autograd.grad(smooth.sh.sum(), sh)
    assert bool(gradient.isfinite().all())
    assert float(gradient[:, 0].sum()) == pytest.approx(3 * len(SCENE))
