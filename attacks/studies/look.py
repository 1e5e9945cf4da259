"""What one detector reports on one attacked splat under one condition: clean, attacked, and with noise of its size."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Generator

from attacks.aims import PluggedObjective
from attacks.dagger.config import Control, DaggerConfig
from attacks.dagger.controls import control_scenes
from attacks.dagger.problem import Problem
from attacks.dagger.views import View, fixed_views
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import Hide, Relabel, Target, Untargeted
from attacks.observe.conditions import OWN, Condition, SunTable, Viewing, condition_of
from attacks.observe.observations import observe, report_cells, seen_from, verdict_cells
from attacks.observe.rows import ATTACKED, CLEAN, NOISE
from attacks.observe.views import ViewDetections
from attacks.optimisers import NormName
from attacks.search import Budget
from attacks.studies.attack import AttackScene, attack_scene, detectors_of, distribution
from attacks.transformations.config import Transformations
from attacks.transformations.draws import PictureChange, changing
from mi_splat.attributes import ATTRIBUTES, Attribute
from mi_splat.cameras import Camera, RenderFn
from mi_splat.io import load_splat
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.ledger import Out

HELD_OUT = "held-out views"
"""Name of the condition of looks from a region."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """One look: through the cameras that were attacked, or from held-out views of a region."""

    object: str
    objective: Relabel | Hide | Untargeted | PluggedObjective
    detector: str
    attributes: tuple[Attribute, ...]
    eps: tuple[float, ...]
    norm: NormName
    sh_degree: int | None = None  # highest degree of the SH coefficients that noise may change; None is the splat's
    seed: int
    condition: str = ""
    sun: SunTable | None = None
    camera: int = 0
    views: int = 1
    transformations: Transformations | None = None  # where views are drawn from; None where cameras are fixed
    fingerprints: tuple[str, ...] = ()
    controls: tuple[Control, ...] = ()  # random changes by name; none is noise of the attack's norm
    package: str = ""  # which package brings the condition, with its version; empty for this project


def run(config: Look, inputs: Mapping[str, Path], out: Out) -> list[dict[str, Any]]:
    """Look at the splats of a job with its detector."""
    scene = attack_scene(inputs["scene"])
    rows, original = scene.objects[config.object], config.object.replace("_", " ")
    viewing = Viewing(
        settings=scene.settings,
        centre=scene.centre(config.object),
        alone=lambda splat: splat.select(rows),
        sun=config.sun,
        clean=scene.scene.select(rows),
    )
    condition = condition_of(config.condition, viewing)
    subset, render = GaussianSubset.of(scene.scene, rows), scene.renderer("")
    moved = {condition.move(view.camera): view for view in _views(config, scene, subset, inputs)}
    boxes = {
        camera: view.box if camera is view.camera else fixed_views(subset, [camera], render=render)[0].box
        for camera, view in moved.items()
    }
    if config.transformations is not None:
        condition = _changing(condition, {camera: view.change for camera, view in moved.items()})
    directions = seen_from(viewing.centre)

    splats = _splats(config, scene, load_splat(inputs["attacked"]), list(moved.values()))
    detectors = detectors_of((config.detector,), inputs)
    wanted, classes = config.objective, tuple(detectors[0].classes)

    def cells(seen: ViewDetections) -> dict[str, Any]:
        assert seen.box is not None  # as `fixed_views` has seen to
        target = Target(box=seen.box, label=wanted.label, classes=classes, original=original)
        reported = report_cells(seen.detections, seen.box, original=original, target=wanted.label)
        return {**directions(seen), **reported, **verdict_cells(wanted.verdict(seen.detections, target))}

    unmoved = replace(condition, move=lambda camera: camera)
    looked = observe(unmoved, splats, list(boxes), detectors, boxes=boxes.__getitem__, cells=cells)
    shown = config.condition or (OWN if config.transformations is None else HELD_OUT)
    return [{**row, "condition": shown} for row in looked.rows.iter_rows(named=True)]


def _views(config: Look, scene: AttackScene, subset: GaussianSubset, inputs: Mapping[str, Path]) -> list[View]:
    if config.transformations is not None:
        return distribution(scene, config.object, config.transformations).views(config.seed, config.views)
    cameras = scene.attacked(config.object, inputs, camera=config.camera, count=config.views, seed=config.seed)
    return fixed_views(subset, cameras, render=scene.renderer(""))


def _changing(condition: Condition, changes: Mapping[Camera, PictureChange]) -> Condition:
    """The condition in pictures to which something happens."""

    def show(splat: GaussianScene) -> tuple[GaussianScene, RenderFn]:
        shown, render = condition.show(splat)
        return shown, changing(render, changes)

    return replace(condition, show=show)


def _splats(config: Look, scene: AttackScene, saved: GaussianScene, views: Sequence[View]) -> dict[str, GaussianScene]:
    """The clean splat, the attacked one, and random changes as large as the attack on what it could change."""
    rows, drawn = scene.objects[config.object], config.transformations is not None
    clean, attacked = clean_and_attacked(scene.scene, rows, saved.select(rows) if drawn else saved, config.attributes)
    clean, attacked = (replace(subset, sh_degree=config.sh_degree) for subset in (clean, attacked))
    reference, moved = (subset.parameters(config.attributes) for subset in (clean, attacked))
    if config.controls:
        problem, attack = _problem(config, clean, scene.renderer("")), _attack(config)
        changed = {name: splat for (name, _), splat in control_scenes(problem, moved, attack, views)}
        return {CLEAN: clean.scene, ATTACKED: attacked.scene, **changed}
    radii = config.eps if len(config.eps) > 1 else config.eps * len(config.attributes)
    budget = Budget(radius=dict(zip(config.attributes, radii, strict=True)), norm=config.norm)
    noisy = clean.applied(budget.noise(moved, reference, Generator().manual_seed(config.seed + 1)))
    # The file of an attack on a region holds the whole scene.
    shown = (scene.scene, saved) if drawn else (clean.scene, attacked.scene)
    return {CLEAN: shown[0], ATTACKED: shown[1], NOISE: noisy}


def _problem(config: Look, clean: GaussianSubset, render: RenderFn) -> Problem:
    """What the attack saw, as far as its controls ask."""
    return Problem(
        subset=clean,
        detectors=(),
        objective=config.objective,
        originals=lambda view, name: None,
        render=render,
        clean=functools.cache(lambda camera: render(clean.scene, camera).clamp(0, 1)),
    )


def _attack(config: Look) -> DaggerConfig:
    """The settings of the attack, as far as its controls ask."""
    return DaggerConfig(
        attributes=config.attributes,
        eps=config.eps,
        norm=config.norm,
        sh_degree=config.sh_degree,
        seed=config.seed,
        controls=config.controls,
        noise_draws=1,
    )


def clean_and_attacked(
    scene: GaussianScene, rows: slice, saved: GaussianScene, attributes: Sequence[str]
) -> tuple[GaussianSubset, GaussianSubset]:
    """An object in the clean scene, with as many coefficients as the attacked one has, and in the attacked scene."""
    clean = GaussianSubset.of(scene.with_degree(max(saved.degree, scene.degree)), rows)
    values = {
        name: whole.clone().index_put((clean.rows,), part)
        for name, whole, part in zip(ATTRIBUTES, clean.scene.tensors(), saved.tensors(), strict=True)
        if name in attributes
    }
    return clean, GaussianSubset.of(clean.scene.replace(**values), rows)
