"""The clean splat's file with its object in layers, whose colours are trained on poisoned pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.kinds.parts import SET, SceneJob, renderer_of
from attacks.cloak.kinds.trained import train_into
from attacks.cloak.layer_config import LayersConfig, layered_fit_config
from attacks.cloak.layers import layer_object
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat
from mi_splat.training.resume import METRICS

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = (METRICS,)


@dataclass(frozen=True, slots=True, kw_only=True)
class LayeredConfig(SceneJob):
    """How the layers are made and trained; the attacks are those that have one."""

    layers: LayersConfig


def run(config: LayeredConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Make the layers, and train them or go on with what an interrupted training left."""
    setup, layers, background = config.setup(inputs), config.layers, config.scene.background
    fit = layered_fit_config(layers)
    views = load_dataset(inputs["pictures"] / SET, split="train", background=background)
    render = renderer_of(background, config.near, fit=fit)
    out.progress("making the layers", 0, 1)
    layering = layer_object(setup, layers, load_splat(inputs["clean"]), views, render=render)
    train_into(out, layering.views, layering.scene, layering.rendered_by(render), fit, seed=config.seed)
