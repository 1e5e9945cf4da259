"""APGD: PGD that needs no step length (Croce and Hein, "Reliable Evaluation of Adversarial Robustness", ICML 2020).

It begins with steps of twice the radius, with momentum. At checkpoints, which become denser, it asks whether the loss
fell in enough of the last steps, and whether the best loss fell at all. If not, it halves the step and goes on from the
best point. Here the loss falls, where the paper's rises.
"""

from attacks.optimisers.settings import SearchSettings
from attacks.search import Evaluation, Optimiser, OptimiserState, Parameters

_FIRST, _SHRINK, _LEAST = 22, 3, 6
"""The first interval between checkpoints, what each next one is shorter by, the shortest: hundredths of all steps."""

_ENOUGH = 0.75
"""Share of an interval's steps in which the loss has to fall, rho in the paper."""


def checkpoints(steps: int) -> list[int]:
    """The steps after which the length is asked about."""
    percent, interval, numbers = _FIRST, _FIRST, []
    while percent < 100:
        numbers.append(-(-percent * steps // 100))
        interval = max(interval - _SHRINK, _LEAST)
        percent += interval
    return list(dict.fromkeys(number for number in numbers if number < steps))


def apgd(settings: SearchSettings) -> Optimiser:
    """The steps of APGD; momentum is the share of the last move that is kept, 1 - alpha in the paper."""
    asked, ball = checkpoints(settings.steps), settings.ball

    def update(point: Parameters, here: Evaluation, memory: OptimiserState) -> tuple[Parameters | None, OptimiserState]:
        index, tensors = memory.index, dict(memory.tensors)
        numbers = {"length": 2.0, "best": here.loss, "last": here.loss, "fell": 0.0, **memory.numbers}
        numbers["fell"] += here.loss < numbers["last"]
        numbers["last"] = here.loss
        if not index or here.loss < numbers["best"]:
            numbers["best"] = here.loss
            tensors |= {"best": point, "slope": here.gradients}
        start, slope = point, here.gradients
        if index in asked:
            before = asked[: asked.index(index)][-1:] or [0]
            few = numbers["fell"] < _ENOUGH * (index - before[0])
            stuck = (numbers["length"], numbers["best"]) == (numbers.get("length_then"), numbers.get("best_then"))
            numbers |= {"fell": 0.0, "length_then": numbers["length"], "best_then": numbers["best"]}
            if few or stuck:
                numbers["length"] /= 2
                start, slope = tensors["best"], tensors["slope"]
        directions, last = ball.steepest(slope), tensors.get("last", start)
        kept = settings.momentum if index else 0.0
        aims = settings.project(
            {name: start[name] - numbers["length"] * ball.radius[name] * directions[name] for name in start}
        )
        moved = {
            name: value + (1 - kept) * (aims[name] - value) + kept * (value - last[name])
            for name, value in start.items()
        }
        return moved, memory.after(tensors={**tensors, "last": start}, numbers=numbers)

    return update
