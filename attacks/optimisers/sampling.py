"""Searches without gradients: blocks of neighbouring Gaussians, and points at random.

They know the loss alone, so no gradient can mislead them. One that does as well as an attack with gradients says that
these gradients are no good: AutoAttack's sign of doubt.
"""

import dataclasses
import math

import torch

from attacks.optimisers.settings import SearchSettings
from attacks.search import Evaluation, Optimiser, OptimiserState, Parameters

_FIRST_SHARE = 0.8
"""Share of the object's Gaussians in the first block."""

_HALVED_AT = (0.001, 0.005, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8)
"""Shares of the steps after which blocks are half as large: those of the paper, for any number of steps."""


def square(settings: SearchSettings) -> Optimiser:
    """Square Attack (Andriushchenko et al. 2020) on the rows of a splat.

    The paper changes a square of pixels by one colour. A splat has no grid. Here a block is a random Gaussian of the
    object and those nearest to it, by their means. All Gaussians of a block get the same change: each coefficient moves
    up or down, at random, by what fills the ball evenly. In linf this is the radius, as in the paper. In l2 every
    coefficient has the same share of the radius; the paper moves mass between windows there, which this does not. A
    block is kept if the loss falls. Blocks become smaller.
    """
    level = settings.level

    def update(point: Parameters, here: Evaluation, memory: OptimiserState) -> tuple[Parameters | None, OptimiserState]:
        best, memory = _best(point, here, memory)
        generator, positions = settings.generator(memory), settings.positions
        halvings = sum(memory.index >= share * settings.steps for share in _HALVED_AT)
        count = max(1, round(_FIRST_SHARE / 2**halvings * len(positions)))
        centre = positions[int(torch.randint(len(positions), (), generator=generator))]
        block = (positions - centre).square().sum(1).topk(count, largest=False).indices
        moved = {}
        for name, value in best.items():
            signs = torch.randint(0, 2, value.shape[1:], generator=generator).to(value) * 2 - 1
            moved[name] = value.clone()
            moved[name][block] = settings.reference[name][block] + level[name] * signs
        return moved, memory.after()

    return update


def random_points(settings: SearchSettings) -> Optimiser:
    """Points at random: every second one from the whole ball, the others within a step of the best one so far."""
    near = dataclasses.replace(settings.ball, radius=settings.step)

    def update(point: Parameters, here: Evaluation, memory: OptimiserState) -> tuple[Parameters | None, OptimiserState]:
        best, memory = _best(point, here, memory)
        generator = settings.generator(memory)
        if memory.index % 2:
            return near.uniform(best, generator), memory.after()
        return settings.ball.uniform(settings.reference, generator), memory.after()

    return update


def _best(point: Parameters, here: Evaluation, memory: OptimiserState) -> tuple[Parameters, OptimiserState]:
    """The point of the lowest loss so far, and a memory of it."""
    if here.loss >= memory.numbers.get("best", math.inf):
        return memory.tensors["best"], memory
    return point, dataclasses.replace(memory, tensors={"best": point}, numbers={"best": here.loss})
