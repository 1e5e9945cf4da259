"""What is checked, and the attacks that the checks share, each made once."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from attacks.dagger.attack import attack, fixed_problem, widened
from attacks.dagger.config import DaggerConfig
from attacks.dagger.judging import look
from attacks.dagger.problem import Problem
from attacks.dagger.result import Result
from attacks.dagger.views import View
from attacks.detectors.base import Detector
from attacks.gaussian_subset import GaussianSubset, Mask
from attacks.objectives import Relabel
from attacks.observe.views import as_saved
from attacks.search import Verdict
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
        case, render = self.case, render or self.case.render
        subset, cameras = GaussianSubset.of(widened(case.scene, case.config), case.mask), [case.cameras[seed]]
        problem, (view,), _ = fixed_problem(subset, cameras, (case.detector,), case.objective, render=render)
        return problem, view

    def judged(self, results: Sequence[Result]) -> list[Verdict]:
        """What the detector of the case makes of the splats of one attack for each seed."""
        verdicts = []
        for seed, result in enumerate(results):
            problem, view = self.problem(seed)
            (seen,) = look([self.case.detector], as_saved(result.scene), [view], problem.render).values()
            verdicts.append(problem.objective.verdict(seen.detections, problem.target(view, self.case.detector)))
        return verdicts
