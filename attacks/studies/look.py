"""What one detector reports on one attacked splat under one condition: clean, attacked,
and with its controls.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from attacks.dagger.config import DaggerConfig
from attacks.dagger.controls import control_scenes
from attacks.dagger.problem import Problem, counted_from
from attacks.dagger.views import View, fixed_views
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import PluggedObjective
from attacks.objectives.base import Target, least_confidence
from attacks.objectives.relabel import Relabel
from attacks.objectives.suppression import Hide, Untargeted
from attacks.observe import Control
from attacks.observe.conditions import OWN, Condition, SunTable, Viewing, condition_of
from attacks.observe.observations import observe, report_cells, seen_from, verdict_cells
from attacks.observe.rows import ATTACKED, CLEAN, OPERATING
from attacks.observe.views import ViewDetections, image_change
from attacks.optimisers import NormName
from attacks.studies.attack import AttackScene, attack_scene, detectors_of, drawn_views
from attacks.transformations.config import Transformations
from attacks.transformations.draws import ImageTransformation, changing
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.io import load_splat
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.ledger import Out

HELD_OUT = "held-out views"
"""Name of the condition of looks from a region."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """One look: through the cameras that were attacked, or from held-out views of a
    region.
    """

    object: str
    objective: Relabel | Hide | Untargeted | PluggedObjective
    detector: str
    attributes: tuple[str, ...]
    eps: tuple[float, ...]
    norm: NormName
    # highest degree of the SH coefficients that controls may change; None is the
    # splat's
    sh_degree: int | None = None
    controls: tuple[Control, ...] = ("noise",)  # a draw of each is looked at
    seed: int
    condition: str = ""
    sun: SunTable | None = None
    camera: int = 0
    views: int = 1
    # where views are drawn from; None where cameras are fixed
    transformations: Transformations | None = None
    fingerprints: tuple[str, ...] = ()
    # which package brings the condition, with its version; empty for this project
    package: str = ""


def run(config: Look, inputs: Mapping[str, Path], out: Out) -> list[dict[str, Any]]:
    """Look at the splats of a job with its detector."""
    scene = attack_scene(inputs["scene"])
    rows = scene.objects[config.object]
    original = config.object.replace("_", " ")
    viewing = Viewing(
        settings=scene.settings,
        centre=scene.centre(config.object),
        alone=lambda splat: splat.select(rows),
        sun=config.sun,
        clean=scene.scene.select(rows),
    )
    condition = condition_of(config.condition, viewing)
    subset = GaussianSubset.of(scene.scene, rows)
    render = scene.renderer("")
    moved = {
        condition.move(view.camera): view
        for view in _views(config, scene, subset, inputs)
    }
    shown = {
        camera: (
            view
            if camera is view.camera
            else fixed_views(subset, [camera], render=render)[0]
        )
        for camera, view in moved.items()
    }
    if config.transformations is not None:
        condition = _changing(
            condition, {camera: view.change for camera, view in moved.items()}
        )
    directions = seen_from(viewing.centre)

    splats = _splats(config, scene, load_splat(inputs["attacked"]), [*moved.values()])
    detectors = detectors_of((config.detector,), inputs)
    wanted = config.objective
    before = dict[int, Tensor]()
    classes = tuple(detectors[0].classes)

    def cells(seen: ViewDetections) -> dict[str, Any]:
        assert seen.box is not None  # as `fixed_views` has seen to
        target = Target(
            box=seen.box,
            label=wanted.label,
            classes=classes,
            original=original,
            threshold=counted_from(wanted, detectors[0]),
        )
        reported = report_cells(
            seen.detections, seen.box, original=original, target=wanted.label
        )
        verdict = verdict_cells(wanted.verdict(seen.detections, target))
        clean = before.setdefault(seen.view, seen.image)  # the clean splat is the first
        change = image_change(
            [clean], [seen.image], [shown[seen.camera].weight]
        ).psnr_object
        return {
            **directions(seen),
            **reported,
            **verdict,
            "threshold": least_confidence(wanted, target),
            OPERATING: target.threshold,
            "object_psnr": change,
        }

    unmoved = replace(condition, move=lambda camera: camera)
    looked = observe(
        unmoved,
        splats,
        list(shown),
        detectors,
        boxes=lambda camera: shown[camera].box,
        cells=cells,
    )
    name = config.condition or (OWN if config.transformations is None else HELD_OUT)
    return [{**row, "condition": name} for row in looked.rows.iter_rows(named=True)]


def _views(
    config: Look, scene: AttackScene, subset: GaussianSubset, inputs: Mapping[str, Path]
) -> list[View]:
    if config.transformations is not None:
        views = drawn_views(scene, config, inputs, config.transformations)
        return views.views(config.seed, config.views)
    cameras = scene.attacked(
        config.object,
        inputs,
        camera=config.camera,
        count=config.views,
        seed=config.seed,
    )
    return fixed_views(subset, cameras, render=scene.renderer(""))


def _changing(
    condition: Condition, changes: Mapping[Camera, ImageTransformation]
) -> Condition:
    """The condition in images to which something happens."""

    def show(splat: GaussianScene) -> tuple[GaussianScene, RenderFn]:
        shown, render = condition.show(splat)
        return shown, changing(render, changes)

    return replace(condition, show=show)


def _splats(
    config: Look, scene: AttackScene, saved: GaussianScene, views: Sequence[View]
) -> dict[str, GaussianScene]:
    """The clean splat, the attacked one, and its controls, which are matched to it in
    the views without a condition.
    """
    rows = scene.objects[config.object]
    drawn = config.transformations is not None
    clean, attacked = clean_and_attacked(
        scene.scene, rows, saved.select(rows) if drawn else saved, config.attributes
    )
    clean, attacked = (
        replace(subset, sh_degree=config.sh_degree) for subset in (clean, attacked)
    )
    settings = DaggerConfig(
        attributes=config.attributes,
        eps=config.eps,
        norm=config.norm,
        seed=config.seed,
        sh_degree=config.sh_degree,
        controls=config.controls,
        noise_draws=1,
    )
    render = scene.renderer("")

    @functools.cache
    def image(camera: Camera) -> Tensor:
        with torch.no_grad():
            return render(clean.scene, camera).clamp(0, 1)

    problem = Problem(
        subset=clean,
        detectors=(),
        objective=config.objective,
        originals=lambda view, name: None,
        render=render,
        clean=image,
    )
    controls = control_scenes(
        problem, attacked.parameters(config.attributes), settings, views
    )
    # The file of an attack on a region holds the whole scene.
    shown = (scene.scene, saved) if drawn else (clean.scene, attacked.scene)
    return {
        CLEAN: shown[0],
        ATTACKED: shown[1],
        **{name: noisy for (name, _), noisy in controls},
    }


def clean_and_attacked(
    scene: GaussianScene, rows: slice, saved: GaussianScene, attributes: Sequence[str]
) -> tuple[GaussianSubset, GaussianSubset]:
    """An object in the clean scene, with as many coefficients as the attacked one has,
    and in the attacked scene.
    """
    clean = GaussianSubset.of(scene.with_degree(max(saved.degree, scene.degree)), rows)
    values = {
        name: whole.clone().index_put((clean.rows,), part)
        for name, whole, part in zip(
            ATTRIBUTES, clean.scene.tensors(), saved.tensors(), strict=True
        )
        if name in attributes
    }
    return clean, GaussianSubset.of(clean.scene.replace(**values), rows)
