"""`mi-splat capture`: path-traced pictures of a mesh scene, as a set from which a splat can be trained."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from mi_splat import provenance
from mi_splat.camera_sets import camera_set, framing, held_out_set
from mi_splat.cameras import Camera
from mi_splat.capture.record import RECORD, Inputs
from mi_splat.capture.sources import CaptureSource, open_source
from mi_splat.capture.writer import WrittenCapture, write_capture
from mi_splat.cli.console import progress, show, show_json, warn
from mi_splat.cli.options import CaptureOptions
from mi_splat.datasets.transforms import read_world_offset
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import own_folder

SIZE, FOV = (256,), 45.0
"""Size in pixels and field of view in degrees that are taken where none are given."""


def run(options: CaptureOptions) -> int:
    """Capture, or go on with a capture, and say what was written."""
    with own_folder(options.out, RECORD):
        return _capture(options)


def _capture(options: CaptureOptions) -> int:
    """As `run`, in a folder that is this process's own."""
    size, fov = _size(options), FOV if options.fov is None else options.fov
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


def _size(options: CaptureOptions) -> tuple[int, int]:
    """Width and height in pixels."""
    size = SIZE if options.size is None else options.size
    if len(size) not in (1, 2) or min(size) < 1:
        raise InvalidValueError(message("size", "one or two positive numbers", size, "for instance 256"))
    return size[0], size[-1]


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
