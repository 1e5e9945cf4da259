"""Warnings: signs that a success or a failure is not what it looks like."""

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.figures import attack_figures
from attacks.dagger.result import JudgedView, Result, observed
from attacks.detectors.base import Detections
from attacks.figures.frame import MEASURE, Figures, Labels
from attacks.figures.rate import Rate
from attacks.objectives.relabel import relabel
from attacks.objectives.suppression import hide
from attacks.observe.rows import ATTACKED, NOISE
from tests.fakes import ColourDetector, blobs, camera, toy_scene

DETECTOR = ColourDetector()


def test_warnings_about_a_picture_without_a_detection() -> None:
    scene, mask = toy_scene()
    dark = scene.sh.clone()
    dark[mask, 0] = -1.4
    result = attack(
        scene.replace(sh=dark), mask, [camera()], DETECTOR, hide(), render=blobs
    )
    assert result.figures.rate("reached", splat=NOISE) == Rate(successes=5, total=5)
    assert result.warnings == (
        "the clean image of view 0 has no detection of 0.5 or more on the object",
        "the aim is reached without any attack",
        "a random change (noise) does as well",
    )


def test_warnings_about_clamped_colours_and_zero_gradients() -> None:
    scene, mask = toy_scene()
    black = torch.where(mask[:, None, None], torch.full_like(scene.sh, 0.0), scene.sh)
    black[mask, 0] = -3.0
    scene = scene.replace(sh=black)
    cameras = [camera(), camera(offset=0.4)]
    result = attack(scene, mask, cameras, DETECTOR, relabel("person"), render=blobs)
    assert result.clamped_fraction == 1.0  # the mean over the views
    assert (
        "100% of the object's colour channels are clamped at 0, where SH has no"
        " gradient" in result.warnings
    )
    assert "up to 100% of the gradient's elements are exactly zero" in result.warnings
    assert "the loss did not fall" in result.warnings
    assert not result.success


def test_a_success_that_eight_bits_lose_is_warned_of() -> None:
    class Fickle(ColourDetector):
        """Sees persons only before `attack` comes to judge the file: a stand-in for
        rounding.
        """

        calls = 0

        def detect(self, images: Tensor) -> list[Detections]:
            self.calls += 1
            car = super().detect(images)[0]
            return [
                dataclasses.replace(car, labels=("person",)) if self.calls == 2 else car
            ]

    scene, mask = toy_scene()
    result = attack(
        scene,
        mask,
        [camera()],
        Fickle(),
        relabel("person", confidence=1e-6),
        render=blobs,
        config=DaggerConfig(eps=(0.1,)),
    )
    assert (
        "success in the search did not survive the saved file and 8-bit images"
        in result.warnings
    )
    assert not result.success


@pytest.fixture(scope="module")
def sound() -> Result:
    scene, mask = toy_scene()
    config = DaggerConfig(eps=(12.0,), noise_draws=2)
    result = attack(
        scene,
        mask,
        [camera()],
        DETECTOR,
        relabel("person"),
        render=blobs,
        config=config,
    )
    assert result.warnings == ()
    return result


def of_views(result: Result, *views: JudgedView) -> Result:
    """The result with other views."""
    looked = observed(views, result.objective, seed=0)
    figures = attack_figures(
        looked.rows,
        result.detectors,
        result.objective.label,
        result.config.required_views,
        None,
        drawn=False,
    )
    return dataclasses.replace(result, views=views, looked=looked, figures=figures)


def with_figures(result: Result, *entries: tuple[Labels, Any]) -> Result:
    """The result with other figures."""
    figures = Figures.together([result.figures, Figures.of(entries)])
    return dataclasses.replace(result, figures=figures)


@pytest.mark.parametrize(
    ("left", "strict"), [(0.49, True), (0.5, False), (0.91, False)]
)
def test_an_own_class_that_stays_beside_the_wanted_one_is_warned_of(
    sound: Result, left: float, strict: bool
) -> None:
    (view,) = sound.views
    box = view.target.box
    both = Detections(
        torch.stack([box, box]), torch.tensor([0.95, left]), ("person", "car")
    )
    seen = dataclasses.replace(
        view, attacked=dataclasses.replace(view.attacked, detections=both)
    )
    result = of_views(sound, seen)
    assert result.success
    assert result.strict is strict
    # What a view shows in which nothing was reported before is not the object's own
    # class.
    unknown = dataclasses.replace(
        view, target=dataclasses.replace(view.target, original=None)
    )
    two = of_views(result, seen, unknown)
    assert (
        strict
        or f"the object's own class is still reported on it, at up to {left:.0%}"
        in two.warnings
    )
    still = f"the object's own class is still reported on it, at up to {left:.0%}"
    assert result.warnings == (() if strict else (still,))


@pytest.mark.parametrize(
    ("success", "score", "best", "reached", "warned"),
    [
        (True, 0.9, 0.8, 1, True),
        (True, 0.9, 0.8, 0, False),
        (False, 0.4, 0.4, 0, True),
        (False, 0.4, 0.3, 0, False),
        (False, 0.0, 0.0, 0, False),
    ],
)
def test_noise_that_does_as_well_is_warned_of(
    sound: Result, success: bool, score: float, best: float, reached: int, warned: bool
) -> None:
    step = dataclasses.replace(sound.best, success=success)
    once = Rate(successes=int(success), total=1)
    result = with_figures(
        sound,
        ({MEASURE: "reached", "splat": ATTACKED}, once),
        ({MEASURE: "reached_unambiguously", "splat": ATTACKED}, once),
        ({MEASURE: "score", "splat": ATTACKED}, score),
        ({MEASURE: "best_score", "splat": NOISE}, best),
        ({MEASURE: "reached", "splat": NOISE}, Rate(successes=reached, total=2)),
    )
    warnings = dataclasses.replace(result, best=step).warnings
    assert ("a random change (noise) does as well" in warnings) is warned


@pytest.mark.parametrize(("score", "warned"), [(0.49, True), (0.5, False)])
def test_an_object_that_is_hardly_seen_before_is_warned_of(
    sound: Result, score: float, warned: bool
) -> None:
    (view,) = sound.views
    seen = Detections(view.target.box[None], torch.tensor([score]), ("car",))
    faint = dataclasses.replace(
        view, clean=dataclasses.replace(view.clean, detections=seen)
    )
    message = "the clean image of view 0 has no detection of 0.5 or more on the object"
    assert (message in of_views(sound, faint).warnings) is warned
