"""Finished scenes are scored in both forms of the rate, with Wilson intervals."""

from __future__ import annotations

import pytest
import torch
from scipy.stats import binomtest

from attacks.dagger.attack import DaggerConfig, attack
from attacks.evaluation.rates import Rate, evaluate, rates
from attacks.objectives import relabel
from mi_splat.errors import InvalidValueError
from tests.fakes import ColourDetector, blobs, camera, toy_scene


def test_an_attack_is_scored_on_other_views_with_its_control() -> None:
    scene, mask = toy_scene()
    config = DaggerConfig(eps=(20.0,), early_stop=False, noise_draws=0)
    found = attack(scene, mask, [camera()], ColourDetector(), relabel("person"), render=blobs, config=config)
    views = [camera(offset=offset) for offset in (-0.2, 0.1, 0.3)]
    frames = evaluate({"clean": scene, "attacked": found.scene}, mask, views, [ColourDetector()], render=blobs)
    assert len(frames) == 6
    attacked = rates(frames, "attacked", "fake_colour", original="car", wanted="person")
    control = rates(frames, "clean", "fake_colour", original="car", wanted="person")
    assert attacked["all"] == attacked["given_found"] == Rate(successes=3, total=3)
    assert control["all"] == Rate(successes=0, total=3)
    gone = rates(frames, "attacked", "fake_colour", original="car", wanted=None)
    assert gone["all"].fraction == 1.0


def test_views_without_the_object_do_not_count() -> None:
    scene, mask = toy_scene()
    hidden = scene.replace(opacities=torch.where(mask, 0.0, scene.opacities))
    frames = evaluate({"clean": hidden}, mask, [camera()], [ColourDetector()], render=blobs)
    assert frames[0].box is None
    assert frames[0].confidence("car") == 0.0
    assert rates(frames, "clean", "fake_colour", original="car", wanted=None)["all"].total == 0


@pytest.mark.parametrize(("successes", "total"), [(0, 10), (10, 10), (3, 7), (78, 80)])
def test_wilson_interval_against_scipy(successes: int, total: int) -> None:
    expected = binomtest(successes, total).proportion_ci(method="wilson")
    assert Rate(successes=successes, total=total).interval == pytest.approx((expected.low, expected.high))


def test_no_views_say_nothing() -> None:
    assert Rate(successes=0, total=0).interval == (0.0, 1.0)
    assert Rate(successes=0, total=0).fraction == 0.0


def test_a_clean_scene_is_asked_for() -> None:
    scene, mask = toy_scene()
    with pytest.raises(InvalidValueError, match="scenes: expected one of the name clean"):
        evaluate({"attacked": scene}, mask, [camera()], [ColourDetector()], render=blobs)
