"""DAGGER: projected gradient descent on the finished splat file, so that a detector sees one object as something else.

After "3D Gaussian Splat Vulnerabilities": the attacker holds the splat and the detector (white box) and edits only the
Gaussians of one object. The paper's text takes eleven steps of length 2 eps / steps in one l2 ball of radius 5 over the
SH coefficients. The search is PGD (Madry et al. 2018, see `attacks.pgd`).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from torch import Generator

from attacks.dagger.config import DaggerConfig
from attacks.dagger.ensemble import Ensemble
from attacks.dagger.result import NoiseControl, Result, find_warnings
from attacks.detectors.base import Detector
from attacks.detectors.given import as_detectors
from attacks.gaussian_subset import GaussianSubset, Mask
from attacks.objectives import Objective, check_objective
from attacks.observe.views import as_saved, clamped_fraction, image_change
from attacks.optimisers import momentum
from attacks.pgd import Outcome, Parameters, Step, pgd
from mi_splat import provenance
from mi_splat.cameras import Camera, RenderFn, as_cameras
from mi_splat.errors import InvalidValueError, message
from mi_splat.scene import GaussianScene, check_scene, scene_hash


def attack(
    scene: GaussianScene,
    mask: Mask,
    cameras: Camera | Sequence[Camera],
    detector: Detector | str | Sequence[Detector | str],
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
        cameras: Views that are attacked together, or one.
        detector: The one attacked, or several to be deceived at once, or their names; their weights are known (white
            box).
        objective: What the detector shall see, for instance `relabel("person")` or `hide()`.
        render: Any differentiable renderer.
        config: Budget, steps and seed; the paper's if None.
        on_step: Called with every line of the trace as it happens.

    Raises:
        InvalidValueError: An argument is of another kind, the mask selects nothing, a view does not show the object,
            a detector does not know the target class, two have one name, or a gradient is not finite.
    """
    config = config or DaggerConfig()
    begun = time.perf_counter()
    cameras, detectors = as_cameras(cameras), as_detectors(detector)
    check_scene("scene", scene)
    check_objective(objective)
    _check_views(cameras, render)
    clean_hash = scene_hash(scene)
    if config.sh_degree is not None and "sh" in config.attributes and scene.degree < config.sh_degree:
        scene = scene.with_degree(config.sh_degree)
    subset = GaussianSubset.of(scene, mask)
    ensemble = Ensemble.of(detectors, subset, cameras, objective, render=render, config=config)
    reference = subset.parameters(config.attributes)
    outcome = _search(ensemble.frozen(config), reference, config, on_step)
    attacked = subset.applied(outcome.parameters)
    saved = as_saved(attacked)
    in_file = GaussianSubset.of(saved, subset.rows).parameters(config.attributes)
    results = ensemble.judge(saved)
    clean_views = ensemble.views[0]  # the pictures are the same for every detector
    result = Result(
        scene=attacked,
        verdict=ensemble.verdict(results),
        detectors=results,
        trace=outcome.trace,
        best=outcome.best,
        used=config.budget.measure(outcome.parameters, reference),
        used_in_file=config.budget.measure(in_file, reference),
        object_gaussians=len(subset.rows),
        changed_gaussians=subset.changed(attacked),
        image=image_change(
            [view.image for view in clean_views],
            [view.after.image for view in results[0].views],
            [view.weight for view in clean_views],
        ),
        clamped_fraction=sum(clamped_fraction(subset, view.camera) for view in clean_views) / len(clean_views),
        noise=_noise_control(ensemble, subset, outcome.parameters, config),
        warnings=(),
        objective=objective,
        config=config,
        origin=_origin(clean_hash, detectors, render),
        seconds=time.perf_counter() - begun,
    )
    return dataclasses.replace(result, warnings=find_warnings(result))


def _check_views(cameras: Sequence[Camera], render: object) -> None:
    """Raise unless there are cameras, and something to render with."""
    if not callable(render):
        do = "pass for instance Renderer()"
        raise InvalidValueError(message("render", "a function of scene and camera", type(render).__name__, do))
    if not cameras:
        raise InvalidValueError(message("cameras", "at least one camera", "none", "say where the detector looks from"))


def _search(
    ensemble: Ensemble,
    reference: Parameters,
    config: DaggerConfig,
    on_step: Callable[[Step], None] | None,
) -> Outcome:
    """The attacker's search, on pictures as the renderer makes them."""
    budget, generator = config.budget, Generator().manual_seed(config.seed)

    def starts() -> Iterator[Parameters]:
        for restart in range(config.restarts):
            yield budget.uniform(reference, generator) if restart or config.random_start else reference

    return pgd(
        ensemble.evaluate,
        reference,
        budget,
        step=config.step,
        steps=config.steps,
        starts=starts(),
        optimiser=momentum(
            decay=config.momentum, schedule=config.schedule, steps=config.steps, power=config.gradient_power
        ),
        early_stop=config.early_stop,
        on_step=on_step,
    )


def _noise_control(
    ensemble: Ensemble, subset: GaussianSubset, parameters: Parameters, config: DaggerConfig
) -> NoiseControl:
    """Random noise of the same size in the same norm, judged on 8-bit pictures."""
    generator = Generator().manual_seed(config.seed + 1)  # not the draws of the attack's own starting points
    reference = subset.parameters(config.attributes)
    verdicts, views = [], []
    for _ in range(config.noise_draws):
        noisy = config.budget.noise(parameters, reference, generator)
        judged = ensemble.judge(subset.applied(noisy))
        verdicts.append(ensemble.verdict(judged))
        views.append(tuple(view.verdict for one in judged for view in one.views))
    return NoiseControl(
        scores=tuple(verdict.score for verdict in verdicts),
        successes=sum(verdict.success for verdict in verdicts),
        views=tuple(views),
    )


def _origin(clean_hash: str, detectors: Sequence[Detector], render: RenderFn) -> dict[str, Any]:
    return {
        "detector": " + ".join(detector.name for detector in detectors),
        "detector_fingerprint": " + ".join(detector.fingerprint for detector in detectors),
        "scene_hash": clean_hash,
        **provenance.rendered_with(render),
        **provenance.origin(),
    }
