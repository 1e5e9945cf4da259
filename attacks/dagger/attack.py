"""DAGGER: projected gradient descent on the finished splat file, so that a detector sees one object as something else.

After "3D Gaussian Splat Vulnerabilities": the attacker holds the splat and the detector (white box) and edits only the
Gaussians of one object. The paper's text takes eleven steps of length 2 eps / steps in one l2 ball of radius 5 over the
SH coefficients.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torch import Generator, Tensor

from attacks.budgets import Parameters
from attacks.dagger.config import Attribute, DaggerConfig
from attacks.dagger.problem import AttackProblem, AttackView, together
from attacks.dagger.result import NoiseControl, Result, find_warnings
from attacks.detectors.base import Detector
from attacks.evaluation.visibility import clamped_fraction, image_change
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import Objective
from attacks.pgd import Outcome, Step, pgd, rank
from mi_splat import provenance
from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat, save_splat
from mi_splat.scene import GaussianScene, scene_hash

__all__ = ["Attribute", "DaggerConfig", "Result", "attack"]


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
    clean_hash = scene_hash(scene)
    if config.sh_degree is not None and "sh" in config.attributes and scene.degree < config.sh_degree:
        scene = scene.with_degree(config.sh_degree)
    subset = GaussianSubset.of(scene, mask)
    problem = AttackProblem(
        subset=subset, detector=detector, objective=objective, render=render, required_views=config.required_views
    )
    clean_views = [problem.view(camera) for camera in cameras]
    reference = subset.parameters(config.attributes)
    outcome = _search(problem, clean_views, reference, config, on_step)
    attacked = subset.applied(outcome.parameters)
    saved = _through_file(attacked)
    results = problem.judge(saved, clean_views)
    verdict = together([result.verdict for result in results], config.required_views)
    result = Result(
        scene=attacked,
        verdict=verdict,
        views=results,
        trace=outcome.trace,
        best=outcome.best,
        used=config.budget.measure(outcome.parameters, reference),
        in_file=config.budget.measure(GaussianSubset.of(saved, subset.rows).parameters(config.attributes), reference),
        size=len(subset.rows),
        changed=subset.changed(attacked),
        image=image_change(
            [view.image for view in clean_views],
            [result.after for result in results],
            [view.weight for view in clean_views],
        ),
        clamped=sum(clamped_fraction(subset, view.camera) for view in clean_views) / len(clean_views),
        noise=_noise_control(problem, clean_views, outcome.parameters, config),
        warnings=(),
        objective=objective,
        config=config,
        origin=_origin(clean_hash, detector),
        seconds=time.perf_counter() - begun,
    )
    return dataclasses.replace(result, warnings=find_warnings(result))


def _search(
    problem: AttackProblem,
    views: Sequence[AttackView],
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
            lambda parameters: problem.evaluate(parameters, views),
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


def _noise_control(
    problem: AttackProblem, views: Sequence[AttackView], parameters: Parameters, config: DaggerConfig
) -> NoiseControl:
    """Random noise of the same size in the same norm, judged like the attack."""
    generator = Generator().manual_seed(config.seed + 1)
    reference = problem.subset.parameters(config.attributes)
    verdicts = []
    for _ in range(config.noise_draws):
        noisy = config.budget.noise(parameters, reference, generator)
        results = problem.judge(problem.subset.applied(noisy), views)
        verdicts.append(together([result.verdict for result in results], config.required_views))
    return NoiseControl(
        scores=tuple(verdict.score for verdict in verdicts),
        successes=sum(verdict.success for verdict in verdicts),
    )


def _through_file(scene: GaussianScene) -> GaussianScene:
    """What a user gets who loads the attacked file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "attacked.ply"
        save_splat(scene, path)
        return load_splat(path).to(scene.means.device)


def _origin(clean_hash: str, detector: Detector) -> dict[str, Any]:
    return {
        "detector": detector.name,
        "detector_fingerprint": detector.fingerprint,
        "scene_hash": clean_hash,
        "versions": provenance.versions(),
        "variant": provenance.variant(),
        "commit": provenance.commit(),
    }
