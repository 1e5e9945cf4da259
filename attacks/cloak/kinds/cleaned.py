"""A finished splat after what a victim does to it before anybody looks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.cleaning import cleaned
from attacks.cloak.config import CleaningConfig
from attacks.cloak.kinds.parts import SET
from attacks.poisons.config import FrequencyPruningConfig
from attacks.poisons.defences import frequency_pruned
from mi_splat.audit import audit, repaired
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat, save_splat
from mi_splat.training.resume import SPLAT

if TYPE_CHECKING:
    from mi_splat.ledger import Out


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanedConfig:
    """What is done."""

    cleaning: CleaningConfig | None = None
    prune: FrequencyPruningConfig | None = None
    near: float = 0.0


def run(config: CleanedConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Clean the splat of a job."""
    scene = load_splat(inputs["splat"])
    if config.cleaning is not None:
        scene = cleaned(repaired(scene, audit(scene)) if config.cleaning.repair else scene, config.cleaning)
    if config.prune is not None:
        views = load_dataset(inputs["pictures"] / SET, split="train")
        scene = frequency_pruned(scene, views, config.prune, near=config.near)
    save_splat(scene, out / SPLAT)
