"""What a step of projected gradient descent does with the gradient: momentum or Adam, in steps that become shorter.

They go into `pgd(optimiser=...)`. A run's memory is a value (`OptimiserState`), so that a run can be taken up again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from attacks.limits import Schedule
from attacks.pgd import Ball, Optimiser, OptimiserState, Parameters

LENGTHS: dict[Schedule, Callable[[float], float]] = {
    "constant": lambda share: 1.0,
    "linear": lambda share: 1.0 - share,
    "cosine": lambda share: 0.5 * (1.0 + math.cos(math.pi * share)),
}
"""Factor of the step's length by the share of the steps that are done, in [0, 1)."""

_SQUARE_DECAY = 0.99


def momentum(
    ball: Ball, step: Mapping[str, float], *, decay: float, schedule: Schedule, steps: int, power: float = 1.0
) -> Optimiser:
    """Steps against the steepest direction of a decaying sum of gradients: MI-FGSM (Dong et al. 2018) in any norm.

    Each gradient is divided by its mean absolute value before it is added, so that no single picture outweighs the
    others; the paper divides by the sum, which only scales. Without decay there is nothing to add, and gradients stay
    as they are: with the constant schedule these are plain steps of fixed length (Madry et al. 2018). A power
    between 0 and 1 makes small gradients count for more: the direction is then the steepest one of the l_p norm with
    p = 1 + 1 / power, between that of l2 (1) and that of linf (0).

    Args:
        ball: Its norm says which direction is steepest.
        step: Length of a step for each parameter, in that norm.
        decay: Share of the sum of earlier gradients that is kept at each step, in [0, 1).
        schedule: How the steps become shorter.
        steps: Number of steps of a run.
        power: Of the gradients' absolute values, in [0, 1].
    """

    def update(gradients: Parameters, memory: OptimiserState) -> tuple[Parameters, OptimiserState]:
        if power != 1:
            gradients = {name: value.sign() * value.abs() ** power for name, value in gradients.items()}
        velocity = {
            name: unit + decay * memory.velocity[name] if name in memory.velocity else unit
            for name, unit in (normalised(gradients) if decay else gradients).items()
        }
        factor = LENGTHS[schedule](memory.index / steps)
        directions = ball.steepest(velocity)
        change = {name: -step[name] * factor * direction for name, direction in directions.items()}
        return change, OptimiserState(index=memory.index + 1, velocity=velocity)

    return update


def adam(step: Mapping[str, float], *, decay: float, schedule: Schedule, steps: int) -> Optimiser:
    """Steps of Adam (Kingma and Ba 2015) on normalised gradients, their length falling by a schedule.

    A coefficient whose gradient changes its sign from view to view moves little, where a sign step moves it by as much
    as any other. So less of the change is noise. The step does not depend on the norm of the ball; its length is that
    of a coefficient whose gradient is steady.

    Args:
        step: Length of the first step for each parameter.
        decay: Share of the earlier gradients that is kept at each step, in [0, 1).
        schedule: How the steps become shorter.
        steps: Number of steps of a run.
    """

    def update(gradients: Parameters, memory: OptimiserState) -> tuple[Parameters, OptimiserState]:
        index, velocity, square, change = memory.index + 1, {}, {}, {}
        factor = LENGTHS[schedule](memory.index / steps)
        first, second = 1 - decay**index, 1 - _SQUARE_DECAY**index  # corrections of the zero start
        for name, unit in normalised(gradients).items():
            before, squares = memory.velocity.get(name, 0.0), memory.square.get(name, 0.0)
            velocity[name] = decay * before + (1 - decay) * unit
            square[name] = _SQUARE_DECAY * squares + (1 - _SQUARE_DECAY) * unit**2
            size = (square[name] / second).sqrt().clamp(min=1e-12)
            change[name] = -step[name] * factor * (velocity[name] / first) / size
        return change, OptimiserState(index=index, velocity=velocity, square=square)

    return update


def normalised(gradients: Parameters) -> Parameters:
    """Each gradient over its mean absolute value; zero stays zero."""
    units = {}
    for name, gradient in gradients.items():
        size = gradient.abs().mean() if gradient.numel() else gradient.new_zeros(())
        units[name] = gradient / size if float(size) > 0 else gradient
    return units
