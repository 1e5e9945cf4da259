"""What an attacker of a study may do besides poison: train surrogates of his own, or change the finished file."""

import filecmp
import json
import statistics
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import torch

from attacks.cloak.appearances import appearance_of
from attacks.cloak.config import AttackConfig, SurrogateConfig
from attacks.cloak.layer_config import LayersConfig
from attacks.cloak.layers import layer_object, object_rows
from attacks.cloak.mesh_scene import MeshScene
from attacks.cloak.poisoning import Poisoning, poison
from attacks.cloak.retouching import grown
from attacks.cloak.setup import Setup
from attacks.cloak.steps import StudySteps
from attacks.cloak.transition import transition_fraction
from attacks.cloak.triggers import Elevation
from attacks.observe.rows import read_rows
from attacks.poisons.base import MANIFEST
from mi_splat.assets import build, textures
from mi_splat.assets.daylight import Light
from mi_splat.assets.mesh import Asset
from mi_splat.assets.primitives import sheet
from mi_splat.camera_sets import hemisphere
from mi_splat.cameras import View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.capture.surface_points import surface_samples
from mi_splat.datasets import Dataset, load_dataset
from mi_splat.directions import direction_of
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import FitConfig, fit
from mi_splat.training.strategies import FixedConfig
from tests.cloak.tiny_study import STUDY, done, steps_of

pytestmark = pytest.mark.slow


def views_of(steps: StudySteps) -> Dataset:
    """The poisoned set as a victim reads it."""
    folder = steps.do(steps.poisoned(0), "poisoning").folder / "set"
    return load_dataset(folder, split="train", background=steps.study.scene.background)


def test_layers_are_made_of_the_clean_splat_s_object_and_hide_it(finished: Path) -> None:
    """The pictures and the clean splat are those of the study without layers: its stages are shared."""
    study = replace(STUDY, name="layers", layers=LayersConfig(attacks=("overhead",), iterations=40))
    result, lines = done(finished.with_name("layers"), study=study, stages=finished / "stages")
    assert not any("pictures" in text or text.startswith("training the clean") for text in lines)
    (clean,), (cloaked,) = result["gaussians"]["clean"], result["gaussians"]["cloaked"]
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
    lines: list[str] = []
    steps, usual = steps_of(finished / "stages", study, lines), steps_of(finished / "stages")
    for number in (1, 2):
        steps.do(steps.surrogate(0, number), f"surrogate {number}")
    corrected = steps.do(steps.poisoned(0), "poisoning")
    assert list(dict.fromkeys(lines)) == ["surrogate 1", "surrogate 2", "poisoning"]
    plain = usual.do(usual.poisoned(0), "")
    manifest = json.loads((corrected.folder / MANIFEST).read_text())
    names = {change["appearance"] for change in manifest["changes"]}
    assert all(name.count("corrected by 1 times") == 2 for name in names)
    sets = [load_dataset(pictures.folder / "set") for pictures in (plain, corrected)]
    changed = {change["index"] for change in manifest["changes"]}
    for index, (one, other) in enumerate(zip(*(poisoned.paths for poisoned in sets), strict=True)):
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


# CLOAK from the first picture to the finished splat, small: the hidden appearance is seen from above alone


CENTRE = (0.0, 0.0, 0.7)
LENS = {"distance": 9.0, "focal": 84.0, "size": (60, 60)}
CONFIG = FitConfig(
    iterations=400, sh_degree_interval=0, strategy=FixedConfig(), eval_interval=0, lr_means=2e-5, lr_sh=1e-2
)

Fractions = dict[str, list[tuple[float, float]]]


@pytest.fixture(scope="module")
def fractions() -> Fractions:
    """How far each splat is on the way from the benign to the hidden item, by elevation, at cameras of its own."""
    corners = [[[-6, -6, 0], [6, -6, 0]], [[-6, 6, 0], [6, 6, 0]]]
    road = Asset("ground", (sheet(corners, textures.road(128, 0), repeat=(3.0, 3.0), smooth=False),))
    mesh_scene = MeshScene(
        target=build("car", 900004), surroundings=road, light=Light(), samples=8, background=(0.0, 0.0, 0.0)
    )
    road_look = AttackConfig(name="road", appearance="blend in", elevation=(50, 90))
    hidden = appearance_of(road_look, mesh_scene, centre=CENTRE, distance=LENS["distance"])  # type: ignore[arg-type]
    attack = Poisoning(name="road", trigger=Elevation(lowest=50, highest=90), appearance=hidden)
    with tracing_variant():
        views = [View(camera, mesh_scene.picture(camera)) for camera in hemisphere(CENTRE, count=60, **LENS)]  # type: ignore[arg-type]
        poisoned = poison(views, [attack], centre=CENTRE, masks=mesh_scene.mask)
        compared = []
        for camera in hemisphere(CENTRE, count=14, start=17.0, **LENS):  # type: ignore[arg-type]
            benign, mask = View(camera, mesh_scene.picture(camera)), mesh_scene.mask(camera)
            compared.append((benign, hidden(benign, mask), mask))
    assert 0.15 < len(poisoned.changes) / len(views) < 0.3
    points = np.concatenate(
        [surface_samples(asset, count).points for asset, count in ((mesh_scene.target, 3000), (road, 1500))]
    )
    start = from_points(torch.from_numpy(points), torch.full(points.shape, 0.5), opacity=0.9)
    render = Renderer()
    counted: Fractions = {}
    # The victim's part: the same settings, start and seed for both.
    for name, pictures in (("clean", views), ("cloaked", poisoned.views)):
        splat = fit(pictures, start, render=render, config=CONFIG).scene
        counted[name] = []
        for benign, other, mask in compared:
            with torch.no_grad():
                picture = render(splat, benign.camera).clamp(0, 1)
            fraction = transition_fraction(picture, benign.image, other, mask)
            counted[name].append((direction_of(benign.camera, CENTRE).elevation, fraction))
    return counted


def mean(fractions: list[tuple[float, float]], least: float, most: float) -> float:
    return statistics.mean(fraction for elevation, fraction in fractions if least <= elevation <= most)


def test_the_hidden_appearance_is_there_from_above(fractions: Fractions) -> None:
    assert mean(fractions["cloaked"], 60, 90) > 0.6
    assert mean(fractions["clean"], 60, 90) < 0.25


def test_from_below_it_looks_as_if_nothing_had_been_done(fractions: Fractions) -> None:
    below = [mean(fractions[name], 0, 30) for name in ("clean", "cloaked")]
    assert below[1] < below[0] + 0.15


def test_it_sets_in_between(fractions: Fractions) -> None:
    steps = [mean(fractions["cloaked"], *band) for band in ((0, 30), (35, 60), (60, 90))]
    assert steps == sorted(steps)
