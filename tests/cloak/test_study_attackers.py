"""What an attacker of a study may do besides poison: train surrogates of his own, or change the finished file."""

import filecmp
import json
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
import torch

from attacks.cloak.appearances import grown
from attacks.cloak.config import LayersConfig, StudyConfig, SurrogateConfig
from attacks.cloak.layers import Layering, layer_object, object_rows
from attacks.cloak.setup import SET, Setup
from attacks.cloak.steps import StudySteps
from attacks.observe.rows import read_rows
from attacks.poisons.base import MANIFEST
from mi_splat.cameras import View
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.scene import GaussianScene
from tests.cloak.tiny_study import STUDY, done
from tests.ledger.drive import Ledger

pytestmark = pytest.mark.slow


LAYERS = LayersConfig(attacks=("overhead",), iterations=40)


def splats(finished: Path, study: StudyConfig) -> list[GaussianScene]:
    """The clean and the cloaked splat; jobs are shared with the finished study."""
    ledger, steps = Ledger(finished / "stages"), StudySteps(study=study)
    return [load_splat(ledger.do(steps.splat(name, 0)).folder / "splat.ply") for name in ("clean", "cloaked")]


def made(finished: Path, layers: LayersConfig, clean: GaussianScene) -> tuple[Layering, int]:
    """The layers before their training, and the number of poisoned pictures."""
    steps = StudySteps(study=STUDY)
    folder = Ledger(finished / "stages").do(steps.poisoned(0)).folder / SET
    views = load_dataset(folder, split="train", background=STUDY.scene.background)
    return layer_object(steps.setup, layers, clean, views, render=steps.renderer()), len(views)


def test_layers_are_made_of_the_clean_splat_s_object_and_hide_it(finished: Path) -> None:
    """The pictures and the clean splat are those of the study without layers: its jobs are shared."""
    study = replace(STUDY, name="layers", layers=LAYERS)
    out = finished.with_name("layers")
    _, kinds = done(out, study=study, store=finished / "stages")
    assert not {"pictures", "trained", "appearances"} & set(kinds)
    before, after = splats(finished, study)
    assert len(before) < len(after) <= 2 * len(before)
    other = ~object_rows(LAYERS, before, Setup.of(study).target)
    for name in ("means", "sh"):
        assert torch.equal(getattr(before, name)[other], getattr(after, name)[: len(before)][other])
    for layers in (LAYERS, replace(LAYERS, surroundings=True)):
        layering, count = made(finished, layers, before)
        assert bool(layering.trained.all()) == layers.surroundings
        assert len(layering.views) < count  # those from where the look changes are left out
    rows = read_rows(out / "rows.csv.xz").filter(pl.col("elevation") >= 50)
    control, hidden = (rows.filter(splat=splat)["original_score"].to_list() for splat in ("clean", "attacked"))
    assert sum(hidden) < 0.5 * sum(control)


def test_the_geometry_of_layers_is_trained_and_made_finer(finished: Path) -> None:
    layers = replace(LAYERS, geometry=True, iterations=300)
    clean, cloaked = splats(finished, replace(STUDY, layers=layers))
    layering, _ = made(finished, layers, clean)
    assert layering.geometry
    assert bool(layering.trained.all())
    assert len(cloaked) > len(layering.scene)
    assert torch.dist(cloaked.means[: len(clean)], clean.means) > 0
    with pytest.raises(InvalidValueError, match=r"layers.max_gaussians: expected room for the layers, got"):
        made(finished, replace(layers, max_gaussians=len(clean)), clean)


def test_a_surrogate_of_the_attacker_s_own_corrects_the_poison(finished: Path) -> None:
    """It overdoes what the surrogate lacks; pictures that were not poisoned stay as they are."""
    study = replace(STUDY, surrogate=SurrogateConfig(rounds=2, iterations=30))
    ledger = Ledger(finished / "stages")
    plain, corrected = (ledger.do(StudySteps(study=one).poisoned(0)) for one in (STUDY, study))
    manifest = json.loads((corrected.folder / MANIFEST).read_text())
    assert all(change["appearance"].count("corrected by 1 times") == 2 for change in manifest["changes"])
    changed = {change["index"] for change in manifest["changes"]}
    sets = [load_dataset(one.folder / SET) for one in (plain, corrected)]
    for index, (one, other) in enumerate(zip(*(views.paths for views in sets), strict=True)):
        assert filecmp.cmp(one, other, shallow=False) == (index not in changed)


def test_a_reach_leaves_the_shadow_of_what_is_removed() -> None:
    setup = Setup.of(STUDY)
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
