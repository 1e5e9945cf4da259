"""DAGGER: projected gradient descent on the finished splat file, so that a detector
sees one object as something else.

After "3D Gaussian Splat Vulnerabilities": the attacker holds the splat and the detector
(white box) and edits only the Gaussians of one object. The paper's text takes eleven
steps of length 2 eps / steps in one l2 ball of radius 5 over the SH coefficients. The
search is PGD (Madry et al. 2018, see `attacks.search.loop`), over fixed views or over a
distribution of them (expectation over transformation, Athalye et al. 2018).
"""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

from attacks.dagger.config import DaggerConfig
from attacks.dagger.controls import control_scenes
from attacks.dagger.figures import attack_figures
from attacks.dagger.problem import Problem, check_detectors, counted_from
from attacks.dagger.result import Result, judge, observed
from attacks.dagger.search import OnStep, climb
from attacks.dagger.views import DrawnViews, FixedViews, ViewDistribution
from attacks.detectors.base import Detector
from attacks.detectors.registry import as_detectors
from attacks.gaussian_subset import GaussianSubset, Mask
from attacks.objectives.base import Objective, check_objective
from attacks.observe.views import as_saved, clamped_fraction
from attacks.search.loop import Outcome
from mi_splat import provenance
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.cameras.directions import UP, Point
from mi_splat.io.camera_records import values_of
from mi_splat.scene import GaussianScene, scene_hash


def attack(
    scene: GaussianScene,
    mask: Mask,
    cameras: Camera | Sequence[Camera] | ViewDistribution,
    detector: Detector | str | Sequence[Detector | str],
    objective: Objective,
    *,
    render: RenderFn,
    config: DaggerConfig | None = None,
    up: Point = UP,
    on_step: OnStep | None = None,
) -> Result:
    """Attack one object of a scene in one view or many, or from all cameras of a
    region.

    Args:
        scene: The clean splat.
        mask: The object's Gaussians: (N,) bool, row numbers, or a slice.
        cameras: Views that are attacked together, or one, and on which the result is
            evaluated; or a `ViewDistribution`, evaluated on held-out views.
        detector: The one attacked, or several to be deceived at once, or their names;
            their weights are known (white box).
        objective: What the detector shall see, for instance `relabel("person")` or
            `hide()`.
        render: Any differentiable renderer.
        config: Budget, steps and seeds; None is `DaggerConfig.for_views()`, or
            `DaggerConfig.for_region()` for a distribution.
        up: (3,) direction that is up in the scene, for azimuths and elevations.
        on_step: Called with every line of the trace as it happens; once it says so, the
            search ends with the best point so far.

    Returns:
        What the attack did.

    Raises:
        InvalidValueError: An argument is of another kind, the mask selects nothing, a
            view does not show the object, a detector does not know the target class,
            two have one name, or a gradient is not finite.
    """
    if isinstance(cameras, ViewDistribution):
        views: FixedViews = DrawnViews(
            scene,
            mask,
            cameras.reference,
            cameras.transformations,
            render=render,
            up=up,
        )
    else:
        views = FixedViews(scene, mask, cameras, render=render, up=up)
    return attack_views(views, detector, objective, config=config, on_step=on_step)


def attack_views(
    views: FixedViews,
    detectors: Detector | str | Sequence[Detector | str],
    objective: Objective,
    *,
    config: DaggerConfig | None = None,
    evaluation: FixedViews | None = None,
    on_step: OnStep | None = None,
) -> Result:
    """The same for views that are there, which several attacks may share.

    `evaluation` is where the held-out views of a region are drawn from, if elsewhere.
    """
    begun = time.perf_counter()
    detectors = as_detectors(detectors)
    config = config or (
        DaggerConfig.for_views()
        if views.transformations is None
        else DaggerConfig.for_region()
    )
    check_objective(objective)
    check_detectors(detectors, objective)
    views.check(config)
    problem = problem_of(views, detectors, objective, config)
    searched = views.isolated() if config.isolated else views
    if config.isolated:
        attacked = problem_of(searched, detectors, objective, config)
    else:
        attacked = problem
    clock = time.process_time()
    outcome, config, levels = climb(attacked, searched, config, on_step)
    spent = time.process_time() - clock
    views.release()
    result = _judged(problem, config, outcome, evaluation or views)
    return dataclasses.replace(
        result,
        origin=result.origin | _origin(views, detectors),
        redraws=views.redraws(config) if isinstance(views, DrawnViews) else {},
        transformations=views.transformations,
        levels=levels,
        seconds=time.perf_counter() - begun,
        cpu_seconds=spent,
    )


def _origin(views: FixedViews, detectors: Sequence[Detector]) -> dict[str, Any]:
    """What a result says of its detectors, its scene and its views; nothing of z as the
    direction that is up.
    """
    if isinstance(views, DrawnViews):
        reference = {"reference": values_of(views.reference)}
    else:
        reference = {}
    return {
        "detector": " + ".join(detector.name for detector in detectors),
        "detector_fingerprint": " + ".join(
            detector.fingerprint for detector in detectors
        ),
        "scene_hash": scene_hash(views.scene),
        **reference,
        **_kept_up(views.up),
    }


def _kept_up(up: Point) -> dict[str, list[float]]:
    if tuple(up) == UP:
        return {}
    return {"up": [float(value) for value in up]}


def problem_of(
    views: FixedViews,
    detectors: tuple[Detector, ...],
    objective: Objective,
    config: DaggerConfig,
) -> Problem:
    """The problem of an attack on some views."""
    thresholds = {one.name: counted_from(objective, one) for one in detectors}
    return Problem(
        subset=GaussianSubset.of(
            widened(views.scene, config), views.mask, sh_degree=config.sh_degree
        ),
        detectors=detectors,
        objective=objective,
        originals=views.originals(detectors, config, thresholds),
        render=views.render,
        clean=views.picture,
        on_object=config.object_psnr is not None,
        local_gap=config.local_gap,
    )


def widened(scene: GaussianScene, config: DaggerConfig) -> GaussianScene:
    """The scene with as many SH coefficients as the attacked file shall have."""
    degree = config.sh_degree
    wider = degree is not None and "sh" in config.attributes and scene.degree < degree
    if wider and degree is not None:
        return scene.with_degree(degree)
    return scene


def _judged(
    problem: Problem, config: DaggerConfig, outcome: Outcome, views: FixedViews
) -> Result:
    """What a search has led to, judged beside its controls."""
    subset, budget, reference = (
        problem.subset,
        config.budget,
        problem.subset.parameters(config.attributes),
    )
    attacked = subset.applied(outcome.parameters)
    drawn = views.transformations
    held_out = views.held_out(config)
    saved = as_saved(attacked)
    controls = {
        draw: as_saved(noisy)
        for draw, noisy in control_scenes(problem, outcome.parameters, config, held_out)
    }
    views.release()
    clean = (views.saved, views.clean_reports(problem.detectors, held_out))
    judged, image, control_images = judge(
        problem, held_out, clean, saved, controls, config.attributes
    )
    # what a threat has done cannot be read from the Gaussians of a file
    stored = [name for name in config.attributes if name in ATTRIBUTES]
    in_file = GaussianSubset.of(
        saved, subset.rows, sh_degree=subset.sh_degree
    ).parameters(stored)
    names = [detector.name for detector in problem.detectors]
    looked = observed(judged, problem.objective, seed=config.seed)
    elevations = None if drawn is None else drawn.elevations
    return Result(
        scene=attacked,
        views=judged,
        image=image,
        control_images=control_images,
        looked=looked,
        figures=attack_figures(
            looked.rows,
            names,
            problem.objective.label,
            config.required_views,
            elevations,
            drawn=drawn is not None,
        ),
        fingerprints={
            detector.name: detector.fingerprint for detector in problem.detectors
        },
        trace=outcome.trace,
        best=outcome.best,
        stopped=outcome.stopped,
        used=budget.measure(outcome.parameters, reference),
        used_in_file=budget.measure(in_file, reference),
        object_gaussians=len(subset.rows),
        changed_gaussians=subset.changed(attacked),
        clamped_fraction=sum(clamped_fraction(subset, view.camera) for view in held_out)
        / len(held_out),
        objective=problem.objective,
        config=config,
        origin={**provenance.rendered_with(problem.render), **provenance.origin()},
        seconds=0.0,
        evaluation=drawn,
    )
