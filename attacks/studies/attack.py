"""One attack of a study: an object attacked from some of its scene's cameras, or from all cameras of a region.

What it leaves: result.json as `mi-splat dagger` writes it, a picture of what was reported before and
after, and the splat: object.ply has the object's Gaussians alone, attacked.ply of a region the whole scene.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from attacks.aims import PluggedObjective
from attacks.dagger.attack import attack, attack_views
from attacks.dagger.config import DaggerConfig
from attacks.dagger.report import before_and_after, summary, write_files
from attacks.dagger.search import Checkpoint
from attacks.dagger.views import DrawnViews
from attacks.objectives import Hide, Relabel, Untargeted
from attacks.search import Step
from attacks.studies.scenes import AttackScene, attack_scene, detectors_of
from attacks.transformations.config import Transformations
from mi_splat.cameras import Camera, RenderFn
from mi_splat.io import save_splat
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.folders import RECORD
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from torch import Tensor

    from mi_splat.ledger import Out

VARIES = (RECORD,)
SPLAT, WHOLE_SPLAT, PICTURE = "object.ply", "attacked.ply", "detections.png"


@dataclass(frozen=True, slots=True, kw_only=True)
class Attack:
    """One attack."""

    object: str  # id of the object
    objective: Relabel | Hide | Untargeted | PluggedObjective  # what the detectors shall see
    detectors: tuple[str, ...] = ("fasterrcnn_small",)  # attacked at once
    fingerprints: tuple[str, ...] = ()  # of the detectors whose weights are in no file
    packages: tuple[str, ...] = ()  # that bring the optimiser and the renderers; empty for this project


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedAttack(Attack):
    """An attack from some of the scene's cameras."""

    attack: DaggerConfig = field(default_factory=DaggerConfig)  # its seed also moves the cameras, see `jittered`
    camera: int = 0  # position of the first camera that is attacked, in the order of the scene file
    views: int = 1  # cameras that are attacked together, from that one on; 0 is all of them
    renderer: str = ""  # whose pictures the attacker looks at; "" is the scene's own
    gradient: str = ""  # whose gradient the attacker follows; "" is that of the pictures


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnAttack(Attack):
    """An attack from all cameras of a region."""

    attack: DaggerConfig = field(default_factory=DaggerConfig.for_region)  # how to attack
    transformations: Transformations = field(default_factory=Transformations)  # the views that it is made for
    judged: Transformations | None = None  # the views that judge it, where these are others


def run(config: FixedAttack | DrawnAttack, inputs: Mapping[str, Path], out: Out) -> list[dict[str, Any]]:
    """Attack, and write what comes of it."""
    scene = attack_scene(inputs["scene"])

    def follow(step: Step) -> None:
        out.progress("attacking", step.index, config.attack.steps)

    detectors = detectors_of(config.detectors, inputs)
    if isinstance(config, FixedAttack):
        result = attack(
            scene.scene,
            scene.objects[config.object],
            scene.views(config.object, camera=config.camera, count=config.views, seed=config.attack.seed),
            detectors,
            config.objective,
            render=attackers_renderer(scene, config.renderer, config.gradient),
            config=config.attack,
            on_step=follow,
        )
        named = len(result.detectors) > 1
        save_png(np.concatenate([before_and_after(view, named=named) for view in result.views]), out / PICTURE)
        save_splat(result.scene.select(scene.objects[config.object]), out / SPLAT)
        save_json(summary(result), out / RECORD)
    else:
        result = attack_views(
            distribution(scene, config.object, config.transformations),
            detectors,
            config.objective,
            config=config.attack,
            judged=None if config.judged is None else distribution(scene, config.object, config.judged),
            checkpoint=Checkpoint(path=out.partial / "search.checkpoint"),
            on_step=follow,
        )
        write_files(result, out.files)
    return list(result.looked.rows.iter_rows(named=True))


@functools.lru_cache(maxsize=4)
def distribution(scene: AttackScene, name: str, transformations: Transformations) -> DrawnViews:
    """The views of an object; drawn once for all jobs of a process."""
    reference = next(iter(scene.cameras.values()))
    return DrawnViews(scene.scene, scene.objects[name], reference, transformations, render=scene.renderer(""))


def attackers_renderer(scene: AttackScene, renderer: str, gradient: str) -> RenderFn:
    """What makes the attacker's pictures, with the gradient of another renderer if one is named."""
    picture = scene.renderer(renderer)
    same = gradient in ("", renderer)
    return picture if same else with_gradient_of(scene.renderer(gradient), picture)


def with_gradient_of(gradient: RenderFn, picture: RenderFn) -> RenderFn:
    """The pictures of `picture`, through which autograd goes as through those of `gradient`.

    A derivative of the loss by the pixels is therefore that at the picture that is shown; the derivative of the pixels
    by the Gaussians is the other renderer's.
    """

    def rendered(scene: GaussianScene, camera: Camera) -> Tensor:
        with torch.no_grad():
            shown = picture(scene.detach(), camera)
        if not any(tensor.requires_grad for tensor in scene.tensors()):
            return shown
        carrier = gradient(scene, camera)
        return carrier + (shown - carrier).detach()

    return rendered
