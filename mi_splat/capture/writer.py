"""A capture that is written picture by picture, and that goes on where it stopped.

Picture i depends on the scene, its camera, the settings and seed + i alone, so what is on the disk after any number of
interruptions is what one run would have left. The files that list the pictures come last.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from PIL import Image

from mi_splat.cameras import Camera
from mi_splat.capture.path_tracer import PASSES, PathTracer, check_camera, scalar_variant
from mi_splat.capture.point_clouds import surface_points
from mi_splat.capture.sources import CaptureSource
from mi_splat.datasets.dataset import Dataset
from mi_splat.datasets.frames import Frame
from mi_splat.datasets.transforms import POINTS
from mi_splat.datasets.writing import IMAGES, list_colmap, list_transforms, make_folder, picture_name
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.points import load_points, save_points, to_bytes

RECORD = "capture.json"
"""File in the folder of a capture that holds its settings."""

_GREY = (0.5, 0.5, 0.5)

OnStep = Callable[[int, int], None]
"""Called after each picture with the number on the disk and the number wanted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureSettings:
    """What the pictures of a capture depend on besides scene and cameras.

    Attributes:
        samples: Samples per pixel.
        seed: Picture i uses seed + i; pictures for tests are counted on from the others.
        alpha: Whether pictures are RGBA with nothing but the surfaces in them.
        points: Number of points wanted in the point cloud.

    Raises:
        InvalidValueError: A number is out of range.
    """

    samples: int = 32
    seed: int = 0
    alpha: bool = False
    points: int = 20_000

    def __post_init__(self) -> None:
        for name, low, high in (("samples", 1, 1 << 20), ("seed", 0, 1 << 28), ("points", 1, 10_000_000)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InvalidValueError(message(name, f"{low} to {high}", value, "change it"))


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenCapture:
    """What a capture left on the disk.

    Attributes:
        train: Number of pictures for training.
        test: Number of pictures held out.
        rendered: How many of both were rendered by this call; the others were on the disk.
        points: Points of the cloud.
        files: The point cloud and the files that list the pictures.
        seconds: Wall time of the rendering.
    """

    train: int
    test: int
    rendered: int
    points: int
    files: tuple[Path, ...]
    seconds: float


def write_capture(
    source: CaptureSource,
    cameras: Sequence[Camera],
    folder: Path,
    *,
    test: Sequence[Camera] = (),
    settings: CaptureSettings | None = None,
    layout: Literal["transforms", "colmap", "both"] = "transforms",
    on_step: OnStep | None = None,
) -> WrittenCapture:
    """Take pictures of a source and write them as a set that `mi_splat.datasets.load_dataset` reads.

    Pictures that are in the folder from an earlier call with the same arguments are kept. The layout may change.

    Args:
        source: What to take pictures of.
        cameras: Cameras of the pictures for training; fx must equal fy.
        folder: A new or empty folder, or that of an earlier call.
        test: Cameras of the pictures held out.
        settings: Samples per pixel, seed, alpha, number of points; their defaults if None.
        layout: Which files list the pictures: Blender/NeRF transforms, a COLMAP text model, or both.
        on_step: Called after each picture.

    Raises:
        InvalidValueError: There are no cameras, the folder holds something else, or no picture shows a surface.
        SplatFileError: A file cannot be written.
    """
    settings = settings or CaptureSettings()
    listing = _listing(cameras, test)
    with scalar_variant():
        tracer = PathTracer(source.scene, samples=settings.samples, alpha=settings.alpha)
        _check_surface_in_sight(tracer, cameras)
        _claim_folder(folder, _capture_record(source, listing, settings))
        images = make_folder(folder / IMAGES)
        begun = time.perf_counter()
        rendered = _render(tracer, listing, images, settings, on_step)
        seconds = time.perf_counter() - begun
        cloud = folder / POINTS[0]
        if not cloud.is_file():
            frames = tuple(Frame(camera=camera, path=images / name) for name, camera in listing["train"])
            views = Dataset(frames=frames, background=_GREY)
            save_points(surface_points(tracer, source.assets, views, count=settings.points, seed=settings.seed), cloud)
    points = load_points(cloud)
    files = [cloud]
    if layout in ("transforms", "both"):
        files += [file for file in list_transforms(folder, listing, points) if file != cloud]
    if layout in ("colmap", "both"):
        files += list_colmap(folder, listing, points)
    return WrittenCapture(
        train=len(cameras), test=len(test), rendered=rendered, points=len(points), files=tuple(files), seconds=seconds
    )


def _listing(cameras: Sequence[Camera], test: Sequence[Camera]) -> dict[str, list[tuple[str, Camera]]]:
    """Names and cameras of all pictures, once it is sure that each can be taken."""
    if not cameras:
        raise InvalidValueError(message("cameras", "at least one", "none", "ask for more"))
    with scalar_variant():
        for camera in (*cameras, *test):
            check_camera(camera)
    parts = {"train": cameras, "test": test}
    return {split: [(picture_name(split, i), camera) for i, camera in enumerate(part)] for split, part in parts.items()}


def _check_surface_in_sight(tracer: PathTracer, cameras: Sequence[Camera]) -> None:
    """Raise unless some camera sees a surface."""
    if not any(bool((tracer.surface(camera, seed=0)[1] > 0).any()) for camera in cameras):
        raise InvalidValueError(message("cameras", "a view of the scene", "nothing but sky", "move or turn them"))


def _render(
    tracer: PathTracer,
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
        if not _is_complete(images / name, camera, settings.alpha):
            picture = tracer.picture(camera, seed=settings.seed + number)
            save_png(to_bytes(picture), images / name)
            rendered += 1
        if on_step is not None:
            on_step(number + 1, len(entries))
    return rendered


def _is_complete(path: Path, camera: Camera, alpha: bool) -> bool:
    """Whether a picture is on the disk, whole and of the right size and kind."""
    try:
        with Image.open(path) as picture:
            picture.load()
            return picture.size == (camera.width, camera.height) and picture.mode == ("RGBA" if alpha else "RGB")
    except (OSError, SyntaxError, ValueError):
        return False


def _capture_record(
    source: CaptureSource, listing: Mapping[str, Sequence[tuple[str, Camera]]], settings: CaptureSettings
) -> dict[str, Any]:
    """Everything that the pictures depend on, as JSON can hold it."""
    poses = hashlib.sha256()
    for name, camera in (entry for part in listing.values() for entry in part):
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.to_world.flatten().tolist()]
        digits = " ".join(f"{value + 0.0:.9f}" for value in numbers)  # the last digits differ between machines
        poses.update(f"{name} {camera.width} {camera.height} {digits}\n".encode())
    return {
        "scene": source.digest,
        "cameras": poses.hexdigest(),
        **{split: len(part) for split, part in listing.items()},
        **asdict(settings),
        "mitsuba": importlib.metadata.version("mitsuba"),
    }


def _claim_folder(folder: Path, wanted: dict[str, Any]) -> None:
    """Write the record of a new capture, or check that the folder's record is the same."""
    make_folder(folder)
    file = folder / RECORD
    if not file.exists():
        # A killed write may have left a temporary file.
        others = sorted(path.name for path in folder.iterdir() if not path.name.endswith(".tmp"))
        if others:
            found, do = f"{others[0]} in it and no {RECORD}", "choose a new folder"
            raise InvalidValueError(message(str(folder), "an empty folder or that of a capture", found, do))
        save_json(wanted, file)
        return
    try:
        there = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidValueError(
            message(str(file), "the record of a capture", str(error), "choose a new folder")
        ) from error
    if there != wanted:
        known = there if isinstance(there, dict) else {}
        changed = [
            f"{key} {known.get(key)!r}, now {value!r}" for key, value in wanted.items() if known.get(key) != value
        ]
        do = "choose a new folder, or the same settings to go on"
        raise InvalidValueError(message(str(file), "the settings of this capture", "; ".join(changed) or "more", do))
