"""What a step of projected gradient descent does with the gradient: momentum, and steps that become shorter.

They go into `pgd(optimiser=...)`. A run's memory is a value (`OptimiserState`), so that a run can be taken up again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from attacks.limits import Schedule
from attacks.pgd import START, Ball, Optimiser, OptimiserState, Parameters, Update

LENGTHS: dict[Schedule, Callable[[float], float]] = {
    "constant": lambda share: 1.0,
    "linear": lambda share: 1.0 - share,
    "cosine": lambda share: 0.5 * (1.0 + math.cos(math.pi * share)),
}
"""Factor of the step's length by the share of the steps that are done, in [0, 1)."""


class MomentumDescent:
    """Steps against the steepest direction of a decaying sum of gradients: MI-FGSM (Dong et al. 2018) in any norm.

    Each gradient is divided by its mean absolute value before it is added, so that no single picture outweighs the
    others; the paper divides by the sum, which only scales. Without decay there is nothing to add, and gradients stay
    as they are: with the constant schedule these are plain steps of fixed length (Madry et al. 2018). A power
    between 0 and 1 makes small gradients count for more: the direction is then the steepest one of the l_p norm with
    p = 1 + 1 / power, between that of l2 (1) and that of linf (0).

    Attributes:
        state: What it remembers; set it to go on with another run's.
    """

    def __init__(
        self,
        ball: Ball,
        step: Mapping[str, float],
        *,
        decay: float,
        schedule: Schedule,
        steps: int,
        power: float = 1.0,
        state: OptimiserState = START,
    ) -> None:
        """A run at its beginning, or where `state` left it."""
        self.state = state
        self._ball, self._step, self._power = ball, dict(step), power
        self._decay, self._length, self._steps = decay, LENGTHS[schedule], steps

    def __call__(self, gradients: Parameters) -> Parameters:
        """The change of the parameters."""
        before = self.state.velocity
        raised = self._raised(gradients)
        velocity = {
            name: unit + self._decay * before[name] if name in before else unit
            for name, unit in (normalised(raised) if self._decay else raised).items()
        }
        factor = self._length(self.state.index / self._steps)
        self.state = OptimiserState(index=self.state.index + 1, velocity=velocity)
        directions = self._ball.steepest(velocity)
        return {name: -self._step[name] * factor * direction for name, direction in directions.items()}

    def _raised(self, gradients: Parameters) -> Parameters:
        """Gradients whose absolute values are raised to the power."""
        if self._power == 1:
            return gradients
        return {name: gradient.sign() * gradient.abs() ** self._power for name, gradient in gradients.items()}


class AdamDescent:
    """Steps of Adam (Kingma and Ba 2015) on normalised gradients, their length falling by a schedule.

    A coefficient whose gradient changes its sign from view to view moves little, where a sign step moves it by as much
    as any other. So less of the change is noise. The step does not depend on the norm of the ball; its length is that
    of a coefficient whose gradient is steady.

    Attributes:
        state: What it remembers; set it to go on with another run's.
    """

    def __init__(
        self,
        step: Mapping[str, float],
        *,
        decay: float,
        schedule: Schedule,
        steps: int,
        state: OptimiserState = START,
        square_decay: float = 0.99,
    ) -> None:
        """A run at its beginning, or where `state` left it."""
        self.state = state
        self._step, self._decay, self._square_decay = dict(step), decay, square_decay
        self._length, self._steps = LENGTHS[schedule], steps

    def __call__(self, gradients: Parameters) -> Parameters:
        """The change of the parameters."""
        index, velocity, square, change = self.state.index + 1, {}, {}, {}
        factor = self._length(self.state.index / self._steps)
        first, second = 1 - self._decay**index, 1 - self._square_decay**index  # corrections of the zero start
        for name, unit in normalised(gradients).items():
            before, squares = self.state.velocity.get(name, 0.0), self.state.square.get(name, 0.0)
            velocity[name] = self._decay * before + (1 - self._decay) * unit
            square[name] = self._square_decay * squares + (1 - self._square_decay) * unit**2
            size = (square[name] / second).sqrt().clamp(min=1e-12)
            change[name] = -self._step[name] * factor * (velocity[name] / first) / size
        self.state = OptimiserState(index=index, velocity=velocity, square=square)
        return change


def normalised(gradients: Parameters) -> Parameters:
    """Each gradient over its mean absolute value; zero stays zero."""
    found = {}
    for name, gradient in gradients.items():
        size = gradient.abs().mean() if gradient.numel() else gradient.new_zeros(())
        found[name] = gradient / size if float(size) > 0 else gradient
    return found


def momentum(*, decay: float, schedule: Schedule, steps: int, power: float = 1.0) -> Optimiser:
    """Momentum with steps of falling length, for `pgd`; each run begins without memory.

    Args:
        decay: Share of the sum of earlier gradients that is kept at each step, in [0, 1).
        schedule: How the steps become shorter.
        steps: Number of steps of a run.
        power: Of the gradients' absolute values, in [0, 1]; see `MomentumDescent`.
    """

    def optimiser(ball: Ball, step: Mapping[str, float], state: OptimiserState) -> Update:
        return MomentumDescent(ball, step, decay=decay, schedule=schedule, steps=steps, power=power, state=state)

    return optimiser


def adam(*, decay: float, schedule: Schedule, steps: int) -> Optimiser:
    """Adam with steps of falling length, for `pgd`.

    Args:
        decay: Share of the earlier gradients that is kept at each step, in [0, 1).
        schedule: How the steps become shorter.
        steps: Number of steps of a run.
    """

    def optimiser(ball: Ball, step: Mapping[str, float], state: OptimiserState) -> Update:
        return AdamDescent(step, decay=decay, schedule=schedule, steps=steps, state=state)

    return optimiser
