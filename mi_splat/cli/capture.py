"""`mi-splat capture`: path-traced pictures of a mesh scene, as a set from which a splat can be trained."""

from __future__ import annotations

from typing import Any

from mi_splat.camera_sets import camera_set, framing, held_out_set
from mi_splat.capture.sources import CaptureSource, open_source
from mi_splat.capture.writer import CaptureSettings, WrittenCapture, write_capture
from mi_splat.cli.console import progress, show, show_json
from mi_splat.cli.options import CaptureOptions
from mi_splat.errors import InvalidValueError, message


def run(options: CaptureOptions) -> int:
    """Capture, or go on with a capture, and say what was written."""
    settings = CaptureSettings(samples=options.samples, seed=options.seed, alpha=options.rgba, points=options.points)
    size = _size(options)
    _check_fov(options.fov)
    with progress("building the scene"):
        source = open_source(options.scene, up=options.up, scale=options.scale)
    placed = _placement(options, source, size)
    cameras = camera_set(options.cameras, **placed)
    held_out = held_out_set(options.cameras, options.test, **placed)
    with progress("rendering", total=len(cameras) + len(held_out)) as advance:
        done = write_capture(
            source,
            cameras,
            options.out,
            test=held_out,
            settings=settings,
            layout=options.format,
            on_step=lambda number, total: advance("rendering" if number < total else "laying points on surfaces"),
        )
    _report(done, options, (cameras[0].width, cameras[0].height))
    return 0


def _size(options: CaptureOptions) -> tuple[int, int]:
    """Width and height in pixels."""
    if len(options.size) not in (1, 2) or min(options.size) < 1:
        raise InvalidValueError(message("size", "one or two positive numbers", options.size, "for instance 256"))
    return options.size[0], options.size[-1]


def _check_fov(fov: float) -> None:
    """Raise unless it is an angle that a picture can have."""
    if not 0 < fov < 180:
        raise InvalidValueError(message("fov", "degrees between 0 and 180", fov, "45 is usual"))


def _placement(options: CaptureOptions, source: CaptureSource, size: tuple[int, int]) -> dict[str, Any]:
    """Where cameras look, how far away they are, and their lens."""
    distance, focal = framing(source.radius, fov=options.fov, size=size)
    return {
        "centre": source.centre if options.centre is None else options.centre,
        "distance": distance if options.distance is None else options.distance,
        "focal": focal,
        "size": size,
    }


def _report(done: WrittenCapture, options: CaptureOptions, size: tuple[int, int]) -> None:
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
    show(f"in Python: mi_splat.load_dataset({str(options.out)!r})")
