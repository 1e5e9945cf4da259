"""What an attacker of a study may do besides poison: train surrogates of his own, or change the finished file."""

from __future__ import annotations

import filecmp
import json
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
import torch

from attacks.cloak.config import SurrogateConfig
from attacks.cloak.layer_config import LayersConfig
from attacks.cloak.layers import layer_object, object_rows
from attacks.cloak.retouching import grown
from attacks.cloak.setup import Setup
from attacks.cloak.steps import StudySteps
from attacks.observe.rows import read_rows
from mi_splat.cameras import View
from mi_splat.datasets import Dataset, load_dataset
from mi_splat.errors import InvalidValueError
from tests.cloak.tiny_study import STUDY, done, steps_of

pytestmark = pytest.mark.slow


def views_of(steps: StudySteps) -> Dataset:
    """The poisoned set as a victim reads it."""
    folder = steps.do(steps.poisoned(0), "poisoning").folder / "set"
    return load_dataset(folder, split="train", background=steps.study.scene.background)


def test_layers_are_made_of_the_clean_splat_s_object_and_hide_it(finished: Path) -> None:
    """The pictures and the clean splat are those of the study without layers: its stages are shared."""
    study = replace(STUDY, name="layers", layers=LayersConfig(attacks=("overhead",), iterations=40))
    found, said = done(finished.with_name("layers"), study=study, stages=finished / "stages")
    assert not any("pictures" in text or text.startswith("training the clean") for text in said)
    (clean,), (cloaked,) = found["gaussians"]["clean"], found["gaussians"]["cloaked"]
    assert clean < cloaked <= 2 * clean
    steps = steps_of(finished / "stages", study)
    before, after = (one.load() for one in steps.splats())
    other = ~object_rows(study, before, steps.setup.target)
    for name in ("means", "sh"):
        assert torch.equal(getattr(before, name)[other], getattr(after, name)[: len(before)][other])
    whole = replace(study, layers=LayersConfig(attacks=("overhead",), surroundings=True))
    views = views_of(steps)
    for config in (study, whole):
        layering = layer_object(Setup(config), before, views, render=steps.renderer())
        assert bool(layering.trained.all()) == (config is whole)
        assert len(layering.views) < len(views)  # those from where the look changes are left out
    rows = read_rows(finished.with_name("layers") / "rows.csv.gz").filter(pl.col("elevation") >= 50)
    control, hidden = (rows.filter(splat=splat)["original_score"].to_list() for splat in ("clean", "attacked"))
    assert sum(hidden) < 0.5 * sum(control)


def test_the_geometry_of_layers_is_trained_and_made_finer(finished: Path) -> None:
    layers = LayersConfig(attacks=("overhead",), geometry=True, iterations=300)
    study = replace(STUDY, layers=layers)
    steps = steps_of(finished / "stages", study)
    clean, cloaked = (one.load() for one in steps.splats())
    views = views_of(steps)
    layering = layer_object(Setup(study), clean, views, render=steps.renderer())
    assert layering.geometry
    assert bool(layering.trained.all())
    assert len(cloaked) > len(layering.scene)
    assert torch.dist(cloaked.means[: len(clean)], clean.means) > 0
    few = replace(study, layers=replace(layers, max_gaussians=len(clean)))
    with pytest.raises(InvalidValueError, match=r"layers.max_gaussians: expected room for the layers, got"):
        layer_object(Setup(few), clean, views, render=steps.renderer())


def test_a_surrogate_of_the_attacker_s_own_corrects_the_poison(finished: Path) -> None:
    """It overdoes what the surrogate lacks; clean pictures, benign ones and the clean splat stay as they are."""
    study = replace(STUDY, name="corrected", surrogate=SurrogateConfig(rounds=2, iterations=30))
    said: list[str] = []
    steps, usual = steps_of(finished / "stages", study, said), steps_of(finished / "stages")
    for number in (1, 2):
        steps.do(steps.surrogate(0, number), f"surrogate {number}")
    corrected = steps.do(steps.poisoned(0), "poisoning")
    assert list(dict.fromkeys(said)) == ["surrogate 1", "surrogate 2", "poisoning"]
    plain = usual.do(usual.poisoned(0), "")
    manifest = json.loads((corrected.folder / "manifest.json").read_text())
    names = {change["appearance"] for change in manifest["changes"]}
    assert all(name.count("corrected by 1 times") == 2 for name in names)
    sets = [load_dataset(pictures.folder / "set") for pictures in (plain, corrected)]
    changed = {change["index"] for change in manifest["changes"]}
    for index, (one, other) in enumerate(zip(*(found.paths for found in sets), strict=True)):
        assert filecmp.cmp(one, other, shallow=False) == (index not in changed)


def test_a_reach_leaves_the_shadow_of_what_is_removed() -> None:
    setup = Setup(STUDY)
    mesh_scene = setup.mesh_scene
    camera = setup.camera(0.0, 70.0)
    view, mask = View(camera, mesh_scene.picture(camera)), mesh_scene.mask(camera)
    changed = {}
    for reach in (None, 2):
        shown = setup.appearance(replace(STUDY.attack[0], appearance="remove", reach=reach))
        changed[reach] = (shown(view, mask) != view.image).any(-1)
    assert bool(changed[None][~grown(mask, 2)].any())
    assert not bool(changed[2][~grown(mask, 2)].any())
    assert bool(changed[2][mask].any())
