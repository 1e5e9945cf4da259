"""Projected gradient descent on a dictionary of tensors. It knows nothing of splats, pictures or detectors.

PGD after Madry et al., "Towards Deep Learning Models Resistant to Adversarial Attacks", ICLR 2018: steps along the
steepest direction of the ball's norm, each followed by a projection, from one starting point or several. What a step
does with the gradient is a function that can be exchanged (`Optimiser`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError, message

Parameters = dict[str, Tensor]

NOT_JUDGED = -1.0
"""Score of a point that nothing judged."""


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
        score: How near it is, in [0, 1]; `NOT_JUDGED` where nothing judged the point.
        unambiguous: Whether it has its aim and nothing speaks against it; an early stop waits for this.
    """

    loss: float
    gradients: Parameters
    success: bool = False
    score: float = NOT_JUDGED
    unambiguous: bool = False


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Judgement:
    """What a judge says, who looks at some points only.

    Attributes:
        point: The point judged: the one of the search, or what the judge made of it. It may become the outcome.
        success: As in `Evaluation`.
        score: As in `Evaluation`.
        unambiguous: As in `Evaluation`.
    """

    point: Parameters
    success: bool
    score: float
    unambiguous: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One line of the trace.

    Attributes:
        index: 0 is the start of a run; after n steps the index is n.
        loss: Lower is better for the attacker.
        score: In [0, 1], higher is better for the attacker; `NOT_JUDGED` where nothing judged the point.
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


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OptimiserState:
    """What a run remembers between two steps.

    Attributes:
        index: Number of steps done.
        velocity: Decaying sum of normalised gradients, by parameter; empty before the first step.
        square: Decaying sum of their squares (Adam); empty where nothing needs it.
    """

    index: int
    velocity: Parameters
    square: Parameters = field(default_factory=dict)


START = OptimiserState(index=0, velocity={})


class Update(Protocol):
    """From the gradients at a point to the change of the parameters; it may remember the gradients of its run."""

    @property
    def state(self) -> OptimiserState:
        """What it remembers."""
        ...

    def __call__(self, gradients: Parameters) -> Parameters:
        """The change of the parameters."""
        ...


Optimiser = Callable[[Ball, Mapping[str, float], OptimiserState], Update]
"""Makes the `Update` of one run from the ball, the length of a step by parameter, and what it remembers."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SearchState:
    """A search between two steps: all that the rest of it depends on.

    Attributes:
        point: Where it is.
        optimiser: What the optimiser remembers; its index is the number of steps done.
        best: The best point so far; `point` before anything was judged.
        best_line: Its line of the trace; None before anything was judged.
        trace: Every point before `point`.
    """

    point: Parameters
    optimiser: OptimiserState
    best: Parameters
    best_line: Step | None
    trace: tuple[Step, ...]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Hooks:
    """What a search calls while it runs.

    Attributes:
        judge: Judges the point of every `every`-th step and of the last one; then these points alone may become the
            outcome. None leaves the judgement to each evaluation.
        every: Steps between two judgements.
        on_step: Called with every line of the trace as it happens.
        on_state: Called with the search as it stands before every step but the first.
    """

    judge: Callable[[Parameters], Judgement] | None = None
    every: int = 1
    on_step: Callable[[Step], None] | None = None
    on_state: Callable[[SearchState], None] | None = None


def pgd(
    evaluate: Callable[[Parameters], Evaluation],
    reference: Parameters,
    ball: Ball,
    *,
    step: Mapping[str, float],
    steps: int,
    optimiser: Optimiser,
    starts: Iterable[Parameters] | None = None,
    early_stop: bool = True,
    hooks: Hooks | None = None,
    begun: SearchState | None = None,
) -> Outcome:
    """Descend from every start, project after every step, and keep the best point of all.

    Args:
        evaluate: Loss, gradients, success and score at a point; at most steps + 1 calls for each start.
        reference: Centre of the ball, one tensor for each parameter.
        ball: Projection and direction; `Budget` is one.
        step: Length of a step for each parameter, in the ball's norm.
        steps: Number of steps from each start.
        optimiser: What makes a step of the gradient (`attacks.optimisers`); asked anew for each run.
        starts: First point of each run, taken when the run begins; the reference alone if None.
        early_stop: End everything at the first unambiguous success; otherwise take all steps from all starts.
        hooks: What is called while the search runs.
        begun: A search with one start that goes on from here.

    Raises:
        InvalidValueError: A gradient or the loss is not finite, steps is negative, or there is no start.
        BudgetError: The best point is outside the ball (`Ball.check`).
    """
    if steps < 0:
        raise InvalidValueError(message("steps", "a number >= 0", steps, "ask for at least one step"))
    hooks = hooks or Hooks()
    if begun is None:
        begun = SearchState(point=reference, optimiser=START, best=reference, best_line=None, trace=())
        starts = [reference] if starts is None else starts
    else:
        starts = [begun.point]
    best, best_line, trace = begun.best, begun.best_line, list(begun.trace)
    for restart, start in enumerate(starts):
        update = optimiser(ball, step, begun.optimiser)
        point = ball.project({name: value.detach().clone() for name, value in start.items()}, reference)
        for index in range(begun.optimiser.index, steps + 1):
            if hooks.on_state is not None and index > begun.optimiser.index:
                memory = update.state
                hooks.on_state(
                    SearchState(point=point, optimiser=memory, best=best, best_line=best_line, trace=tuple(trace))
                )
            here, judged = _judged(evaluate(point), point, index, steps, hooks)
            line = _line(here, index, restart)
            trace.append(line)
            if hooks.on_step is not None:
                hooks.on_step(line)
            if judged is not None and (best_line is None or rank(line) > rank(best_line)):
                best_line, best = line, judged
            if index == steps or (early_stop and _ended(line)):
                break
            change = update(here.gradients)
            point = ball.project({name: value + change[name] for name, value in point.items()}, reference)
        if early_stop and best_line is not None and _ended(best_line):
            break
    if best_line is None:
        raise InvalidValueError(message("starts", "at least one point", "none", "pass the reference, or nothing"))
    ball.check(best, reference)
    return Outcome(parameters=best, best=best_line, trace=tuple(trace))


def _judged(
    here: Evaluation, point: Parameters, index: int, steps: int, hooks: Hooks
) -> tuple[Evaluation, Parameters | None]:
    """An evaluation with its judgement, and the point that may become the outcome; None where nothing judged it."""
    if hooks.judge is None:
        return here, point
    if index != steps and (index == 0 or index % hooks.every):
        return replace(here, success=False, score=NOT_JUDGED, unambiguous=False), None
    found = hooks.judge(point)
    judged = replace(here, success=found.success, score=found.score, unambiguous=found.unambiguous)
    return judged, found.point


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
