"""Several detectors attacked at once: one problem for each, one loss over all of them, and a verdict of each.

The loss is the mean of the detectors' losses (Liu et al., "Delving into Transferable Adversarial Examples and Black-box
Attacks", ICLR 2017) or that of the detector that resists most. With one detector it is that detector's alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from attacks.dagger.config import DaggerConfig, EnsembleLoss
from attacks.dagger.problem import AttackProblem, AttackView, ViewResult, joint_verdict
from attacks.detectors.base import Detector
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import Objective, Verdict
from attacks.pgd import Evaluation, Parameters
from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, message, nearest
from mi_splat.scene import GaussianScene
from mi_splat.view_freezing import freeze_views


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DetectorResult:
    """What one of the detectors makes of an attack.

    Attributes:
        detector: Its name.
        fingerprint: What stands for its weights.
        verdict: Over its views.
        views: Every view before and after, as it sees them.
    """

    detector: str
    fingerprint: str
    verdict: Verdict
    views: tuple[ViewResult, ...]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Ensemble:
    """The detectors of an attack and what each saw in the clean scene.

    Attributes:
        problems: One for each detector.
        views: The clean views of each problem; those of all problems are from the same cameras.
        loss: How the losses of several detectors become one.
        required_detectors: Fraction of the detectors that the attack has to deceive.
    """

    problems: tuple[AttackProblem, ...]
    views: tuple[tuple[AttackView, ...], ...]
    loss: EnsembleLoss = "mean"
    required_detectors: float = 1.0

    @classmethod
    def of(
        cls,
        detectors: Sequence[Detector],
        subset: GaussianSubset,
        cameras: Sequence[Camera],
        objective: Objective,
        *,
        render: RenderFn,
        config: DaggerConfig,
    ) -> Ensemble:
        """Look at the clean scene with every detector.

        Args:
            detectors: At least one; different names.
            subset: The object in its scene.
            cameras: Views.
            objective: The aim.
            render: The renderer.
            config: Which fractions of views and detectors are required, and the loss of several.

        Raises:
            InvalidValueError: A view does not show the object, two detectors have one name, or one of them does not
                know the target class.
        """
        _check(detectors, objective)
        problems = tuple(
            AttackProblem(
                subset=subset,
                detector=detector,
                objective=objective,
                render=render,
                required_views=config.required_views,
            )
            for detector in detectors
        )
        return cls(
            problems=problems,
            views=tuple(tuple(problem.view(camera) for camera in cameras) for problem in problems),
            loss=config.ensemble,
            required_detectors=config.required_detectors,
        )

    def frozen(self, config: DaggerConfig) -> Ensemble:
        """The same, with frozen views for a search with this configuration if it changes SH alone."""
        if config.attributes != ("sh",):
            return self
        subset, render = self.problems[0].subset, self.problems[0].render
        views = freeze_views(
            subset.scene,
            [view.camera for view in self.views[0]],
            render=render,
            pictures=len(self.problems) * config.restarts * (config.steps + 1),
            rows=subset.rows,
        )
        return replace(self, problems=tuple(replace(problem, frozen=views) for problem in self.problems))

    def evaluate(self, parameters: Parameters) -> Evaluation:
        """Loss, gradients, success and score at one point of the search, over all views and detectors."""
        found = [problem.evaluate(parameters, views) for problem, views in zip(self.problems, self.views, strict=True)]
        if len(found) == 1:
            return found[0]
        verdicts = [Verdict(success=one.success, score=one.score, unambiguous=one.unambiguous) for one in found]
        whole = joint_verdict(verdicts, self.required_detectors)
        loss, gradients = _LOSSES[self.loss](found)
        return Evaluation(
            loss=loss, gradients=gradients, success=whole.success, score=whole.score, unambiguous=whole.unambiguous
        )

    def judge(self, scene: GaussianScene) -> tuple[DetectorResult, ...]:
        """Let every detector judge a scene from every camera, on 8-bit pictures that went through PNG."""
        found = []
        for problem, views in zip(self.problems, self.views, strict=True):
            results = problem.judge(scene, views)
            verdict = joint_verdict([result.verdict for result in results], problem.required_views)
            name, fingerprint = problem.detector.name, problem.detector.fingerprint
            found.append(DetectorResult(detector=name, fingerprint=fingerprint, verdict=verdict, views=results))
        return tuple(found)

    def verdict(self, results: Sequence[DetectorResult]) -> Verdict:
        """Success with at least the required fraction of the detectors, and the score that so many reach."""
        return joint_verdict([result.verdict for result in results], self.required_detectors)


def _check(detectors: Sequence[Detector], objective: Objective) -> None:
    names = [detector.name for detector in detectors]
    if not names or len(set(names)) < len(names):
        do = "name each one once"
        raise InvalidValueError(message("detector", "one detector, or several with different names", names, do))
    for detector in detectors:
        if objective.label is not None and objective.label not in detector.classes:
            of = "" if len(detectors) == 1 else f" of {detector.name}"
            expected, do = (
                f"one of {', '.join(detector.classes)}",
                nearest(objective.label, detector.classes, "choose one of them"),
            )
            raise InvalidValueError(message(f"target{of}", expected, objective.label, do))


def _mean(found: Sequence[Evaluation]) -> tuple[float, Parameters]:
    gradients = {name: torch.stack([one.gradients[name] for one in found]).mean(0) for name in found[0].gradients}
    return sum(one.loss for one in found) / len(found), gradients


def _max(found: Sequence[Evaluation]) -> tuple[float, Parameters]:
    hardest = max(found, key=lambda one: one.loss)
    return hardest.loss, hardest.gradients


_LOSSES: dict[EnsembleLoss, Callable[[Sequence[Evaluation]], tuple[float, Parameters]]] = {"mean": _mean, "max": _max}
