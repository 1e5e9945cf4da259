"""What the commands that attack one object share: the aim, the object if none is named, and its files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from torch import Tensor

from attacks.cli.names import DEFAULT_OBJECT, DEFAULT_TARGET
from attacks.dagger.report import write_files
from attacks.dagger.result import Result
from attacks.objectives import Objective, hide, relabel, untargeted
from mi_splat.io.folders import new_folder
from mi_splat.scene_files import SplatScene
from mi_splat.scene_writing import write_scene
from mi_splat.selection.config import Selection
from mi_splat.selection.masks import save_mask

MASK = "mask.npy"
"""The attacked object."""


def aim(objective: str, target: str | None, confidence: float | None) -> Objective:
    """The attacker's aim.

    Args:
        objective: Its name on the command line.
        target: Class that detectors shall see (relabel); None is the usual one.
        confidence: What counts as success; None is the objective's own.
    """
    aims: dict[str, Callable[..., Objective]] = {
        "relabel": lambda **limit: relabel(target or DEFAULT_TARGET, **limit),
        "hide": hide,
        "untargeted": untargeted,
    }
    return aims[objective](**({} if confidence is None else {"confidence": confidence}))


def chosen_object(loaded: SplatScene, selection: Selection) -> Selection:
    """What the options select; the part called car if they say nothing and there is one."""
    nothing = selection.is_empty and DEFAULT_OBJECT in loaded.objects
    return dataclasses.replace(selection, object=DEFAULT_OBJECT) if nothing else selection


def object_name(selection: Selection) -> str:
    """The object, as a human calls it."""
    if selection.is_empty:
        return f"the {DEFAULT_OBJECT}"
    return "the selection" if selection.object is None else f"the {selection.object}"


def sentence(objective: Objective, detectors: Sequence[str], name: str, *, success: bool, clear: bool = True) -> str:
    """What detectors make of an attacked object, measured by the aim.

    Args:
        objective: The aim.
        detectors: Their names, at least one.
        name: The object, as a human calls it.
        success: Whether the aim was reached.
        clear: Whether no other class is reported there with more confidence.
    """
    who, plural = " and ".join(detectors), len(detectors) > 1
    see, take, do = ("see", "take", "do") if plural else ("sees", "takes", "does")
    if objective.label is not None:
        wanted = f"{'an' if objective.label[0] in 'aeiou' else 'a'} {objective.label}"
        if not success:
            return f"{who} {do} not see {wanted} in place of {name}"
        if not clear:
            return f"{who} {see} {wanted} where {name} is, and something else there with more confidence"
        return f"{who} {see} {wanted} in place of {name}"
    if objective.name == "hide":
        return f"{who} {see} nothing in place of {name}" if success else f"{who} still {see} something where {name} is"
    return f"{who} {do} not take {name} for what it was" if success else f"{who} still {take} {name} for what it was"


def write_result(result: Result, loaded: SplatScene, mask: Tensor, out: Path, *, force: bool) -> dict[str, str]:
    """Write a result, the object's mask, and of a scene file its parts and the XML that names them.

    Args:
        result: Of the attack.
        loaded: The clean scene.
        mask: (N,) bool, the object's Gaussians.
        out: Folder, which appears whole or not at all.
        force: Whether an older result may be replaced.

    Returns:
        Path of every file by its name.
    """
    with new_folder(out, force=force) as folder:
        save_mask(mask, folder / MASK)
        # A bare splat has no cameras, and so makes no scene file.
        parts = write_scene(loaded, result.scene, folder / "attacked.xml") if loaded.cameras else []
        names = [path.name for path in (*write_files(result, folder), folder / MASK, *parts)]
    return {name: str(out / name) for name in names}
