"""A capture that is written picture by picture, and that goes on where it stopped.

Picture i depends on the scene, its camera, the settings and seed + i alone, so what is on the disk after any number of
interruptions is what one run would have left. The files that list the pictures come last.
"""

import hashlib
import importlib.metadata
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mi_splat import provenance
from mi_splat.cameras import Camera
from mi_splat.capture.path_tracer import NEAR, PASSES, PathTracer, check_camera, tracing_variant
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.sources import CaptureSource, WorkingFrame
from mi_splat.capture.surface_points import surface_points
from mi_splat.datasets.dataset import Dataset
from mi_splat.datasets.frames import Frame
from mi_splat.datasets.transforms import POINTS, WORLD_OFFSET
from mi_splat.datasets.writing import IMAGES, list_colmap, list_transforms, make_folder, picture_name
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.atomic import is_temporary, sweep_temporary
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.locks import locked_folder
from mi_splat.io.parsing import DocumentReader, Fields
from mi_splat.io.picture_files import PictureFileError, check_pixels, load_picture
from mi_splat.io.points import load_points, save_points, to_bytes

_GREY = (0.5, 0.5, 0.5)

RECORD = "capture.json"
"""File in the folder of a capture that holds its settings."""
PICTURES = 2
"""Version of the code that makes pictures: raise it when it makes others of the same input."""

_RECORD = DocumentReader(expected="the record of a capture", do="choose a new folder")

Inputs = Mapping[str, Mapping[str, Any]]
"""What the user asked for, as JSON can hold it: names and values under "scene" and under "cameras"."""

OnStep = Callable[[int, int], None]
"""Called after each picture with the number on the disk and the number wanted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenCapture:
    """What a capture left on the disk."""

    train: int
    test: int
    rendered: int
    points: int
    files: tuple[Path, ...]
    seconds: float
    begun_by: str
    warnings: tuple[str, ...] = ()


def write_capture(
    source: CaptureSource,
    cameras: Sequence[Camera],
    folder: Path,
    *,
    test: Sequence[Camera] = (),
    settings: CaptureSettings | None = None,
    layout: Literal["transforms", "colmap", "both"] = "transforms",
    inputs: Inputs | None = None,
    on_step: OnStep | None = None,
) -> WrittenCapture:
    """Take pictures of a source and write them as a set that `mi_splat.datasets.load_dataset` reads.

    Pictures that are in the folder from an earlier call with the same arguments are kept. The layout may change.
    """
    settings = settings or CaptureSettings()
    listing = _listing(cameras, test)
    frame = source.frame
    near = NEAR if settings.near is None else settings.near * frame.unit
    with locked_folder(folder):
        with tracing_variant():
            tracer = PathTracer(source.scene, samples=settings.samples, alpha=settings.rgba, near=near)
            if not any(bool((tracer.surface(frame.camera(view), seed=0)[1] > 0).any()) for view in cameras):
                raise InvalidValueError.of("cameras", "a view of the scene", "nothing but sky", "move or turn them")
            begun_by = claim_folder(folder, capture_record(source, listing, settings, inputs))
            images = make_folder(folder / IMAGES)
            begun = time.perf_counter()
            rendered = _render(tracer, frame, listing, images, settings, on_step)
            seconds = time.perf_counter() - begun
            cloud = folder / POINTS[0]
            if not cloud.is_file():
                frames = tuple(
                    Frame(camera=frame.camera(entry), path=images / name) for name, entry in listing["train"]
                )
                views = Dataset(frames=frames, background=_GREY)
                sampled = surface_points(tracer, source.assets, views, count=settings.points, seed=settings.seed)
                save_points(frame.in_world(sampled), cloud)
        points = load_points(cloud)
        files = [cloud]
        if layout in ("transforms", "both"):
            more = {WORLD_OFFSET: list(source.world_offset)} if any(source.world_offset) else None
            files += [file for file in list_transforms(folder, listing, points, more=more) if file != cloud]
        if layout in ("colmap", "both"):
            files += list_colmap(folder, listing, points)
        return WrittenCapture(
            train=len(cameras),
            test=len(test),
            rendered=rendered,
            points=len(points),
            files=tuple(files),
            seconds=seconds,
            begun_by=begun_by,
            warnings=_black_pictures(images, [name for part in listing.values() for name, _ in part]),
        )


def _listing(cameras: Sequence[Camera], test: Sequence[Camera]) -> dict[str, list[tuple[str, Camera]]]:
    """Names and cameras of all pictures, once it is sure that each can be taken."""
    if not cameras:
        raise InvalidValueError.of("cameras", "at least one", "none", "ask for more")
    with tracing_variant():
        for camera in (*cameras, *test):
            check_camera(camera)
            check_pixels("size", camera.width, camera.height)  # or they could not be read again
    parts = {"train": cameras, "test": test}
    return {split: [(picture_name(split, i), camera) for i, camera in enumerate(part)] for split, part in parts.items()}


def _render(
    tracer: PathTracer,
    frame: WorkingFrame,
    listing: Mapping[str, Sequence[tuple[str, Camera]]],
    images: Path,
    settings: CaptureSettings,
    on_step: OnStep | None,
) -> int:
    """Render and write the pictures that are not on the disk; returns their number."""
    entries = [entry for part in listing.values() for entry in part]
    assert (settings.seed + len(entries)) * PASSES < 1 << 32  # Mitsuba's seeds; CaptureSettings and MOST see to it
    rendered = 0
    for number, (name, camera) in enumerate(entries):
        if not _is_complete(images / name, camera, settings.rgba):
            picture = tracer.picture(frame.camera(camera), seed=settings.seed + number)
            save_png(to_bytes(picture), images / name)
            rendered += 1
        if on_step is not None:
            on_step(number + 1, len(entries))
    return rendered


def _black_pictures(images: Path, names: Sequence[str]) -> tuple[str, ...]:
    """A warning if nothing but black is to be seen in any picture."""
    for name in names:
        if any(high > 0 for _, high in np.reshape(load_picture(images / name).convert("RGB").getextrema(), (3, 2))):
            return ()
    do = "move them away (--distance), or light the scene"
    cause = "black alone, as from cameras inside the object or far too near"
    return (message("pictures", "some that are not black", cause, do),)


def _is_complete(path: Path, camera: Camera, alpha: bool) -> bool:
    """Whether a picture is on the disk, whole and of the right size and kind."""
    try:
        picture = load_picture(path)
    except PictureFileError:
        return False
    return picture.size == (camera.width, camera.height) and picture.mode == ("RGBA" if alpha else "RGB")


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
