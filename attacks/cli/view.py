"""`mi-splat view`: a splat, a data set or a result on a page in the browser, and the
object that is selected there.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from attacks.detectors import load_detector
from mi_splat.cli.console import limit_threads, progress, show, warn
from mi_splat.cli.flags import Flag, Positional
from mi_splat.cli.options import Colour, Direction, Size, up_line
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Length, Metavar, between

EXAMPLES = (
    "view YOUR.ply",
    "view out/truck",
    "view out/truck-splat/splat.ply --cameras out/truck",
    "view out/dagger --detectors fasterrcnn_small",
    "view out/cloak",
)


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """View a splat, a data set or the result of an attack in the browser.

    Images come from the renderer, with view-dependent colours. For a result folder of
    `mi-splat dagger`, `evaluate` or `cloak`, the clean and the attacked splat are shown
    from the same camera; for `mi-splat audit` the splat and its heat map, from the
    cameras that prove hidden content; for `mi-splat train` the splat and the
    photographs. On the page a click selects an object, whose mask `mi-splat dagger`
    takes. The page is served to this machine alone until Ctrl-C; open it by the address
    that is printed. From another machine use an SSH tunnel.
    """

    path: Positional[Annotated[Path, Metavar("RESULT")]]
    """Splat file of any format that is read, scene XML made of splats, data set (COLMAP
    or transforms), or folder of results.
    """
    clean: Path | None = None
    """Splat or scene to compare with; found automatically in result folders. For an
    audit: the splat, if it was moved.
    """
    cameras: Annotated[Path, Metavar("SET|FILE")] | None = None
    """Data set whose photographs are shown beside the splat, or a JSON file with
    viewpoints.
    """
    up: Direction | None = None
    """Up direction in the files: an axis, or X,Y,Z; third-party splats and COLMAP sets
    often have -y. Default: that of the result, else taken from the file's comment, its
    cameras or its ground, else z.
    """
    detector: Annotated[str, Flag(name="detectors"), Metavar("DETECTOR")] | None = None
    """Name of a detector (see `mi-splat detectors`) to run whenever the camera rests.
    """
    weights: Path | None = None
    """File with the detector's weights. Default: the shipped ones."""
    size: Size | None = None
    """Image size for the detector in pixels, as 256 or 256x192. Default: that of the
    scene's cameras.
    """
    background: Colour | None = None
    """Background colour, as white, #80b0e0 or 0.5,0.7,0.9. Default: the scene's own;
    black for a splat file.
    """
    near: Length | None = None
    """Near plane: Gaussians nearer than this depth in world units are not drawn.
    Default: the scene's own; 0.2 for a splat file.
    """
    port: Annotated[
        int, between(0, 65535, do="0 takes a free one"), Metavar("PORT")
    ] = 8080
    """Port to serve on; 0 is any free one."""
    no_open: bool = False
    """Do not open a browser."""


def run(options: ViewOptions) -> None:
    """Serve the page until Ctrl-C or SIGTERM."""
    from attacks.report.viewer_content import detector_inspector, open_content
    from mi_splat.render.renderer import Renderer
    from mi_splat.viewer.painter import Painter
    from mi_splat.viewer.server import Page, check_port

    limit_threads()
    if options.weights is not None and options.detector is None:
        raise InvalidValueError.of(
            "weights",
            "a detector that they belong to",
            "none",
            "name it with --detectors",
        )
    check_port(options.port)
    with progress("loading"):
        content = open_content(
            options.path,
            clean=options.clean,
            up=options.up,
            cameras=options.cameras,
            background=options.background,
        )
        if (
            options.up is None
            and content.file_up is not None
            and content.up == content.file_up.direction
        ):
            warn(up_line(content.file_up))
        content = content.with_settings(
            background=options.background, near=options.near, size=options.size
        )
        inspector = None
        if options.detector is not None:
            inspector = detector_inspector(
                load_detector(options.detector, weights=options.weights)
            )
        painter = Painter(content, Renderer(content.settings), inspector)
    with Page(painter, port=options.port) as page:
        show(f"Open {page.address}")
        show("Ctrl-C ends it.")
        # a program that reads it through a pipe waits for the address
        sys.stdout.flush()
        # Without a screen, Python would start a browser that takes the terminal.
        has_screen = sys.platform != "linux" or bool(
            {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ)
        )
        if has_screen and not options.no_open:
            threading.Thread(
                target=webbrowser.open, args=(page.address,), daemon=True
            ).start()
        with contextlib.suppress(KeyboardInterrupt):
            page.run()
    show("The page is closed.")
