"""The paper's six pairs on the shipped scenes and the shipped detector: the attack works, random noise does not.

Five of the six reach the 0.7 that counts as success. The sign as a bird gets to 0.65: a quarter of its green is clamped
at 0, where SH has no gradient, and the ball is used up before it is through (the README has the experiment).
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.study import PAIRS
from attacks.detectors import load_detector
from attacks.detectors.base import Detector
from attacks.objectives import hide, relabel
from mi_splat.rendering import Renderer
from mi_splat.scene_files import SplatScene, read_scene

SCENES = Path(__file__).parents[2] / "scenes"


@pytest.fixture(scope="module")
def detector() -> Detector:
    return load_detector("fasterrcnn_small")


@pytest.fixture(scope="module")
def scenes() -> dict[str, SplatScene]:
    return {name: read_scene(SCENES / f"{name}.xml") for name, _, _ in PAIRS}


OUT_OF_REACH = {"bird": 0.5}


@pytest.mark.parametrize(("scene", "part", "target"), PAIRS)
def test_the_paper_s_pairs(
    scene: str, part: str, target: str, scenes: dict[str, SplatScene], detector: Detector
) -> None:
    loaded = scenes[scene]
    camera = next(iter(loaded.cameras.values()))
    config = DaggerConfig(noise_draws=1)
    rows, render = loaded.objects[part], Renderer(loaded.settings)
    found = attack(loaded.scene, rows, [camera], detector, relabel(target), render=render, config=config)
    assert found.target_confidence is not None
    least = OUT_OF_REACH.get(target, 0.7)
    assert found.target_confidence >= least, f"{target} at {found.target_confidence:.0%}"
    assert found.success == (found.target_confidence >= 0.7)
    assert found.used["sh"] <= 5.0
    assert found.image.psnr is not None
    assert found.image.psnr > 25
    assert found.noise.successes == 0
    others = torch.ones(len(loaded.scene), dtype=torch.bool)
    others[rows] = False
    clean = loaded.scene.with_degree(3)
    for after, before in zip(found.scene.tensors(), clean.tensors(), strict=True):
        assert torch.equal(after[others], before[others])


@pytest.mark.parametrize(("scene", "part", "left"), [("car_street", "car", 0.3), ("stop_sign", "stop_sign", 0.6)])
def test_the_object_is_found_before_and_fades_after(
    scene: str, part: str, left: float, scenes: dict[str, SplatScene], detector: Detector
) -> None:
    """The car is hidden (less than 0.3 is left); of the sign 0.45 of 1.00 is left at this radius."""
    loaded = scenes[scene]
    camera = next(iter(loaded.cameras.values()))
    config = DaggerConfig(noise_draws=0)
    render = Renderer(loaded.settings)
    found = attack(loaded.scene, loaded.objects[part], [camera], detector, hide(), render=render, config=config)
    (view,) = found.views
    assert view.before.target.original == part.replace("_", " ")
    assert view.confidence(view.before.target.original, attacked=False) >= 0.5
    assert 1 - found.score <= left
