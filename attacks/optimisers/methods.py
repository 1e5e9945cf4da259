"""How a search moves from one point to the next: along gradients, or without them.

Each is a function of `SearchSettings` that makes an `attacks.search.loop.Optimiser`.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from attacks.optimisers import Schedule
from attacks.search.budget import Budget
from attacks.search.loop import Evaluation, Memory, Optimiser
from attacks.search.parameters import Parameters

LENGTHS: dict[Schedule, Callable[[float], float]] = {
    "constant": lambda share: 1.0,
    "linear": lambda share: 1.0 - share,
    "cosine": lambda share: 0.5 * (1.0 + math.cos(math.pi * share)),
}
"""Factor of the step's length by the share of the steps that are done, in [0, 1)."""

_RESTARTS = 1 << 8
_STEPS = 1 << 20
"""Bounds of what becomes one number for a generator's seed."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SearchSettings:
    """A search as its optimiser sees it."""

    ball: Budget  # what the parameters may not leave
    # its centre, one tensor for each parameter; the first dimension is the Gaussian
    reference: Parameters
    positions: Tensor  # (N, 3) means of the clean object's Gaussians, world units
    # length of a step for each parameter, in the norm of the ball
    step: Mapping[str, float]
    steps: int  # number of steps of a run
    # share of the sum of earlier gradients that is kept at each step, in [0, 1)
    momentum: float = 0.0
    schedule: Schedule = "constant"  # how steps become shorter
    power: float = 1.0  # of the gradients' absolute values, in [0, 1]
    seed: int = 0  # of everything random

    def generator(self, memory: Memory) -> Generator:
        """Random numbers of one step."""
        run = self.seed * _RESTARTS + memory.restart % _RESTARTS
        return Generator().manual_seed(run * _STEPS + memory.index)

    def project(self, parameters: Parameters) -> Parameters:
        """The nearest parameters inside the ball."""
        return self.ball.project(parameters, self.reference)

    @property
    def level(self) -> dict[str, float]:
        """Size of each coefficient's change where all have the same and the ball is
        full, by parameter.
        """
        return {name: self.ball.radius[name] * unit for name, unit in self.unit.items()}

    @property
    def unit(self) -> dict[str, float]:
        """The same where the ball has a radius of 1: 1 of linf, 1 over the root of the
        number of coefficients of l2.
        """
        ones = {name: torch.ones_like(value) for name, value in self.reference.items()}
        sizes = self.ball.measure(
            ones, {name: torch.zeros_like(value) for name, value in ones.items()}
        )
        return {name: 1 / size if size else 0.0 for name, size in sizes.items()}


def normalised(gradients: Parameters) -> Parameters:
    """Each gradient over its mean absolute value; zero stays zero."""
    units = {}
    for name, gradient in gradients.items():
        size = gradient.abs().mean() if gradient.numel() else gradient.new_zeros(())
        units[name] = gradient / size if float(size) > 0 else gradient
    return units


def momentum(settings: SearchSettings) -> Optimiser:
    """Steps against the steepest direction of a decaying sum of gradients: MI-FGSM
    (Dong et al. 2018) in any norm.

    Each gradient is divided by its mean absolute value before it is added, so that no
    single image outweighs the others; the paper divides by the sum, which only
    scales. Without momentum there is nothing to add, and gradients stay as they are:
    with the constant schedule this is PGD (Madry et al. 2018). A power between 0 and 1
    makes small gradients count for more: the direction is then the steepest one of the
    l_p norm with p = 1 + 1 / power, between that of l2 (1) and that of linf (0).
    """
    decay = settings.momentum
    power = settings.power

    def update(
        point: Parameters, here: Evaluation, memory: Memory
    ) -> Parameters | None:
        gradients = here.gradients
        before = memory.tensors.get("velocity", {})
        if power != 1:
            gradients = {
                name: value.sign() * value.abs() ** power
                for name, value in gradients.items()
            }
        velocity = {
            name: unit + decay * before[name] if name in before else unit
            for name, unit in (normalised(gradients) if decay else gradients).items()
        }
        factor = LENGTHS[settings.schedule](memory.index / settings.steps)
        directions = settings.ball.steepest(velocity)
        memory.tensors = {"velocity": velocity}
        return {
            name: value - settings.step[name] * factor * directions[name]
            for name, value in point.items()
        }

    return update


def fgsm(settings: SearchSettings) -> Optimiser:
    """One step as long as the radius, and no other: FGSM (Goodfellow et al. 2015) in
    any norm.

    From a random start it is what "Fast is better than free" (Wong et al. 2020) trains
    against.
    """

    def update(
        point: Parameters, here: Evaluation, memory: Memory
    ) -> Parameters | None:
        if memory.index:
            return None
        directions = settings.ball.steepest(here.gradients)
        return {
            name: value - settings.ball.radius[name] * directions[name]
            for name, value in point.items()
        }

    return update


_SQUARE_DECAY = 0.99


def adam(settings: SearchSettings) -> Optimiser:
    """Steps of Adam (Kingma and Ba 2015) on normalised gradients, their length falling
    by a schedule.

    A coefficient whose gradient changes its sign from view to view moves little, where
    a sign step moves it by as much as any other. Where every gradient is steady the
    step has its full length in the norm of the ball, and every coefficient the same
    share of it.
    """
    decay = settings.momentum
    unit = settings.unit

    def update(
        point: Parameters, here: Evaluation, memory: Memory
    ) -> Parameters | None:
        index = memory.index + 1
        velocity = {}
        square = {}
        moved = {}
        factor = LENGTHS[settings.schedule](memory.index / settings.steps)
        # corrections of the zero start
        first = 1 - decay**index
        second = 1 - _SQUARE_DECAY**index
        velocities = memory.tensors.get("velocity", {})
        squares = memory.tensors.get("square", {})
        for name, slope in normalised(here.gradients).items():
            velocity[name] = decay * velocities.get(name, 0.0) + (1 - decay) * slope
            square[name] = (
                _SQUARE_DECAY * squares.get(name, 0.0) + (1 - _SQUARE_DECAY) * slope**2
            )
            size = (square[name] / second).sqrt().clamp(min=1e-12)
            length = settings.step[name] * factor * unit[name]
            moved[name] = point[name] - length * (velocity[name] / first) / size
        memory.tensors = {"velocity": velocity, "square": square}
        return moved

    return update


_FIRST = 22
_SHRINK = 3
_LEAST = 6
"""The first interval between checkpoints, what each next one is shorter by, the
shortest: hundredths of all steps.
"""
_ENOUGH = 0.75
"""Share of an interval's steps in which the loss has to fall, rho in the paper."""


def checkpoints(steps: int) -> list[int]:
    """The steps after which APGD asks about the length."""
    percent = _FIRST
    interval = _FIRST
    numbers = []
    while percent < 100:
        numbers.append(-(-percent * steps // 100))
        interval = max(interval - _SHRINK, _LEAST)
        percent += interval
    return list(dict.fromkeys(number for number in numbers if number < steps))


def apgd(settings: SearchSettings) -> Optimiser:
    """APGD, which needs no step length (Croce and Hein, "Reliable Evaluation of
    Adversarial Robustness", ICML 2020).

    It begins with steps of twice the radius, with momentum: the share of the last move
    that is kept, 1 - alpha in the paper. At checkpoints it asks whether the loss fell
    in enough of the last steps, and whether the best loss fell at all. If not, it
    halves the step and goes on from the best point. Here the loss falls, where the
    paper's rises.
    """
    asked = checkpoints(settings.steps)
    ball = settings.ball

    def update(
        point: Parameters, here: Evaluation, memory: Memory
    ) -> Parameters | None:
        index = memory.index
        tensors = memory.tensors
        numbers = memory.numbers = {
            "length": 2.0,
            "best": here.loss,
            "last": here.loss,
            "fell": 0.0,
            **memory.numbers,
        }
        numbers["fell"] += here.loss < numbers["last"]
        numbers["last"] = here.loss
        if not index or here.loss < numbers["best"]:
            numbers["best"] = here.loss
            tensors |= {"best": point, "slope": here.gradients}
        start = point
        slope = here.gradients
        if index in asked:
            before = asked[: asked.index(index)][-1:] or [0]
            few = numbers["fell"] < _ENOUGH * (index - before[0])
            stuck = (numbers["length"], numbers["best"]) == (
                numbers.get("length_then"),
                numbers.get("best_then"),
            )
            numbers |= {
                "fell": 0.0,
                "length_then": numbers["length"],
                "best_then": numbers["best"],
            }
            if few or stuck:
                numbers["length"] /= 2
                start = tensors["best"]
                slope = tensors["slope"]
        directions = ball.steepest(slope)
        last = tensors.get("last", start)
        kept = settings.momentum if index else 0.0
        goals = settings.project(
            {
                name: (
                    start[name]
                    - numbers["length"] * ball.radius[name] * directions[name]
                )
                for name in start
            }
        )
        tensors["last"] = start
        return {
            name: (
                value + (1 - kept) * (goals[name] - value) + kept * (value - last[name])
            )
            for name, value in start.items()
        }

    return update


_ROUNDS = 4
"""Weights that C&W tries, one after the other, each with as many of the steps."""
_GROWTH = 10.0
"""Factor of the weight after a round without success, as long as none had one."""


def cw(settings: SearchSettings) -> Optimiser:
    """Steps of Adam on a weight times the loss plus the squared size of the change, in
    rounds of one weight each.

    After Carlini and Wagner, "Towards Evaluating the Robustness of Neural Networks"
    (S&P 2017). There results may be of any size; here every point is projected into the
    ball as well, so that its budget is that of the other attacks.

    At weight 1 both pull alike at the edge of an evenly filled ball, if the loss is as
    steep there as at the start. A round without a success makes the weight ten times as
    large, one with a success looks between this weight and the largest that failed.
    Each begins at the run's first point, whose gradient is kept, with steps as long as
    if it were the whole search. Where steps are not judged one by one
    (`dagger --region`) the weight only grows.
    """
    length = math.ceil(settings.steps / _ROUNDS)
    step = {
        name: size * settings.steps / length for name, size in settings.step.items()
    }
    inner = adam(
        dataclasses.replace(settings, step=step, steps=length, schedule="linear")
    )
    edge = {
        name: size * math.sqrt(settings.reference[name].numel())
        for name, size in settings.level.items()
    }

    def update(
        point: Parameters, here: Evaluation, memory: Memory
    ) -> Parameters | None:
        tensors = memory.tensors
        numbers = memory.numbers = {
            "weight": 1.0,
            "low": 0.0,
            "high": 0.0,
            "won": 0.0,
            **memory.numbers,
        }
        numbers["won"] = max(
            numbers["won"], float(here.verdict is not None and here.verdict.success)
        )
        slope = here.gradients
        if not memory.index:
            tensors |= {"first": point, "slope": slope}
        elif memory.index % length == 0:
            numbers |= _next_weight(numbers)
            point = tensors["first"]
            slope = tensors["slope"]
            tensors = {k: tensors[k] for k in ("first", "slope")}
        total = {}
        for name, gradient in slope.items():
            steepness = float(tensors["slope"][name].norm())
            size = edge[name]
            if size:
                pull = (point[name] - settings.reference[name]) / size
            else:
                pull = torch.zeros_like(gradient)
            total[name] = pull + (
                numbers["weight"] / steepness * gradient if steepness else 0.0
            )
        within = Memory(
            index=memory.index % length, restart=memory.restart, tensors=tensors
        )
        moved = inner(point, dataclasses.replace(here, gradients=total), within)
        memory.tensors = {**tensors, **within.tensors}
        return moved

    return update


def _next_weight(numbers: dict[str, float]) -> dict[str, float]:
    """The weight after a round, the largest that failed and the smallest that won; 0
    stands for none of them yet.
    """
    weight = numbers["weight"]
    low = numbers["low"]
    high = numbers["high"]
    low, high = (low, weight) if numbers["won"] else (weight, high)
    following = (
        weight * _GROWTH
        if not high
        else math.sqrt(low * high)
        if low
        else high / _GROWTH
    )
    return {"weight": following, "low": low, "high": high, "won": 0.0}


# Searches without gradients know the loss alone, so no gradient can mislead them. One
# that does as well as an attack with gradients says that these gradients are no good:
# AutoAttack's sign of doubt.

_FIRST_SHARE = 0.8
"""Share of the object's Gaussians in the first block."""
_HALVED_AT = (0.001, 0.005, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8)
"""Shares of the steps after which blocks are half as large: those of the paper, for any
number of steps.
"""


def square(settings: SearchSettings) -> Optimiser:
    """Square Attack (Andriushchenko et al. 2020) on the rows of a splat.

    The paper changes a square of pixels by one colour. Here a block is a random
    Gaussian of the object and those nearest to it, by their means. All Gaussians of a
    block get the same change: each coefficient moves up or down, at random, by what
    fills the ball evenly. In linf this is the radius, as in the paper. In l2 every
    coefficient has the same share of the radius; the paper moves mass between windows
    there, which this does not. A block is kept if the loss falls. Blocks become
    smaller.
    """
    level = settings.level

    def update(
        point: Parameters, here: Evaluation, memory: Memory
    ) -> Parameters | None:
        best = _best(point, here, memory)
        generator = settings.generator(memory)
        positions = settings.positions
        halvings = sum(memory.index >= share * settings.steps for share in _HALVED_AT)
        count = max(1, round(_FIRST_SHARE / 2**halvings * len(positions)))
        centre = positions[int(torch.randint(len(positions), (), generator=generator))]
        block = (positions - centre).square().sum(1).topk(count, largest=False).indices
        moved = {}
        for name, value in best.items():
            signs = (
                torch.randint(0, 2, value.shape[1:], generator=generator).to(value) * 2
                - 1
            )
            is_of_gaussians = len(value) == len(positions)
            rows = block if is_of_gaussians else slice(None)
            moved[name] = value.clone()
            moved[name][rows] = settings.reference[name][rows] + level[name] * signs
        return moved

    return update


def random_points(settings: SearchSettings) -> Optimiser:
    """Points at random: every second one from the whole ball, the others within a step
    of the best one so far.
    """
    ball, near = settings.ball, dataclasses.replace(settings.ball, radius=settings.step)

    def update(
        point: Parameters, here: Evaluation, memory: Memory
    ) -> Parameters | None:
        best = _best(point, here, memory)
        generator = settings.generator(memory)
        if memory.index % 2:
            return near.uniform(best, generator)
        return ball.uniform(settings.reference, generator)

    return update


def _best(point: Parameters, here: Evaluation, memory: Memory) -> Parameters:
    """The point of the lowest loss so far, which the memory keeps."""
    if here.loss < memory.numbers.get("best", math.inf):
        memory.tensors = {"best": point}
        memory.numbers = {"best": here.loss}
    return memory.tensors["best"]
