"""Gradients against central finite differences: of the renderer alone, and of the whole chain from Gaussians to loss.

The whole chain has steps that are constant for the gradient: the candidates that a detector or an objective chooses.
So its agreement is measured over directions, by cosine and slope, with a wider tolerance than the renderer's.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator, Tensor

from attacks.dagger.attack import attack, problem_of
from attacks.dagger.config import DaggerConfig
from attacks.dagger.problem import Problem
from attacks.dagger.result import Result
from attacks.dagger.views import FixedViews, View, detected
from attacks.detectors.base import Detector
from attacks.gaussian_subset import Mask
from attacks.objectives import Relabel
from attacks.observe.views import as_saved
from attacks.search import Parameters, Verdict
from mi_splat.cameras import Camera, RenderFn
from mi_splat.scene import GaussianScene

Attack = Callable[..., Result]
"""The attack that is checked: `attacks.dagger.attack.attack`, or one that takes the same arguments."""


Scored = Result | Verdict
"""What a run has reached: whether it has its aim, and a score."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Case:
    """An attack that is checked.

    Attributes:
        scene: The clean splat.
        mask: The object's Gaussians.
        cameras: One for each seed, from 0; every seed is one attack in one view.
        detector: The one attacked.
        objective: The aim.
        render: The renderer.
        config: How to attack; its radii are those that the checks take fractions and multiples of.
        surrogate: Another detector, whose attacks are judged by `detector`; None leaves that check out.
    """

    scene: GaussianScene
    mask: Mask
    cameras: tuple[Camera, ...]
    detector: Detector
    objective: Relabel
    render: RenderFn
    config: DaggerConfig
    surrogate: Detector | None = None


class Runs:
    """The attacks on a case; the same one is made once.

    Args:
        case: What is checked.
        make: The attack; another one than the project's in the tests of the checks.
        on_run: Called after each attack.
    """

    def __init__(self, case: Case, make: Attack = attack, on_run: Callable[[], None] = lambda: None) -> None:
        self.case, self._attack, self._on_run = case, make, on_run
        self._made: dict[tuple[str, DaggerConfig, int], Result] = {}

    @property
    def made(self) -> tuple[tuple[DaggerConfig, Result], ...]:
        """Every attack so far, and what it was asked for."""
        return tuple((config, result) for (_, config, _), result in self._made.items())

    def results(self, scale: float = 1.0, *, detector: Detector | None = None, **changes: Any) -> tuple[Result, ...]:
        """One attack for each seed."""
        attacked = detector or self.case.detector
        return tuple(self._result(seed, scale, attacked, changes) for seed in range(len(self.case.cameras)))

    def _result(self, seed: int, scale: float, detector: Detector, changes: dict[str, Any]) -> Result:
        case, base = self.case, self.case.config
        eps = tuple(scale * radius for radius in base.eps)
        config = dataclasses.replace(base, **{"eps": eps, "seed": seed, "random_start": seed > 0, **changes})
        key = (detector.name, config, seed)
        if key not in self._made:
            self._made[key] = self._attack(
                case.scene, case.mask, [case.cameras[seed]], detector, case.objective, render=case.render, config=config
            )
            self._on_run()
        return self._made[key]

    def mean(self, scored: Sequence[Scored]) -> float:
        """Mean score; what is more than a success needs does not count."""
        enough = self.case.objective.confidence
        return sum(min(result.score, enough) for result in scored) / len(scored)

    def problem(self, seed: int, *, render: RenderFn | None = None) -> tuple[Problem, View]:
        """The detector of the case as an attack differentiates it, and the view of a seed."""
        case = self.case
        views = FixedViews(case.scene, case.mask, case.cameras[seed], render=render or case.render)
        problem = problem_of(views, (case.detector,), case.objective, case.config)
        return problem, views.held_out(case.config)[0]

    def judged(self, results: Sequence[Result]) -> list[Verdict]:
        """What the detector of the case makes of the splats of one attack for each seed."""
        verdicts = []
        for seed, result in enumerate(results):
            problem, view = self.problem(seed)
            (seen,) = detected([self.case.detector], as_saved(result.scene), [view], problem.render).values()
            verdicts.append(problem.objective.verdict(seen.detections, problem.target(view, self.case.detector)))
        return verdicts


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
