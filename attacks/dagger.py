"""DAGGER: projected gradient descent on the finished splat file, so that a detector sees one object as something else.

After "3D Gaussian Splat Vulnerabilities": the attacker holds the splat and the detector (white box) and edits only the
Gaussians of one object. The paper's text takes eleven steps of length 2 eps / steps in one l2 ball of radius 5 over the
SH coefficients.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from torch import Generator, Tensor

from attacks import provenance
from attacks.budgets import Budget, NormName, Parameters
from attacks.detectors.base import Detector
from attacks.filespace import Part
from attacks.objectives import Objective
from attacks.pgd import Outcome, Step, pgd, rank
from attacks.scoring import ImageChange, clamped_share, image_change
from attacks.staging import Shot, Stage, ViewResult, reached, together
from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat, save_splat
from mi_splat.scene import GaussianScene, scene_hash

Attribute = Literal["means", "scales", "rotations", "opacities", "sh"]

_ZERO_DOUBT = 0.9
"""Share of zero gradients that raises a doubt; hidden Gaussians have none in any case, so it is high."""

_CLAMP_DOUBT = 0.1
"""Share of clamped colour channels that raises a doubt."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerConfig:
    """How to attack. The defaults are the paper's.

    Attributes:
        attributes: What may change of the object's Gaussians.
        eps: Radius of the budget for each attribute, in the same order and in the units of the splat file.
        norm: linf, l2 (one ball over the whole object) or l2_per_gaussian (a ball for each).
        steps: Number of steps.
        step_factor: A step is eps * step_factor / steps long.
        restarts: Number of runs; the first starts at the clean splat, the others anywhere in the ball.
        random_start: Start the first run anywhere in the ball, too.
        early_stop: Stop at the first success instead of spending every step.
        share: Share of the views in which the attack has to succeed.
        noise_draws: Number of draws of the random-noise control.
        seed: Seed of restarts and noise; with one run the attack itself is deterministic.
    """

    attributes: tuple[Attribute, ...] = ("sh",)
    eps: tuple[float, ...] = (5.0,)
    norm: NormName = "l2"
    steps: int = 11
    step_factor: float = 2.0
    restarts: int = 1
    random_start: bool = False
    early_stop: bool = True
    share: float = 1.0
    noise_draws: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        if len(self.attributes) != len(self.eps) or len(set(self.attributes)) != len(self.attributes):
            raise InvalidValueError(
                message(
                    "eps", f"one number for each of {', '.join(self.attributes)}", self.eps, "give each its own radius"
                )
            )
        for name, value, least in (
            ("steps", self.steps, 1),
            ("restarts", self.restarts, 1),
            ("noise_draws", self.noise_draws, 0),
        ):
            if value < least:
                raise InvalidValueError(message(name, f"a number >= {least}", value, "ask for more"))
        if not 0 < self.share <= 1:
            raise InvalidValueError(message("share", "a number in (0, 1]", self.share, "1 means every view"))
        if not (math.isfinite(self.step_factor) and self.step_factor > 0):
            raise InvalidValueError(message("step_factor", "a positive number", self.step_factor, "2 is the paper's"))
        _ = self.budget

    @property
    def budget(self) -> Budget:
        """Radius and norm as one value."""
        return Budget(radius=dict(zip(self.attributes, self.eps, strict=True)), norm=self.norm)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseControl:
    """Random noise of the size of the attack in the same norm; an attack worth its name does better.

    Attributes:
        scores: Score of every draw (the confidence in the wanted class, or 1 minus what is still detected).
        successes: Number of draws that had the attacker's aim.
    """

    scores: tuple[float, ...]
    successes: int


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Result:
    """What an attack did, judged on the saved file and 8-bit pictures.

    Attributes:
        scene: The attacked scene; Gaussians outside the object are bit for bit what they were.
        success: Whether the aim was reached in enough views.
        score: Score that enough views reach: the confidence in the wanted class, or 1 minus what is still detected.
        views: Every view before and after.
        trace: Every point that was visited, all runs, in order.
        best: The line of the trace whose point was kept.
        used: Size of the perturbation by attribute; never above its radius.
        in_file: The same, measured on the saved file, where quaternions have been normalised and logits rounded.
        size: Number of Gaussians of the object.
        changed: Number of Gaussians that differ.
        image: Size of the change in the pictures.
        clamped: Share of the object's colour channels at the clamp (clean, mean over views).
        noise: The control.
        doubts: Reasons not to trust the result at its face, in words.
        objective: The aim and its settings.
        config: The full configuration.
        origin: Detector, versions, variant, commit, scene hash.
        seconds: Wall time of the attack.
    """

    scene: GaussianScene
    success: bool
    score: float
    views: tuple[ViewResult, ...]
    trace: tuple[Step, ...]
    best: Step
    used: dict[str, float]
    in_file: dict[str, float]
    size: int
    changed: int
    image: ImageChange
    clamped: float
    noise: NoiseControl
    doubts: tuple[str, ...]
    objective: Objective
    config: DaggerConfig
    origin: dict[str, Any]
    seconds: float

    @property
    def target_confidence(self) -> float | None:
        """Confidence in the wanted class on the object that enough views reach; None when no class was wanted."""
        if self.objective.label is None:
            return None
        scores = [view.confidence(self.objective.label, attacked=True) for view in self.views]
        return reached(scores, self.config.share)


def attack(
    scene: GaussianScene,
    mask: Tensor | slice,
    cameras: Sequence[Camera],
    detector: Detector,
    objective: Objective,
    *,
    render: RenderFn,
    config: DaggerConfig | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> Result:
    """Attack one object of a scene in one view or many.

    Args:
        scene: The clean splat.
        mask: The object's Gaussians: (N,) bool, row numbers, or a slice.
        cameras: Views that are attacked together.
        detector: The victim, white box.
        objective: What it shall see, for instance `relabel("person")` or `hide()`.
        render: Any differentiable renderer.
        config: Budget, steps and seed; the paper's if None.
        on_step: Called with every line of the trace as it happens.

    Raises:
        InvalidValueError: The mask selects nothing, a view does not show the object, the detector does not know the
            class wanted, or a gradient is not finite.
    """
    config = config or DaggerConfig()
    begun = time.perf_counter()
    if objective.label is not None and objective.label not in detector.classes:
        raise InvalidValueError(
            message("target", f"one of {', '.join(detector.classes)}", objective.label, "choose a class that it knows")
        )
    if not cameras:
        raise InvalidValueError(message("cameras", "at least one camera", "none", "say where the victim looks from"))
    part = Part.of(scene, mask)
    stage = Stage(part=part, detector=detector, objective=objective, render=render, share=config.share)
    shots = [stage.shot(camera) for camera in cameras]
    reference = part.parameters(config.attributes)
    outcome = _search(stage, shots, reference, config, on_step)
    attacked = part.sealed(outcome.parameters)
    saved = _through_file(attacked)
    views = stage.look(saved, shots)
    success, score = together([view.verdict for view in views], config.share)
    result = Result(
        scene=attacked,
        success=success,
        score=score,
        views=views,
        trace=outcome.trace,
        best=outcome.best,
        used=config.budget.measure(outcome.parameters, reference),
        in_file=config.budget.measure(Part.of(saved, part.rows).parameters(config.attributes), reference),
        size=len(part.rows),
        changed=part.changed(attacked),
        image=image_change([s.before for s in shots], [v.after for v in views], [s.weight for s in shots]),
        clamped=sum(clamped_share(part, shot.camera) for shot in shots) / len(shots),
        noise=_noise_control(stage, shots, outcome.parameters, config),
        doubts=(),
        objective=objective,
        config=config,
        origin=_origin(scene, detector),
        seconds=time.perf_counter() - begun,
    )
    return dataclasses.replace(result, doubts=_doubts(result))


def _search(
    stage: Stage,
    shots: Sequence[Shot],
    reference: Parameters,
    config: DaggerConfig,
    on_step: Callable[[Step], None] | None,
) -> Outcome:
    """All restarts; the best point of all, and the trace of all."""
    generator = Generator().manual_seed(config.seed)
    step = {name: eps * config.step_factor / config.steps for name, eps in config.budget.radius.items()}
    found: list[Outcome] = []
    for restart in range(config.restarts):

        def numbered(line: Step, restart: int = restart) -> None:
            if on_step is not None:
                on_step(dataclasses.replace(line, restart=restart))

        run = pgd(
            lambda parameters: stage.evaluate(parameters, shots),
            reference,
            config.budget,
            step=step,
            steps=config.steps,
            start=config.budget.uniform(reference, generator) if restart or config.random_start else None,
            early_stop=config.early_stop,
            on_step=numbered,
        )
        lines = tuple(dataclasses.replace(line, restart=restart) for line in run.trace)
        found.append(dataclasses.replace(run, best=dataclasses.replace(run.best, restart=restart), trace=lines))
        if config.early_stop and run.best.success:
            break
    best = max(found, key=lambda run: rank(run.best))
    return dataclasses.replace(best, trace=tuple(line for run in found for line in run.trace))


def _noise_control(stage: Stage, shots: Sequence[Shot], parameters: Parameters, config: DaggerConfig) -> NoiseControl:
    """Random noise of the same size in the same norm, judged like the attack."""
    generator = Generator().manual_seed(config.seed + 1)
    reference = stage.part.parameters(config.attributes)
    verdicts = []
    for _ in range(config.noise_draws):
        noisy = config.budget.noise(parameters, reference, generator)
        views = stage.look(stage.part.sealed(noisy), shots)
        verdicts.append(together([view.verdict for view in views], config.share))
    return NoiseControl(scores=tuple(score for _, score in verdicts), successes=sum(success for success, _ in verdicts))


def _through_file(scene: GaussianScene) -> GaussianScene:
    """What a user gets who loads the attacked file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "attacked.ply"
        save_splat(scene, path)
        return load_splat(path).to(scene.means.device)


def _origin(scene: GaussianScene, detector: Detector) -> dict[str, Any]:
    return {
        "detector": detector.name,
        "scene_hash": scene_hash(scene),
        "versions": provenance.versions(),
        "variant": provenance.variant(),
        "commit": provenance.commit(),
    }


def _doubts(result: Result) -> tuple[str, ...]:
    """Flags in the spirit of AutoAttack: signs that success or failure is not what it looks like."""
    found = []
    for index, view in enumerate(result.views):
        if view.confidence(view.shot.target.original, attacked=False) < 0.5:
            found.append(f"the clean picture of view {index} has no detection of 0.5 or more on the object")
    first = result.trace[0]
    if first.success:
        found.append("the aim is reached without any attack")
    if max(line.zero_share for line in result.trace) > _ZERO_DOUBT:
        share = max(line.zero_share for line in result.trace)
        found.append(f"up to {share:.0%} of the gradient's elements are exactly zero")
    if len(result.trace) > 1 and min(line.loss for line in result.trace[1:]) >= first.loss:
        found.append("the loss did not fall")
    if "sh" in result.config.attributes and result.clamped > _CLAMP_DOUBT:
        found.append(f"{result.clamped:.0%} of the object's colour channels are clamped at 0, where SH has no gradient")
    if result.best.success and not result.success:
        found.append("success in the search did not survive the saved file and 8-bit pictures")
    if result.noise.scores and (
        (result.success and result.noise.successes) or max(result.noise.scores) >= result.score > 0
    ):
        found.append("random noise of the same size does as well")
    return tuple(found)
