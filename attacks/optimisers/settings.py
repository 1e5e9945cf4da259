"""What an optimiser may know of its search before it begins, and what several of them need."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from attacks.budgets import Budget
from attacks.limits import Schedule
from attacks.search import OptimiserState, Parameters

LENGTHS: dict[Schedule, Callable[[float], float]] = {
    "constant": lambda share: 1.0,
    "linear": lambda share: 1.0 - share,
    "cosine": lambda share: 0.5 * (1.0 + math.cos(math.pi * share)),
}
"""Factor of the step's length by the share of the steps that are done, in [0, 1)."""

_RESTARTS, _STEPS = 1 << 8, 1 << 20
"""Bounds of what becomes one number for a generator's seed."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SearchSettings:
    """A search as its optimiser sees it."""

    ball: Budget  # what the parameters may not leave
    reference: Parameters  # its centre, one tensor for each parameter; the first dimension is the Gaussian
    positions: Tensor  # (N, 3) means of the clean object's Gaussians, world units
    step: Mapping[str, float]  # length of a step for each parameter, in the norm of the ball
    steps: int  # number of steps of a run
    momentum: float = 0.0  # share of the sum of earlier gradients that is kept at each step, in [0, 1)
    schedule: Schedule = "constant"  # how steps become shorter
    power: float = 1.0  # of the gradients' absolute values, in [0, 1]
    seed: int = 0  # of everything random

    def generator(self, memory: OptimiserState) -> Generator:
        """Random numbers of one step; the same ones again where a search is taken up again."""
        run = self.seed * _RESTARTS + memory.restart % _RESTARTS
        return Generator().manual_seed(run * _STEPS + memory.index)

    def project(self, parameters: Parameters) -> Parameters:
        """The nearest parameters inside the ball."""
        return self.ball.project(parameters, self.reference)

    @property
    def level(self) -> dict[str, float]:
        """Size of each coefficient's change where all have the same and the ball is full, by parameter."""
        return {name: self.ball.radius[name] * unit for name, unit in self.unit.items()}

    @property
    def unit(self) -> dict[str, float]:
        """The same where the ball has a radius of 1: 1 of linf, 1 over the root of the number of coefficients of l2."""
        ones = {name: torch.ones_like(value) for name, value in self.reference.items()}
        sizes = self.ball.measure(ones, {name: torch.zeros_like(value) for name, value in ones.items()})
        return {name: 1 / size if size else 0.0 for name, size in sizes.items()}


def normalised(gradients: Parameters) -> Parameters:
    """Each gradient over its mean absolute value; zero stays zero."""
    units = {}
    for name, gradient in gradients.items():
        size = gradient.abs().mean() if gradient.numel() else gradient.new_zeros(())
        units[name] = gradient / size if float(size) > 0 else gradient
    return units
