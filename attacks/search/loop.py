"""Projected gradient descent on a dictionary of tensors, and the ball that it may not
leave.

It knows nothing of splats, images or detectors. PGD after Madry et al., "Towards Deep
Learning Models Resistant to Adversarial Attacks", ICLR 2018: steps along the steepest
direction of the ball's norm, each followed by a projection, from one starting point or
several. How the next point is chosen is a function that can be exchanged (`Optimiser`),
so that every attack is this one loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import torch

from attacks.search.budget import Budget
from attacks.search.parameters import Parameters
from mi_splat.errors import InvalidValueError

NOT_JUDGED = -1.0
"""Score of a point that nothing judged."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the aim is reached in one view or at one point of a search, judged on
    reports and not on the loss.

    Attributes:
        success: The aim is reached.
        score: How near it is, in [0, 1].
        unambiguous: The aim is reached and nothing speaks against it: no other class is
            reported on the object with more confidence than the one wanted. An early
            stop waits for this.
    """

    success: bool
    score: float
    unambiguous: bool


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Evaluation:
    """What the attacker knows about one point."""

    loss: float  # lower is better for the attacker
    # derivative of the loss by each parameter; empty where nobody asks for it
    gradients: Parameters
    # of the point; None where a judge looks at some points only
    verdict: Verdict | None = None
    error: float = 0.0  # mean squared error of the images, where it has a price


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One line of the trace.

    Attributes:
        index: 0 is the start of a run; after n steps the index is n.
        loss: Lower is better for the attacker.
        score: In [0, 1], higher is better for the attacker; `NOT_JUDGED` where nothing
            judged the point.
        success: Whether the attack has its aim here.
        unambiguous: Whether it has its aim and nothing speaks against it.
        zero_gradient_fraction: Fraction of the gradient's elements that are exactly
            zero; 0 where there is no gradient.
        restart: Number of the run, 0 for the first.
        share: Share of the radius that the change takes.
    """

    index: int
    loss: float
    score: float
    success: bool
    unambiguous: bool
    zero_gradient_fraction: float
    restart: int = 0
    share: float = 0.0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Outcome:
    """The best point of all runs and how it was found."""

    parameters: Parameters  # the best point (`rank`)
    best: Step  # its line of the trace
    trace: tuple[Step, ...]  # every point in order, the starts included
    stopped: bool = False  # whether it was ended before its time by `Hooks.on_step`


@dataclass(slots=True, eq=False, kw_only=True)
class Memory:
    """Of one run; what it keeps from step to step is the optimiser's own, by names of
    its own.
    """

    index: int = 0  # number of steps done
    restart: int = 0  # number of the run
    # what has the shape of the parameters
    tensors: dict[str, Parameters] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)


Optimiser = Callable[[Parameters, Evaluation, Memory], Parameters | None]
"""From a point, what is known of it and the memory of the run, which it may change, to
the next point.

The next point may be outside the ball, into which it is projected; None ends the run.
See `attacks.optimisers`.
"""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Hooks:
    """What a search calls while it runs.

    Attributes:
        judge: Judges the point of every `every`-th step and of the last one, and gives
            back the point that may become the outcome: this one or what it made of it.
            None leaves the judgement to each evaluation.
        every: Steps between two judgements.
        start: Whether the point where a run begins is judged, too; it becomes the
            outcome only if it is a success.
        on_step: Called with every line of the trace as it happens. Once it says so, the
            search ends where something was judged, with the best point so far.
    """

    judge: Callable[[Parameters], tuple[Parameters, Verdict]] | None = None
    every: int = 1
    start: bool = False
    on_step: Callable[[Step], bool | None] | None = None


def pgd(
    evaluate: Callable[[Parameters], Evaluation],
    reference: Parameters,
    ball: Budget,
    *,
    steps: int,
    optimiser: Optimiser,
    starts: Iterable[Parameters] | None = None,
    early_stop: bool = True,
    smallest: bool = False,
    hooks: Hooks | None = None,
) -> Outcome:
    """Search from every start, project after every step, and keep the best point of
    all.

    Args:
        evaluate: Loss, gradients and verdict at a point; at most steps + 1 calls for
            each start.
        reference: Centre of the ball, one tensor for each parameter.
        ball: Projection and direction; `Budget` is one.
        steps: Number of steps from each start.
        optimiser: How the next point is chosen (`attacks.optimisers`).
        starts: First point of each run, taken when the run begins; the reference alone
            if None.
        early_stop: End everything at the first unambiguous success; otherwise take all
            steps from all starts.
        smallest: Whether the smaller of two successes is the better one, see `rank`.
        hooks: What is called while the search runs.

    Returns:
        The best point of all runs, and every point in order.

    Raises:
        InvalidValueError: A gradient or the loss is not finite, steps is negative, or
            there is no start.
        BudgetError: The best point is outside the ball (`Ball.check`).
    """
    if steps < 0:
        raise InvalidValueError.of(
            "steps", "a number >= 0", steps, "ask for at least one step"
        )
    hooks = hooks or Hooks()
    best = reference
    best_line = None
    trace = list[Step]()
    stopped = False
    for restart, start in enumerate([reference] if starts is None else starts):
        memory = Memory(restart=restart)
        point = start
        for index in range(steps + 1):
            point = ball.project(
                {name: value.detach().clone() for name, value in point.items()},
                reference,
            )
            here = _checked(evaluate(point))
            memory.index = index
            following = None if index == steps else optimiser(point, here, memory)
            judged = point
            verdict = here.verdict if hooks.judge is None else None
            is_due = not index % hooks.every and (index > 0 or hooks.start)
            if hooks.judge is not None and (following is None or is_due):
                judged, verdict = hooks.judge(point)
            line = _line(here, verdict, index, restart, _share(ball, judged, reference))
            trace.append(line)
            stopped = bool(hooks.on_step is not None and hooks.on_step(line)) or stopped
            is_idle_start = hooks.start and index < min(1, steps) and not line.success
            if (
                verdict is not None
                and not is_idle_start
                and (
                    best_line is None
                    or rank(line, smallest) > rank(best_line, smallest)
                )
            ):
                best_line = line
                best = judged
            if (
                following is None
                or (early_stop and _ended(line))
                or (stopped and best_line is not None)
            ):
                break
            point = following
        if best_line is not None and (stopped or (early_stop and _ended(best_line))):
            break
    if best_line is None:
        raise InvalidValueError.of(
            "starts", "at least one point", "none", "pass the reference, or nothing"
        )
    ball.check(best, reference)
    return Outcome(parameters=best, best=best_line, trace=tuple(trace), stopped=stopped)


def rank(line: Step, smallest: bool = False) -> tuple[bool, bool, float, float]:
    """Sort key of points: success, then an unambiguous one, then the score; the loss
    only between equals.
    """
    value = 1.0 - line.share if smallest and line.success else line.score
    return line.success, line.unambiguous, value, -line.loss


def _ended(line: Step) -> bool:
    """Whether a search that stops early stops here."""
    return line.success and line.unambiguous


def _checked(here: Evaluation) -> Evaluation:
    """The evaluation, once its loss and gradients are known to be finite."""
    for name, gradient in here.gradients.items():
        if not bool(torch.isfinite(gradient).all()):
            do = "look at the renderer and the objective"
            raise InvalidValueError.of(
                f"gradient of {name}", "finite numbers", "NaN or infinity", do
            )
    if not math.isfinite(here.loss):
        raise InvalidValueError.of(
            "loss", "a finite number", here.loss, "look at the objective"
        )
    return here


def _share(ball: Budget, parameters: Parameters, reference: Parameters) -> float:
    """Share of its radius that the change takes, of the attribute that takes most; 0
    where none may move.
    """
    sizes = ball.measure(parameters, reference)
    return max(
        (size / ball.radius[name] for name, size in sizes.items() if ball.radius[name]),
        default=0.0,
    )


def _line(
    here: Evaluation, verdict: Verdict | None, index: int, restart: int, share: float
) -> Step:
    zeros = sum(int((gradient == 0).sum()) for gradient in here.gradients.values())
    total = sum(gradient.numel() for gradient in here.gradients.values())
    verdict = verdict or Verdict(success=False, score=NOT_JUDGED, unambiguous=False)
    return Step(
        index=index,
        loss=here.loss,
        score=verdict.score,
        success=verdict.success,
        unambiguous=verdict.unambiguous,
        zero_gradient_fraction=zeros / total if total else 0.0,
        restart=restart,
        share=share,
    )
