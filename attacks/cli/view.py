"""`mi-splat view`: a splat, a data set or a result on a page in the browser, and the commands that the page runs."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import webbrowser
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from attacks.cli.options import DEFAULT_TARGET
from attacks.detectors import load_detector
from attacks.detectors.catalogue import DetectorError
from attacks.detectors.registry import DETECTORS
from attacks.optimisers import NORM_NAMES
from mi_splat.cli.console import limit_threads, progress, show
from mi_splat.cli.flags import Flag, Positional
from mi_splat.cli.options import Colour, Direction, Size
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Length, Metavar, between
from mi_splat.io.parsing import read_json

if TYPE_CHECKING:
    from mi_splat.viewer.content import Content
    from mi_splat.viewer.runner import JobKind, JobRequest, JobResult

EXAMPLES = (
    "view YOUR.ply",
    "view out/truck",
    "view out/truck-splat/splat.ply --cameras out/truck",
    "view out/dagger --detectors fasterrcnn_small",
    "view out/cloak",
)
OBJECTIVES = ("relabel", "hide", "untargeted")


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Look at a splat, a data set or the result of an attack on a page in the browser.

    Pictures are those of the renderer, spherical harmonics and all. Of a folder that `mi-splat dagger`, `evaluate` or
    `cloak` has written, the clean and the attacked splat are shown from one camera; of one of `mi-splat audit` the
    splat and its heat map, from the cameras that prove hidden content; of one of `mi-splat train` the splat and the
    photographs. On the page a click selects an object, which can be attacked from there, and the splat can be audited.
    The page is served to this machine alone until Ctrl-C; open it by the address that is
    printed.
    """

    path: Positional[Annotated[Path, Metavar("RESULT")]]
    """Splat file of any format that is read, scene XML made of splats, data set (COLMAP or transforms), or folder of
    results."""
    clean: Path | None = None
    """Splat or scene to compare with; of a folder of results it is found. Of an audit, the splat if it was moved."""
    cameras: Annotated[Path, Metavar("SET|FILE")] | None = None
    """Data set, whose photographs are shown beside the splat, or JSON file with cameras to look from."""
    up: Direction | None = None
    """Direction that is up in the files: an axis, or three numbers; foreign splats and sets of COLMAP often have -y.
    None is what the result was made with, z if it says nothing."""
    detector: Annotated[str, Flag(name="detectors"), Metavar("DETECTOR")] | None = None
    """Name of a detector (see `mi-splat detectors`) that looks at the pictures of a resting camera."""
    weights: Path | None = None
    """File with the detector's weights; None takes the shipped ones."""
    size: Size | None = None
    """Pixels of the picture that the detector sees, as 256 or 256x192; None is that of the scene's cameras."""
    background: Colour | None = None
    """Colour behind the Gaussians, as white, #80b0e0 or three sRGB numbers in [0, 1]; None is the scene's own,
    black for a bare splat file."""
    near: Length | None = None
    """Gaussians nearer than this (depth, world units) are left out; None is the scene's own, 0.2 for a bare splat."""
    host: Annotated[str, Metavar("HOST")] = "127.0.0.1"
    """Name or address to serve on; one that other machines can reach needs --allow-remote."""
    port: Annotated[int, between(0, 65535, do="0 takes a free one"), Metavar("PORT")] = 8080
    """Port to serve on; 0 is any free one."""
    allow_remote: bool = False
    """Let other machines in that know the token in the address; nothing is encrypted. An SSH tunnel is better."""
    no_open: bool = False
    """Do not open a browser."""


def run(options: ViewOptions) -> None:
    """Serve the page until Ctrl-C or SIGTERM."""
    from attacks.report.viewer_content import detector_inspector, open_content
    from mi_splat.rendering import Renderer
    from mi_splat.viewer.guard import checked_host, is_loopback
    from mi_splat.viewer.painter import Painter
    from mi_splat.viewer.runner import JobRunner
    from mi_splat.viewer.server import Page, check_port

    limit_threads()
    if options.weights is not None and options.detector is None:
        raise InvalidValueError.of("weights", "a detector that they belong to", "none", "name it with --detectors")
    check_port(checked_host(options.host, allow_remote=options.allow_remote), options.port)
    with progress("loading"):
        content = open_content(
            options.path, clean=options.clean, up=options.up, cameras=options.cameras, background=options.background
        )
        content = content.with_settings(background=options.background, near=options.near, size=options.size)
        inspector = None
        if options.detector is not None:
            inspector = detector_inspector(load_detector(options.detector, weights=options.weights))
        painter = Painter(content, Renderer(content.settings), inspector)
    # There is nothing to work on in a data set without a splat.
    jobs = [audit_job(content), attack_job(options.detector, weights=options.weights)] if content.splats else []
    with Page(JobRunner(painter, jobs), host=options.host, port=options.port) as page:
        show(f"Open {page.address}")
        if not is_loopback(options.host):
            show("Other machines can reach it under the name of this one. Nothing is encrypted, the token included.")
        show("Ctrl-C ends it.")
        sys.stdout.flush()  # a program that reads it through a pipe waits for the address
        # Without a screen, Python would start a browser that takes the terminal.
        has_screen = sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
        if has_screen and not options.no_open:
            threading.Thread(target=webbrowser.open, args=(page.address,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            page.run()
    show("The page is closed.")


def audit_job(content: Content) -> JobKind:
    """An audit of one of the splats, by `mi-splat audit`."""
    from attacks.report.viewer_content import open_content
    from mi_splat.audit.files import HEAT
    from mi_splat.io.folders import RECORD
    from mi_splat.viewer.orbit import up_options
    from mi_splat.viewer.runner import Choice, JobKind, JobResult

    def file(request: JobRequest) -> Path:
        """Of the chosen splat; of the first where that is shown no longer."""
        splats = {splat.name: splat.path for splat in request.content.splats}
        return splats.get(str(request.values["splat"]), request.content.splats[0].path)

    def arguments(request: JobRequest, mask: Path, out: Path) -> list[str]:
        return ["audit", str(file(request)), *up_options(request.content.up), "--out", str(out)]

    def opened(request: JobRequest, out: Path) -> JobResult:
        record, shown = read_json(out / RECORD), None
        if record["verdict"] not in (None, "nothing found") and (out / HEAT).is_file():
            shown = open_content(out, clean=file(request), up=request.content.up)
        return JobResult(lines=tuple(map(str, record["summary"])), content=shown)

    names = tuple(splat.name for splat in content.splats)
    field = Choice(name="splat", label="Splat", options=names, default=names[-1])
    return JobKind(name="Audit", fields=(field,), out=Path("out/audit"), arguments=arguments, opened=opened)


def attack_job(detector: str | None = None, *, weights: Path | None = None) -> JobKind:
    """An attack on the selected object, by `mi-splat dagger`; the named detector, with its weights, is the default."""
    from attacks.report.viewer_content import detector_inspector, open_content
    from mi_splat.viewer.orbit import camera_options
    from mi_splat.viewer.runner import Choice, JobKind, JobResult, Number

    known = {detector: DETECTORS[detector].classes} if detector is not None else {}
    known |= {name: classes for name, classes in available() if name not in known}
    files = {} if detector is None or weights is None else {detector: weights}
    classes = tuple(dict.fromkeys(label for labels in known.values() for label in labels))
    target = DEFAULT_TARGET if DEFAULT_TARGET in classes else classes[0]

    def arguments(request: JobRequest, mask: Path, out: Path) -> list[str]:
        content, values, picked = request.content, request.values, request.picked
        if picked is None:
            raise InvalidValueError.of("Attack", "an object", "none", "click on one in the picture")
        splat, size, name = content.splat(picked.splat), content.size_at(request.orbit), str(values["detector"])
        camera = camera_options(request.orbit, size, settings=content.settings, up=content.up, path=splat.path)
        options = ["--mask", str(mask), "--detectors", name]
        options += ["--weights", str(files[name])] if name in files else []
        options += ["--objective", str(values["objective"])]
        options += ["--target", str(values["target"])] if values["objective"] == "relabel" else []
        options += ["--norm", str(values["norm"]), "--eps", f"{values['eps']:g}", "--steps", f"{values['steps']:.0f}"]
        return ["dagger", str(splat.path), *options, *camera, "--out", str(out)]

    def opened(request: JobRequest, out: Path) -> JobResult:
        assert request.picked is not None
        name, content = str(request.values["detector"]), request.content
        return JobResult(
            lines=tuple(_summary(out)),
            content=open_content(out, clean=content.splat(request.picked.splat).path, up=content.up),
            inspector=detector_inspector(load_detector(name, weights=files.get(name))),
        )

    fields = (
        Choice(name="detector", label="Detector", options=tuple(known), default=next(iter(known))),
        Choice(name="objective", label="Objective", options=OBJECTIVES, default="relabel"),
        Choice(name="target", label="Class (relabel)", options=classes, default=target),
        Choice(name="norm", label="Norm", options=tuple(NORM_NAMES), default="l2"),
        Number(name="eps", label="eps", low=0.1, high=50.0, step=0.1, default=5.0),
        Number(name="steps", label="Steps", low=1, high=500, step=1, default=11),
    )
    return JobKind(name="Attack", fields=fields, out=Path("out/dagger"), arguments=arguments, opened=opened)


def available() -> Iterator[tuple[str, tuple[str, ...]]]:
    """Names and classes of the detectors that can be loaded without any download."""
    for name in DETECTORS:
        with contextlib.suppress(DetectorError):  # of an installed package that is broken
            if not DETECTORS[name].missing():
                yield name, DETECTORS[name].classes


def _summary(result: Path) -> Iterator[str]:
    from attacks.cli.summary import figure_rows, plain
    from attacks.report.results import read_section

    section = read_section(result)
    yield plain(section.conclusion)
    yield from (f"{label}: {text}" for label, text in figure_rows(section))
    yield from (f"Warning: {plain(text)}" for text in section.warnings)
