"""A capture that is written image by image, and that goes on where it stopped.

Image i depends on the scene, its camera, the settings and seed + i alone, so what is on
the disk after any number of interruptions is what one run would have left. The files
that list the images come last.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mi_splat.cameras.camera import Camera
from mi_splat.capture.path_tracer import NEAR, PASSES, PathTracer, tracing_variant
from mi_splat.capture.record import Inputs, Listing, capture_record, claim_folder
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.sources import CaptureSource
from mi_splat.capture.surface_points import surface_points
from mi_splat.datasets.dataset import Dataset
from mi_splat.datasets.frames import Frame
from mi_splat.datasets.transforms import POINTS
from mi_splat.datasets.writing import (
    IMAGES,
    list_colmap,
    list_transforms,
    make_folder,
    picture_name,
)
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import save_png
from mi_splat.io.folders import locked_folder
from mi_splat.io.picture_files import PictureFileError, check_pixels, load_picture
from mi_splat.io.points import load_points, save_points, to_bytes
from mi_splat.render.plugins.sensor import sensor_dict

_GREY = (0.5, 0.5, 0.5)

OnStep = Callable[[int, int], None]
"""Called after each image with the number on the disk and the number wanted."""

Layout = Literal["transforms", "colmap", "both"]


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
    layout: Layout = "transforms",
    inputs: Inputs | None = None,
    on_step: OnStep | None = None,
) -> WrittenCapture:
    """Render images of a source and write them as a set that
    `mi_splat.datasets.load_dataset` reads.
    """
    settings = settings or CaptureSettings()
    listing = _listing(cameras, test)
    near = NEAR if settings.near is None else settings.near
    images = folder / IMAGES
    cloud = folder / POINTS[0]
    with locked_folder(folder):
        with tracing_variant():
            tracer = PathTracer(
                source.scene, samples=settings.samples, alpha=settings.rgba, near=near
            )
            _check_views(tracer, cameras)
            record = capture_record(source, listing, settings, inputs)
            begun_by = claim_folder(folder, record)
            make_folder(images)
            begun = time.perf_counter()
            rendered = _render(tracer, listing, images, settings, on_step)
            seconds = time.perf_counter() - begun
            if not cloud.is_file():
                frames = tuple(
                    Frame(camera=camera, path=images / name)
                    for name, camera in listing["train"]
                )
                sampled = surface_points(
                    tracer,
                    source.assets,
                    Dataset(frames=frames, background=_GREY),
                    count=settings.points,
                    seed=settings.seed,
                )
                save_points(sampled, cloud)
        points = load_points(cloud)
        files = [cloud]
        if layout in ("transforms", "both"):
            written = list_transforms(folder, listing, points)
            files += [file for file in written if file != cloud]
        if layout in ("colmap", "both"):
            files += list_colmap(folder, listing, points)
        names = [name for part in listing.values() for name, _ in part]
        return WrittenCapture(
            train=len(cameras),
            test=len(test),
            rendered=rendered,
            points=len(points),
            files=tuple(files),
            seconds=seconds,
            begun_by=begun_by,
            warnings=_black_images(images, names),
        )


def _check_views(tracer: PathTracer, cameras: Sequence[Camera]) -> None:
    """Raise if no camera sees any surface."""
    for camera in cameras:
        _, distance = tracer.surface(camera, seed=0)
        if bool((distance > 0).any()):
            return
    expected = "a view of the scene"
    do = "move or turn them"
    raise InvalidValueError.of("cameras", expected, "nothing but sky", do)


def _listing(
    cameras: Sequence[Camera], test: Sequence[Camera]
) -> dict[str, list[tuple[str, Camera]]]:
    """Names and cameras of all images, once it is sure that each can be rendered."""
    if not cameras:
        raise InvalidValueError.of("cameras", "at least one", "none", "ask for more")
    with tracing_variant():
        for camera in (*cameras, *test):
            sensor_dict(camera)  # which refuses pixels that are not square
            # or they could not be read again
            check_pixels("size", camera.width, camera.height)
    parts = {"train": cameras, "test": test}
    return {
        split: [(picture_name(split, i), camera) for i, camera in enumerate(part)]
        for split, part in parts.items()
    }


def _render(
    tracer: PathTracer,
    listing: Listing,
    images: Path,
    settings: CaptureSettings,
    on_step: OnStep | None,
) -> int:
    """Render and write the images that are not on the disk; returns their number."""
    entries = [entry for part in listing.values() for entry in part]
    # Mitsuba's seeds; CaptureSettings and MOST see to it
    assert (settings.seed + len(entries)) * PASSES < 1 << 32
    rendered = 0
    for number, (name, camera) in enumerate(entries):
        if not _is_complete(images / name, camera, settings.rgba):
            image = tracer.picture(camera, seed=settings.seed + number)
            save_png(to_bytes(image), images / name)
            rendered += 1
        if on_step is not None:
            on_step(number + 1, len(entries))
    return rendered


def _black_images(images: Path, names: Sequence[str]) -> tuple[str, ...]:
    """A warning if nothing but black is to be seen in any image."""
    for name in names:
        image = load_picture(images / name).convert("RGB")
        if image.getbbox() is not None:  # the box around what is not black
            return ()
    do = "move them away (--distance), or light the scene"
    cause = "only black, as from cameras inside the object or far too near"
    return (message("images", "some that are not black", cause, do),)


def _is_complete(path: Path, camera: Camera, alpha: bool) -> bool:
    """Whether an image is on the disk, whole and of the right size and kind."""
    try:
        image = load_picture(path)
    except PictureFileError:
        return False
    size = (camera.width, camera.height)
    mode = "RGBA" if alpha else "RGB"
    return image.size == size and image.mode == mode
