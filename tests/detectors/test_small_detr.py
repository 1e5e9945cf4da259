"""The small detection transformer: its network behind the `Detector` interface, its set loss, its training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from attacks.detectors import small_detr
from attacks.detectors.base import Detector
from attacks.detectors.small_detr import DETRDetector, Guesses, resized
from attacks.detectors.training.assignment import least_cost
from attacks.detectors.training.config import TrainConfig
from attacks.detectors.training.detr import DETRTrainer, matched, set_losses
from attacks.detectors.training.loop import Training
from mi_splat.errors import InvalidValueError
from tests.detectors.pictures import drawn


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def detector() -> DETRDetector:
    torch.manual_seed(1)
    return DETRDetector("detr_small", small_detr.build(), min_confidence=0.02)


def pictures(count: int = 1, height: int = 96, width: int = 128) -> Tensor:
    coarse = torch.rand((count, 3, 12, 16), generator=torch.Generator().manual_seed(5))
    return torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear").permute(0, 2, 3, 1)


def guesses(*rows: tuple[list[float], int]) -> Guesses:
    """Of one picture; each is sure of one of two classes."""
    logits = torch.tensor([[[12.0 if number == label else -12.0 for number in range(2)] for _, label in rows]])
    return Guesses(logits, torch.tensor([[box for box, _ in rows]]))


LEFT, RIGHT = [0.25, 0.5, 0.2, 0.4], [0.75, 0.5, 0.3, 0.4]


def test_the_protocol_holds(detector: DETRDetector) -> None:
    assert isinstance(detector, Detector)
    assert not detector.model.training
    assert not any(p.requires_grad for p in detector.model.parameters())
    with pytest.raises(InvalidValueError, match="images: expected floating point"):
        detector.detect(torch.zeros(1, 3, 96, 96))


def test_detections_are_the_queries_that_are_confident(detector: DETRDetector) -> None:
    for found, considered in zip(detector.detect(pictures(2)), detector.candidates(pictures(2)), strict=True):
        best = considered.scores.amax(1)
        assert len(found) == int((best >= 0.02).sum()) > 0
        torch.testing.assert_close(found.scores, best.sort(descending=True).values[: len(found)])
        assert float(considered.boxes.min()) >= 0
        assert float(considered.boxes[..., 0::2].max()) <= 128
        assert float(considered.boxes[..., 1::2].max()) <= 96


def test_pictures_are_brought_to_a_size_of_whole_cells() -> None:
    assert resized(torch.rand(1, 3, 256, 256), 256).shape == (1, 3, 256, 256)
    assert resized(torch.rand(1, 3, 96, 128), 256).shape == (1, 3, 256, 352)
    assert resized(torch.rand(1, 3, 600, 300), 160).shape == (1, 3, 320, 160)


def test_the_gradient_agrees_with_finite_differences() -> None:
    torch.manual_seed(2)
    model = small_detr.build()
    for layer in model.shifts:
        for part in layer.modules():
            if isinstance(part, torch.nn.Linear):
                part.reset_parameters()
    with torch.no_grad():
        for _ in range(30):  # the norms need the statistics of something
            model(torch.rand(2, 3, 64, 64))
    detector = DETRDetector("detr_small", model.double())

    def confidence(image: Tensor) -> Tensor:
        (found,) = detector.candidates(image)
        return found.scores[0, 2] + 1e-3 * found.boxes[0, 2].sum()

    image = pictures().double().clamp(0.01, 0.99)
    leaf = image.clone().requires_grad_()
    confidence(leaf).backward()  # type: ignore[no-untyped-call]
    assert leaf.grad is not None
    assert (leaf.grad != 0).double().mean() > 0.9
    direction = torch.randn(image.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with torch.no_grad():
        slope = (confidence(image + 1e-7 * direction) - confidence(image - 1e-7 * direction)) / 2e-7
    torch.testing.assert_close((leaf.grad * direction).sum(), slope, rtol=1e-4, atol=1e-9)


def test_each_object_is_matched_with_the_guess_that_fits_it() -> None:
    rows = guesses((RIGHT, 0), (LEFT, 0), (LEFT, 1), (RIGHT, 1))
    true, labels = torch.tensor([LEFT, RIGHT]), torch.tensor([1, 0])
    found, objects = matched(rows.logits[0], rows.boxes[0], true, labels, 1)
    assert dict(zip(found.tolist(), objects.tolist(), strict=True)) == {2: 0, 0: 1}
    found, objects = matched(rows.logits[0], rows.boxes[0], true, labels, 2)
    assert sorted(objects.tolist()) == [0, 0, 1, 1]
    assert len(set(found.tolist())) == 4
    found, _ = matched(rows.logits[0], rows.boxes[0], torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), 2)
    assert len(found) == 0


def test_the_loss_is_least_where_every_object_is_found_once() -> None:
    true, labels = [torch.tensor([LEFT])], [torch.tensor([1])]
    nothing = torch.tensor([[-12.0, -12.0]])
    right = Guesses(torch.cat([guesses((LEFT, 1)).logits, nothing[None]], 1), torch.tensor([[LEFT, RIGHT]]))
    assert sum(float(v) for v in set_losses(right, true, labels).values()) < 1e-4
    for wrong in (guesses((LEFT, 1), (LEFT, 1)), guesses((LEFT, 0), (RIGHT, 0)), guesses((RIGHT, 1))):
        assert sum(float(v) for v in set_losses(wrong, true, labels).values()) > 0.5
    empty = set_losses(guesses((LEFT, 1)), [torch.zeros(0, 4)], [torch.zeros(0, dtype=torch.int64)])
    assert float(empty["class"]) > 0.5
    assert float(empty["distance"]) == float(empty["overlap"]) == 0.0


@pytest.mark.parametrize("shape", [(0, 4), (1, 1), (3, 3), (5, 40), (16, 80)])
def test_the_assignment_costs_the_least(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(7)
    for _ in range(5):
        cost = rng.normal(size=shape)
        found = least_cost(cost)
        rows, columns = linear_sum_assignment(cost)
        assert len(set(found.tolist())) == shape[0]
        assert cost[np.arange(shape[0]), found].sum() == pytest.approx(cost[rows, columns].sum())
    tied = least_cost(np.ones(shape))
    assert len(set(tied.tolist())) == shape[0]


@pytest.mark.slow
def test_training_lowers_the_loss() -> None:
    few = [drawn((20 + 4 * i, 30, 70, 80), label=1 + i % 2) for i in range(4)]
    config = TrainConfig(epochs=12, batch=4, low_resolution=96, low_resolution_fraction=1.0, seed=3, warm_up=0.01)
    training = Training(replace(config, learning_rate=1e-3), DETRTrainer())
    losses = [sum(training.run_epoch(few).values()) for _ in range(12)]
    assert min(losses[-2:]) < 0.7 * losses[0]
    assert isinstance(training.snapshot(), DETRDetector)
