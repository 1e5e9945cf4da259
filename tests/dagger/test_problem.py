"""The problem of an attack: gradients at the clamp, several views, what is judged."""

from typing import Any

import pytest
import torch

from attacks.dagger.attack import problem_of
from attacks.dagger.config import DaggerConfig
from attacks.dagger.problem import Problem, bounded
from attacks.dagger.views import FixedViews, View
from attacks.detectors.base import Detections, Detector
from attacks.objectives.base import Objective
from attacks.objectives.relabel import relabel
from attacks.objectives.suppression import hide
from attacks.objectives.verdicts import joint_verdict, reached_by
from attacks.search.loop import Verdict
from mi_splat.cameras.camera import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io.images import quantise
from mi_splat.scene import GaussianScene
from tests.fakes import ColourDetector, blobs, camera, toy_scene


def test_gradients_pass_the_clamp_only_inwards() -> None:
    image = torch.tensor([-0.5, -0.5, 0.5, 1.5, 1.5], requires_grad=True)
    inside = bounded(image)
    assert inside.tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
    (gradient,) = torch.autograd.grad(
        inside, [image], torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0])
    )
    assert gradient.tolist() == [0.0, -1.0, 1.0, 1.0, 0.0]


def test_a_fraction_of_the_views_can_be_enough() -> None:
    scores = [0.1, 0.9, 0.5, 0.7]
    assert [reached_by(scores, fraction) for fraction in (1.0, 0.75, 0.5, 0.25)] == [
        0.1,
        0.5,
        0.7,
        0.9,
    ]
    assert reached_by(scores, 0.51) == 0.5  # rounded up to whole views
    # 0.07 * 100 is a little more than 7
    assert reached_by([i / 100 for i in range(100)], 0.07) == 0.93


@pytest.mark.parametrize(
    ("required_views", "expected"),
    [
        (1.0, Verdict(success=False, score=0.2, unambiguous=False)),
        (2 / 3, Verdict(success=True, score=0.8, unambiguous=False)),
        (1 / 3, Verdict(success=True, score=0.9, unambiguous=True)),
    ],
)
def test_verdicts_of_several_views_are_joined(
    required_views: float, expected: Verdict
) -> None:
    verdicts = [
        Verdict(success=True, score=0.9, unambiguous=True),
        Verdict(success=False, score=0.2, unambiguous=False),
        Verdict(success=True, score=0.8, unambiguous=False),
    ]
    assert joint_verdict(verdicts, required_views) == expected


CONFIG = DaggerConfig(sh_degree=None)


def problem(
    *cameras: Camera,
    detector: Detector | None = None,
    objective: Objective | None = None,
    wide: bool = False,
) -> tuple[Problem, list[View]]:
    scene, mask = toy_scene()
    if wide:
        scene = GaussianScene(*(value.double() for value in scene.tensors()))
    else:
        scene = scene
    views = FixedViews(scene, mask, cameras or camera(), render=blobs)
    made = problem_of(
        views, (detector or ColourDetector(),), objective or relabel("person"), CONFIG
    )
    return made, views.held_out(CONFIG)


def test_loss_and_gradient_are_means_over_the_views() -> None:
    made, views = problem(camera(), camera(offset=0.8))
    parameters = made.subset.parameters(("sh",))
    alone = [made.evaluate(parameters, [view], CONFIG) for view in views]
    both = made.evaluate(parameters, views, CONFIG)
    assert both.loss == pytest.approx(sum(evaluation.loss for evaluation in alone) / 2)
    mean = (alone[0].gradients["sh"] + alone[1].gradients["sh"]) / 2
    torch.testing.assert_close(both.gradients["sh"], mean)


def test_the_gradient_is_that_of_the_loss() -> None:
    """Central differences along a random direction, in double precision."""
    made, views = problem(objective=hide(), wide=True)
    clean = made.subset.parameters(("sh", "scales"))
    direction = {
        name: torch.randn(value.shape, dtype=torch.float64)
        for name, value in clean.items()
    }

    def loss(amount: float) -> float:
        moved = {
            name: value + amount * direction[name] for name, value in clean.items()
        }
        return made.evaluate(moved, views, CONFIG).loss

    measured = (loss(1e-5) - loss(-1e-5)) / 2e-5
    gradients = made.evaluate(clean, views, CONFIG).gradients
    assert measured == pytest.approx(
        sum(float((gradients[n] * direction[n]).sum()) for n in clean), rel=1e-4
    )


def test_the_search_counts_what_is_detected_in_eight_bits() -> None:
    seen: list[torch.Tensor] = []

    class Recording(ColourDetector):
        def detect(self, images: torch.Tensor) -> list[Detections]:
            seen.append(images)
            return super().detect(images)

    made, views = problem(detector=Recording())
    far = made.evaluate(made.subset.parameters(("sh",)), views, CONFIG)
    # nothing there comes near a person, so that nobody asks what is reported
    assert len(seen) == 1
    assert far.verdict is not None
    assert not far.verdict.success
    assert far.verdict.score < 0.35
    seen.clear()
    made, views = problem(
        detector=Recording(), objective=relabel("person", confidence=far.verdict.score)
    )
    made.evaluate(made.subset.parameters(("sh",)), views, CONFIG)
    assert len(seen) == 2
    assert torch.equal(seen[-1], quantise(seen[-1]))
    # the clean object, in the image that was looked at first
    torch.testing.assert_close(seen[-1], seen[0])


# DAGGER's configuration: what the paper fixes, and what is refused


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (
            {"eps": (1.0, 2.0)},
            "eps: expected one number for all of sh, or one for each",
        ),
        (
            {"attributes": ("sh", "means"), "eps": ()},
            "eps: expected one number for all of sh, means, or one for each",
        ),
        (
            {"attributes": ("sh", "sh"), "eps": (1.0, 1.0)},
            "eps: expected one number for all",
        ),
        ({"attributes": ()}, "attributes: expected at least one"),
    ],
)
def test_a_wrong_configuration_says_what_is_wrong(
    settings: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(InvalidValueError, match=complaint):
        DaggerConfig(**settings)
