"""`mi-splat view`: a splat or a result on a page in the browser, or as a page in a file."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser

from attacks.cli.options import ViewOptions
from attacks.detectors import load_detector
from attacks.report.exhibits import detector_inspector, open_exhibit
from mi_splat.cli.console import limit_threads, progress, show
from mi_splat.errors import InvalidValueError, message
from mi_splat.rendering import Renderer
from mi_splat.viewer.exhibit import Exhibit, Wishes
from mi_splat.viewer.export import check_export, write_export
from mi_splat.viewer.guard import checked_host, is_loopback
from mi_splat.viewer.page import Page, check_port, need_viser, stopping
from mi_splat.viewer.painter import Painter


def run(options: ViewOptions) -> int:
    """Serve the page until Ctrl-C or SIGTERM, or write it."""
    limit_threads((os.cpu_count() or 1) // 2)
    if options.weights is not None and options.detector is None:
        raise InvalidValueError(
            message("weights", "a detector that they belong to", "none", "name it with --detectors")
        )
    if options.export is not None:
        check_export(options.export, options.views, force=options.force)
    else:
        need_viser()
        check_port(checked_host(options.host, allow_remote=options.allow_remote), options.port)
    with progress("loading"):
        painter = _painter(options)
    if options.export is None:
        return _serve(painter, options)
    with progress("taking pictures", total=options.views[0] * options.views[1]) as advance:
        write_export(painter, options.export, views=options.views, force=options.force, on_view=advance)
    show(f"{options.export}: {options.views[0]} x {options.views[1]} pictures; open it in any browser.")
    return 0


def _painter(options: ViewOptions) -> Painter:
    """What makes the pictures that the options ask for."""
    wishes = Wishes(background=options.background, near=options.near, size=options.size)
    exhibit: Exhibit = wishes.applied(open_exhibit(options.path, clean=options.clean))
    inspector = None
    if options.detector is not None:
        inspector = detector_inspector(load_detector(options.detector, weights=options.weights))
    return Painter(exhibit, Renderer(exhibit.settings), inspector)


def _serve(painter: Painter, options: ViewOptions) -> int:
    """Serve the page until it is to stop."""
    stop = threading.Event()
    with stopping(stop), Page(painter, host=options.host, port=options.port) as page:
        show(f"Open {page.address}")
        if not is_loopback(options.host):
            show("Other machines can reach it under the name of this one. Nothing is encrypted, the token included.")
        show("Ctrl-C ends it.")
        sys.stdout.flush()  # whoever reads it through a pipe waits for the address
        if not options.no_open and _has_screen():
            threading.Thread(target=webbrowser.open, args=(page.address,), daemon=True).start()
        page.run(stop)
    show("The page is closed.")
    return 0


def _has_screen() -> bool:
    """Whether a browser has somewhere to open; without a screen, Python would start one that takes the terminal."""
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
