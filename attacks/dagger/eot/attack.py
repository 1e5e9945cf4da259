"""DAGGER under expectation over transformation: one object, all views of a region, one or several detectors.

After Athalye et al., "Synthesizing Robust Adversarial Examples", ICML 2018: the loss is the mean over a distribution
of views, estimated at each step from a few that are drawn anew. The search is PGD with momentum (Dong et al. 2018).
Views that the search did not see judge the result.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Generator

from attacks.dagger.eot.checkpoint import SearchState
from attacks.dagger.eot.config import EotConfig
from attacks.dagger.eot.judging import clean_detections, judge
from attacks.dagger.eot.problem import EotProblem
from attacks.dagger.eot.result import EotResult, find_warnings
from attacks.dagger.eot.search import VALIDATION_SEED_OFFSET, Checkpoint, search
from attacks.dagger.eot.views import DrawnView, ViewDistribution
from attacks.detectors.base import Detector
from attacks.detectors.given import as_detectors
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import Objective, check_objective
from attacks.observe.comparison import usual_label
from attacks.observe.views import as_saved
from attacks.pgd import Step
from mi_splat import provenance
from mi_splat.errors import InvalidValueError, message, nearest
from mi_splat.io.camera_records import values_of
from mi_splat.scene import scene_hash


def attack_views(
    views: ViewDistribution,
    detectors: Detector | str | Sequence[Detector | str],
    objective: Objective,
    *,
    config: EotConfig | None = None,
    judged: ViewDistribution | None = None,
    checkpoint: Checkpoint | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> EotResult:
    """Attack one object so that it deceives from all views of a distribution, and judge that on held-out views.

    Args:
        views: The object and the distribution of its views.
        detectors: Those attacked, all at once: the loss is the mean over them, and a view is a success when every
            one is deceived. Their weights are known (white box).
        objective: What they shall see, for instance `relabel("person")` or `hide()`.
        config: Budget, steps, views and seeds.
        judged: Where the held-out views are drawn from, for instance with pictures that change; None is `views`.
        checkpoint: Where to keep the search while it runs; one that is there is taken up again.
        on_step: Called with every line of the trace as it happens.

    Raises:
        InvalidValueError: An argument is of another kind, a detector does not know the target class, no view shows the
            object, or a gradient is not finite.
        CheckpointError: The checkpoint is one of another attack.
    """
    config, detectors = config or EotConfig(), as_detectors(detectors)
    check_objective(objective)
    _check_detectors(detectors, objective)
    scene = views.scene
    if config.sh_degree is not None and "sh" in config.attributes and scene.degree < config.sh_degree:
        scene = scene.with_degree(config.sh_degree)
    problem = EotProblem(
        subset=GaussianSubset.of(scene, views.mask),
        detectors=detectors,
        objective=objective,
        originals=_originals(views, detectors, config),
        render=views.render,
        clean=views.picture,
    )
    key = _key(views, problem, config)
    found = search(problem, views, config, key=key, checkpoint=checkpoint, on_step=on_step)
    begun = time.perf_counter()
    result = _judged(problem, views, judged or views, config, found)
    if checkpoint is not None:
        checkpoint.path.unlink(missing_ok=True)
    return dataclasses.replace(
        result, warnings=find_warnings(result), seconds=found.seconds + time.perf_counter() - begun
    )


def _judged(
    problem: EotProblem,
    views: ViewDistribution,
    judged: ViewDistribution,
    config: EotConfig,
    found: SearchState,
) -> EotResult:
    """The result of a search, judged on held-out views."""
    subset, budget, parameters = problem.subset, config.budget, found.best
    reference = problem.reference(config.attributes, config.sh_degree)
    attacked = problem.applied(parameters)
    generator = Generator().manual_seed(config.seed + 1)
    noisy = [problem.applied(budget.noise(parameters, reference, generator)) for _ in range(config.noise_draws)]
    in_file = dataclasses.replace(problem, subset=GaussianSubset.of(as_saved(attacked), subset.rows))
    return EotResult(
        scene=attacked,
        judgement=judge(problem, attacked, noisy, judged, seed=config.judge_seed, count=config.held_out),
        trace=found.trace,
        best=found.best_line or found.trace[0],
        used=budget.measure(parameters, reference),
        used_in_file=budget.measure(in_file.reference(config.attributes, config.sh_degree), reference),
        object_gaussians=len(subset.rows),
        changed_gaussians=subset.changed(attacked),
        redraws=_redraws(views, config, judged.views(config.judge_seed, config.held_out)),
        originals=problem.originals,
        warnings=(),
        objective=problem.objective,
        transformations=views.transformations,
        judged=judged.transformations,
        config=config,
        origin=_origin(views, problem),
        seconds=0.0,
    )


def _check_detectors(detectors: Sequence[Detector], objective: Objective) -> None:
    """Raise unless there are detectors of different names that know the target class."""
    names = [detector.name for detector in detectors]
    if not names or len(set(names)) < len(names):
        raise InvalidValueError(message("detectors", "at least one, of different names", names, "name each once"))
    for detector in detectors:
        if objective.label is not None and objective.label not in detector.classes:
            expected = f"a class of {detector.name}: {', '.join(detector.classes)}"
            do = nearest(objective.label, detector.classes, "choose a class that all know")
            raise InvalidValueError(message("target", expected, objective.label, do))


def _originals(views: ViewDistribution, detectors: Sequence[Detector], config: EotConfig) -> dict[str, str | None]:
    """What each detector calls the clean object in most of the validation views."""
    seed = config.seed + VALIDATION_SEED_OFFSET
    found = clean_detections(views, detectors, seed=seed, count=config.validation)
    return {
        detector.name: usual_label([one for (_, name), one in found.items() if name == detector.name])
        for detector in detectors
    }


def _redraws(views: ViewDistribution, config: EotConfig, held_out: Sequence[DrawnView]) -> dict[str, int]:
    """Cameras drawn in vain, by what they were drawn for; of an unlimited pool nothing is known."""
    groups = {
        "held_out": held_out,
        "validation": views.views(config.seed + VALIDATION_SEED_OFFSET, config.validation),
        "attacked": views.views(config.seed, min(config.pool, config.batch * (config.steps + 1))),
    }
    return {name: sum(view.redraws for view in some) for name, some in groups.items()}


def _origin(views: ViewDistribution, problem: EotProblem) -> dict[str, Any]:
    return {
        "detectors": {detector.name: detector.fingerprint for detector in problem.detectors},
        "scene_hash": scene_hash(views.scene),
        "reference": values_of(views.reference),
        **provenance.rendered_with(views.render),
        **provenance.origin(),
    }


def _key(views: ViewDistribution, problem: EotProblem, config: EotConfig) -> str:
    """Hash of everything that the search depends on; what only judges it does not count."""
    settings = {
        **dataclasses.asdict(config),
        **dict.fromkeys(("held_out", "judge_seed", "noise_draws")),
        "transformations": dataclasses.asdict(views.transformations),
        "objective": repr(problem.objective),
        "detectors": {detector.name: detector.fingerprint for detector in problem.detectors},
        "scene": scene_hash(views.scene),
        "rows": hashlib.sha256(problem.subset.rows.cpu().numpy().tobytes()).hexdigest(),
        "reference": [*views.reference.to_world.flatten().tolist(), views.reference.fx, views.reference.fy],
        "size": [views.reference.width, views.reference.height],
        "render": repr(getattr(views.render, "settings", None)),
        "threads": torch.get_num_threads(),
    }
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
