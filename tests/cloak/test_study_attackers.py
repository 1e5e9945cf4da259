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
from attacks.cloak.config import AttackConfig, StudyConfig, SurrogateConfig
from attacks.cloak.kinds.parts import SET
from attacks.cloak.layer_config import LayersConfig
from attacks.cloak.layers import Layering, layer_object, object_rows
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
from mi_splat.datasets import load_dataset
from mi_splat.directions import direction_of
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.ledger import Ledger
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import FitConfig, fit
from mi_splat.training.strategies import FixedConfig
from tests.cloak.tiny_study import STUDY, done

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
