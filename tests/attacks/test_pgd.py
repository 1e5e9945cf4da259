"""The descent loop on functions whose minimum is known: no splats, no images."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.optimisers import NormName
from attacks.optimisers.methods import SearchSettings, momentum
from attacks.search.budget import Budget, BudgetError
from attacks.search.loop import Evaluation, Hooks, Outcome, Step, Verdict, rank
from attacks.search.loop import pgd as search
from attacks.search.parameters import Parameters
from mi_splat.errors import InvalidValueError

Oracle = Callable[[Parameters], Evaluation]
REFERENCE = {"sh": torch.zeros(4, 3)}
GOAL = torch.tensor(
    [[3.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0]]
)


def settings(ball: Budget, reference: Parameters, **more: Any) -> SearchSettings:
    """A search over Gaussians in a row."""
    rows = torch.arange(len(next(iter(reference.values()))), dtype=torch.float32)
    positions = torch.stack([rows, torch.zeros_like(rows), torch.zeros_like(rows)], 1)
    return SearchSettings(
        **{
            "ball": ball,
            "reference": reference,
            "positions": positions,
            "steps": 1,
            **more,
        }
    )


def pgd(
    evaluate: Oracle,
    reference: Parameters,
    ball: Budget,
    *,
    step: Mapping[str, float],
    **more: Any,
) -> Outcome:
    """Plain steps of a fixed length."""
    plain = momentum(settings(ball, reference, step=step))
    return search(evaluate, reference, ball, optimiser=plain, **more)


def bowl(
    *, aim: float = -1.0, score: Callable[[Tensor], float] | None = None
) -> Oracle:
    """Squared distance to GOAL; success when it is at most `aim`."""

    def evaluate(point: Parameters) -> Evaluation:
        leaf = point["sh"].detach().requires_grad_(True)
        loss = (leaf - GOAL).square().sum()
        (gradient,) = torch.autograd.grad(loss, [leaf])
        value = float(loss.detach())
        mark = 1 / (1 + value) if score is None else score(leaf.detach())
        return Evaluation(
            loss=value,
            gradients={"sh": gradient},
            verdict=Verdict(value <= aim, mark, True),
        )

    return evaluate


@pytest.mark.parametrize("norm", ["linf", "l2", "l2_per_gaussian"])
def test_it_finds_the_nearest_point_of_the_ball(norm: NormName) -> None:
    budget = Budget(radius={"sh": 1.0}, norm=norm)
    result = pgd(bowl(), REFERENCE, budget, step={"sh": 0.02}, steps=400)
    best = budget.project({"sh": GOAL}, REFERENCE)["sh"]
    torch.testing.assert_close(result.parameters["sh"], best, atol=0.05, rtol=0)
    assert budget.measure(result.parameters, REFERENCE)["sh"] <= 1.0


def test_every_point_that_is_evaluated_is_inside() -> None:
    budget = Budget(radius={"sh": 1.0})
    sizes = []
    plain = bowl()

    def watched(point: Parameters) -> Evaluation:
        sizes.append(budget.measure(point, REFERENCE)["sh"])
        return plain(point)

    start = {"sh": torch.full((4, 3), 9.0)}
    pgd(watched, REFERENCE, budget, step={"sh": 0.5}, steps=20, starts=[start])
    assert len(sizes) == 21
    assert max(sizes) <= 1.0


def test_the_trace_and_the_callback_tell_the_same_story() -> None:
    heard: list[Step] = []
    result = pgd(
        bowl(),
        REFERENCE,
        Budget(radius={"sh": 1.0}),
        step={"sh": 0.1},
        steps=5,
        hooks=Hooks(on_step=heard.append),
    )
    assert tuple(heard) == result.trace
    assert [line.index for line in heard] == [0, 1, 2, 3, 4, 5]
    assert heard[0].loss == pytest.approx(13.25)
    assert heard[0].zero_gradient_fraction == pytest.approx(9 / 12)
    short = pgd(
        bowl(),
        REFERENCE,
        Budget(radius={"sh": 1.0}),
        step={"sh": 0.1},
        steps=5,
        hooks=Hooks(on_step=lambda line: line.index == 2),
    )
    assert (short.trace, short.stopped, result.stopped) == (
        result.trace[:3],
        True,
        False,
    )
    assert short.best == max(short.trace, key=rank)


def test_early_stop_ends_at_the_first_success_and_the_full_budget_goes_on() -> None:
    budget = Budget(radius={"sh": 10.0})
    early = pgd(bowl(aim=9.0), REFERENCE, budget, step={"sh": 0.5}, steps=12)
    full = pgd(
        bowl(aim=9.0), REFERENCE, budget, step={"sh": 0.5}, steps=12, early_stop=False
    )
    assert early.best.success
    assert early.best.index == len(early.trace) - 1 == 2
    assert len(full.trace) == 13
    assert full.best.score > early.best.score


def test_early_stop_waits_for_a_unambiguous_success() -> None:
    oracle = scripted(
        (False, False), (True, False), (True, False), (True, True), (True, True)
    )
    result = pgd(
        oracle, REFERENCE, Budget(radius={"sh": 10.0}), step={"sh": 1.0}, steps=9
    )
    assert len(result.trace) == 4
    assert result.best.index == 3


def test_a_ball_that_does_not_hold_is_noticed_at_the_end() -> None:
    class Leaky(Budget):
        def project(self, parameters: Parameters, reference: Parameters) -> Parameters:
            return parameters

    with pytest.raises(BudgetError, match=r"l2 of sh: expected <= 1\.0"):
        pgd(bowl(), REFERENCE, Leaky(radius={"sh": 1.0}), step={"sh": 1.0}, steps=3)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_what_is_not_finite_is_an_error(bad: float) -> None:
    def sick(where: str) -> Oracle:
        def evaluate(point: Parameters) -> Evaluation:
            gradient = torch.full_like(point["sh"], bad if where == "gradient" else 1.0)
            loss = bad if where == "loss" else 1.0
            return Evaluation(loss=loss, gradients={"sh": gradient})

        return evaluate

    budget = Budget(radius={"sh": 1.0})
    with pytest.raises(
        InvalidValueError, match="gradient of sh: expected finite numbers"
    ):
        pgd(sick("gradient"), REFERENCE, budget, step={"sh": 1.0}, steps=3)
    with pytest.raises(InvalidValueError, match="loss: expected a finite number"):
        pgd(sick("loss"), REFERENCE, budget, step={"sh": 1.0}, steps=3)


def scripted(*points: tuple[bool, bool]) -> Oracle:
    """Success and unambiguity of one point after the other, with a constant
    gradient.
    """
    calls = iter(points)

    def evaluate(point: Parameters) -> Evaluation:
        success, unambiguous = next(calls)
        gradients = {"sh": torch.ones_like(point["sh"])}
        return Evaluation(
            loss=1.0, gradients=gradients, verdict=Verdict(success, 0.8, unambiguous)
        )

    return evaluate


def test_the_best_point_of_all_starts_is_kept_and_starts_are_drawn_late() -> None:
    taken: list[float] = []

    def starts() -> Iterator[Parameters]:
        for value in (-1.0, 0.5, 0.0):
            taken.append(value)
            yield {"sh": torch.full((4, 3), value)}

    budget = Budget(radius={"sh": 10.0})
    result = pgd(bowl(), REFERENCE, budget, step={"sh": 0.1}, steps=0, starts=starts())
    assert taken == [-1.0, 0.5, 0.0]
    assert [line.loss for line in result.trace] == pytest.approx(
        [28.25, 14.75 - 0.0, 13.25], abs=2.0
    )
    assert result.best.restart == 2
    assert torch.equal(result.parameters["sh"], torch.zeros(4, 3))
    taken.clear()
    pgd(bowl(aim=99.0), REFERENCE, budget, step={"sh": 0.1}, steps=0, starts=starts())
    assert taken == [-1.0]


def line(success: bool, unambiguous: bool, score: float, loss: float) -> Step:
    """A line of a trace."""
    return Step(
        index=0,
        loss=loss,
        score=score,
        success=success,
        unambiguous=unambiguous,
        zero_gradient_fraction=0.0,
    )


def test_the_order_of_points() -> None:
    """Success, then without ambiguity, then the score, then the loss."""
    worst_to_best = [
        line(False, False, 0.9, 5.0),
        line(False, False, 0.9, 4.0),
        line(False, False, 0.95, 9.0),
        line(False, True, 0.1, 9.0),
        line(True, False, 0.1, 9.0),
        line(True, False, 0.9, 9.0),
        line(True, True, 0.2, 9.0),
    ]
    mixed = [worst_to_best[number] for number in (3, 0, 6, 2, 5, 1, 4)]
    assert sorted(mixed, key=rank) == worst_to_best


def test_a_judge_looks_at_some_points_and_what_it_makes_of_them_is_kept() -> None:
    """Every second step and the last; the best is what the judge gave back, not the
    search's own point.
    """
    seen: list[float] = []

    def judge(point: Parameters) -> tuple[Parameters, Verdict]:
        seen.append(float(point["sh"].sum()))
        return {"sh": point["sh"] / 2}, Verdict(
            success=False, score=len(seen) / 10, unambiguous=False
        )

    hooks = Hooks(judge=judge, every=2)
    result = pgd(
        bowl(),
        REFERENCE,
        Budget(radius={"sh": 9.0}),
        step={"sh": 0.5},
        steps=5,
        hooks=hooks,
    )
    assert [line.index for line in result.trace if line.score >= 0] == [2, 4, 5]
    assert result.best.index == 5
    assert float(result.parameters["sh"].sum()) == seen[-1] / 2
