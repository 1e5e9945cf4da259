"""What the commands that attack one object share: the aim, the object if none is named, and its files."""

import dataclasses
from pathlib import Path

from torch import Tensor

from attacks.aims import OBJECTIVES, objective_of
from attacks.cli.options import DEFAULT_OBJECT, DEFAULT_TARGET
from attacks.dagger.report import write_files
from attacks.dagger.result import Result
from attacks.objectives import Objective
from mi_splat.io.folders import new_folder
from mi_splat.scene_files import SplatScene, write_scene
from mi_splat.selection.config import Selection
from mi_splat.selection.select import save_mask

MASK = "mask.npy"
"""The attacked object."""


def aim(objective: str, target: str | None, confidence: float | None) -> Objective:
    """The attacker's aim."""
    targeted = OBJECTIVES.chosen(objective).targeted
    return objective_of(objective, (target or DEFAULT_TARGET) if targeted else None, confidence)


def chosen_object(loaded: SplatScene, selection: Selection) -> Selection:
    """What the options select; the part called car if they say nothing and there is one."""
    nothing = selection.is_empty and DEFAULT_OBJECT in loaded.objects
    return dataclasses.replace(selection, object=DEFAULT_OBJECT) if nothing else selection


def write_result(result: Result, loaded: SplatScene, mask: Tensor, out: Path, *, force: bool) -> None:
    """Write a result, the object's mask, and of a scene file its parts and the XML that names them."""
    with new_folder(out, force=force) as folder:
        save_mask(mask, folder / MASK)
        if loaded.cameras:  # a bare splat has none, and so makes no scene file
            write_scene(loaded, result.scene, folder / "attacked.xml")
        write_files(result, folder)
