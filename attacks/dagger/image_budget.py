"""A budget in pictures: the attack on a distribution of views keeps their PSNR above a limit.

A ball in the units of a file says little about what one sees: the same radius costs few decibels on a hidden Gaussian
and many on the bonnet. With a limit on the pictures the attacker pays for their squared error. The price is a Lagrange
multiplier, which is raised while the pictures are worse than the limit, and lowered while they are better. A point that
is worse than the limit is pulled towards the clean object before it may become the result; one that is better and does
not deceive everywhere may be stretched up to the limit.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

from attacks.search import Ball, Parameters

_MEMORY = 0.8
"""Share of the earlier errors in the decaying mean that the price follows."""

_GAIN, _LOWEST, _HIGHEST = 20.0, 0.02, 100.0
"""Change of the price's logarithm over a whole search whose error is e times the limit; bounds of the price in units of
1 / limit."""

_HALVINGS = 7
"""Of the interval in which the factor of a perturbation is looked for."""

_FARTHEST = 1.5
"""Largest factor by which a perturbation is stretched."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagePrice:
    """What the mean squared error of the pictures costs the attacker.

    Attributes:
        limit: Largest mean squared error wanted, values in [0, 1].
        weight: The multiplier: the loss is the detectors' plus `weight` times the error.
        gain: Change of the weight's logarithm in a step whose error is e times the limit.
        error: Decaying mean of the errors so far; None before the first step.
    """

    limit: float
    weight: float
    gain: float
    error: float | None = None

    @classmethod
    def of(cls, psnr: float, *, steps: int) -> ImagePrice:
        """The price at the beginning of a search: an error at the limit costs 1."""
        limit = 10 ** (-psnr / 10)
        return cls(limit=limit, weight=1 / limit, gain=_GAIN / steps)

    @property
    def now(self) -> float:
        """What an error costs in the next step: more than the weight while errors are above the limit.

        The weight alone follows the errors late, so that these would swing about the limit.
        """
        return self.weight * max(1.0, (self.error or 0.0) / self.limit)

    def after(self, error: float) -> ImagePrice:
        """The price after a step whose pictures had a mean squared error."""
        mean = error if self.error is None else _MEMORY * self.error + (1 - _MEMORY) * error
        excess = math.log(mean / self.limit) if mean > 0 else -1.0
        weight = self.weight * math.exp(self.gain * max(-1.0, min(1.0, excess)))
        bounded = max(_LOWEST, min(_HIGHEST, weight * self.limit)) / self.limit
        return dataclasses.replace(self, weight=bounded, error=mean)


def fitted(
    parameters: Parameters, reference: Parameters, limit: float, error: Callable[[Parameters], float]
) -> Parameters:
    """The parameters, or the farthest point on the way to them from the reference whose error is within the limit."""
    if error(parameters) <= limit:
        return parameters
    low, high = 0.0, 1.0
    farthest = reference
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        point = {name: base + middle * (parameters[name] - base) for name, base in reference.items()}
        if error(point) <= limit:
            low, farthest = middle, point
        else:
            high = middle
    return farthest


def stretched(
    parameters: Parameters, reference: Parameters, ball: Ball, limit: float, error: Callable[[Parameters], float]
) -> Parameters:
    """The farthest point beyond parameters on the line from the reference whose error is within the limit."""
    farther = {name: base + _FARTHEST * (parameters[name] - base) for name, base in reference.items()}

    def inside(point: Parameters) -> float:
        return error(ball.project(point, reference))

    return ball.project(fitted(farther, reference, limit, inside), reference)
