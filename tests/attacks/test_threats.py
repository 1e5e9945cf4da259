"""Threats: parameters of an attack that are no attribute of the Gaussians."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from attacks import cli
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives.suppression import hide
from attacks.threats import THREATS, Threat
from attacks.threats.rigid import apply_turn
from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError
from mi_splat.maths.rotation import normalise
from mi_splat.scene import GaussianScene, Similarity
from tests.fakes import ColourDetector, blobs, camera, toy_scene
from tests.gaussians import varied_scene

SCENE = varied_scene(30, degree=2, seed=4)
ROWS = slice(5, 25)


def doubled(subset: GaussianSubset) -> dict[str, Tensor]:
    return {name: value.double() for name, value in subset.clean.items()}


@pytest.mark.parametrize("name", THREATS)
def test_the_clean_value_changes_nothing(name: str) -> None:
    subset = GaussianSubset.of(SCENE, ROWS)
    start = subset.parameters([name])
    assert subset.changed(subset.applied(start)) == 0


@pytest.mark.parametrize("name", THREATS)
def test_only_what_is_named_changes_and_only_of_the_object(name: str) -> None:
    subset = GaussianSubset.of(SCENE, ROWS)
    value = subset.parameters([name])[name]
    moved = subset.applied({name: value + 0.1})
    outside = torch.ones(len(SCENE), dtype=torch.bool)
    outside[ROWS] = False
    for attribute in ATTRIBUTES:
        before = getattr(SCENE, attribute)
        after = getattr(moved, attribute)
        assert torch.equal(before[outside], after[outside])
        is_same = torch.equal(before, after)
        assert is_same is (attribute not in THREATS[name].changes)


@pytest.mark.parametrize("name", THREATS)
@pytest.mark.parametrize("size", [0.0, 0.3])
def test_the_derivatives_are_those_of_finite_differences(
    name: str, size: float
) -> None:
    subset = GaussianSubset.of(SCENE, ROWS)
    clean = doubled(subset)
    threat = THREATS[name]
    generator = torch.Generator().manual_seed(2)
    start = threat.start(clean)
    noise = torch.randn(start.shape, generator=generator, dtype=torch.float64)
    weights = {
        attribute: torch.randn(
            clean[attribute].shape, generator=generator, dtype=torch.float64
        )
        for attribute in threat.changes
    }

    def total(value: Tensor) -> Tensor:
        changed = threat.apply(value, clean)
        assert changed.keys() == set(threat.changes)
        parts = [(changed[key] * weight).sum() for key, weight in weights.items()]
        return torch.stack(parts).sum()

    value = (start + size * noise).requires_grad_(True)
    assert torch.autograd.gradcheck(total, (value,), atol=1e-6)


def test_a_turn_is_that_of_the_whole_scene_about_its_centre() -> None:
    subset = GaussianSubset.of(SCENE, slice(None))
    angle = torch.tensor([0.0, 0.0, torch.pi / 2], dtype=torch.float64)
    turned = apply_turn(angle, doubled(subset))
    matrix = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    middle = SCENE.means.double().mean(0)
    centred = SCENE.replace(means=SCENE.means - middle.float())
    about = Similarity(rotation=matrix, translation=middle, scale=1.0)
    expected = centred.transform(about)
    torch.testing.assert_close(
        turned["means"].float(), expected.means, rtol=0, atol=1e-5
    )
    torch.testing.assert_close(turned["sh"].float(), expected.sh, rtol=0, atol=1e-5)
    ours = normalise(turned["rotations"])
    theirs = normalise(expected.rotations.double())
    assert float((ours * theirs).sum(1).abs().min()) > 1 - 1e-6


def test_an_attack_stays_within_its_radii_and_is_judged_beside_noise() -> None:
    scene, mask = toy_scene()
    config = DaggerConfig(
        attributes=("shift", "turn"),
        eps=(0.3, 0.2),
        norm="linf",
        steps=6,
        noise_draws=2,
        early_stop=False,
    )
    result = attack(
        scene, mask, camera(), ColourDetector(), hide(), render=blobs, config=config
    )
    assert result.used.keys() == {"shift", "turn"}
    assert 0 < result.used["shift"] <= 0.3
    assert 0 <= result.used["turn"] <= 0.2
    assert result.used_in_file == {}
    assert result.best.loss < result.trace[0].loss
    assert torch.equal(result.scene.scales, scene.scales)
    assert not torch.equal(result.scene.means, scene.means)
    kept = torch.ones(len(scene), dtype=torch.bool)
    kept[mask] = False
    assert torch.equal(result.scene.means[kept], scene.means[kept])


@pytest.mark.parametrize("optimiser", ["adam", "square", "random", "apgd", "cw"])
def test_every_optimiser_takes_them(optimiser: str) -> None:
    scene, mask = toy_scene()
    config = DaggerConfig(
        attributes=("sh", "lattice"),
        eps=(1.0, 0.1),
        norm="linf",
        steps=4,
        noise_draws=0,
        optimiser=optimiser,
    )
    result = attack(
        scene, mask, camera(), ColourDetector(), hide(), render=blobs, config=config
    )
    assert result.used["lattice"] <= 0.1


def test_the_command_takes_their_names() -> None:
    words = ["a.ply", "--attributes", "turn", "shift", "--eps", "0.2", "0.1"]
    config = cli.parse("dagger", words).config
    assert config.radius == {"turn": 0.2, "shift": 0.1}
    with pytest.raises(InvalidValueError, match="did you mean shift"):
        DaggerConfig(attributes=("shft",))
    with pytest.raises(InvalidValueError, match="noise or norm-noise"):
        DaggerConfig(attributes=("means", "shift"), controls=("smooth-noise",))


def test_one_of_another_package_is_one_value(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    swell = Threat(
        name="swell",
        about="the object's Gaussians grow",
        unit="log world units",
        changes=("scales",),
        start=lambda clean: clean["scales"].new_zeros(()),
        apply=lambda value, tensors: {"scales": tensors["scales"] + value},
    )
    monkeypatch.setitem(THREATS.own, "swell", swell)
    scene, mask = toy_scene()
    config = DaggerConfig(attributes=("swell",), eps=(0.5,), steps=3, noise_draws=1)
    result = attack(
        scene, mask, camera(), ColourDetector(), hide(), render=blobs, config=config
    )
    grown: GaussianScene = result.scene
    ratio = grown.scales[mask] / scene.scales[mask]
    torch.testing.assert_close(ratio, ratio[:1, :1].expand_as(ratio))
    assert dataclasses.asdict(result.config)["attributes"] == ("swell",)
