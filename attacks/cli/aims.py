"""What the commands that attack one object share: the aim, the object if none is named, and its files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from attacks.objectives import Objective, hide, relabel, untargeted
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import SplatScene
from mi_splat.scene_writing import write_scene
from mi_splat.selection.config import Selection
from mi_splat.selection.masks import save_mask

DEFAULT_OBJECT = "car"
"""Part that is attacked if nothing else is said."""


def aim(objective: str, target: str, confidence: float | None) -> Objective:
    """The attacker's aim.

    Args:
        objective: Its name on the command line.
        target: Class that detectors shall see (relabel).
        confidence: What counts as success; None is the objective's own.
    """
    aims: dict[str, Callable[..., Objective]] = {
        "relabel": lambda **limit: relabel(target, **limit),
        "hide": hide,
        "untargeted": untargeted,
    }
    return aims[objective](**({} if confidence is None else {"confidence": confidence}))


def chosen_object(loaded: SplatScene, selection: Selection) -> Selection:
    """What the options select; the part called car if they say nothing and there is one."""
    nothing = selection.is_empty and DEFAULT_OBJECT in loaded.objects
    return dataclasses.replace(selection, object=DEFAULT_OBJECT) if nothing else selection


def write_parts(loaded: SplatScene, mask: Tensor, attacked: GaussianScene, folder: Path) -> list[Path]:
    """Write the object's mask, and of a scene file its parts and the XML that names them.

    Args:
        loaded: The clean scene.
        mask: (N,) bool, the object's Gaussians.
        attacked: The attacked scene.
        folder: Where to write.

    Returns:
        The files written.
    """
    path = folder / "mask.npy"
    save_mask(mask, path)
    # A bare splat has no cameras, and so makes no scene file.
    parts = write_scene(loaded, attacked, folder / "attacked.xml") if loaded.cameras else []
    return [path, *parts]
