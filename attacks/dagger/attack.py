"""DAGGER: projected gradient descent on the finished splat file, so that a detector sees one object as something else.

After "3D Gaussian Splat Vulnerabilities": the attacker holds the splat and the detector (white box) and edits only the
Gaussians of one object. The paper's text takes eleven steps of length 2 eps / steps in one l2 ball of radius 5 over the
SH coefficients. The search is PGD (Madry et al. 2018, see `attacks.search`), over fixed views (`attack`) or over a
distribution of them (`attack_views`: expectation over transformation, Athalye et al. 2018).
"""

import dataclasses
import hashlib
import json
import time
from collections.abc import Sequence

import torch
from torch import Generator

from attacks.dagger.config import Config, DaggerConfig, EotConfig
from attacks.dagger.judging import Reports, clean_reports, judge, look
from attacks.dagger.problem import Problem, check_detectors
from attacks.dagger.result import Result, counted
from attacks.dagger.search import VALIDATION_SEED_OFFSET, Checkpoint, OnStep, search_drawn, search_fixed
from attacks.dagger.views import View, ViewDistribution, fixed_views
from attacks.detectors.base import Detections, Detector
from attacks.detectors.registry import as_detectors
from attacks.gaussian_subset import GaussianSubset, Mask
from attacks.objectives import Objective, check_objective, overlap
from attacks.observe.comparison import usual_label
from attacks.observe.views import as_saved, clamped_fraction
from attacks.search import Outcome
from attacks.transformations.config import Transformations
from mi_splat import provenance
from mi_splat.cameras import Camera, RenderFn, as_cameras
from mi_splat.directions import UP, Point
from mi_splat.errors import InvalidValueError
from mi_splat.io.camera_records import values_of
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
    up: Point = UP,
    on_step: OnStep | None = None,
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
        up: (3,) direction that is up in the scene, for the azimuth and the elevation of each view.
        on_step: Called with every line of the trace as it happens; once it says so, the search ends with the best
            point so far.

    Returns:
        What the attack did.

    Raises:
        InvalidValueError: An argument is of another kind, the mask selects nothing, a view does not show the object,
            a detector does not know the target class, two have one name, or a gradient is not finite.
    """
    begun, config, detectors = time.perf_counter(), config or DaggerConfig(), as_detectors(detector)
    cameras = as_cameras(cameras)
    check_scene("scene", scene)
    check_objective(objective)
    _check_views(cameras, render)
    subset = GaussianSubset.of(widened(scene, config), mask)
    check_detectors(detectors, objective)
    problem, views, reports = fixed_problem(subset, cameras, detectors, objective, render=render, up=up)
    searched = (problem, views)
    if config.alone:
        only = GaussianSubset.of(subset.scene.select(subset.rows), slice(None))
        searched = fixed_problem(only, cameras, detectors, objective, render=render)[:2]
    clock = time.process_time()
    outcome = search_fixed(*searched, config, on_step)
    spent = time.process_time() - clock
    origin = {
        "detector": " + ".join(detector.name for detector in detectors),
        "detector_fingerprint": " + ".join(detector.fingerprint for detector in detectors),
        "scene_hash": scene_hash(scene),
        **_kept_up(up),
    }
    result = _judged(problem, config, outcome, views, (subset.scene, reports), None)
    seconds = time.perf_counter() - begun
    return dataclasses.replace(result, origin=result.origin | origin, seconds=seconds, cpu_seconds=spent)


def attack_views(
    views: ViewDistribution,
    detectors: Detector | str | Sequence[Detector | str],
    objective: Objective,
    *,
    config: EotConfig | None = None,
    judged: ViewDistribution | None = None,
    checkpoint: Checkpoint | None = None,
    on_step: OnStep | None = None,
) -> Result:
    """Attack one object so that it deceives from all views of a distribution, and judge that on held-out views.

    Args:
        views: The object and the distribution of its views.
        detectors: Those attacked, all at once: the loss is the mean over them, and a view is a success when every
            one is deceived. Their weights are known (white box).
        objective: What they shall see, for instance `relabel("person")` or `hide()`.
        config: Budget, steps, views and seeds.
        judged: Where the held-out views are drawn from, for instance with pictures that change; None is `views`.
        checkpoint: Where to keep the search while it runs; one that is there is taken up again.
        on_step: Called with every line of the trace as it happens; once it says so, the search ends with the best
            point so far.

    Returns:
        What the attack did, judged on the held-out views.

    Raises:
        InvalidValueError: An argument is of another kind, a detector does not know the target class, no view shows the
            object, or a gradient is not finite.
        CheckpointError: The checkpoint is one of another attack.
    """
    config, judged, detectors = config or EotConfig(), judged or views, as_detectors(detectors)
    check_objective(objective)
    check_detectors(detectors, objective)
    originals = _originals(views, detectors, config)
    problem = Problem(
        subset=GaussianSubset.of(widened(views.scene, config), views.mask, sh_degree=config.sh_degree),
        detectors=detectors,
        objective=objective,
        originals=lambda view, name: originals[name],
        render=views.render,
        clean=views.picture,
        frozen=views.frozen,
    )
    key = _key(views, problem, config)
    outcome, seconds = search_drawn(problem, views, config, key=key, checkpoint=checkpoint, on_step=on_step)
    begun = time.perf_counter()
    reports = clean_reports(judged, detectors, seed=config.judge_seed, count=config.held_out)
    held_out, clean = judged.views(config.judge_seed, config.held_out), (as_saved(judged.scene), reports)
    result = _judged(problem, config, outcome, held_out, clean, judged.transformations)
    reference = values_of(views.reference)
    origin = {"scene_hash": scene_hash(views.scene), "reference": reference, **_kept_up(views.up)}
    if checkpoint is not None:
        checkpoint.path.unlink(missing_ok=True)
    return dataclasses.replace(
        result,
        origin=result.origin | origin,
        redraws=_redraws(views, config, held_out),
        transformations=views.transformations,
        seconds=seconds + time.perf_counter() - begun,
    )


def _kept_up(up: Point) -> dict[str, list[float]]:
    """What a result says of the direction that is up: nothing of z."""
    return {} if tuple(up) == UP else {"up": [float(value) for value in up]}


def _check_views(cameras: Sequence[Camera], render: object) -> None:
    """Raise unless there are cameras, and something to render with."""
    if not callable(render):
        do = "pass for instance Renderer()"
        raise InvalidValueError.of("render", "a function of scene and camera", type(render).__name__, do)
    if not cameras:
        raise InvalidValueError.of("cameras", "at least one camera", "none", "say where the detector looks from")


def fixed_problem(
    subset: GaussianSubset,
    cameras: Sequence[Camera],
    detectors: tuple[Detector, ...],
    objective: Objective,
    *,
    render: RenderFn,
    up: Point = UP,
) -> tuple[Problem, list[View], Reports]:
    """The problem of an attack from fixed cameras, its views, and what the detectors report on the clean scene."""
    views = fixed_views(subset, cameras, render=render, up=up)
    reports = look(detectors, subset.scene, views, render)
    originals = {key: _label_on(seen.detections, views[key[0]].box) for key, seen in reports.items()}
    problem = Problem(
        subset=subset,
        detectors=detectors,
        objective=objective,
        originals=lambda view, name: originals[view.index, name],
        render=render,
        clean=lambda camera: render(subset.scene, camera),
    )
    return problem, views, reports


def widened(scene: GaussianScene, config: Config) -> GaussianScene:
    """The scene with as many SH coefficients as the attacked file shall have."""
    degree = config.sh_degree
    wider = degree is not None and "sh" in config.attributes and scene.degree < degree
    return scene.with_degree(degree) if wider and degree is not None else scene


def _judged(
    problem: Problem,
    config: Config,
    outcome: Outcome,
    views: Sequence[View],
    clean: tuple[GaussianScene, Reports],
    drawn: Transformations | None,
) -> Result:
    """What a search has led to, judged beside random noise of the same size; `drawn` is None for fixed views."""
    subset, budget, reference = problem.subset, config.budget, problem.subset.parameters(config.attributes)
    generator = Generator().manual_seed(config.seed + 1)  # not the draws of the attack's own starting points
    attacked = subset.applied(outcome.parameters)
    noisy = [subset.applied(budget.noise(outcome.parameters, reference, generator)) for _ in range(config.noise_draws)]
    saved = as_saved(attacked)
    judgement = judge(problem, views, clean, saved, noisy if drawn is None else list(map(as_saved, noisy)))
    in_file = GaussianSubset.of(saved, subset.rows, sh_degree=subset.sh_degree).parameters(config.attributes)
    names, looked = [detector.name for detector in problem.detectors], judgement.looked(seed=config.seed)
    elevations = None if drawn is None else drawn.cameras.elevations
    return Result(
        scene=attacked,
        judgement=judgement,
        looked=looked,
        figures=counted(looked.rows, names, problem.objective.label, config, elevations),
        fingerprints={detector.name: detector.fingerprint for detector in problem.detectors},
        trace=outcome.trace,
        best=outcome.best,
        stopped=outcome.stopped,
        used=budget.measure(outcome.parameters, reference),
        used_in_file=budget.measure(in_file, reference),
        object_gaussians=len(subset.rows),
        changed_gaussians=subset.changed(attacked),
        clamped_fraction=sum(clamped_fraction(subset, view.camera) for view in views) / len(views),
        objective=problem.objective,
        config=config,
        origin={**provenance.rendered_with(problem.render), **provenance.origin()},
        seconds=0.0,
        judged=drawn,
    )


def _label_on(detections: Detections, box: torch.Tensor) -> str | None:
    """What the detector calls the object: the most confident detection on it."""
    if not len(detections):
        return None
    scores = torch.where(overlap(detections.boxes, box) >= 0.5, detections.scores, -1.0)
    best = int(scores.argmax())
    return detections.labels[best] if float(scores[best]) > 0 else None


def _originals(views: ViewDistribution, detectors: Sequence[Detector], config: EotConfig) -> dict[str, str | None]:
    """What each detector calls the clean object in most of the validation views."""
    reports = clean_reports(views, detectors, seed=config.seed + VALIDATION_SEED_OFFSET, count=config.validation)
    return {
        detector.name: usual_label([seen for (_, name), seen in reports.items() if name == detector.name])
        for detector in detectors
    }


def _redraws(views: ViewDistribution, config: EotConfig, held_out: Sequence[View]) -> dict[str, int]:
    """Cameras drawn in vain, by what they were drawn for; of an unlimited pool nothing is known."""
    groups = {
        "held_out": held_out,
        "validation": views.views(config.seed + VALIDATION_SEED_OFFSET, config.validation),
        "attacked": views.views(config.seed, min(config.pool, config.batch * (config.steps + 1))),
    }
    return {name: sum(view.redraws for view in drawn) for name, drawn in groups.items()}


def _key(views: ViewDistribution, problem: Problem, config: EotConfig) -> str:
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
        **_kept_up(views.up),
        "render": repr(getattr(views.render, "settings", None)),
        "threads": torch.get_num_threads(),
    }
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
