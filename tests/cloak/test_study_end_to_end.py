"""CLOAK from the first picture to the finished splat, small: the hidden appearance is seen from above alone."""

from __future__ import annotations

import statistics

import numpy as np
import pytest
import torch

from attacks.cloak.appearances import appearance_of
from attacks.cloak.config import AttackConfig
from attacks.cloak.mesh_scene import MeshScene
from attacks.cloak.poisoning import Poisoning, poison
from attacks.cloak.transition import transition_fraction
from attacks.cloak.triggers import Elevation
from mi_splat.assets import build, textures
from mi_splat.assets.daylight import Light
from mi_splat.assets.mesh import Asset
from mi_splat.assets.primitives import sheet
from mi_splat.camera_sets import hemisphere
from mi_splat.cameras import View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.capture.surface_sampling import surface_samples
from mi_splat.directions import direction_of
from mi_splat.rendering import Renderer
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import FitConfig, fit
from mi_splat.training.strategies import FixedConfig

pytestmark = pytest.mark.slow

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
    found: Fractions = {}
    # The victim's part: the same settings, start and seed for both.
    for name, pictures in (("clean", views), ("cloaked", poisoned.views)):
        splat = fit(pictures, start, render=render, config=CONFIG).scene
        found[name] = []
        for benign, other, mask in compared:
            with torch.no_grad():
                picture = render(splat, benign.camera).clamp(0, 1)
            fraction = transition_fraction(picture, benign.image, other, mask)
            found[name].append((direction_of(benign.camera, CENTRE).elevation, fraction))
    return found


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
