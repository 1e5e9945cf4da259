"""The record of a capture: everything that its pictures depend on, and what differs between two such records."""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_splat import provenance
from mi_splat.cameras import Camera
from mi_splat.capture.passes import is_halved
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.sources import CaptureSource
from mi_splat.datasets.writing import make_folder
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.atomic import is_temporary, sweep_temporary
from mi_splat.io.documents import save_json
from mi_splat.io.fields import Fields
from mi_splat.io.parsing import DocumentReader

RECORD = "capture.json"
"""File in the folder of a capture that holds its settings."""
FORMAT = 2
"""Of the record; those of format 1 have no key for it, and digests in the place of what was asked for."""
PICTURES = 1
"""Version of the code that makes pictures: raise it when it makes others of the same input."""
PICTURES_RECOUNTED = 2
"""That version for counts of samples that version 1 rounded up."""

_OLDER: dict[str, Any] = {"near": None, "pictures": 1}
"""What a record of format 1 does not say."""

_RECORD = DocumentReader(expected="the record of a capture", do="choose a new folder")

Inputs = Mapping[str, Mapping[str, Any]]
"""What the user asked for, as JSON can hold it: names and values under "scene" and under "cameras"."""


def capture_record(
    source: CaptureSource,
    listing: Mapping[str, Sequence[tuple[str, Camera]]],
    settings: CaptureSettings,
    inputs: Inputs | None = None,
) -> dict[str, Any]:
    """Everything that the pictures depend on, as JSON can hold it.

    Args:
        source: What is photographed.
        listing: Names and cameras of the pictures of each split.
        settings: Samples and the like.
        inputs: What the user asked for, in words, from which source and cameras come.
    """
    poses = hashlib.sha256()
    for name, camera in (entry for part in listing.values() for entry in part):
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.to_world.flatten().tolist()]
        digits = " ".join(f"{value + 0.0:.9f}" for value in numbers)  # the last digits differ between machines
        poses.update(f"{name} {camera.width} {camera.height} {digits}\n".encode())
    return {
        "format": FORMAT,
        "version": provenance.versions().get("mi-splat", "unknown"),
        "scene": source.digest,
        "cameras": poses.hexdigest(),
        **{split: len(part) for split, part in listing.items()},
        "samples": settings.samples,
        "seed": settings.seed,
        "alpha": settings.rgba,
        "points": settings.points,
        "near": settings.near,
        "pictures": PICTURES if is_halved(settings.samples) else PICTURES_RECOUNTED,
        "mitsuba": importlib.metadata.version("mitsuba"),
        "world_offset": list(source.world_offset),
        "inputs": {kind: dict(values) for kind, values in (inputs or {}).items()},
    }


def claim_folder(folder: Path, wanted: dict[str, Any]) -> str | None:
    """Write the record of a new capture, or check that the folder's record is the same.

    Returns:
        The version of the project that began the capture, None if its record does not say.

    Raises:
        InvalidValueError: The folder holds something else, or a capture that differs in what the message says.
    """
    make_folder(folder)
    for subfolder in (folder, folder / "images"):
        sweep_temporary(subfolder)
    file = folder / RECORD
    if not file.exists():
        others = sorted(path.name for path in folder.iterdir() if not is_temporary(path.name))
        if others:
            got, do = f"{others[0]} in it and no {RECORD}", "choose a new folder"
            raise InvalidValueError(message(str(folder), "an empty folder or that of a capture", got, do))
        save_json(wanted, file)
        return str(wanted["version"])
    there = _RECORD.read_json(file)
    inputs = Fields(there, str(file), InvalidValueError, _RECORD.do).object("inputs", {})
    for kind in inputs.values:
        inputs.object(kind)
    if changed := differences(there, wanted):
        do = "choose a new folder, or the same settings to go on"
        raise InvalidValueError(message(str(file), "the settings of this capture", "; ".join(changed), do))
    return None if "version" not in there else str(there["version"])


def differences(there: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """What differs between the record of a folder and the one wanted, in words; empty if the pictures are the same.

    Args:
        there: The folder's record, of any format.
        wanted: As `capture_record` makes it.
    """
    written_by = there.get("format", 1)
    if not isinstance(written_by, int) or written_by > FORMAT:
        return [f"a record of format {written_by!r}, which a newer version wrote"]
    known = {**_OLDER, **there}
    plain = ("train", "test", "samples", "seed", "alpha", "points", "near", "pictures", "mitsuba")
    changed = [f"{key} {known.get(key)!r}, now {wanted[key]!r}" for key in plain if known.get(key) != wanted[key]]
    counts = known.get("train"), known.get("test")
    for key in ("scene", "cameras"):
        if known.get(key) == wanted[key]:
            continue
        asked = _asked(known, wanted, key)
        if asked:
            changed += asked
        elif key == "scene" or (counts == (wanted["train"], wanted["test"]) and known.get("scene") == wanted["scene"]):
            changed.append(_unknown(key, there, wanted))
    return changed


def _asked(there: Mapping[str, Any], wanted: Mapping[str, Any], key: str) -> list[str]:
    """What was asked for otherwise, of the scene or of the cameras."""
    before, now = (record.get("inputs", {}).get(key, {}) for record in (there, wanted))
    names = [name for name in {**now, **before} if name in before and before.get(name) != now.get(name)]
    return [f"{name} {before.get(name)!r}, now {now.get(name)!r}" for name in names]


def _unknown(key: str, there: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """The words for a difference in content alone."""
    what = {"scene": "another scene", "cameras": "other cameras"}[key]
    if there.get("format", 1) < FORMAT:
        why = "the record was written by an older version: it cannot say what differs"
        return f"{what} ({why}; that version may also have read the same scene otherwise)"
    where = {"scene": "what its files hold", "cameras": "their poses or lenses"}[key]
    versions = there.get("version"), wanted["version"]
    upgrade = (
        f", or how version {versions[1]} reads them, where {versions[0]} began" if versions[0] != versions[1] else ""
    )
    return f"{what} ({where}{upgrade})"
