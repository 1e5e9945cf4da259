"""The clean splat's file with its object in layers, whose colours are trained on poisoned pictures."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak import setup
from attacks.cloak.config import LayersConfig, layered_fit_config
from attacks.cloak.kinds.parts import SET, SceneParts
from attacks.cloak.layers import layer_object
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.training.resume import METRICS, SPLAT, train

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = (METRICS,)


@dataclass(frozen=True, slots=True, kw_only=True)
class LayeredConfig:
    """How layers are made and trained.

    Attributes:
        parts: The scene, and the cones of the attacks that have layers.
        layers: How.
        near: Near plane, world units.
        seed: Of the training.
    """

    parts: SceneParts
    layers: LayersConfig
    near: float
    seed: int


def run(config: LayeredConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Make them, and train them or go on with what an interrupted training left."""
    study = config.parts.study(inputs, layers=config.layers)
    fit = layered_fit_config(config.layers)
    views = load_dataset(inputs["pictures"] / SET, split="train", background=study.scene.background)
    settings = RenderSettings(background=study.scene.background, near=config.near)
    render = Renderer(settings, screen_gradients=ScreenGradients() if fit.strategy.needs_screen_gradients else None)
    out.progress("making the layers", 0, 1)
    clean, target = load_splat(inputs["clean"]), setup.target_of(study.scene)
    layering = layer_object(study, clean, target, views, render=render)
    train(
        layering.views,
        layering.scene,
        out.partial,
        render=layering.rendered_by(render),
        config=fit,
        seed=config.seed,
        on_step=lambda line: out.progress("training the layers", line.iteration, fit.iterations),
    )
    for name in (SPLAT, METRICS):
        os.replace(out.partial / name, out / name)
