"""A kind that makes a splat without a training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mi_splat.io import save_splat
from tests.fakes import toy_scene

if TYPE_CHECKING:
    from mi_splat.ledger import Out


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    number: int


def run(config: Made, inputs: Mapping[str, Path], out: Out) -> None:
    save_splat(toy_scene(seed=config.number)[0], out / "splat.ply")
