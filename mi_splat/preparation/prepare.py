"""From a folder of photographs or a video to a set that every command reads: images and
a COLMAP model.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mi_splat import provenance
from mi_splat.datasets import load_dataset
from mi_splat.datasets.folders import IMAGES, MASKS
from mi_splat.datasets.frames import Split
from mi_splat.errors import install
from mi_splat.io.documents import save_json
from mi_splat.io.folders import check_new_folder, new_folder
from mi_splat.preparation.config import VIDEOS, PreparationError, PrepareConfig
from mi_splat.preparation.photographs import (
    FEWEST_IMAGES,
    OnProgress,
    Photograph,
    images_in,
    take_photographs,
)
from mi_splat.processes import python_command

RECORD = "prepare.json"
"""What was placed and what was not; by it a set that was prepared is known."""
_LAST_WORDS = 300
"""Characters of what a process wrote before it failed that are shown."""


def prepare(
    source: Path,
    out: Path,
    config: PrepareConfig,
    *,
    masks: Path | None = None,
    force: bool = False,
    on_progress: OnProgress,
) -> dict[str, Any]:
    """Write a set of images with cameras, whole or not at all: images/, masks/,
    sparse/0 and a record.

    Lenses keep their distortion in the model; it is undone as the set is loaded. Images
    that could not be placed are in the record, and not in images/.

    Args:
        source: A folder of photographs, or a video.
        out: Folder of the set.
        config: How large and how many the images are.
        masks: Folder of masks, by the names of the photographs; black does not count.
        force: Replace an older set.
        on_progress: Told of the progress.

    Returns:
        The record, as prepare.json holds it.

    Raises:
        PreparationError: The source cannot be read, COLMAP is not there, or it places
            no image.
    """
    check_new_folder(out, force=force, record=RECORD)
    _check_source(source, config)
    _check_colmap()
    with new_folder(out, force=force, record=RECORD) as root:
        (root / IMAGES).mkdir()
        broken: Mapping[str, str] = {}
        if source.is_dir():
            photos, broken = take_photographs(
                source, root, config, on_progress, masks=masks
            )
        else:
            photos = _frames_of(source, root, config, on_progress)
        placed = _placed_by_colmap(source, root, photos, config, on_progress)
        shutil.rmtree(root / "colmap", ignore_errors=True)
        for photo in photos:
            if photo.name not in placed["points"]:
                (root / IMAGES / photo.name).unlink()
                (root / MASKS / f"{photo.name}.png").unlink(missing_ok=True)
        parts = _parts(root)
        record = {
            "source": str(source),
            **dataclasses.asdict(config),
            "cameras_by": placed["made_by"],
            "models": placed["models"],
            "reprojection_error": placed["error"],
            "points": placed["points3D"],
            "images": [_row(photo, placed, parts) for photo in photos],
            "broken": dict(broken),
            **provenance.origin(),
        }
        save_json(record, root / RECORD)
    return record


def not_placed(record: Mapping[str, Any]) -> list[str]:
    """What of a record could not be placed, each with the reason, as far as one is
    known.
    """
    reasons = []
    for row in record["images"]:
        if row["part"] == "none":
            details = (
                f"{row['features']} features, overlaps with {row['overlaps']} images"
            )
            reasons.append(f"{row['source']} ({details})")
    return reasons + [f"{name} ({reason})" for name, reason in record["broken"].items()]


def _check_source(source: Path, config: PrepareConfig) -> None:
    """Raise, before any work is done, unless there are photographs or a video."""
    if source.is_dir():
        images_in(source, config.max_images)
    elif source.suffix.lower() not in VIDEOS:
        expected = f"a folder of photographs, or a video ({', '.join(VIDEOS)})"
        got = source.suffix or "a file without an ending"
        raise PreparationError.of(str(source), expected, got, "pass one of these")


def _check_colmap() -> None:
    if find_spec("pycolmap") is None:
        expected = "pycolmap, which finds the cameras of photographs"
        raise PreparationError.of(
            "prepare", expected, "no such package", install("photos")
        )


def _frames_of(
    video: Path, root: Path, config: PrepareConfig, on_progress: OnProgress
) -> list[Photograph]:
    task = {
        "kind": "frames",
        "root": str(root),
        "video": str(video),
        "longest_side": config.longest_side,
        "interval": config.interval,
        "most": config.max_images,
    }
    frames = in_child(str(video), task, on_progress)["images"]
    if len(frames) < FEWEST_IMAGES:
        expected = f"a video of at least {FEWEST_IMAGES} intervals"
        got = f"{len(frames)} of {config.interval:g} seconds"
        error = PreparationError.of(
            str(video), expected, got, "pass a longer one, or a shorter interval"
        )
        raise error.hinted("--interval")
    return [
        Photograph(
            name=frame["name"],
            source=frame["source"],
            size=(frame["size"][0], frame["size"][1]),
        )
        for frame in frames
    ]


def _placed_by_colmap(
    source: Path,
    root: Path,
    photos: Sequence[Photograph],
    config: PrepareConfig,
    on_progress: OnProgress,
) -> dict[str, Any]:
    """What COLMAP says, which has written the largest model."""
    masks = root / MASKS
    task = {
        "kind": "place",
        "root": str(root),
        "images": [(photo.name, photo.size, photo.focal) for photo in photos],
        "in_order": not source.is_dir(),
        "features": config.features,
        "masks": str(masks) if masks.is_dir() else "",
    }
    placed = in_child(str(source), task, on_progress)
    if placed["models"]:
        return placed
    features = sorted(placed["features"].get(photo.name, 0) for photo in photos)
    middle = features[len(features) // 2]
    alone = sum(not placed["overlaps"].get(photo.name) for photo in photos)
    got = f"none (features: {middle} in the middle; overlapping with no other: {alone})"
    do = "pass larger or sharper images, of things with texture"
    if middle >= 200:
        do = (
            "take sharp images of things with texture, each from another place, that"
            " overlap by two thirds"
        )
    raise PreparationError.of(
        str(source), f"{len(photos)} images that can be placed", got, do
    )


def in_child(
    what: str, task: Mapping[str, Any], on_progress: OnProgress
) -> dict[str, Any]:
    """The result of a task of `mi_splat.preparation.worker`, done by a process of its
    own.

    Raises:
        PreparationError: The process refused the task, or ended before it was done.
    """
    command = python_command("mi_splat.preparation.worker", json.dumps(task))
    result: dict[str, Any] | None = None
    with tempfile.TemporaryFile() as errors:
        # The child ends when its standard input closes, so it does not outlive this
        # process.
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors
        ) as child:
            assert child.stdout is not None
            try:
                for line in child.stdout:
                    value = json.loads(line)
                    if isinstance(value, list):
                        on_progress(*value)
                    else:
                        result = value
            finally:
                child.kill()
        if result is None:
            errors.seek(0)
            text = " ".join(errors.read(1 << 20).decode(errors="replace").split())
            got = f"it ended with status {child.returncode}: ...{text[-_LAST_WORDS:]}"
            raise PreparationError.of(
                what, "a process that finishes", got, "try fewer or smaller images"
            )
    if "failed" in result:
        raise PreparationError(result["failed"])
    if "refused" in result:
        raise PreparationError.of(what, *result["refused"])
    return result


def _parts(root: Path) -> dict[str, str]:
    """Which part of the set each image is in, as those who load the set find it."""
    splits: tuple[Split, ...] = ("train", "test")
    return {
        path.name: split
        for split in splits
        for path in load_dataset(root, split=split).paths
    }


def _row(
    photo: Photograph, placed: Mapping[str, Any], parts: Mapping[str, str]
) -> dict[str, Any]:
    return {
        "name": photo.name,
        "source": photo.source,
        "part": parts.get(photo.name, "none"),
        "features": placed["features"].get(photo.name, 0),
        "overlaps": placed["overlaps"].get(photo.name, 0),
        "points": placed["points"].get(photo.name, 0),
    }
