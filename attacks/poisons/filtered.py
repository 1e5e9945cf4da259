"""A kind of job: the set of pictures that a victim trains on after it has filtered those that it was given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.kinds.parts import SET, StepConfig
from attacks.poisons.base import poisoned
from attacks.poisons.config import FilterConfig
from attacks.poisons.defences import filtered
from attacks.poisons.writing import write_poisoned
from mi_splat.datasets import load_dataset

if TYPE_CHECKING:
    from mi_splat.ledger import Out


@dataclass(frozen=True, slots=True, kw_only=True)
class FilteredConfig(StepConfig):
    """Which filter."""

    filter: FilterConfig


def run(config: FilteredConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Filter all `pictures`."""
    views = load_dataset(inputs["pictures"] / SET, split="train", background=config.asked.scene.background)
    pictures = {index: filtered(view.image, config.filter) for index, view in enumerate(views)}
    write_poisoned(out / SET, views, poisoned(views, pictures, {}))
