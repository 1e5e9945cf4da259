"""The problem of an attack: gradients at the clamp, several views, what is judged."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from attacks.dagger.problem import AttackProblem, _label_on, bounded, joint_verdict, reached_by
from attacks.detectors.base import Detections
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import Verdict, hide, relabel
from mi_splat.io.images import quantise
from mi_splat.scene import GaussianScene
from tests.fakes import ColourDetector, blobs, camera, toy_scene


def test_gradients_pass_the_clamp_only_inwards() -> None:
    image = torch.tensor([-0.5, -0.5, 0.5, 1.5, 1.5], requires_grad=True)
    inside = bounded(image)
    assert inside.tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
    (gradient,) = torch.autograd.grad(inside, [image], torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0]))
    assert gradient.tolist() == [0.0, -1.0, 1.0, 1.0, 0.0]


def test_a_fraction_of_the_views_can_be_enough() -> None:
    scores = [0.1, 0.9, 0.5, 0.7]
    assert [reached_by(scores, fraction) for fraction in (1.0, 0.75, 0.5, 0.25)] == [0.1, 0.5, 0.7, 0.9]
    assert reached_by(scores, 0.51) == 0.5  # rounded up to whole views
    assert reached_by([i / 100 for i in range(100)], 0.07) == 0.93  # 0.07 * 100 is a little more than 7


@pytest.mark.parametrize(
    ("required_views", "expected"),
    [
        (1.0, Verdict(success=False, score=0.2, unambiguous=False)),
        (2 / 3, Verdict(success=True, score=0.8, unambiguous=False)),
        (1 / 3, Verdict(success=True, score=0.9, unambiguous=True)),
    ],
)
def test_verdicts_of_several_views_are_joined(required_views: float, expected: Verdict) -> None:
    verdicts = [
        Verdict(success=True, score=0.9, unambiguous=True),
        Verdict(success=False, score=0.2, unambiguous=False),
        Verdict(success=True, score=0.8, unambiguous=False),
    ]
    assert joint_verdict(verdicts, required_views) == expected


def problem(required_views: float = 1.0) -> AttackProblem:
    scene, mask = toy_scene()
    return AttackProblem(
        subset=GaussianSubset.of(scene, mask),
        detector=ColourDetector(),
        objective=relabel("person"),
        render=blobs,
        required_views=required_views,
    )


def test_loss_and_gradient_are_means_over_the_views() -> None:
    one = problem()
    views = [one.view(camera()), one.view(camera(offset=0.8))]
    parameters = one.subset.parameters(("sh",))
    alone = [one.evaluate(parameters, [view]) for view in views]
    both = one.evaluate(parameters, views)
    assert both.loss == pytest.approx(sum(found.loss for found in alone) / 2)
    mean = (alone[0].gradients["sh"] + alone[1].gradients["sh"]) / 2
    torch.testing.assert_close(both.gradients["sh"], mean)


def test_the_gradient_is_that_of_the_loss() -> None:
    """Central differences along a random direction, in double precision."""
    scene, mask = toy_scene()
    wide = GaussianScene(*(value.double() for value in scene.tensors()))
    one = dataclasses.replace(problem(), subset=GaussianSubset.of(wide, mask), objective=hide())
    view = one.view(camera())
    clean = one.subset.parameters(("sh", "scales"))
    direction = {name: torch.randn(value.shape, dtype=torch.float64) for name, value in clean.items()}

    def loss(amount: float) -> float:
        moved = {name: value + amount * direction[name] for name, value in clean.items()}
        return one.evaluate(moved, [view]).loss

    measured = (loss(1e-5) - loss(-1e-5)) / 2e-5
    gradients = one.evaluate(clean, [view]).gradients
    assert measured == pytest.approx(sum(float((gradients[n] * direction[n]).sum()) for n in clean), rel=1e-4)


def test_the_judge_sees_eight_bits_of_the_scene_that_it_gets() -> None:
    one = problem()
    view = one.view(camera())
    (result,) = one.judge(one.subset.scene, [view])
    picture = quantise(blobs(one.subset.scene, camera())).float()
    assert torch.equal(result.after.image, picture)
    assert torch.equal(view.image, picture)
    assert result.verdict == one.objective.verdict(one.detector.detect(picture[None])[0], view.target)
    assert view.target.original == "car"
    assert view.target.label == "person"


def test_the_search_counts_what_is_detected_in_eight_bits() -> None:
    seen: list[torch.Tensor] = []

    class Recording(ColourDetector):
        def detect(self, images: torch.Tensor) -> list[Detections]:
            seen.append(images)
            return super().detect(images)

    one = dataclasses.replace(problem(), detector=Recording())
    view = one.view(camera())
    one.evaluate(one.subset.parameters(("sh",)), [view])
    assert torch.equal(seen[-1], quantise(seen[-1]))
    torch.testing.assert_close(seen[-1][0], view.image)


def test_the_object_is_what_is_seen_on_it_with_most_confidence() -> None:
    box = torch.tensor([10.0, 10.0, 20.0, 20.0])
    boxes = torch.stack([box + 40, box + 1, box])
    seen = Detections(boxes, torch.tensor([0.9, 0.6, 0.5]), ("person", "car", "stop sign"))
    assert _label_on(seen, box) == "car"
    assert _label_on(seen, box + 200) is None
    assert _label_on(Detections(torch.zeros(0, 4), torch.zeros(0), ()), box) is None
