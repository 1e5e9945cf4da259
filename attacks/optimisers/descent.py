"""Steps along gradients: steepest descent with or without momentum, one step alone, and Adam.

A run's memory is a value (`OptimiserState`), so that a run can be taken up again.
"""

from attacks.optimisers.settings import LENGTHS, SearchSettings, normalised
from attacks.search import Evaluation, Optimiser, OptimiserState, Parameters

_SQUARE_DECAY = 0.99


def momentum(settings: SearchSettings) -> Optimiser:
    """Steps against the steepest direction of a decaying sum of gradients: MI-FGSM (Dong et al. 2018) in any norm.

    Each gradient is divided by its mean absolute value before it is added, so that no single picture outweighs the
    others; the paper divides by the sum, which only scales. Without momentum there is nothing to add, and gradients
    stay as they are: with the constant schedule this is PGD (Madry et al. 2018). A power between 0 and 1 makes small
    gradients count for more: the direction is then the steepest one of the l_p norm with p = 1 + 1 / power, between
    that of l2 (1) and that of linf (0).
    """
    decay, power = settings.momentum, settings.power

    def update(point: Parameters, here: Evaluation, memory: OptimiserState) -> tuple[Parameters | None, OptimiserState]:
        gradients, before = here.gradients, memory.tensors.get("velocity", {})
        if power != 1:
            gradients = {name: value.sign() * value.abs() ** power for name, value in gradients.items()}
        velocity = {
            name: unit + decay * before[name] if name in before else unit
            for name, unit in (normalised(gradients) if decay else gradients).items()
        }
        factor = LENGTHS[settings.schedule](memory.index / settings.steps)
        directions = settings.ball.steepest(velocity)
        moved = {name: value - settings.step[name] * factor * directions[name] for name, value in point.items()}
        return moved, memory.after(tensors={"velocity": velocity})

    return update


def fgsm(settings: SearchSettings) -> Optimiser:
    """One step as long as the radius, and no other: FGSM (Goodfellow et al. 2015) in any norm.

    From a random start it is what "Fast is better than free" (Wong et al. 2020) trains against.
    """

    def update(point: Parameters, here: Evaluation, memory: OptimiserState) -> tuple[Parameters | None, OptimiserState]:
        if memory.index:
            return None, memory
        directions = settings.ball.steepest(here.gradients)
        moved = {name: value - settings.ball.radius[name] * directions[name] for name, value in point.items()}
        return moved, memory.after()

    return update


def adam(settings: SearchSettings) -> Optimiser:
    """Steps of Adam (Kingma and Ba 2015) on normalised gradients, their length falling by a schedule.

    A coefficient whose gradient changes its sign from view to view moves little, where a sign step moves it by as much
    as any other. So less of the change is noise. Where every gradient is steady the step has its full length in the
    norm of the ball, and every coefficient the same share of it.
    """
    decay, unit = settings.momentum, settings.unit

    def update(point: Parameters, here: Evaluation, memory: OptimiserState) -> tuple[Parameters | None, OptimiserState]:
        index, velocity, square, moved = memory.index + 1, {}, {}, {}
        factor = LENGTHS[settings.schedule](memory.index / settings.steps)
        first, second = 1 - decay**index, 1 - _SQUARE_DECAY**index  # corrections of the zero start
        velocities, squares = memory.tensors.get("velocity", {}), memory.tensors.get("square", {})
        for name, slope in normalised(here.gradients).items():
            velocity[name] = decay * velocities.get(name, 0.0) + (1 - decay) * slope
            square[name] = _SQUARE_DECAY * squares.get(name, 0.0) + (1 - _SQUARE_DECAY) * slope**2
            size = (square[name] / second).sqrt().clamp(min=1e-12)
            length = settings.step[name] * factor * unit[name]
            moved[name] = point[name] - length * (velocity[name] / first) / size
        return moved, memory.after(tensors={"velocity": velocity, "square": square})

    return update
