"""The files of an audit of images: the account as JSON, and a pair of images side by
side.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mi_splat.audit.images import CALLED, ImageAudit, smaller_images
from mi_splat.datasets import Dataset
from mi_splat.errors import counted
from mi_splat.io.documents import save_json
from mi_splat.io.folders import RECORD, new_folder
from mi_splat.io.images import save_picture, side_by_side
from mi_splat.provenance import origin

STORY = "image-audit"
SHOWN = 8
"""Names that a summary lists; the record has all."""
UNKNOWN = (
    "which group shows the truth, images cannot tell: look at them, or ask who took"
    " them. `mi-splat train --trust A` trains without group B, `--trust B` without"
    " group A"
)

PAIR = "pair.png"
PICTURE = 512  # pixels along the longer side of each of the two images


def image_names(views: Dataset) -> list[str]:
    """The names of the images of a set, from the folder that holds them all."""
    parents = [path.parent for path in views.paths]
    folder = Path(os.path.commonpath(parents))
    return [path.relative_to(folder).as_posix() for path in views.paths]


def document_of_images(audit: ImageAudit, names: Sequence[str]) -> dict[str, Any]:
    """An audit of the images of a set as JSON can hold it."""
    larger, smaller = audit.groups
    neither = ~larger & ~smaller
    parts = {"A": larger, "B": smaller, "neither": neither}
    split = audit.split
    evidence = None
    scores = None
    if split is not None:
        evidence = {
            "strength": split.strength,
            "called_from": CALLED,
            "step": split.step,
            "spread": split.spread,
            "edge": split.edge,
            "difference": split.difference,
            "gain": split.gain,
            "agreement": split.agreement,
            "opposed": split.opposed,
        }
        scores = dict(zip(names, split.scores.tolist(), strict=True))
    return {
        "verdict": audit.verdict,
        "summary": summary_of(audit, names),
        "images": audit.count,
        "points": audit.points,
        "groups": {part: _names(names, group) for part, group in parts.items()},
        "nearly_equal": audit.is_nearly_equal,
        "evidence": evidence,
        "scores": scores,
    }


def _names(names: Sequence[str], group: Tensor) -> list[str]:
    return [names[number] for number in group.nonzero()[:, 0].tolist()]


def summary_of(audit: ImageAudit, names: Sequence[str]) -> list[str]:
    """What was found in sentences."""
    compared = f"{counted(audit.count, 'image')}, {audit.points:,} points"
    if audit.split is None:
        too_few = "the images share too few points to be compared"
        return [f"not judged: {too_few} ({compared})"]
    strength = f"strength {audit.split.strength:.3f}, called from {CALLED:g}"
    if audit.verdict == "nothing found":
        return [
            f"nothing found: no two groups of images contradict each other ({compared};"
            f" {strength})",
            "a change that nearly all images show, that sets in gradually, or that one"
            " image shows, is not found",
        ]
    if audit.verdict == "not judged":
        return [
            "not judged: images contradict each other, but several divisions into two"
            f" groups explain that about as well ({compared}; {strength}), so that no"
            " image is named"
        ]
    larger, smaller = audit.groups
    usual = int(larger.sum())
    other = int(smaller.sum())
    rest = audit.count - usual - other
    lines = [
        f"two groups of images contradict each other: A, {counted(usual, 'image')},"
        f" and B, {counted(other, 'image')}; {rest} belong to neither"
        f" ({compared}; {strength})",
        UNKNOWN,
    ]
    if audit.is_nearly_equal:
        lines.append("the groups are nearly equal, so that neither is the usual one")
    found = _names(names, smaller)
    more = ", ..." if len(found) > SHOWN else ""
    lines.append(f"B: {', '.join(found[:SHOWN])}{more}")
    return lines


def write_image_audit(
    audit: ImageAudit,
    views: Dataset,
    folder: Path,
    *,
    account: dict[str, Any],
    source: str,
    force: bool = False,
) -> list[Path]:
    """Write the files of an audit of images into a new folder, whole or not at all."""
    pictures = list[dict[str, Any]]()
    names = image_names(views)
    split = audit.split
    pair = None if split is None else split.pair
    with new_folder(folder, force=force) as temporary:
        if pair is not None and audit.verdict == "two groups":
            shown = smaller_images(views, PICTURE)
            with torch.no_grad():
                beside = side_by_side([shown[number].image for number in pair])
            save_picture(beside, temporary / PAIR)
            pictures.append(
                {"file": PAIR, "images": [names[number] for number in pair]}
            )
        record = {"story": STORY, "file": source, **account, "pictures": pictures}
        save_json({**record, **origin()}, temporary / RECORD)
    return [folder / name for name in (RECORD, *(one["file"] for one in pictures))]
