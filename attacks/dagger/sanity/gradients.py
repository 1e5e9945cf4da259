"""Gradients against central finite differences: of the renderer alone, and of the whole chain from Gaussians to loss.

The whole chain has steps that are constant for the gradient: the candidates that a detector or an objective chooses.
So its agreement is measured over directions, by cosine and slope, with a wider tolerance than the renderer's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from attacks.dagger.config import DaggerConfig
from attacks.dagger.problem import Problem
from attacks.dagger.views import View
from attacks.pgd import Parameters
from mi_splat.cameras import Camera, RenderFn
from mi_splat.scene import GaussianScene

CONTRAST = 0.8
"""Contrast of the pictures that are differentiated: no pixel is near the clamp at 0 and 1, which has a kink."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Two lists of directional derivatives beside each other.

    Attributes:
        automatic: From automatic differentiation.
        measured: From central differences.
    """

    automatic: tuple[float, ...]
    measured: tuple[float, ...]

    @property
    def cosine(self) -> float:
        """Cosine between the two lists as vectors; 0 if one of them is zero."""
        sizes = math.hypot(*self.automatic) * math.hypot(*self.measured)
        return self._product / sizes if sizes else 0.0

    @property
    def slope(self) -> float:
        """Factor by which the measured ones are the automatic ones, by least squares; 0 if these are zero."""
        size = math.hypot(*self.automatic) ** 2
        return self._product / size if size else 0.0

    @property
    def _product(self) -> float:
        return sum(a * b for a, b in zip(self.automatic, self.measured, strict=True))


def soft(render: RenderFn) -> RenderFn:
    """The renderer with less contrast around middle grey."""

    def softened(scene: GaussianScene, camera: Camera) -> Tensor:
        return 0.5 + CONTRAST * (render(scene, camera) - 0.5)

    return softened


def random_directions(gradients: Parameters, count: int, generator: Generator) -> list[Parameters]:
    """Random directions of length 1 that move the Gaussians which matter.

    A Gaussian moves as far as the size of its gradient, every one of its components at random: Gaussians out of sight
    stay, and a component that lacks its gradient moves like the others. Directions without any order would change the
    loss so little that the differences drown in what is not smooth.

    Args:
        gradients: One for each parameter; the first dimension is the Gaussian.
        count: Number of directions.
        generator: Draws them.
    """
    found = []
    for _ in range(count):
        direction = {}
        for name, gradient in gradients.items():
            rows = gradient.detach().double().reshape(len(gradient), -1).norm(dim=1)
            rows = rows if float(rows.max()) > 0 else torch.ones_like(rows)
            draw = torch.randn(gradient.shape, generator=generator, dtype=torch.float64).to(rows.device)
            direction[name] = rows.reshape(-1, *[1] * (gradient.ndim - 1)) * draw
        size = math.sqrt(sum(float(part.square().sum()) for part in direction.values()))
        found.append({name: (part / size).to(gradients[name]) for name, part in direction.items()})
    return found


def moved(parameters: Parameters, direction: Parameters, amount: float) -> Parameters:
    """The parameters, so far along a direction."""
    return {name: value + amount * direction[name] for name, value in parameters.items()}


def compare(
    value: Callable[[Parameters], float],
    gradients: Parameters,
    point: Parameters,
    directions: Sequence[Parameters],
    *,
    steps: Sequence[float],
) -> Agreement:
    """Directional derivatives at a point by both ways.

    Args:
        value: The function differentiated.
        gradients: Its gradient at the point.
        point: The point.
        directions: Of length 1.
        steps: Half widths of the central differences, whose mean is taken.
    """
    automatic, measured = [], []
    for direction in directions:
        automatic.append(sum(float((gradients[name] * part).double().sum()) for name, part in direction.items()))
        slopes = [
            (value(moved(point, direction, step)) - value(moved(point, direction, -step))) / (2 * step)
            for step in steps
        ]
        measured.append(sum(slopes) / len(slopes))
    return Agreement(automatic=tuple(automatic), measured=tuple(measured))


def whole_chain(
    problem: Problem,
    view: View,
    point: Parameters,
    config: DaggerConfig,
    *,
    count: int,
    step: float,
    generator: Generator,
) -> Agreement:
    """From the object's parameters through renderer and detector to the loss.

    Args:
        problem: Renderer, detector and objective.
        view: Where from.
        point: The parameters.
        config: How the loss of several detectors becomes one; here there is one.
        count: Number of random directions.
        step: Half width of the narrower of two central differences; the other is twice as wide.
        generator: Draws the directions.
    """
    gradients = problem.evaluate(point, [view], config).gradients
    return compare(
        lambda parameters: problem.evaluate(parameters, [view], config).loss,
        gradients,
        point,
        random_directions(gradients, count, generator),
        steps=(step, 2 * step),
    )


def renderer_alone(
    problem: Problem,
    view: View,
    point: Parameters,
    config: DaggerConfig,
    *,
    count: int,
    step: float,
    generator: Generator,
) -> Agreement:
    """From the object's parameters to a fixed random weighting of the pixels, blurred so that it adds up.

    Args:
        problem: Renderer, detector and objective.
        view: Where from.
        point: The parameters.
        config: How the loss of several detectors becomes one; here there is one.
        count: Number of random directions.
        step: As in `whole_chain`.
        generator: Draws the weighting and the directions.
    """
    coarse = torch.randn(1, 3, 6, 6, generator=generator)
    size = (view.camera.height, view.camera.width)
    weights = torch.nn.functional.interpolate(coarse, size=size, mode="bilinear")[0].permute(1, 2, 0)

    def value(parameters: Parameters) -> Tensor:
        picture = problem.render(problem.subset.scene_with(parameters), view.camera)
        return (weights.to(picture) * picture).sum(dtype=torch.float64)

    leaves = {name: tensor.detach().requires_grad_(True) for name, tensor in point.items()}
    found = torch.autograd.grad(value(leaves), list(leaves.values()), materialize_grads=True)
    gradients = dict(zip(leaves, found, strict=True))
    with torch.no_grad():
        return compare(
            lambda parameters: float(value(parameters)),
            gradients,
            point,
            random_directions(gradients, count, generator),
            steps=(step, 2 * step),
        )
