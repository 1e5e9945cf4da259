"""What an attack did, and the warnings about it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from attacks.dagger.config import DaggerConfig
from attacks.dagger.ensemble import DetectorResult
from attacks.dagger.problem import ViewResult, joint_verdict, reached_by
from attacks.objectives import Objective, Verdict
from attacks.observe.views import ImageChange
from attacks.pgd import Step
from mi_splat.scene import GaussianScene

_ZERO_GRADIENT_LIMIT = 0.9
"""Fraction of zero gradients that raises a warning; hidden Gaussians have none in any case, so it is high."""

_CLAMPED_LIMIT = 0.25
"""Fraction of clamped colour channels that raises a warning."""

STILL_REPORTED = 0.5
"""Confidence from which the object's own class counts as reported beside the one that was wanted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseControl:
    """Random noise of the size of the attack in the same norm; an attack has to do better.

    Attributes:
        scores: Score of every draw, as `Verdict.score`.
        successes: Number of draws that reached the attacker's aim.
        views: Of every draw the verdict of each view, in the order of `Result.views`.
    """

    scores: tuple[float, ...]
    successes: int
    views: tuple[tuple[Verdict, ...], ...] = ()


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Result:
    """What an attack did, judged on the saved file and 8-bit pictures.

    Attributes:
        scene: The attacked scene; Gaussians outside the object are bit for bit what they were.
        verdict: Whether the aim was reached in enough views, whether without ambiguity, and the score that enough views
            reach: the confidence in the wanted class, or 1 minus the confidence in what is still detected. With several
            detectors, whether so with enough of them, and the score that so many reach.
        detectors: The same of each detector, with every view before and after.
        trace: Every point that was looked at, all runs, in order.
        best: The line of the trace whose point was kept.
        used: Size of the perturbation by attribute; never above its radius.
        used_in_file: The same, measured on the saved file, where quaternions have been normalised and logits rounded.
        object_gaussians: Number of Gaussians of the object.
        changed_gaussians: Number of Gaussians that differ.
        image: Size of the change in the pictures.
        clamped_fraction: Fraction of the object's colour channels at the clamp (clean, mean over views).
        noise: The control.
        warnings: Reasons to look twice before the result is believed, in words.
        objective: The aim and its settings.
        config: The full configuration.
        origin: Detector, versions, variant, commit, scene hash.
        seconds: Wall time of the attack.
    """

    scene: GaussianScene
    verdict: Verdict
    detectors: tuple[DetectorResult, ...]
    trace: tuple[Step, ...]
    best: Step
    used: dict[str, float]
    used_in_file: dict[str, float]
    object_gaussians: int
    changed_gaussians: int
    image: ImageChange
    clamped_fraction: float
    noise: NoiseControl
    warnings: tuple[str, ...]
    objective: Objective
    config: DaggerConfig
    origin: dict[str, Any]
    seconds: float

    @property
    def views(self) -> tuple[ViewResult, ...]:
        """Every view before and after, detector by detector."""
        return tuple(view for one in self.detectors for view in one.views)

    @property
    def success(self) -> bool:
        """Whether the aim was reached in enough views, with enough detectors."""
        return self.verdict.success

    @property
    def strict(self) -> bool:
        """Whether so where the object's own class has to be gone, too: reported with less than `STILL_REPORTED`."""
        config = self.config
        by_detector = [
            joint_verdict([strictly(view) for view in one.views], config.required_views) for one in self.detectors
        ]
        return joint_verdict(by_detector, config.required_detectors).success

    @property
    def score(self) -> float:
        """Score that enough views reach, in [0, 1]."""
        return self.verdict.score

    @property
    def target_confidence(self) -> float | None:
        """Confidence in the wanted class on the object that enough views reach; None when no class was wanted."""
        if self.objective.label is None:
            return None
        return reached_by([self.target_confidence_of(one) for one in self.detectors], self.config.required_detectors)

    def target_confidence_of(self, one: DetectorResult) -> float:
        """Confidence of one of `detectors` in the wanted class, or in any class, that enough views reach."""
        scores = [view.confidence(self.objective.label, attacked=True) for view in one.views]
        return reached_by(scores, self.config.required_views)


def strictly(view: ViewResult) -> Verdict:
    """The verdict of a view in which the object's own class has to be gone, too, for a success."""
    original = view.before.target.original
    gone = original is None or view.confidence(original, attacked=True) < STILL_REPORTED
    return dataclasses.replace(view.verdict, success=view.verdict.success and gone)


def find_warnings(result: Result) -> tuple[str, ...]:
    """Flags in the spirit of AutoAttack: signs that success or failure is not what it looks like."""
    found = []
    for one in result.detectors:
        by = "" if len(result.detectors) == 1 else f" by {one.detector}"
        for index, view in enumerate(one.views):
            if view.confidence(view.before.target.original, attacked=False) < 0.5:
                found.append(f"the clean picture of view {index} has no detection{by} of 0.5 or more on the object")
    first = result.trace[0]
    if first.success:
        found.append("the aim is reached without any attack")
    if max(line.zero_gradient_fraction for line in result.trace) > _ZERO_GRADIENT_LIMIT:
        fraction = max(line.zero_gradient_fraction for line in result.trace)
        found.append(f"up to {fraction:.0%} of the gradient's elements are exactly zero")
    if len(result.trace) > 1 and min(line.loss for line in result.trace[1:]) >= first.loss:
        found.append("the loss did not fall")
    if "sh" in result.config.attributes and result.clamped_fraction > _CLAMPED_LIMIT:
        found.append(
            f"{result.clamped_fraction:.0%} of the object's colour channels are clamped at 0, where SH has no gradient"
        )
    if result.best.success and not result.success:
        found.append("success in the search did not survive the saved file and 8-bit pictures")
    if result.success and not result.verdict.unambiguous:
        found.append("another class is still detected on the object with more confidence")
    if result.success and not result.strict:
        known = [view for view in result.views if view.before.target.original is not None]
        left = max(view.confidence(view.before.target.original, attacked=True) for view in known)
        found.append(f"the object's own class is still reported on it, at up to {left:.0%}")
    if result.noise.scores and (
        (result.success and result.noise.successes) or max(result.noise.scores) >= result.score > 0
    ):
        found.append("random noise of the same size does as well")
    return tuple(found)
