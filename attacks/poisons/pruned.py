"""A kind of job: a finished splat without the Gaussians that are too fine for the cameras that it was trained from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.kinds.parts import SET, StepConfig
from attacks.poisons.config import FrequencyPruningConfig
from attacks.poisons.defences import frequency_pruned
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat, save_splat
from mi_splat.training.resume import SPLAT

if TYPE_CHECKING:
    from mi_splat.ledger import Out


@dataclass(frozen=True, slots=True, kw_only=True)
class PrunedConfig(StepConfig):
    """From where on a Gaussian is too fine."""

    prune: FrequencyPruningConfig


def run(config: PrunedConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Prune the `splat` by the cameras of the `pictures`."""
    views, near = load_dataset(inputs["pictures"] / SET, split="train"), config.asked.training.near
    assert near is not None
    save_splat(frequency_pruned(load_splat(inputs["splat"]), views, config.prune, near=near), out / SPLAT)
