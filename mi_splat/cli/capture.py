"""`mi-splat capture`: path-traced images of a mesh scene, as a set from which a splat
can be trained.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mi_splat import provenance
from mi_splat.cameras.forms import parse_form
from mi_splat.capture.settings import (
    CaptureSettings,
    MeshSettings,
    SurroundingsSettings,
)
from mi_splat.cli.console import progress, show_result, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import FieldOfView, JsonOptions, Point, Size
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Length, Metavar, OutFolder, between

if TYPE_CHECKING:
    from mi_splat.capture.record import Inputs
    from mi_splat.capture.writer import WrittenCapture


EXAMPLES = (
    "capture YOUR.glb --cameras hemisphere:210 --test 20 --out out/truck",
    "capture car --cameras orbit:36@20 --size 128 --samples 16 --out out/orbit",
)


@dataclass(frozen=True, kw_only=True)
class CaptureOptions(JsonOptions):
    """Render path-traced images of a mesh scene from a set of cameras, for training a
    splat.

    Writes images/, a list of them with their cameras, a point cloud and a record of the
    settings into --out. Repeat the command to resume an interrupted capture.
    """

    scene: Positional[Annotated[str, Metavar("SCENE")]]
    """Mitsuba mesh XML; a GLB mesh; a shipped object, for instance car; or a shipped
    scene, car_street or stop_sign.
    """
    cameras: Annotated[str, Metavar("CAMERAS")] = "hemisphere:210"
    """hemisphere:N, orbit:N@ELEVATION, cap:N@MIN_ELEVATION, grid:AxE (azimuths x
    elevations), or a transforms .json.
    """
    out: OutFolder = Path("out/capture")
    """Folder to write: a new one, or that of the same capture, which is then resumed.
    """
    size: Size | None = None
    """Image size in pixels, as 256 or 256x192. Default: 256, or that of a transforms
    .json.
    """
    test: Annotated[int, between(0, 100_000, "images")] = 0
    """Number of held-out images, from other cameras over the same range."""
    format: Literal["transforms", "colmap", "both"] = "transforms"
    """Format of the camera file: Blender/NeRF transforms_*.json, a COLMAP text model in
    sparse/0, or both.
    """
    fov: FieldOfView | None = None
    """Field of view in degrees over the shorter side of the image. Default: 45."""
    centre: Point | None = None
    """Point that the cameras face, in the coordinates of the mesh file after rotation
    and scaling. Default: the centre of the scene or of its object.
    """
    distance: Length | None = None
    """World units between cameras and centre. Default: as near as shows the whole scene
    or its object.
    """
    settings: CaptureSettings = field(default_factory=CaptureSettings)
    """How images are rendered."""
    mesh: MeshSettings = field(default_factory=MeshSettings)
    """How a mesh file is read and turned."""
    surroundings: SurroundingsSettings = field(default_factory=SurroundingsSettings)
    """What is around a mesh file, or around an object of the project."""


SIZE = (256, 256)
FOV = 45.0
"""Size in pixels and field of view in degrees that are taken where none are given."""


def check_inputs(options: CaptureOptions) -> None:
    """Raise unless the cameras are a file, or a set that can be made."""
    if not options.cameras.lower().endswith(".json"):
        parse_form(options.cameras)


def run(options: CaptureOptions) -> None:
    """Capture, or go on with a capture, and say what was written."""
    from mi_splat.capture.record import RECORD
    from mi_splat.io.folders import own_folder

    with own_folder(options.out, RECORD):
        _capture(options)


def _capture(options: CaptureOptions) -> None:
    from mi_splat.cameras.framing import no_surface_in_view
    from mi_splat.cameras.sets import camera_set, framing, held_out_set
    from mi_splat.capture.sources import open_source
    from mi_splat.capture.writer import write_capture

    is_file = options.cameras.lower().endswith(".json")
    given = {
        "--fov": options.fov,
        "--distance": options.distance,
        "--centre": options.centre,
    }
    idle = [flag for flag, value in given.items() if value is not None]
    if is_file and idle:
        got = f"--cameras {options.cameras} and {', '.join(idle)}"
        raise InvalidValueError.of(
            "cameras", "cameras that have their places", got, "leave one out"
        )
    with progress("building the scene"):
        source = open_source(
            options.scene, mesh=options.mesh, surroundings=options.surroundings
        )
    size = options.size or SIZE
    distance, lens = framing(
        source.radius, fov=FOV if options.fov is None else options.fov, size=size
    )
    placed: dict[str, Any] = {
        "centre": source.centre if options.centre is None else options.centre,
        "distance": distance if options.distance is None else options.distance,
        "lens": lens,
    }
    cameras = camera_set(options.cameras, **placed)
    unseen = no_surface_in_view(source.centre, source.radius, cameras)
    if unseen:
        warn(unseen)
    width = cameras[0].width
    height = cameras[0].height
    if options.size is not None and any(
        (camera.width, camera.height) != size for camera in cameras
    ):
        got = f"--cameras {options.cameras} of {width} x {height} and --size"
        raise InvalidValueError.of(
            "cameras", "cameras that have their sizes", got, "leave one out"
        )
    held_out = held_out_set(options.cameras, options.test, **placed)
    with progress("rendering", total=len(cameras) + len(held_out)) as advance:
        done = write_capture(
            source,
            cameras,
            options.out,
            test=held_out,
            settings=options.settings,
            layout=options.format,
            inputs=_inputs(options, is_file=is_file),
            on_step=lambda number, total: advance(
                "rendering" if number < total else "laying points on surfaces"
            ),
        )
    for text in done.warnings:
        warn(text)
    document = {
        **{"out": str(options.out), "width": width, "height": height},
        **{
            **asdict(done),
            "files": list(map(str, done.files)),
            "warnings": list(done.warnings),
        },
    }
    show_result(
        document,
        *_lines(done, options.out, f"{width} x {height}"),
        as_json=options.json,
    )


def _inputs(options: CaptureOptions, *, is_file: bool) -> Inputs:
    cameras = {
        name: getattr(options, name)
        for name in ("cameras", "size", "fov", "centre", "distance")
    }
    if not is_file:
        cameras |= {
            "size": options.size or SIZE,
            "fov": FOV if options.fov is None else options.fov,
        }
    scene = {
        "scene": options.scene,
        **asdict(options.mesh),
        **asdict(options.surroundings),
    }
    inputs: Inputs = json.loads(
        json.dumps({"scene": scene, "cameras": cameras}, default=str)
    )
    return inputs


def _lines(done: WrittenCapture, out: Path, size: str) -> Iterator[str]:
    total = done.train + done.test
    if done.rendered < total:
        kept = f", {total - done.rendered} were there before"
    else:
        kept = ""
    held_out = f" ({done.test} of them held out)" if done.test else ""
    yield (
        f"{out}: {total} images of {size}{held_out}; {done.rendered} rendered in"
        f" {done.seconds:.0f} s{kept}"
    )
    yield (
        f"{done.points:,} points; listed in"
        f" {', '.join(str(file.relative_to(out)) for file in done.files)}"
    )
    if done.rendered < total and done.begun_by != provenance.versions().get(
        "mi-splat", "unknown"
    ):
        yield f"begun by {done.begun_by}, which makes the same images"
    yield f"in Python: mi_splat.load_dataset({str(out)!r})"
