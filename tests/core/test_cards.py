"""What notebooks show: a picture, one line of facts, and nothing that a hostile name could do."""

import dataclasses
import html
import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import torch

from attacks import DaggerConfig, attack, judge, relabel
from attacks.cloak.poisoning import Poisoning, poison
from attacks.cloak.triggers import Elevation
from mi_splat import cards
from mi_splat.camera_sets import hemisphere, orbit
from mi_splat.cameras import View
from mi_splat.cards import HEIGHT, Pictures, image
from mi_splat.comparison.compare import CompareConfig, compare
from mi_splat.comparison.methods import Method
from mi_splat.rendering import RenderSettings
from mi_splat.scene_files import SplatScene, read_scene
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import fit
from mi_splat.training.strategies import FixedConfig
from tests.fakes import ColourDetector, blobs, camera, toy_scene
from tests.gaussians import random_scene

HOSTILE = '<img src=x onerror="alert(1)">\x1b[31m\n"</div><script>'


def pictures(shown: str) -> list[str]:
    return re.findall(r'src="(data:image/png;base64,[^"]+)"', shown)


def values() -> dict[str, tuple[Any, int]]:
    """A value of each kind, and how many PNG pictures its card has."""
    scene, cars = toy_scene()[0], torch.arange(1)
    render = blobs
    cameras = hemisphere((0, 0, 0), count=5, distance=4, focal=40, size=(32, 24))
    views = [View(one, torch.rand(24, 32, 3)) for one in cameras]
    hidden = Poisoning(name="up", trigger=Elevation(lowest=30), appearance=lambda view, mask: view.image * 0.5)
    poisoned = poison(views, [hidden], centre=(0.0, 0.0, 0.0))
    methods = {name: Method(render=render) for name in ("one", "two")}
    compared = compare(scene, {"front": camera()}, methods, config=CompareConfig(gradients=False, rounds=0))
    config = DaggerConfig(steps=2, noise_draws=1, eps=(3.0,))
    result = attack(scene, cars, camera(), ColourDetector(), relabel("person"), render=render, config=config)
    judged = judge({"clean": scene, "attacked": scene}, cars, camera(), ColourDetector(), render=render)
    return {
        "GaussianScene": (scene, 1),
        "Camera": (cameras[0], 0),
        "CameraList": (cameras, 0),
        "View": (views[0], 1),
        "PoisonedViews": (poisoned.views, 3),
        "Poisoned": (poisoned, 4),
        "Fit": (fit(views, scene, render=render, config=FitConfig(iterations=1, strategy=FixedConfig())), 1),
        "Comparison": (compared, 2),
        "Result": (result, 1),
        "Judged": (judged, 2),
    }


@pytest.fixture(scope="module")
def shown(variant: str) -> dict[str, tuple[Any, int]]:
    return values()


KINDS = ("GaussianScene", "Camera", "CameraList", "View", "PoisonedViews", "Poisoned", "Fit", "Comparison", "Result")


@pytest.mark.parametrize("kind", [*KINDS, "Judged"])
def test_a_card_has_pictures_and_one_line_of_facts(shown: dict[str, tuple[Any, int]], kind: str) -> None:
    value, count = shown[kind]
    facts, made = repr(value), value._repr_html_()
    assert facts.startswith(f"{kind}(")
    assert "\n" not in facts
    assert len(facts) < 300
    assert html.escape(facts) in made
    assert "no picture" not in made
    assert len(pictures(made)) == count
    assert len(made) < 400_000


def test_a_scene_file_shows_its_cameras(variant: str) -> None:
    scene = read_scene(Path(__file__).parents[2] / "scenes" / "stop_sign.xml")
    made = scene._repr_html_()
    assert len(pictures(made)) == min(4, len(scene.cameras))
    assert all(name in made for name in list(scene.cameras)[:4])
    widths = [int(width) for width in re.findall(r'width="(\d+)" class', made)]
    assert max(widths) <= 2 * HEIGHT


def test_names_of_strangers_are_text(variant: str) -> None:
    scene = random_scene(3, 0)
    cameras = {HOSTILE: orbit((0, 0, 0), count=1, elevation=10, distance=5, focal=20, size=(16, 16))[0]}
    value = SplatScene(scene=scene, objects={HOSTILE: slice(0, 3)}, cameras=cameras, settings=RenderSettings())
    for made in (value._repr_html_(), image(np.zeros((2, 2, 3)), HOSTILE)):
        assert "<script" not in made
        assert "<img src=x" not in made
        assert "\x1b" not in made
        assert "&lt;img src=x" in made
    assert "\n" not in repr(value)
    assert "<script" not in Pictures({HOSTILE: np.zeros((2, 2, 3))})._repr_html_()


def test_a_card_never_fails(shown: dict[str, tuple[Any, int]], monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError(HOSTILE)

    monkeypatch.setattr(cards, "Renderer", broken)
    made = random_scene(3)._repr_html_()
    assert pictures(made) == []
    assert "GaussianScene(3 Gaussians" in made
    assert "no picture: RuntimeError" in made
    empty = dataclasses.replace(shown["Comparison"][0], pictures={})
    assert pictures(cards.html(empty)) == []


def test_looking_changes_no_variant_and_no_gradient(variant: str) -> None:
    mi.set_variant("scalar_rgb")
    scene = random_scene(3)
    scene.means.requires_grad_(True)
    assert "<img" in scene._repr_html_()
    assert mi.variant() == "scalar_rgb"
    assert scene.means.requires_grad
    assert scene.means.grad is None
    mi.set_variant(variant)
