"""What other ways to find a hidden look say of a splat; the audit is compared with them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.audits.baselines import measured
from attacks.audits.learnt import attributes
from mi_splat.io.documents import save_json
from mi_splat.scene_files import open_scene

if TYPE_CHECKING:
    from mi_splat.ledger import Out

RIVALS, COST = "rivals.json", "cost.json"
VARIES = (COST,)


@dataclass(frozen=True, slots=True, kw_only=True)
class RivalsConfig:
    """Nothing: they have no settings."""


def run(config: RivalsConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Write the score of each, and the attributes that a classifier reads.

    Raises:
        InvalidValueError: Nothing of the splat shows.
    """
    scene = open_scene(inputs["splat"]).scene
    scores = measured(scene)
    save_json({"seconds": {name: seconds for name, (_, seconds) in scores.items()}}, out / COST)
    told = {name: score for name, (score, _) in scores.items()}
    save_json({"scores": told, "attributes": attributes(scene).tolist()}, out / RIVALS)
