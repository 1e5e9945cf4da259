"""The clean splat's file with its object in layers, whose colours are trained on poisoned pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.kinds.parts import SET, StepConfig
from attacks.cloak.kinds.rendering import renderer_of
from attacks.cloak.kinds.trained import train_into
from attacks.cloak.layer_config import layered_fit_config
from attacks.cloak.layers import layer_object
from attacks.cloak.setup import Setup
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat
from mi_splat.training.resume import METRICS

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = (METRICS,)


def run(config: StepConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Make the layers, and train them or go on with what an interrupted training left."""
    setup = Setup(config.study(inputs))
    study = setup.study
    assert study.layers is not None
    fit = layered_fit_config(study.layers)
    views = load_dataset(inputs["pictures"] / SET, split="train", background=study.scene.background)
    render = renderer_of(study, fit)
    out.progress("making the layers", 0, 1)
    layering = layer_object(setup, load_splat(inputs["clean"]), views, render=render)
    train_into(out, layering.views, layering.scene, layering.rendered_by(render), fit, seed=study.seeds[0])
