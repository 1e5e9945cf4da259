"""Projected gradient descent on a dictionary of tensors. It knows nothing of splats, pictures or detectors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError, message

Parameters = dict[str, Tensor]


class Ball(Protocol):
    """The set that the parameters may not leave, around a reference."""

    def project(self, parameters: Parameters, reference: Parameters) -> Parameters:
        """The nearest parameters inside."""
        ...

    def check(self, parameters: Parameters, reference: Parameters) -> None:
        """Raise if the parameters are outside."""
        ...

    def steepest(self, gradients: Parameters) -> Parameters:
        """Direction of steepest ascent, of size 1 for each tensor."""
        ...


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Evaluation:
    """What the attacker knows about one point.

    Attributes:
        loss: Lower is better for the attacker.
        gradients: Derivative of the loss by each parameter.
        success: Whether the attack has its aim here, judged by what counts, which is not the loss.
        score: How near it is, in [0, 1].
        unambiguous: Whether success leaves nothing to wish for; an early stop waits for it.
    """

    loss: float
    gradients: Parameters
    success: bool
    score: float
    unambiguous: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One line of the trace.

    Attributes:
        index: 0 is the start; after n steps the index is n.
        loss: Lower is better for the attacker.
        score: In [0, 1], higher is better for the attacker.
        success: Whether the attack has its aim here.
        unambiguous: Whether it has it clearly.
        zero_gradient_fraction: Fraction of the gradient's elements that are exactly zero.
        restart: Number of the run, 0 for the first.
    """

    index: int
    loss: float
    score: float
    success: bool
    unambiguous: bool
    zero_gradient_fraction: float
    restart: int = 0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Outcome:
    """The best point of a run and how it was found.

    Attributes:
        parameters: The best point: success first, then unambiguous success, then the score, then the loss.
        best: Its line of the trace.
        trace: Every point in order, the start included.
    """

    parameters: Parameters
    best: Step
    trace: tuple[Step, ...]


def pgd(
    evaluate: Callable[[Parameters], Evaluation],
    reference: Parameters,
    ball: Ball,
    *,
    step: Mapping[str, float],
    steps: int,
    start: Parameters | None = None,
    early_stop: bool = True,
    on_step: Callable[[Step], None] | None = None,
) -> Outcome:
    """Descend along the steepest direction of the ball's norm and project after every step.

    Args:
        evaluate: Loss, gradients, success and score at a point; at most steps + 1 calls.
        reference: Centre of the ball, one tensor for each parameter.
        ball: Projection and direction; `Budget` is one.
        step: Length of a step for each parameter, in the ball's norm.
        steps: Number of steps.
        start: First point, the reference if None.
        early_stop: Stop at the first unambiguous success; otherwise spend all steps and keep the best point.
        on_step: Called with every line of the trace.

    Raises:
        InvalidValueError: A gradient or the loss is not finite, or steps is negative.
        BudgetError: The best point is outside the ball (`Ball.check`).
    """
    if steps < 0:
        raise InvalidValueError(message("steps", "a number >= 0", steps, "ask for at least one step"))
    point = ball.project({k: v.detach().clone() for k, v in (start or reference).items()}, reference)
    best, kept, trace = None, point, []
    for index in range(steps + 1):
        found = evaluate(point)
        line = _line(index, found)
        trace.append(line)
        if on_step is not None:
            on_step(line)
        if best is None or rank(line) > rank(best):
            best, kept = line, point
        if index == steps or (early_stop and found.success and found.unambiguous):
            break
        direction = ball.steepest(found.gradients)
        point = ball.project({k: v - step[k] * direction[k] for k, v in point.items()}, reference)
    assert best is not None  # the loop ran at least once
    ball.check(kept, reference)
    return Outcome(parameters=kept, best=best, trace=tuple(trace))


def rank(line: Step) -> tuple[bool, bool, float, float]:
    """What makes a point better: success, then an unambiguous one, then the score, and the loss only between equals."""
    return line.success, line.unambiguous, line.score, -line.loss


def _line(index: int, found: Evaluation) -> Step:
    zeros = total = 0
    for name, gradient in found.gradients.items():
        if not bool(torch.isfinite(gradient).all()):
            raise InvalidValueError(
                message(
                    f"gradient of {name}", "finite numbers", "NaN or infinity", "look at the renderer and the objective"
                )
            )
        zeros, total = zeros + int((gradient == 0).sum()), total + gradient.numel()
    if found.loss != found.loss or abs(found.loss) == float("inf"):
        raise InvalidValueError(message("loss", "a finite number", found.loss, "look at the objective"))
    fraction = zeros / total if total else 1.0
    return Step(
        index=index,
        loss=found.loss,
        score=found.score,
        success=found.success,
        unambiguous=found.unambiguous,
        zero_gradient_fraction=fraction,
    )
