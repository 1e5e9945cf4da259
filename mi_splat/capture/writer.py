"""A capture that is written picture by picture, and that goes on where it stopped.

Picture i depends on the scene, its camera, the settings and seed + i alone, so what is
on the disk after any number of interruptions is what one run would have left. The files
that list the pictures come last.
"""

import hashlib
import importlib.metadata
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat import provenance
from mi_splat.cameras.camera import Camera, View, project_points
from mi_splat.capture.mesh import Asset, Floats
from mi_splat.capture.path_tracer import NEAR, PASSES, PathTracer, tracing_variant
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.sources import CaptureSource
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
from mi_splat.io.documents import is_temporary, save_json, save_png, sweep_temporary
from mi_splat.io.folders import locked_folder
from mi_splat.io.parsing import DocumentReader, Fields
from mi_splat.io.picture_files import PictureFileError, check_pixels, load_picture
from mi_splat.io.points import PointCloud, load_points, save_points, to_bytes
from mi_splat.maths.sh import sh_basis, sh_to_colour
from mi_splat.render.plugins.sensor import sensor_dict

COLOUR_VIEWS = 24
"""Pictures from which points take their colours."""
OVERSAMPLING = 2
MAX_OVERSAMPLING = 12
"""How many samples are laid for each point wanted at first, and at most: some of a
surface is hidden.
"""
_R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence in both coordinates."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSamples:
    """Points on a surface."""

    points: Floats  # (N, 3) float32, metres
    normals: Floats  # (N, 3) float32 unit vectors
    # (N,) float32 distance to the neighbours that the local density means, metres
    spacing: Floats


def nearness(
    cameras: Sequence[Camera], *, closest: float = 1.5
) -> Callable[[Floats], Floats]:
    """A density for `surface_samples`: the mean over cameras of one over the squared
    distance.
    """
    eyes = [camera.position.numpy() for camera in cameras]

    def density(points: Floats) -> Floats:
        total = np.zeros(len(points))
        for eye in eyes:
            total += 1 / np.maximum(((points - eye) ** 2).sum(1), closest**2)
        return (total / len(eyes)).astype(np.float32)

    return density


def _split(
    corners: NDArray[np.float64], longest: Callable[[Floats], Floats]
) -> NDArray[np.float64]:
    """Halve triangles (F, 3, 3) across their longest edge until that is no longer than
    `longest` at their centre.
    """
    done = []
    while len(corners):
        edges = np.linalg.norm(corners - np.roll(corners, -1, 1), axis=2)
        large = edges.max(1) > longest(corners.mean(1).astype(np.float32))
        done.append(corners[~large])
        corners = corners[large]
        side = edges[large].argmax(1)
        row = np.arange(len(corners))
        a, b, c = (corners[row, (side + k) % 3] for k in range(3))
        middle = (a + b) / 2
        corners = np.concatenate(
            [np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)]
        )
    return np.concatenate(done)


def surface_samples(
    asset: Asset,
    count: int,
    *,
    density: Callable[[Floats], Floats] | None = None,
    seed: int = 0,
) -> SurfaceSamples:
    """About evenly spread points on the surface of an asset.

    Triangles get points in proportion to area and density by systematic sampling (Madow
    and Madow 1944). Inside them, points follow the R2 sequence (Roberts 2018, "The
    unreasonable effectiveness of quasirandom sequences"), whose steps are 1 / p and 1 /
    p^2 with p^3 = p + 1, folded from the square onto the triangle.
    """
    if count < 1:
        raise InvalidValueError.of(
            "count", "a positive number of samples", count, "ask for more"
        )
    corners = np.concatenate(
        [mesh.vertices[mesh.faces].astype(np.float64) for mesh in asset.meshes]
    )
    if density is not None:
        at = density
        corners = _split(
            corners, lambda points: (0.5 / np.sqrt(at(points))).astype(np.float32)
        )
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    if density is None:
        local = np.ones(len(area))
    else:
        local = density(corners.mean(1).astype(np.float32)).astype(np.float64)
    total = np.cumsum(area * local)
    if not total[-1] > 0:
        raise InvalidValueError.of(
            "asset", "a surface", f"no area in {asset.name!r}", "add meshes to it"
        )
    rng = np.random.default_rng([seed, 0x5A])
    face = np.searchsorted(
        total, (np.arange(count) + rng.random()) * (total[-1] / count)
    ).clip(max=len(area) - 1)
    order = np.arange(count)
    u = (rng.random() + order * _R2[0]) % 1
    v = (rng.random() + order * _R2[1]) % 1
    fold = u + v > 1
    u = np.where(fold, 1 - u, u)
    v = np.where(fold, 1 - v, v)
    a, b, c = (corners[face, k] for k in range(3))
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    normals = cross[face] / (2 * area[face])[:, None]
    spacing = np.sqrt(total[-1] / count / local[face])
    return SurfaceSamples(
        points.astype(np.float32),
        normals.astype(np.float32),
        spacing.astype(np.float32),
    )


def _observe(
    samples: SurfaceSamples, view: View, depth: Tensor, tolerance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Samples in one view: (N,) weight of each (0 where hidden), (N, 3) its colour, (N,
    3) direction to it.
    """
    points = torch.from_numpy(samples.points)
    normals = torch.from_numpy(samples.normals)
    camera = view.camera
    pixels, forward = project_points(points, camera)
    offset = points - camera.position.to(points)
    distance = offset.norm(dim=1)
    direction = offset / distance[:, None]
    column = pixels[:, 0].floor().long()
    row = pixels[:, 1].floor().long()
    inside = (
        (forward > 0.05)
        & (column >= 0)
        & (row >= 0)
        & (column < camera.width)
        & (row < camera.height)
    )
    column = column.clamp(0, camera.width - 1)
    row = row.clamp(0, camera.height - 1)
    surface = depth[row, column]
    facing = (direction * normals).sum(1).abs()
    slack = (
        tolerance * distance
        + 0.02
        + 0.5 * distance / camera.fx / facing.clamp(min=0.08)
    )
    # nothing else there: only what lies beyond every surface, the dome, can be seen
    sky = surface <= 0
    visible = inside & torch.where(
        sky, distance > 60, (distance - surface).abs() < slack
    )
    return visible * facing.clamp(min=0.05), view.image[row, column], direction


def fit_colours(
    samples: SurfaceSamples,
    views: Sequence[View],
    depths: Sequence[Tensor],
    *,
    degree: int = 0,
    damping: float = 2.0,
    tolerance: float = 0.015,
) -> tuple[Tensor, Tensor]:
    """Least-squares SH of each sample over the views that see it, by ridge regression
    (Hoerl and Kennard 1970).
    """
    count = len(samples.points)
    size = (degree + 1) ** 2
    left = torch.zeros(count, size, size)
    right = torch.zeros(count, size, 3)
    seen = torch.zeros(count)
    for view, depth in zip(views, depths, strict=True):
        weight, colour, direction = _observe(samples, view, depth, tolerance)
        basis = sh_basis(direction, degree)
        left += (weight[:, None] * basis)[:, :, None] * basis[:, None]
        right += (weight[:, None] * basis)[:, :, None] * (colour - 0.5)[:, None]
        seen += weight > 0
    ridge = torch.full((size,), damping)
    ridge[0] = 1e-4
    return torch.linalg.solve(left + torch.diag(ridge), right), seen


def surface_points(
    tracer: PathTracer,
    assets: Sequence[Asset],
    views: Sequence[View],
    *,
    count: int = 20_000,
    seed: int = 0,
) -> PointCloud:
    """At most `count` points that the pictures show, in the colours that they show.

    Without assets, the points are where rays through the pictures' pixels meet the
    scene. Of one asset, they lie evenly on it. Of more, half of them do so on the
    first, and the rest is spread over the others, denser near the cameras.
    """
    rows = np.linspace(0, len(views) - 1, min(COLOUR_VIEWS, len(views)))
    chosen = [views[i] for i in sorted({round(row) for row in rows})]
    hits = [
        tracer.surface(view.camera, seed=seed + number)
        for number, view in enumerate(chosen)
    ]
    if not any(bool((distance > 0).any()) for _, distance in hits):
        raise InvalidValueError.of(
            "cameras", "a view of the scene", "nothing but sky", "move or turn them"
        )
    if not assets:
        points = torch.cat([met[distance > 0] for met, distance in hits])
        colours = torch.cat(
            [
                view.image[distance > 0]
                for view, (_, distance) in zip(chosen, hits, strict=True)
            ]
        )
        return _rows_of(
            points,
            colours,
            np.random.default_rng([seed, 0x9C]).permutation(len(points))[:count],
        )
    depths, (first, *others) = [distance for _, distance in hits], assets
    if not others:
        return _visible_points(first, chosen, depths, count, seed=seed)
    rest = Asset("rest", tuple(mesh for asset in others for mesh in asset.meshes))
    near = nearness([view.camera for view in chosen])
    halves = [
        _visible_points(first, chosen, depths, count // 2, seed=seed),
        _visible_points(
            rest, chosen, depths, count - count // 2, density=near, seed=seed
        ),
    ]
    return PointCloud(
        *(
            torch.cat([getattr(half, name) for half in halves])
            for name in ("points", "colours")
        )
    )


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
        sh, times_seen = fit_colours(samples, views, depths)
        rows = np.flatnonzero(times_seen.numpy() > 0)
        if len(rows) >= count or laid >= MAX_OVERSAMPLING * count:
            break
        laid = min(
            MAX_OVERSAMPLING * count, round(1.1 * laid * count / max(len(rows), 1)) + 1
        )
    # Samples follow the surface, so leaving them out at equal steps keeps the rest
    # even.
    kept = np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(np.int64)
    points = torch.from_numpy(samples.points)
    # Colours of degree 0 are the same from everywhere.
    return _rows_of(points, sh_to_colour(sh, torch.zeros_like(points)), rows[kept])


def _rows_of(points: Tensor, colours: Tensor, rows: NDArray[np.int64]) -> PointCloud:
    """The cloud of some rows of (P, 3) points and colours."""
    index = torch.from_numpy(rows)
    return PointCloud(points[index], colours[index].clamp(0, 1))


_GREY = (0.5, 0.5, 0.5)

RECORD = "capture.json"
"""File in the folder of a capture that holds its settings."""
PICTURES = 2
"""Version of the code that makes pictures: raise it when it makes others of the same
input.
"""

_RECORD = DocumentReader(expected="the record of a capture", do="choose a new folder")

Inputs = Mapping[str, Mapping[str, Any]]
"""What the user asked for, as JSON can hold it: names and values under "scene" and
under "cameras".
"""

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
    """Take pictures of a source and write them as a set that
    `mi_splat.datasets.load_dataset` reads.
    """
    settings = settings or CaptureSettings()
    listing = _listing(cameras, test)
    near = NEAR if settings.near is None else settings.near
    with locked_folder(folder):
        with tracing_variant():
            tracer = PathTracer(
                source.scene, samples=settings.samples, alpha=settings.rgba, near=near
            )
            if not any(
                bool((tracer.surface(view, seed=0)[1] > 0).any()) for view in cameras
            ):
                raise InvalidValueError.of(
                    "cameras",
                    "a view of the scene",
                    "nothing but sky",
                    "move or turn them",
                )
            begun_by = claim_folder(
                folder, capture_record(source, listing, settings, inputs)
            )
            images = make_folder(folder / IMAGES)
            begun = time.perf_counter()
            rendered = _render(tracer, listing, images, settings, on_step)
            seconds = time.perf_counter() - begun
            cloud = folder / POINTS[0]
            if not cloud.is_file():
                frames = tuple(
                    Frame(camera=camera, path=images / name)
                    for name, camera in listing["train"]
                )
                views = Dataset(frames=frames, background=_GREY)
                sampled = surface_points(
                    tracer,
                    source.assets,
                    views,
                    count=settings.points,
                    seed=settings.seed,
                )
                save_points(sampled, cloud)
        points = load_points(cloud)
        files = [cloud]
        if layout in ("transforms", "both"):
            files += [
                file
                for file in list_transforms(folder, listing, points)
                if file != cloud
            ]
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
            warnings=_black_pictures(
                images, [name for part in listing.values() for name, _ in part]
            ),
        )


def _listing(
    cameras: Sequence[Camera], test: Sequence[Camera]
) -> dict[str, list[tuple[str, Camera]]]:
    """Names and cameras of all pictures, once it is sure that each can be taken."""
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
    listing: Mapping[str, Sequence[tuple[str, Camera]]],
    images: Path,
    settings: CaptureSettings,
    on_step: OnStep | None,
) -> int:
    """Render and write the pictures that are not on the disk; returns their number."""
    entries = [entry for part in listing.values() for entry in part]
    # Mitsuba's seeds; CaptureSettings and MOST see to it
    assert (settings.seed + len(entries)) * PASSES < 1 << 32
    rendered = 0
    for number, (name, camera) in enumerate(entries):
        if not _is_complete(images / name, camera, settings.rgba):
            picture = tracer.picture(camera, seed=settings.seed + number)
            save_png(to_bytes(picture), images / name)
            rendered += 1
        if on_step is not None:
            on_step(number + 1, len(entries))
    return rendered


def _black_pictures(images: Path, names: Sequence[str]) -> tuple[str, ...]:
    """A warning if nothing but black is to be seen in any picture."""
    for name in names:
        if any(
            high > 0
            for _, high in np.reshape(
                load_picture(images / name).convert("RGB").getextrema(), (3, 2)
            )
        ):
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
    return picture.size == (camera.width, camera.height) and picture.mode == (
        "RGBA" if alpha else "RGB"
    )


def capture_record(
    source: CaptureSource,
    listing: Mapping[str, Sequence[tuple[str, Camera]]],
    settings: CaptureSettings,
    inputs: Inputs | None = None,
) -> dict[str, Any]:
    """Everything that the pictures depend on, as JSON can hold it."""
    poses = hashlib.sha256()
    for name, camera in (entry for part in listing.values() for entry in part):
        numbers = [
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            *camera.to_world.flatten().tolist(),
        ]
        # the last digits differ between machines
        digits = " ".join(f"{value + 0.0:.9f}" for value in numbers)
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
        "inputs": {kind: dict(values) for kind, values in (inputs or {}).items()},
    }


def claim_folder(folder: Path, wanted: dict[str, Any]) -> str:
    """Write the record of a new capture, or check that the folder's record is the
    same.
    """
    make_folder(folder)
    for subfolder in (folder, folder / "images"):
        sweep_temporary(subfolder)
    file = folder / RECORD
    if not file.exists():
        others = sorted(
            path.name for path in folder.iterdir() if not is_temporary(path.name)
        )
        if others:
            got = f"{others[0]} in it and no {RECORD}"
            do = "choose a new folder"
            raise InvalidValueError.of(
                str(folder), "an empty folder or that of a capture", got, do
            )
        save_json(wanted, file)
        return str(wanted["version"])
    stored = _RECORD.read_json(file)
    inputs = Fields(stored, str(file), InvalidValueError, _RECORD.do).object(
        "inputs", {}
    )
    for kind in inputs.values:
        inputs.object(kind)
    changed = differences(stored, wanted)
    if changed:
        do = "choose a new folder, or the same settings to go on"
        raise InvalidValueError.of(
            str(file), "the settings of this capture", "; ".join(changed), do
        )
    return str(stored.get("version", "unknown"))


def differences(stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """What differs between the record of a folder and the one wanted, in words; empty
    if the pictures are the same.
    """
    plain = (
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
    changed = [
        f"{key} {stored.get(key)!r}, now {wanted[key]!r}"
        for key in plain
        if stored.get(key) != wanted[key]
    ]
    content = {
        "scene": "another scene (what its files hold)",
        "cameras": "other cameras (their poses or lenses)",
    }
    for key, words in content.items():
        if stored.get(key) != wanted[key]:
            before, now = (
                record.get("inputs", {}).get(key, {}) for record in (stored, wanted)
            )
            options = [
                name
                for name in {**now, **before}
                if name in before and before[name] != now.get(name)
            ]
            changed += [
                f"{name} {before[name]!r}, now {now.get(name)!r}" for name in options
            ]
            changed += [] if changed else [words]
    return changed
