"""`mi-splat capture`: path-traced pictures of a mesh scene, as a set from which a splat can be trained."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mi_splat import provenance
from mi_splat.capture.settings import CaptureSettings, MeshSettings, SurroundingsSettings
from mi_splat.cli.console import progress, show, show_json, warn
from mi_splat.cli.flags import Positional, Unprefixed
from mi_splat.cli.options import FieldOfView, Point, Size
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import Called, Folder, Length, between

if TYPE_CHECKING:
    from mi_splat.cameras import Camera
    from mi_splat.capture.record import Inputs
    from mi_splat.capture.sources import CaptureSource
    from mi_splat.capture.writer import WrittenCapture


EXAMPLES = (
    "capture truck.glb --cameras hemisphere:210 --test 20 --out out/truck",
    "capture car:900004 --cameras orbit:36@20 --size 128 --samples 16 --out out/orbit",
)
SEE_ALSO = ("train", "render")


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureOptions:
    """Take path-traced pictures of a mesh scene from a set of cameras, for training a splat.

    Writes images/, a list of them with their cameras, a point cloud and a record of the settings into --out. A capture
    that was interrupted goes on where it stopped when the same command is given again.
    """

    scene: Positional[Annotated[str, Called("SCENE")]]
    """Mitsuba mesh XML; an OBJ, PLY, GLB or glTF mesh (needs the extra `meshes`); car_street or stop_sign; or one of
    the project's objects by name and seed, for instance car:900004."""
    cameras: Annotated[str, Called("CAMERAS")] = "hemisphere:210"
    """hemisphere:N, orbit:N@ELEVATION, cap:N@MIN_ELEVATION, grid:AxE (azimuths x elevations), or a transforms .json."""
    out: Folder = Path("out/capture")
    """Folder to write: a new one, or that of the same capture, which then goes on."""
    size: Size | None = None
    """Pixels, as 256 or 256x192; 1 to 32768. None is 256, or what a transforms .json says."""
    test: Annotated[int, between(0, 100_000, "pictures")] = 0
    """Pictures held out, from other cameras over the same range; 0 or more."""
    format: Literal["transforms", "colmap", "both"] = "transforms"
    """How pictures are listed: Blender/NeRF transforms_*.json, a COLMAP text model in sparse/0, or both."""
    fov: FieldOfView | None = None
    """Field of view in degrees over the shorter side of the picture; between 0 and 180. None is 45."""
    centre: Point | None = None
    """Point that cameras look at, in the coordinates of the mesh file as it is turned and scaled; None is the middle of
    the scene or of its object."""
    distance: Length | None = None
    """World units between cameras and centre, more than 0; None is as near as shows the whole scene or its object."""
    settings: Unprefixed[CaptureSettings] = field(default_factory=CaptureSettings)
    """How pictures are taken."""
    mesh: Unprefixed[MeshSettings] = field(default_factory=MeshSettings)
    """How a mesh file is read and turned."""
    surroundings: Unprefixed[SurroundingsSettings] = field(default_factory=SurroundingsSettings)
    """What is around a mesh file, or around an object of the project."""
    json: bool = False
    """Print what was written as one JSON document on stdout."""


SIZE, FOV = (256, 256), 45.0
"""Size in pixels and field of view in degrees that are taken where none are given."""


def run(options: CaptureOptions) -> int:
    """Capture, or go on with a capture, and say what was written."""
    from mi_splat.capture.record import RECORD
    from mi_splat.io.folders import own_folder

    with own_folder(options.out, RECORD):
        return _capture(options)


def _capture(options: CaptureOptions) -> int:
    """As `run`, in a folder that is this process's own."""
    from mi_splat.camera_sets import camera_set, held_out_set
    from mi_splat.capture.sources import open_source
    from mi_splat.capture.writer import write_capture

    size, fov = options.size or SIZE, FOV if options.fov is None else options.fov
    _check_fov(fov)
    _check_meaning(options)
    with progress("building the scene"):
        source = open_source(options.scene, mesh=options.mesh, surroundings=options.surroundings)
    for text in source.warnings:
        warn(text)
    placed = _placement(options, source, size, fov)
    cameras = _in_coordinates_of(source, camera_set(options.cameras, **placed), options.cameras)
    _check_size(options, size, cameras)
    held_out = held_out_set(options.cameras, options.test, **placed)
    with progress("rendering", total=len(cameras) + len(held_out)) as advance:
        done = write_capture(
            source,
            cameras,
            options.out,
            test=held_out,
            settings=options.settings,
            layout=options.format,
            inputs=_inputs(options),
            on_step=lambda number, total: advance("rendering" if number < total else "laying points on surfaces"),
        )
    for text in done.warnings:
        warn(text)
    _report(done, source, options, (cameras[0].width, cameras[0].height))
    return 0


def _check_meaning(options: CaptureOptions) -> None:
    """Raise if a flag would mean nothing beside the cameras of a file."""
    given = {"--fov": options.fov, "--distance": options.distance, "--centre": options.centre}
    idle = [flag for flag, value in given.items() if value is not None]
    if idle and options.cameras.lower().endswith(".json"):
        got = f"--cameras {options.cameras} and {', '.join(idle)}"
        raise InvalidValueError(message("cameras", "cameras that have their places", got, "leave one out"))


def _check_size(options: CaptureOptions, size: tuple[int, int], cameras: list[Camera]) -> None:
    """Raise if cameras of a file have sizes of their own, and another was asked for."""
    others = [camera for camera in cameras if (camera.width, camera.height) != size]
    if options.size is not None and others:
        got = f"--cameras {options.cameras} of {others[0].width} x {others[0].height} and --size"
        raise InvalidValueError(message("cameras", "cameras that have their sizes", got, "leave one out"))


def _check_fov(fov: float) -> None:
    """Raise unless it is an angle that a picture can have."""
    if not 0 < fov < 180:
        raise InvalidValueError(message("fov", "degrees between 0 and 180", fov, "45 is usual"))


def _placement(options: CaptureOptions, source: CaptureSource, size: tuple[int, int], fov: float) -> dict[str, Any]:
    """Where cameras look, how far away they are, and their lens."""
    from mi_splat.camera_sets import framing

    distance, focal = framing(source.radius, fov=fov, size=size)
    return {
        "centre": source.centre if options.centre is None else _moved(options.centre, source.world_offset, -1),
        "distance": distance if options.distance is None else options.distance,
        "focal": focal,
        "size": size,
    }


def _moved(point: tuple[float, ...], offset: tuple[float, ...], sign: int) -> tuple[float, ...]:
    """A point moved by an offset, or back by it."""
    return tuple(value + sign * by for value, by in zip(point, offset, strict=True))


def _in_coordinates_of(source: CaptureSource, cameras: list[Camera], spec: str) -> list[Camera]:
    """Cameras of a file in the coordinates of a source, either of which may lie far from the world's origin."""
    import torch

    from mi_splat.datasets.transforms import read_world_offset

    if not spec.lower().endswith(".json"):
        return cameras
    by = torch.tensor(_moved(read_world_offset(Path(spec)), source.world_offset, -1), dtype=torch.float64)
    if not by.any():
        return cameras
    moved = []
    for camera in cameras:
        pose = camera.to_world.clone()
        pose[:3, 3] += by
        moved.append(replace(camera, to_world=pose))
    return moved


def _inputs(options: CaptureOptions) -> Inputs:
    """What was asked for, for the record."""
    scene = {"scene": options.scene, **asdict(options.mesh), **asdict(options.surroundings)}
    environment = options.surroundings.environment
    scene["environment"] = None if environment is None else str(environment)
    names = ("cameras", "size", "fov", "centre", "distance")
    cameras = {name: getattr(options, name) for name in names}
    if not options.cameras.lower().endswith(".json"):
        cameras |= {"size": options.size or SIZE, "fov": FOV if options.fov is None else options.fov}
    values = {"scene": scene, "cameras": cameras}
    return {
        kind: {name: list(value) if isinstance(value, tuple) else value for name, value in part.items()}
        for kind, part in values.items()
    }


def _report(done: WrittenCapture, source: CaptureSource, options: CaptureOptions, size: tuple[int, int]) -> None:
    """What was written and what to do with it."""
    total = done.train + done.test
    if options.json:
        show_json(
            {
                "out": str(options.out),
                "train": done.train,
                "test": done.test,
                "rendered": done.rendered,
                "width": size[0],
                "height": size[1],
                "points": done.points,
                "world_offset": list(source.world_offset),
                "warnings": [*source.warnings, *done.warnings],
                "begun_by": done.begun_by,
                "files": [str(file) for file in done.files],
                "seconds": done.seconds,
            }
        )
        return
    kept = f", {total - done.rendered} were there before" if done.rendered < total else ""
    held_out = f" ({done.test} of them held out)" if done.test else ""
    pictures = f"{total} pictures of {size[0]} x {size[1]}{held_out}"
    show(f"{options.out}: {pictures}; {done.rendered} rendered in {done.seconds:.0f} s{kept}")
    show(f"{done.points:,} points; listed in {', '.join(str(file.relative_to(options.out)) for file in done.files)}")
    if any(source.world_offset):
        offset = ", ".join(f"{value:.10g}" for value in source.world_offset)
        show(f"the mesh lies far from its origin: add ({offset}) to what is written to get its own coordinates, metres")
    if done.rendered < total and done.begun_by != provenance.versions().get("mi-splat", "unknown"):
        show(f"begun by {done.begun_by or 'an older version'}, which makes the same pictures")
    show(f"in Python: mi_splat.load_dataset({str(options.out)!r})")
