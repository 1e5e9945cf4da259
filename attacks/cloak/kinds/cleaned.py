"""A finished splat after what a victim does to it before anybody looks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.cleaning import cleaned
from attacks.cloak.config import CleaningConfig
from mi_splat.audit import audit, repaired
from mi_splat.io import load_splat, save_splat
from mi_splat.training.resume import SPLAT

if TYPE_CHECKING:
    from mi_splat.ledger import Out


def run(config: CleaningConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Clean the splat of a job."""
    scene = load_splat(inputs["splat"])
    if config.repair:
        scene = repaired(scene, audit(scene))
    save_splat(cleaned(scene, config), out / SPLAT)
