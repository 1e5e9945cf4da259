"""`mi-splat view`: a splat, a data set or a result on a page in the browser, or as a page in a file."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from attacks.detectors import load_detector
from attacks.report.wording import plural
from mi_splat.cli.console import limit_threads, progress, show
from mi_splat.cli.flags import Flag, Positional
from mi_splat.cli.options import Colour, Direction, Size, axis_name
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Called, Length, at_least, between

if TYPE_CHECKING:
    from mi_splat.viewer.exhibit import Exhibit
    from mi_splat.viewer.painter import Painter


EXAMPLES = (
    "view desk.ply",
    "view out/truck",
    "view out/truck-splat/splat.ply --cameras out/truck",
    "view out/dagger --detectors fasterrcnn_small",
    "view out/cloak --export cloak.html",
)
SEE_ALSO = ("render", "report", "dagger")


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Look at a splat, a data set or the result of an attack on a page in the browser, or write such a page to a file.

    Pictures are those of the renderer, spherical harmonics and all. Of a folder that `mi-splat dagger`, `evaluate` or
    `cloak` has written, the clean and the attacked splat are shown from one camera; of one of `mi-splat audit` the
    splat and its heat, from the cameras that prove a look; of one of `mi-splat train` the splat beside the photographs.
    On the page a click picks an object, which can be attacked from there; the splat can be audited, and the attack
    judged from all around. The page is served to this machine alone until Ctrl-C; open it by the address that is
    printed.
    """

    path: Positional[Annotated[Path, Called("RESULT")]]
    """Splat file of any format that is read, scene XML made of splats, data set (COLMAP or transforms), or folder of
    results."""
    clean: Path | None = None
    """Splat or scene to compare with; of a folder of results it is found. Of an audit, the splat if it was moved."""
    cameras: Annotated[Path, Called("SET|FILE")] | None = None
    """Data set, whose photographs are shown beside the splat, or JSON file with cameras to look from."""
    up: Direction | None = None
    """Direction that is up in the files: an axis, or three numbers; foreign splats and sets of COLMAP often have -y.
    None is what the result was made with, z if it says nothing."""
    detector: Annotated[str, Flag(name="detectors"), Called("DETECTOR")] | None = None
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
    host: Annotated[str, Called("HOST")] = "127.0.0.1"
    """Name or address to serve on; one that other machines can reach needs --allow-remote."""
    port: Annotated[int, between(0, 65535, do="0 takes a free one"), Called("PORT")] = 8080
    """Port to serve on; 0 is any free one."""
    allow_remote: bool = False
    """Let other machines in that know the token in the address; nothing is encrypted. An SSH tunnel is better."""
    no_open: bool = False
    """Do not open a browser."""
    export: Path | None = None
    """Write one HTML file with pictures from all around instead, which needs no server and no network."""
    views: Annotated[tuple[int, int], at_least(1, "pictures"), Called("AZIMUTHS ELEVATIONS")] = (24, 4)
    """Azimuths and elevations of the pictures of --export."""
    force: bool = False
    """Replace the file of --export if it is there."""


def run(options: ViewOptions) -> None:
    """Serve the page until Ctrl-C or SIGTERM, or write it."""
    from attacks.report.exhibits import detector_inspector, open_exhibit
    from mi_splat.rendering import Renderer
    from mi_splat.viewer.exhibit import Wishes
    from mi_splat.viewer.export import check_export, export_cameras, write_export
    from mi_splat.viewer.guard import checked_host
    from mi_splat.viewer.page import check_port, need_viser
    from mi_splat.viewer.painter import Painter

    limit_threads()
    if options.weights is not None and options.detector is None:
        raise InvalidValueError.of("weights", "a detector that they belong to", "none", "name it with --detectors")
    if options.export is not None:
        check_export(options.export, options.views, force=options.force)
    else:
        need_viser()
        check_port(checked_host(options.host, allow_remote=options.allow_remote), options.port)
    with progress("loading"):
        wishes = Wishes(background=options.background, near=options.near, size=options.size)
        exhibit = open_exhibit(
            options.path, clean=options.clean, up=options.up, cameras=options.cameras, background=options.background
        )
        exhibit = wishes.applied(exhibit)
        inspector = None
        if options.detector is not None:
            inspector = detector_inspector(load_detector(options.detector, weights=options.weights))
        painter = Painter(exhibit, Renderer(exhibit.settings), inspector)
    if options.export is None:
        _serve(painter, options)
        return
    listed, around = export_cameras(exhibit), 0 if exhibit.photographs else options.views[0] * options.views[1]
    with progress("taking pictures", total=len(listed) + around) as advance:
        write_export(painter, options.export, views=options.views, force=options.force, on_view=advance)
    turned = f" and {options.views[0]} x {options.views[1]} all around" if around else ""
    show(f"{options.export}: pictures from {plural(len(listed), 'camera')}{turned}; open it in any browser.")
    show(_up_in_words(exhibit))


def _up_in_words(exhibit: Exhibit) -> str:
    """Which direction of the files is up on the page, and which the cameras seem to hold for it."""
    from mi_splat.viewer.exhibit import own_up

    seen = own_up(exhibit)
    doubt = "" if seen is None else f"; most cameras have {axis_name(seen)} up: --up {axis_name(seen)} turns the page"
    return f"Up is {axis_name(exhibit.up)}{doubt}."


def _serve(painter: Painter, options: ViewOptions) -> None:
    """Serve the page until it is to stop."""
    from attacks.cli.laboratory import Laboratory
    from mi_splat.viewer.bench import Bench
    from mi_splat.viewer.guard import is_loopback
    from mi_splat.viewer.page import Page, stopping

    stop = threading.Event()
    # There is nothing to work on in a data set alone.
    laboratory = Laboratory(options.detector, weights=options.weights) if painter.exhibit.splats else None
    bench = Bench(painter, laboratory)
    with stopping(stop), Page(bench, host=options.host, port=options.port) as page:
        show(f"Open {page.address}")
        show(_up_in_words(painter.exhibit))
        if not is_loopback(options.host):
            show("Other machines can reach it under the name of this one. Nothing is encrypted, the token included.")
        show("Ctrl-C ends it.")
        sys.stdout.flush()  # whoever reads it through a pipe waits for the address
        if not options.no_open and _has_screen():
            threading.Thread(target=webbrowser.open, args=(page.address,), daemon=True).start()
        page.run(stop)
    show("The page is closed.")


def _has_screen() -> bool:
    """Whether a browser has somewhere to open; without a screen, Python would start one that takes the terminal."""
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
