"""The commands that repeat an attack of DAGGER, from its result.json: for pages and for artifacts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.dagger.config import DaggerConfig
from attacks.dagger.eot.config import EotConfig
from attacks.reporting.commands import aim, chosen, command, flag, flags, rendered
from attacks.transformations.config import CameraRegion, PictureChanges

CONFIDENCES = {"relabel": 0.7, "hide": 0.3, "untargeted": 0.3}
"""What counts as success if nothing is said (`attacks.objectives`)."""
MASK = "mask.npy"
"""File beside a result that says which Gaussians were attacked."""


def repeat_dagger(
    result: Mapping[str, Any], *, cameras: Sequence[object], mask: Path | None, out: Sequence[str]
) -> str | None:
    """The command line that makes a result of `mi-splat dagger` again; None for one that was made from Python.

    Args:
        result: Its result.json.
        cameras: What --cameras shall name.
        mask: File with the object's mask, if there is one.
        out: The flag --out with its value.
    """
    if "scene" not in result:
        return None
    words = [
        *_conditions(result, cameras, mask),
        *("--detectors", *(one["detector"] for one in result["detectors"])),
        *flags(result["config"], DaggerConfig(), skip=("objective",)),
        *out,
    ]
    return command("dagger", *words)


def repeat_views(
    result: Mapping[str, Any], *, cameras: Sequence[object], mask: Path | None, out: Sequence[str]
) -> str | None:
    """The same for a result of `mi-splat dagger-eot`.

    Args:
        result: Its result.json.
        cameras: What --cameras shall name: the reference camera.
        mask: File with the object's mask, if there is one.
        out: The flag --out with its value.
    """
    if "scene" not in result:
        return None
    config = result["config"]
    made = config["transformations"]
    words = [
        *_conditions(result, cameras, mask),
        *("--detectors", *result["rates"]),
        *flags(config, EotConfig()),
        *flags(made["cameras"], CameraRegion()),
        *flags(made["pictures"], PictureChanges()),
        *out,
    ]
    return command("dagger-eot", *words)


def mask_beside(folder: Path) -> Path | None:
    """The file in a folder of results that says which Gaussians were attacked; None if there is none."""
    return folder / MASK if (folder / MASK).is_file() else None


def _conditions(result: Mapping[str, Any], cameras: Sequence[object], mask: Path | None) -> list[object]:
    """Scene, object, cameras, pictures and aim."""
    return [
        result["scene"],
        *chosen(result, mask),
        *flag("cameras", list(cameras)),
        *rendered(result),
        *aim(result, CONFIDENCES),
    ]
