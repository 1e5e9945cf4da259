"""The paper's six pairs on the shipped scenes and the shipped detector: the attack works, random noise does not."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from attacks.dagger import DaggerConfig, attack
from attacks.detectors import load_detector
from attacks.detectors.base import Detector
from attacks.objectives import hide, relabel
from attacks.studies import PAIRS
from mi_splat.rendering import Renderer, Stage, read_stage

SCENES = Path(__file__).parent.parent / "scenes"


@pytest.fixture(scope="module")
def detector() -> Detector:
    return load_detector("fasterrcnn_small")


@pytest.fixture(scope="module")
def stages() -> dict[str, Stage]:
    return {name: read_stage(SCENES / f"{name}.xml") for name, _, _ in PAIRS}


@pytest.mark.parametrize(("scene", "part", "target"), PAIRS)
def test_the_paper_s_pairs(scene: str, part: str, target: str, stages: dict[str, Stage], detector: Detector) -> None:
    stage = stages[scene]
    camera = next(iter(stage.cameras.values()))
    config = DaggerConfig(noise_draws=1)
    rows, render = stage.parts[part], Renderer(stage.settings)
    found = attack(stage.scene, rows, [camera], detector, relabel(target), render=render, config=config)
    assert found.target_confidence is not None
    assert found.success, f"{target} at {found.target_confidence:.0%}"
    assert found.target_confidence >= 0.7
    assert found.used["sh"] <= 5.0
    assert found.image.psnr is not None
    assert found.image.psnr > 25
    assert found.noise.successes == 0
    others = torch.ones(len(stage.scene), dtype=torch.bool)
    others[rows] = False
    clean = stage.scene.with_degree(3)
    for after, before in zip(found.scene.tensors(), clean.tensors(), strict=True):
        assert torch.equal(after[others], before[others])


@pytest.mark.parametrize(("scene", "part"), dict.fromkeys(pair[:2] for pair in PAIRS))
def test_the_object_is_found_before_and_hidden_after(
    scene: str, part: str, stages: dict[str, Stage], detector: Detector
) -> None:
    stage = stages[scene]
    camera = next(iter(stage.cameras.values()))
    config = DaggerConfig(noise_draws=0)
    render = Renderer(stage.settings)
    found = attack(stage.scene, stage.parts[part], [camera], detector, hide(), render=render, config=config)
    (view,) = found.views
    assert view.shot.target.original == part.replace("_", " ")
    assert view.confidence(view.shot.target.original, attacked=False) >= 0.5
    assert found.success
