"""A capture that is written picture by picture, and that goes on where it stopped.

Picture i depends on the scene, its camera, the settings and seed + i alone, so what is on the disk after any number of
interruptions is what one run would have left. The files that list the pictures come last.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.assets.mesh import Asset, Floats
from mi_splat.cameras import Camera, View
from mi_splat.capture.mesh_splats import DiscConfig, fit_colours
from mi_splat.capture.passes import PASSES
from mi_splat.capture.path_tracer import NEAR, PathTracer, check_camera, tracing_variant
from mi_splat.capture.record import Inputs, capture_record, claim_folder
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.sources import CaptureSource
from mi_splat.capture.surface_sampling import nearness, surface_samples
from mi_splat.capture.working_frame import WorkingFrame
from mi_splat.datasets.dataset import Dataset
from mi_splat.datasets.frames import Frame
from mi_splat.datasets.transforms import POINTS, WORLD_OFFSET
from mi_splat.datasets.writing import IMAGES, list_colmap, list_transforms, make_folder, picture_name
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import save_png
from mi_splat.io.locks import locked_folder
from mi_splat.io.picture_files import PictureFileError, check_pixels, load_picture
from mi_splat.io.points import PointCloud, load_points, save_points, to_bytes
from mi_splat.sh import sh_to_colour

_GREY = (0.5, 0.5, 0.5)

OnStep = Callable[[int, int], None]
"""Called after each picture with the number on the disk and the number wanted."""


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
        begun_by: Version of the project that began the capture.
        warnings: What the user should know of the pictures.
    """

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


COLOUR_VIEWS = 24
"""Pictures from which points take their colours."""
OVERSAMPLING, MAX_OVERSAMPLING = 2, 12
"""How many samples are laid for each point wanted at first, and at most: some of a surface is hidden."""


def surface_points(
    tracer: PathTracer, assets: Sequence[Asset], views: Sequence[View], *, count: int = 20_000, seed: int = 0
) -> PointCloud:
    """At most `count` points that the pictures show, in the colours that they show.

    Without assets, the points are where rays through the pictures' pixels meet the scene. Of one asset, they lie evenly
    on it. Of more, half of them do so on the first, and the rest is spread over the others, denser near the cameras.
    """
    rows = np.linspace(0, len(views) - 1, min(COLOUR_VIEWS, len(views)))
    chosen = [views[i] for i in sorted({round(row) for row in rows})]
    hits = [tracer.surface(view.camera, seed=seed + number) for number, view in enumerate(chosen)]
    if not any(bool((distance > 0).any()) for _, distance in hits):
        raise InvalidValueError.of("cameras", "a view of the scene", "nothing but sky", "move or turn them")
    if not assets:
        points = torch.cat([met[distance > 0] for met, distance in hits])
        colours = torch.cat([view.image[distance > 0] for view, (_, distance) in zip(chosen, hits, strict=True)])
        return _rows_of(points, colours, np.random.default_rng([seed, 0x9C]).permutation(len(points))[:count])
    depths, (first, *others) = [distance for _, distance in hits], assets
    if not others:
        return _visible_points(first, chosen, depths, count, seed=seed)
    rest = Asset("rest", tuple(mesh for asset in others for mesh in asset.meshes))
    near = nearness([view.camera for view in chosen])
    halves = [
        _visible_points(first, chosen, depths, count // 2, seed=seed),
        _visible_points(rest, chosen, depths, count - count // 2, density=near, seed=seed),
    ]
    return PointCloud(*(torch.cat([getattr(half, name) for half in halves]) for name in ("points", "colours")))


def _visible_points(
    asset: Asset,
    views: Sequence[View],
    depths: Sequence[Tensor],
    count: int,
    *,
    density: Callable[[Floats], Floats] | None = None,
    seed: int,
) -> PointCloud:
    """At most `count` points on an asset that the pictures show."""
    laid = OVERSAMPLING * max(count, 1)
    while True:
        samples = surface_samples(asset, laid, density=density, seed=seed)
        sh, times_seen = fit_colours(samples, views, depths, DiscConfig(degree=0))
        rows = np.flatnonzero(times_seen.numpy() > 0)
        if len(rows) >= count or laid >= MAX_OVERSAMPLING * count:
            break
        laid = min(MAX_OVERSAMPLING * count, round(1.1 * laid * count / max(len(rows), 1)) + 1)
    # Samples follow the surface, so leaving them out at equal steps keeps the rest even.
    kept = np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(np.int64)
    points = torch.from_numpy(samples.points)
    # Colours of degree 0 are the same from everywhere.
    return _rows_of(points, sh_to_colour(sh, torch.zeros_like(points)), rows[kept])


def _rows_of(points: Tensor, colours: Tensor, rows: NDArray[np.int64]) -> PointCloud:
    """The cloud of some rows of (P, 3) points and colours."""
    index = torch.from_numpy(rows)
    return PointCloud(points[index], colours[index].clamp(0, 1))
