"""A price of the change in the place of a wall: after Carlini and Wagner, "Towards Evaluating Robustness" (S&P 2017).

The paper minimises the distance plus a weight times the loss, and looks for the weight by bisection. Its results may be
of any size. Here every point is projected into the ball as well, so that its budget is that of the other attacks.
"""

import dataclasses
import math

import torch

from attacks.optimisers.descent import adam
from attacks.optimisers.settings import SearchSettings
from attacks.search import Evaluation, Optimiser, OptimiserState, Parameters

_ROUNDS = 4
"""Weights that are tried, one after the other, each with as many of the steps."""

_GROWTH = 10.0
"""Factor of the weight after a round without success, as long as none had one."""


def cw(settings: SearchSettings) -> Optimiser:
    """Steps of Adam on a weight times the loss plus the squared size of the change, in rounds of one weight each.

    At weight 1 both pull alike at the edge of an evenly filled ball, if the loss is as steep there as at the start. A
    round without a success makes the weight ten times as large, one with a success looks between this weight and the
    largest that failed. Each begins at the run's first point, whose gradient is kept, with steps as long as if it were
    the whole search. Where steps are not judged one by one (`dagger --region`) the weight only grows.
    """
    length = math.ceil(settings.steps / _ROUNDS)
    step = {name: size * settings.steps / length for name, size in settings.step.items()}
    inner = adam(dataclasses.replace(settings, step=step, steps=length, schedule="linear"))
    edge = {name: size * math.sqrt(settings.reference[name].numel()) for name, size in settings.level.items()}

    def update(point: Parameters, here: Evaluation, memory: OptimiserState) -> tuple[Parameters | None, OptimiserState]:
        tensors, numbers = dict(memory.tensors), {"weight": 1.0, "low": 0.0, "high": 0.0, "won": 0.0, **memory.numbers}
        numbers["won"] = max(numbers["won"], float(here.verdict is not None and here.verdict.success))
        slope = here.gradients
        if not memory.index:
            tensors |= {"first": point, "slope": slope}
        elif memory.index % length == 0:
            numbers |= _next_weight(numbers)
            point, slope, tensors = tensors["first"], tensors["slope"], {k: tensors[k] for k in ("first", "slope")}
        total = {}
        for name, gradient in slope.items():
            steepness, size = float(tensors["slope"][name].norm()), edge[name]
            pull = (point[name] - settings.reference[name]) / size if size else torch.zeros_like(gradient)
            total[name] = pull + (numbers["weight"] / steepness * gradient if steepness else 0.0)
        within = OptimiserState(index=memory.index % length, restart=memory.restart, tensors=tensors)
        moved, after = inner(point, dataclasses.replace(here, gradients=total), within)
        return moved, memory.after(tensors={**tensors, **after.tensors}, numbers=numbers)

    return update


def _next_weight(numbers: dict[str, float]) -> dict[str, float]:
    """The weight after a round, the largest that failed and the smallest that won; 0 stands for none of them yet."""
    weight, low, high = numbers["weight"], numbers["low"], numbers["high"]
    low, high = (low, weight) if numbers["won"] else (weight, high)
    following = weight * _GROWTH if not high else math.sqrt(low * high) if low else high / _GROWTH
    return {"weight": following, "low": low, "high": high, "won": 0.0}
