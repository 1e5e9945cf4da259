"""The record of a capture: everything that its pictures depend on, and what differs between two such records."""

import hashlib
import importlib.metadata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_splat import provenance
from mi_splat.cameras import Camera
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.sources import CaptureSource
from mi_splat.datasets.writing import make_folder
from mi_splat.errors import InvalidValueError
from mi_splat.io.atomic import is_temporary, sweep_temporary
from mi_splat.io.documents import save_json
from mi_splat.io.fields import Fields
from mi_splat.io.parsing import DocumentReader

RECORD = "capture.json"
"""File in the folder of a capture that holds its settings."""
PICTURES = 2
"""Version of the code that makes pictures: raise it when it makes others of the same input."""

_RECORD = DocumentReader(expected="the record of a capture", do="choose a new folder")

Inputs = Mapping[str, Mapping[str, Any]]
"""What the user asked for, as JSON can hold it: names and values under "scene" and under "cameras"."""


def capture_record(
    source: CaptureSource,
    listing: Mapping[str, Sequence[tuple[str, Camera]]],
    settings: CaptureSettings,
    inputs: Inputs | None = None,
) -> dict[str, Any]:
    """Everything that the pictures depend on, as JSON can hold it."""
    poses = hashlib.sha256()
    for name, camera in (entry for part in listing.values() for entry in part):
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.to_world.flatten().tolist()]
        digits = " ".join(f"{value + 0.0:.9f}" for value in numbers)  # the last digits differ between machines
        poses.update(f"{name} {camera.width} {camera.height} {digits}\n".encode())
    return {
        "version": provenance.versions().get("mi-splat", "unknown"),
        "scene": source.digest,
        "cameras": poses.hexdigest(),
        **{split: len(part) for split, part in listing.items()},
        "samples": settings.samples,
        "seed": settings.seed,
        "alpha": settings.rgba,
        "points": settings.points,
        "near": settings.near,
        "pictures": PICTURES,
        "mitsuba": importlib.metadata.version("mitsuba"),
        "world_offset": list(source.world_offset),
        "inputs": {kind: dict(values) for kind, values in (inputs or {}).items()},
    }


def claim_folder(folder: Path, wanted: dict[str, Any]) -> str:
    """Write the record of a new capture, or check that the folder's record is the same."""
    make_folder(folder)
    for subfolder in (folder, folder / "images"):
        sweep_temporary(subfolder)
    file = folder / RECORD
    if not file.exists():
        others = sorted(path.name for path in folder.iterdir() if not is_temporary(path.name))
        if others:
            got, do = f"{others[0]} in it and no {RECORD}", "choose a new folder"
            raise InvalidValueError.of(str(folder), "an empty folder or that of a capture", got, do)
        save_json(wanted, file)
        return str(wanted["version"])
    stored = _RECORD.read_json(file)
    inputs = Fields(stored, str(file), InvalidValueError, _RECORD.do).object("inputs", {})
    for kind in inputs.values:
        inputs.object(kind)
    if changed := differences(stored, wanted):
        do = "choose a new folder, or the same settings to go on"
        raise InvalidValueError.of(str(file), "the settings of this capture", "; ".join(changed), do)
    return str(stored.get("version", "unknown"))


def differences(stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """What differs between the record of a folder and the one wanted, in words; empty if the pictures are the same."""
    plain = ("train", "test", "samples", "seed", "alpha", "points", "near", "pictures", "mitsuba")
    changed = [f"{key} {stored.get(key)!r}, now {wanted[key]!r}" for key in plain if stored.get(key) != wanted[key]]
    same_scene = stored.get("scene") == wanted["scene"]
    same_counts = (stored.get("train"), stored.get("test")) == (wanted["train"], wanted["test"])
    for key, unnamed in (("scene", True), ("cameras", same_scene and same_counts)):
        if stored.get(key) == wanted[key]:
            continue
        if asked := _asked(stored, wanted, key):
            changed += asked
        elif unnamed:
            changed.append(_unknown(key, stored, wanted))
    return changed


def _asked(stored: Mapping[str, Any], wanted: Mapping[str, Any], key: str) -> list[str]:
    """What was asked for otherwise, of the scene or of the cameras."""
    before, now = (record.get("inputs", {}).get(key, {}) for record in (stored, wanted))
    names = [name for name in {**now, **before} if name in before and before.get(name) != now.get(name)]
    return [f"{name} {before.get(name)!r}, now {now.get(name)!r}" for name in names]


def _unknown(key: str, stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """The words for a difference in content alone."""
    what = {"scene": "another scene", "cameras": "other cameras"}[key]
    where = {"scene": "what its files hold", "cameras": "their poses or lenses"}[key]
    versions = stored.get("version"), wanted["version"]
    upgrade = (
        f", or how version {versions[1]} reads them, where {versions[0]} began" if versions[0] != versions[1] else ""
    )
    return f"{what} ({where}{upgrade})"
