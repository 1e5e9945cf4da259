"""Gradients against central finite differences: of the renderer alone, and of the whole chain from Gaussians to loss.

The whole chain has steps that are constant for the gradient: the candidates that a detector or an objective chooses.
So its agreement is measured over directions, by cosine and slope, with a wider tolerance than the renderer's.
"""

import math
from collections.abc import Callable

import torch
from torch import Generator, Tensor

from attacks.dagger.config import DaggerConfig
from attacks.dagger.problem import Problem
from attacks.dagger.sanity.runs import Runs
from attacks.dagger.views import View
from attacks.search import Parameters
from mi_splat.cameras import Camera
from mi_splat.scene import GaussianScene

CONTRAST = 0.8
"""Contrast of the pictures that are differentiated: no pixel is near the clamp at 0 and 1, which has a kink."""

DIRECTIONS = 6
"""Random directions for each seed."""

Value = Callable[[Parameters], float]
"""A function that is differentiated."""

Differentiated = Callable[[Problem, View, DaggerConfig, Parameters, Generator], tuple[Value, Parameters]]
"""A function and its gradients at a point, of a problem in one view; the generator draws what is random about it."""


def random_directions(gradients: Parameters, count: int, generator: Generator) -> list[Parameters]:
    """Random directions of length 1 that move the Gaussians which matter.

    A Gaussian moves as far as the size of its gradient, every one of its components at random: Gaussians out of sight
    stay, and a component that lacks its gradient moves like the others. Directions without any order would change the
    loss so little that the differences drown in what is not smooth.
    """
    directions = []
    for _ in range(count):
        direction = {}
        for name, gradient in gradients.items():
            rows = gradient.detach().double().reshape(len(gradient), -1).norm(dim=1)
            rows = rows if float(rows.max()) > 0 else torch.ones_like(rows)
            draw = torch.randn(gradient.shape, generator=generator, dtype=torch.float64).to(rows.device)
            direction[name] = rows.reshape(-1, *[1] * (gradient.ndim - 1)) * draw
        size = math.sqrt(sum(float(part.square().sum()) for part in direction.values()))
        directions.append({name: (part / size).to(gradients[name]) for name, part in direction.items()})
    return directions


def agreement(runs: Runs, differentiate: Differentiated) -> tuple[list[float], list[float]]:
    """Directional derivatives by automatic differentiation, and the same by central differences of two widths.

    Over the seeds, at random points a tenth of the radius from the clean object, in pictures of less contrast.
    """
    automatic, measured, config = list[float](), list[float](), runs.case.config

    def soft(scene: GaussianScene, camera: Camera) -> Tensor:
        return 0.5 + CONTRAST * (runs.case.render(scene, camera) - 0.5)

    for seed in range(len(runs.case.cameras)):
        generator = Generator().manual_seed(2000 + seed)
        problem, view = runs.problem(seed, render=soft)
        clean = problem.subset.parameters(config.attributes)
        drawn = config.budget.uniform(clean, generator)
        point = {name: value + (drawn[name] - value) / 10 for name, value in clean.items()}
        value, gradients = differentiate(problem, view, config, point, generator)

        def slope(direction: Parameters, step: float, value: Value = value, point: Parameters = point) -> float:
            ends = ({n: tensor + amount * direction[n] for n, tensor in point.items()} for amount in (step, -step))
            ahead, behind = map(value, ends)
            return (ahead - behind) / (2 * step)

        for direction in random_directions(gradients, DIRECTIONS, generator):
            automatic.append(sum(float((gradients[name] * part).double().sum()) for name, part in direction.items()))
            step = min(config.eps) / 100
            measured.append((slope(direction, step) + slope(direction, 2 * step)) / 2)
    return automatic, measured


def whole_chain(
    problem: Problem, view: View, config: DaggerConfig, point: Parameters, generator: Generator
) -> tuple[Value, Parameters]:
    """As in `Differentiated`: from the object's parameters through renderer and detector to the loss."""
    gradients = problem.evaluate(point, [view], config).gradients
    return lambda parameters: problem.evaluate(parameters, [view], config).loss, gradients


def renderer_alone(
    problem: Problem, view: View, config: DaggerConfig, point: Parameters, generator: Generator
) -> tuple[Value, Parameters]:
    """As in `Differentiated`: to a fixed random weighting of the pixels, blurred so that it adds up."""
    coarse = torch.randn(1, 3, 6, 6, generator=generator)
    size = (view.camera.height, view.camera.width)
    weights = torch.nn.functional.interpolate(coarse, size=size, mode="bilinear")[0].permute(1, 2, 0)

    def weighted(parameters: Parameters) -> Tensor:
        picture = problem.render(problem.subset.scene_with(parameters), view.camera)
        total: Tensor = (weights.to(picture) * picture).sum(dtype=torch.float64)
        return total

    def value(parameters: Parameters) -> float:
        with torch.no_grad():
            return float(weighted(parameters))

    leaves = {name: tensor.detach().requires_grad_(True) for name, tensor in point.items()}
    parts = torch.autograd.grad(weighted(leaves), list(leaves.values()), materialize_grads=True)
    return value, dict(zip(leaves, parts, strict=True))
