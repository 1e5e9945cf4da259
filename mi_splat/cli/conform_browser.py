"""Images that a web viewer draws in a headless browser, for `mi-splat conform`."""

from __future__ import annotations

import shutil
import subprocess
import threading
import time
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mi_splat.cli.conform_pack import Scenes, write_inputs
from mi_splat.cli.console import warn
from mi_splat.errors import InvalidValueError, one_line
from mi_splat.io.folders import new_folder

_PATIENCE = 600.0
"""Seconds that a viewer may take for all images."""
_BROWSERS = "chromium", "chromium-browser", "google-chrome"
_SWITCHES = (
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
_MOST_BYTES = 64 * 2**20
"""Of one image that the page sends."""


def draw_in_browser(
    adapter: Path, images: Path, scenes: Scenes, *, force: bool = False
) -> None:
    """Fill a folder of images with those that the page of an exported pack sends back
    from a headless browser.

    Files beside the adapter are served, too, so that it can import modules from there;
    a file `importmap.json` there says where bare names such as "three" are.
    """
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None or not adapter.is_file():
        got = "no browser" if browser is None else f"no file {adapter}"
        do = (
            f"install {_BROWSERS[0]}, or open viewer.html of the exported folder in"
            " another browser"
        )
        raise InvalidValueError.of("--browser", "Chromium and an adapter", got, do)
    with TemporaryDirectory() as made, new_folder(images, force=force) as folder:
        pack = Path(made) / "pack"
        write_inputs(scenes, pack, (".ply",))
        _add_import_map(pack / "viewer.html", adapter.with_name("importmap.json"))
        shutil.copyfile(adapter, pack / "adapter.js")
        sent = _Sent(set(scenes), folder)
        _run(browser, Path(made), pack, adapter.resolve().parent, sent)
        for name, text in sent.errors.items():
            warn(f"{adapter.name}, {name}: {one_line(text)}")
    if sent.failure is not None:
        raise InvalidValueError.of(
            str(adapter), "images of every splat", sent.failure, "correct the adapter"
        )


def _add_import_map(page: Path, names: Path) -> None:
    if not names.is_file():
        return
    script = f'<script type="importmap">{names.read_text()}</script>'
    page.write_text(page.read_text().replace("<script", f"{script}\n<script", 1))


class _Sent:
    """What the page has sent."""

    def __init__(self, names: set[str], folder: Path) -> None:
        self.names = names
        self.folder = folder
        self.ended = threading.Event()
        self.errors = dict[str, str]()  # by the scene
        self.failure: str | None = f"no end, or none in {_PATIENCE:.0f} seconds"

    def take(self, path: str, body: bytes) -> None:
        kind, _, name = path.strip("/").partition("/")
        if kind == "end":
            self.failure = body.decode(errors="replace") or None
            self.ended.set()
        elif name in self.names and kind == "error":
            self.errors[name] = body.decode(errors="replace")
        elif name in self.names and kind == "image":
            (self.folder / f"{name}.png").write_bytes(body)


def _run(browser: str, made: Path, pack: Path, beside: Path, sent: _Sent) -> None:
    """Serve the page until it has sent its end."""

    class Handler(SimpleHTTPRequestHandler):
        def do_PUT(self) -> None:
            length = min(int(self.headers["Content-Length"]), _MOST_BYTES)
            sent.take(self.path, self.rfile.read(length))
            self.send_response(204)
            self.end_headers()

        def translate_path(self, path: str) -> str:
            found = super().translate_path(path)
            if Path(found).exists():
                return found
            # modules that lie beside the adapter
            return str(beside / Path(found).relative_to(pack))

        def log_message(self, *_: Any) -> None: ...

    handler = partial(Handler, directory=str(pack))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/viewer.html?send"
        words = [browser, *_SWITCHES, f"--user-data-dir={made}/user", address]
        with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:
            end = time.monotonic() + _PATIENCE
            while not sent.ended.wait(0.5) and time.monotonic() < end:
                if process.poll() is not None:
                    sent.ended.wait(1.0)  # what it sent at last
                    break
            process.terminate()
        server.shutdown()
