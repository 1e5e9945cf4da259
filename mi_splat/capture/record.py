"""The record of a capture: everything that its images depend on, by which a folder goes
on with the same capture only.
"""

import hashlib
import importlib.metadata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_splat import provenance
from mi_splat.cameras.camera import Camera
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.sources import CaptureSource
from mi_splat.datasets.writing import IMAGES, make_folder
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import is_temporary, save_json, sweep_temporary
from mi_splat.io.parsing import DocumentReader, Fields

RECORD = "capture.json"
"""File in the folder of a capture that holds its settings."""
PICTURES = 2
"""Version of the code that makes images: raise it when it makes others of the same
input.
"""

Inputs = Mapping[str, Mapping[str, Any]]
"""The user's options, as JSON can hold them: names and values under "scene" and under
"cameras".
"""
Listing = Mapping[str, Sequence[tuple[str, Camera]]]
"""Names and cameras of the images of each split."""

_READER = DocumentReader(expected="the record of a capture", do="choose a new folder")
_PLAIN = (
    "train",
    "test",
    "samples",
    "seed",
    "alpha",
    "points",
    "near",
    "pictures",
    "mitsuba",
)
"""Keys whose values say what they are."""
_DIGESTS = {
    "scene": "another scene (what its files hold)",
    "cameras": "other cameras (their poses or lenses)",
}
"""Keys of digests, and what a difference means."""


def capture_record(
    source: CaptureSource,
    listing: Listing,
    settings: CaptureSettings,
    inputs: Inputs | None = None,
) -> dict[str, Any]:
    """Everything that the images depend on, as JSON can hold it."""
    return {
        "version": provenance.versions().get("mi-splat", "unknown"),
        "scene": source.digest,
        "cameras": _digest_of_cameras(listing),
        **{split: len(part) for split, part in listing.items()},
        "samples": settings.samples,
        "seed": settings.seed,
        "alpha": settings.rgba,
        "points": settings.points,
        "near": settings.near,
        "pictures": PICTURES,
        "mitsuba": importlib.metadata.version("mitsuba"),
        "inputs": {kind: dict(values) for kind, values in (inputs or {}).items()},
    }


def _digest_of_cameras(listing: Listing) -> str:
    digest = hashlib.sha256()
    for part in listing.values():
        for name, camera in part:
            lens = [camera.fx, camera.fy, camera.cx, camera.cy]
            pose = camera.to_world.flatten().tolist()
            # the last digits differ between machines
            digits = " ".join(f"{value + 0.0:.9f}" for value in (*lens, *pose))
            size = f"{camera.width} {camera.height}"
            digest.update(f"{name} {size} {digits}\n".encode())
    return digest.hexdigest()


def claim_folder(folder: Path, wanted: dict[str, Any]) -> str:
    """Write the record of a new capture, or check that the folder's record is the
    same; returns the version that began it.
    """
    make_folder(folder)
    for subfolder in (folder, folder / IMAGES):
        sweep_temporary(subfolder)
    file = folder / RECORD
    if file.exists():
        return _check_stored(file, wanted)
    names = [path.name for path in folder.iterdir()]
    others = sorted(name for name in names if not is_temporary(name))
    if others:
        expected = "an empty folder or that of a capture"
        got = f"{others[0]} in it and no {RECORD}"
        do = "choose a new folder"
        raise InvalidValueError.of(str(folder), expected, got, do)
    save_json(wanted, file)
    return str(wanted["version"])


def _check_stored(file: Path, wanted: Mapping[str, Any]) -> str:
    """The version in a record of the same capture; another one is refused."""
    stored = _READER.read_json(file)
    fields = Fields(stored, str(file), InvalidValueError, _READER.do)
    inputs = fields.object("inputs", {})
    for kind in inputs.values:
        inputs.object(kind)
    changed = differences(stored, wanted)
    if changed:
        expected = "the settings of this capture"
        do = "choose a new folder, or the same settings to resume"
        raise InvalidValueError.of(str(file), expected, "; ".join(changed), do)
    return str(stored.get("version", "unknown"))


def differences(stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """What differs between the record of a folder and the one wanted, in words; empty
    if the images are the same.
    """
    changed = []
    for key in _PLAIN:
        before = stored.get(key)
        if before != wanted[key]:
            changed.append(f"{key} {before!r}, now {wanted[key]!r}")
    for key, words in _DIGESTS.items():
        if stored.get(key) == wanted[key]:
            continue
        was = stored.get("inputs", {}).get(key, {})
        now = wanted.get("inputs", {}).get(key, {})
        for name in {**now, **was}:
            if name in was and was[name] != now.get(name):
                changed.append(f"{name} {was[name]!r}, now {now.get(name)!r}")
        if not changed:
            changed.append(words)
    return changed
