"""Momentum and falling steps against closed forms."""

from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.optimisers import Schedule
from attacks.optimisers.methods import (
    LENGTHS,
    SearchSettings,
    adam,
    momentum,
    normalised,
)
from attacks.search.budget import Budget
from attacks.search.loop import Evaluation, Memory, Optimiser, Verdict, pgd
from attacks.search.parameters import Parameters

BALL = Budget(radius={"sh": 100.0}, norm="linf")
FALLING: dict[str, Any] = {"momentum": 0.8, "schedule": "linear", "steps": 4}


def search(ball: Budget = BALL, *, rows: int = 1, **more: Any) -> SearchSettings:
    usual = {
        "reference": {"sh": torch.zeros(rows)},
        "positions": torch.zeros(rows, 3),
        "step": {"sh": 0.5},
        "steps": 4,
    }
    return SearchSettings(**{"ball": ball, **usual, **more})


class Run:
    """An optimiser with its memory, that says how far each gradient moves a point."""

    def __init__(self, optimiser: Optimiser) -> None:
        self.optimiser, self.memory = optimiser, Memory()

    def __call__(self, gradient: Tensor) -> Tensor:
        here = Evaluation(loss=0.0, gradients={"sh": gradient})
        moved = self.optimiser({"sh": torch.zeros_like(gradient)}, here, self.memory)
        assert moved is not None
        self.memory.index += 1
        return moved["sh"]


def descent(**settings: Any) -> Run:
    return Run(momentum(search(**{"momentum": 0.8, **settings})))


def adams(**settings: Any) -> Run:
    return Run(
        adam(search(**{"momentum": 0.8, "schedule": "linear", "steps": 6, **settings}))
    )


def test_without_memory_the_steps_are_those_of_steepest_descent() -> None:
    ours = descent(momentum=0.0)
    for gradient in torch.randn(4, 6, generator=torch.Generator().manual_seed(0)):
        steepest = -0.5 * BALL.steepest({"sh": gradient})["sh"]
        assert torch.equal(steepest, ours(gradient))


def test_the_velocity_is_the_decaying_sum_of_normalised_gradients() -> None:
    update = descent()
    gradients = [
        torch.tensor([3.0, -1.0]),
        torch.tensor([-100.0, 100.0]),
        torch.tensor([0.0, 2.0]),
    ]
    for gradient in gradients:
        update(gradient)
    units = [gradient / gradient.abs().mean() for gradient in gradients]
    expected = 0.8 * (0.8 * units[0] + units[1]) + units[2]
    torch.testing.assert_close(update.memory.tensors["velocity"]["sh"], expected)


@pytest.mark.parametrize("schedule", ["constant", "linear", "cosine"])
def test_a_quadratic_is_descended_in_steps_of_the_schedule_s_length(
    schedule: Schedule,
) -> None:
    """From far away all signs agree, so the way is the sum of the lengths."""
    steps = 8
    reached = []

    def evaluate(point: Parameters) -> Evaluation:
        value = point["sh"]
        reached.append(float(value))
        loss = 0.5 * float((value**2).sum())
        return Evaluation(
            loss=loss, gradients={"sh": value}, verdict=Verdict(False, 0.0, False)
        )

    optimiser = momentum(search(momentum=0.5, schedule=schedule, steps=steps))
    pgd(evaluate, {"sh": torch.tensor([50.0])}, BALL, steps=steps, optimiser=optimiser)
    way = [
        50.0 - 0.5 * sum(LENGTHS[schedule](k / steps) for k in range(done))
        for done in range(steps + 1)
    ]
    assert reached == pytest.approx(way)


def test_adam_is_torch_s_on_normalised_gradients() -> None:
    generator = torch.Generator().manual_seed(2)
    leaf = torch.zeros(5, requires_grad=True)
    theirs = torch.optim.Adam([leaf], lr=0.5, betas=(0.8, 0.99), eps=1e-12)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        theirs, lambda k: LENGTHS["linear"](k / 6)
    )
    ours = adams()
    point = torch.zeros(5)
    for _ in range(6):
        gradient = torch.randn(5, generator=generator)
        leaf.grad = normalised({"sh": gradient})["sh"]
        theirs.step()
        schedule.step()
        point = point + ours(gradient)
        torch.testing.assert_close(point, leaf.detach(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("power", [0.5, 0.25])
def test_a_power_gives_the_steepest_direction_of_the_norm_between(power: float) -> None:
    """Along g, nothing in the unit ball of the l_p norm goes further than the step that
    is made of g.
    """
    generator = torch.Generator().manual_seed(0)
    gradient = torch.randn(50, generator=generator)
    ball = Budget(radius={"sh": 100.0}, norm="l2")
    update = Run(momentum(search(ball, step={"sh": 1.0}, power=power)))
    p = 1 + 1 / power
    step = -update(gradient)
    reached = float((step / torch.linalg.vector_norm(step, p)) @ gradient)
    others = torch.randn(2000, 50, generator=generator)
    others = torch.cat([others, gradient + 0.1 * others, step + 0.01 * others])
    assert reached >= float(
        (
            others / torch.linalg.vector_norm(others, p, dim=1, keepdim=True) @ gradient
        ).max()
    )
    assert float(torch.linalg.vector_norm(step)) == pytest.approx(1.0)
