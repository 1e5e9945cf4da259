"""Projected gradient descent on a dictionary of tensors. It knows nothing of splats, pictures or detectors.

PGD after Madry et al., "Towards Deep Learning Models Resistant to Adversarial Attacks", ICLR 2018: steps along the
steepest direction of the ball's norm, each followed by a projection, from one starting point or several. What a step
does with the gradient is a function that can be exchanged (`Optimiser`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
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
        score: How near it is, in [0, 1]; -1 where nothing judged the point.
        unambiguous: Whether it has its aim and nothing speaks against it; an early stop waits for this.
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
        index: 0 is the start of a run; after n steps the index is n.
        loss: Lower is better for the attacker.
        score: In [0, 1], higher is better for the attacker; -1 where nothing judged the point.
        success: Whether the attack has its aim here.
        unambiguous: Whether it has its aim and nothing speaks against it.
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
    """The best point of all runs and how it was found.

    Attributes:
        parameters: The best point: success first, then unambiguous success, then the score, then the loss.
        best: Its line of the trace.
        trace: Every point in order, the starts included.
    """

    parameters: Parameters
    best: Step
    trace: tuple[Step, ...]


Update = Callable[[Parameters], Parameters]
"""From the gradients at a point to the change of the parameters. It may remember the gradients of its run."""

Optimiser = Callable[[Ball, Mapping[str, float]], Update]
"""Makes the `Update` of one run from the ball and the length of a step by parameter."""


def steepest_descent(ball: Ball, step: Mapping[str, float]) -> Update:
    """Steps of fixed length against the steepest direction of the ball's norm (Madry et al. 2018)."""

    def update(gradients: Parameters) -> Parameters:
        return {name: -step[name] * direction for name, direction in ball.steepest(gradients).items()}

    return update


def pgd(
    evaluate: Callable[[Parameters], Evaluation],
    reference: Parameters,
    ball: Ball,
    *,
    step: Mapping[str, float],
    steps: int,
    starts: Iterable[Parameters] | None = None,
    optimiser: Optimiser = steepest_descent,
    early_stop: bool = True,
    on_step: Callable[[Step], None] | None = None,
) -> Outcome:
    """Descend from every start, project after every step, and keep the best point of all.

    Args:
        evaluate: Loss, gradients, success and score at a point; at most steps + 1 calls for each start.
        reference: Centre of the ball, one tensor for each parameter.
        ball: Projection and direction; `Budget` is one.
        step: Length of a step for each parameter, in the ball's norm.
        steps: Number of steps from each start.
        starts: First point of each run, taken when the run begins; the reference alone if None.
        optimiser: What makes a step of the gradient; asked anew for each run.
        early_stop: End everything at the first unambiguous success; otherwise take all steps from all starts.
        on_step: Called with every line of the trace as it happens.

    Raises:
        InvalidValueError: A gradient or the loss is not finite, steps is negative, or there is no start.
        BudgetError: The best point is outside the ball (`Ball.check`).
    """
    if steps < 0:
        raise InvalidValueError(message("steps", "a number >= 0", steps, "ask for at least one step"))
    best, found, trace = None, reference, list[Step]()
    for restart, start in enumerate([reference] if starts is None else starts):
        update = optimiser(ball, step)
        point = ball.project({name: value.detach().clone() for name, value in start.items()}, reference)
        for index in range(steps + 1):
            here = evaluate(point)
            line = _line(here, index, restart)
            trace.append(line)
            if on_step is not None:
                on_step(line)
            if best is None or rank(line) > rank(best):
                best, found = line, point
            if index == steps or (early_stop and _ended(line)):
                break
            change = update(here.gradients)
            point = ball.project({name: value + change[name] for name, value in point.items()}, reference)
        if early_stop and best is not None and _ended(best):
            break
    if best is None:
        raise InvalidValueError(message("starts", "at least one point", "none", "pass the reference, or nothing"))
    ball.check(found, reference)
    return Outcome(parameters=found, best=best, trace=tuple(trace))


def rank(line: Step) -> tuple[bool, bool, float, float]:
    """What makes a point better: success, then an unambiguous one, then the score, and the loss only between equals."""
    return line.success, line.unambiguous, line.score, -line.loss


def _ended(line: Step) -> bool:
    """Whether a search that stops early stops here."""
    return line.success and line.unambiguous


def _line(found: Evaluation, index: int, restart: int) -> Step:
    zeros = total = 0
    for name, gradient in found.gradients.items():
        if not bool(torch.isfinite(gradient).all()):
            raise InvalidValueError(
                message(
                    f"gradient of {name}", "finite numbers", "NaN or infinity", "look at the renderer and the objective"
                )
            )
        zeros, total = zeros + int((gradient == 0).sum()), total + gradient.numel()
    if not math.isfinite(found.loss):
        raise InvalidValueError(message("loss", "a finite number", found.loss, "look at the objective"))
    return Step(
        index=index,
        loss=found.loss,
        score=found.score,
        success=found.success,
        unambiguous=found.unambiguous,
        zero_gradient_fraction=zeros / total if total else 1.0,
        restart=restart,
    )
