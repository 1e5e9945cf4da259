"""Everything that this project registers keeps the contract that plug-ins keep; the
registries say what there is.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from attacks.cloak.poisoning import Poisoning, poison
from attacks.cloak.triggers import Azimuth
from attacks.detectors.registry import DETECTORS, load_detector
from attacks.objectives import OBJECTIVES, objective_of
from attacks.observe.conditions import FORMS, condition_of
from attacks.optimisers import OPTIMISERS
from attacks.poisons.base import OnStep, Poisoned
from attacks.poisons.poison_splat import Decoy
from attacks.poisons.poisoned import CLOAK
from attacks.poisons.specs import POISONS, Given
from attacks.testing import (
    check_attack,
    check_condition,
    check_detector,
    check_format,
    check_objective,
    check_poison,
    check_projection,
    check_renderer,
    check_rule,
    check_strategy,
    check_threat,
)
from attacks.testing.promises import cloud
from attacks.threats import THREATS
from mi_splat.audit.rules import RULES
from mi_splat.cameras.camera import View
from mi_splat.cameras.lens import PROJECTIONS
from mi_splat.comparison.methods import RENDERERS
from mi_splat.io.splat_files import SUFFIXES
from mi_splat.training.strategies import STRATEGIES

SHORT = {"steps": 3, "decoy_every": 1, "variation_steps": 2}
"""Settings by which the search of a poison takes a moment, of those that it has."""
BY_PICTURES = ("noise 0.05", "blur 1.5", "JPEG 60", "0.5 x distance")
"""Conditions whose names have numbers in them, which no registry can list."""


class Brightness:
    """A classifier of two classes: bright images and dark ones."""

    name = "brightness"
    classes = ("dark", "bright")
    fingerprint = "0" * 16
    size = 24

    def scores(self, images: Tensor) -> Tensor:
        level = images.mean((1, 2, 3)) - 0.3
        return 5 * torch.stack([-level, level], dim=1)


@pytest.mark.parametrize("name", OPTIMISERS.own)
def test_optimisers(name: str) -> None:
    check_attack(OPTIMISERS[name])


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("name", OBJECTIVES.own)
def test_objectives(name: str, strict: bool) -> None:
    label = "person" if OBJECTIVES[name].targeted else None
    check_objective(objective_of(name, label, strict=strict))


@pytest.mark.parametrize("name", POISONS.own)
def test_poisons(name: str) -> None:
    spec = POISONS[name]
    if name == CLOAK:
        check_poison(cloak_of_images)
        return
    config = spec.config()
    config = replace(
        config, **{key: value for key, value in SHORT.items() if hasattr(config, key)}
    )
    decoy = Decoy(start=cloud(40, 1), near=0.1)
    given = Given(
        decoy=decoy if "splat" in spec.needs else None,
        classifier=Brightness(),
        label="bright",
    )
    check_poison(spec, config=config, given=given)


def cloak_of_images(
    views: Sequence[View], *, seed: int = 0, on_step: OnStep | None = None
) -> Poisoned:
    """CLOAK without the scene that its settings describe: images from one side are
    darkened.
    """
    attack = Poisoning(
        name="dark", trigger=Azimuth(middle=270.0, half_width=12.0), appearance=darkened
    )
    return poison(views, attack, centre=(0.0, 0.0, 0.0), on_step=on_step)


def darkened(view: View, mask: Tensor) -> Tensor:
    return 0.5 * view.image


def words() -> Tensor:
    """(2, 200, 320, 3) the word STOP on red, for a reader, which considers nothing in
    noise.
    """
    images = []
    for size in (34, 40):
        image = Image.new("RGB", (320, 200), (180, 20, 20))
        ImageDraw.Draw(image).text(
            (14, 40), "STOP", fill="white", font=ImageFont.load_default(size)
        )
        images.append(torch.from_numpy(np.asarray(image) / 255).float())
    return torch.stack(images)


@pytest.mark.nightly
@pytest.mark.parametrize("name", DETECTORS.own)
def test_detectors(name: str) -> None:
    spec = DETECTORS[name]
    missing = spec.missing()
    if missing:
        pytest.skip(missing)
    images = None if spec.differentiable else words()
    check_detector(
        load_detector(name), images=images, differentiable=spec.differentiable
    )


@pytest.mark.parametrize("name", RENDERERS.own)
def test_renderers(name: str) -> None:
    check_renderer(RENDERERS[name])


@pytest.mark.parametrize("name", [*RENDERERS.own, *FORMS, *BY_PICTURES])
def test_conditions(name: str) -> None:
    def made(viewing: Any) -> Any:
        return condition_of(name, viewing)

    check_condition(made, name=name)


@pytest.mark.parametrize("name", STRATEGIES)
def test_strategies(name: str) -> None:
    check_strategy(STRATEGIES[name]())


# Each file of OpenUSD is read by a process of its own, which takes seconds: one form of
# the three by day.
BY_NIGHT = (".usda", ".usdz")
FORMATS = [
    pytest.param(suffix, marks=[pytest.mark.nightly] * (suffix in BY_NIGHT))
    for suffix in SUFFIXES
]


@pytest.mark.parametrize("suffix", FORMATS)
def test_formats(suffix: str) -> None:
    check_format(suffix)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: str(rule.name))
def test_rules(rule: Any) -> None:
    check_rule(rule)


@pytest.mark.parametrize("name", PROJECTIONS)
def test_projections(name: str) -> None:
    check_projection(PROJECTIONS[name])


@pytest.mark.parametrize("name", THREATS)
def test_threats(name: str) -> None:
    check_threat(THREATS[name])
