"""The page in a real browser: it opens, moves, shows both splats and the right numbers,
and connects to nobody else.

Needs Chromium (Debian's package `chromium`) and Playwright (of the extra `dev`).
"""

import io
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from attacks.cloak.config import AttackConfig, CameraConfig, StudyConfig
from attacks.report.viewer_content import detector_inspector, open_content
from mi_splat.viewer.painter import Painter
from tests.browser import CHROMIUM
from tests.fakes import ColourDetector, blobs
from tests.viewer.contents import START, MeanInspector, painter, save_study
from tests.viewer.wire import PATIENCE, serving

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium"),
    # In the threads of a browser that is told to go away.
    pytest.mark.filterwarnings("ignore::DeprecationWarning:websockets"),
]
UNUSED = "'unsafe-eval' is not an allowed source of script"
"""The complaint of viser's own renderer of splats, which the page does not use."""
HOSTILE = (
    "<iframe srcdoc='<img src=x onerror=parent.ran=1>'>"
    " [l](javascript:globalThis.ran=1) **b** `c` &lt; www.a.example"
)
"""A name that would run scripts, and look otherwise than it is written; it can be the
name of a file.
"""


class Window:
    """A window of the browser, which remembers its errors and its connections."""

    def __init__(self, chromium: Any, address: str, size: tuple[int, int]) -> None:
        self.page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on(
            "console",
            lambda line: (
                self.errors.append(line.text) if line.type == "error" else None
            ),
        )
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", lambda socket: self.requests.append(socket.url))
        self.page.goto(address)

    def colours(
        self, rows: int | None = None, columns: int | None = 650
    ) -> tuple[int, int]:
        """How many pixels are clearly red and how many clearly green, without the
        controls on the right.
        """
        red, green = (self.pixels[:rows, :columns, channel] for channel in (0, 1))
        return int((red > green + 60).sum()), int((green > red + 60).sum())

    @property
    def pixels(self) -> NDArray[np.int32]:
        """A screenshot."""
        with Image.open(io.BytesIO(self.page.screenshot())) as image:
            return np.asarray(image.convert("RGB"), np.int32)

    def until(self, true: Callable[[], bool]) -> None:
        """Wait until something is the case."""
        end = time.monotonic() + PATIENCE
        while not true():
            assert time.monotonic() < end, self.page.inner_text("body")
            self.page.wait_for_timeout(100)

    def says(self, text: str) -> None:
        """Wait until the page says something."""
        self.until(lambda: text in self.page.inner_text("body"))

    def commands(self) -> list[str]:
        """All commands on the page."""
        texts: list[str] = self.page.locator("textarea").evaluate_all(
            "areas => areas.map(area => area.value)"
        )
        return texts


@contextmanager
def window(
    chromium: Any,
    shown: Painter,
    size: tuple[int, int] = (1000, 640),
    *,
    says: str = "above the ground",
) -> Iterator[Window]:
    """A window on a page that says something sooner or later, and connects to nobody
    but the server.
    """
    with serving(shown) as page:
        opened = Window(chromium, page.address, size)
        opened.says(says)
        yield opened
        assert not [error for error in opened.errors if UNUSED not in error]
        hosts = {
            urlsplit(url.removeprefix("blob:")).hostname for url in opened.requests
        }
        assert hosts <= {"127.0.0.1", None}
        opened.page.close()


def test_it_shows_both_splats_and_the_keyboard_moves_the_camera(chromium: Any) -> None:
    with window(chromium, painter(inspector=MeanInspector())) as opened:
        expected = painter(inspector=MeanInspector())
        for name in ("clean", "attacked"):
            opened.says(expected.inspect(name, START).text)
        opened.says(f"{expected.similarity(START):.1f} dB")
        # the last image comes after its words
        opened.until(lambda: min(opened.colours()) > 2000)
        assert set(expected.commands(START).values()) <= set(opened.commands())

        keys = opened.page.keyboard
        named = opened.page.get_by_role("slider", name="Elevation")
        named.wait_for()
        for _ in range(40):  # to the first slider, as with the tab key
            keys.press("Tab")
            if (
                opened.page.evaluate("document.activeElement.getAttribute('role')")
                == "slider"
            ):
                break
        assert named.evaluate("slider => slider == document.activeElement")
        assert float(named.get_attribute("aria-valuenow")) == START.elevation
        for _ in range(5):
            keys.press("ArrowRight")
        there = replace(START, elevation=START.elevation + 5)
        opened.says(expected.inspect("clean", there).text)

        opened.page.get_by_role("combobox", name="Show").focus()
        chosen = (
            "() =>"
            " document.querySelector('[role=option][data-combobox-selected]')"
            "?.textContent"
        )
        for _ in range(8):
            keys.press("ArrowDown")
            opened.page.wait_for_timeout(100)
            if opened.page.evaluate(chosen) == "clean":
                break
        keys.press("Enter")
        opened.until(lambda: opened.colours()[1] < 100)
        assert opened.colours()[0] > 2000


def test_a_narrow_window_has_pictures_and_controls(chromium: Any) -> None:
    with window(
        chromium, painter(inspector=MeanInspector()), size=(320, 640)
    ) as opened:
        opened.until(lambda: min(opened.colours(256, None)) > 200)  # above the controls
        slider = opened.page.get_by_role("slider").first
        slider.scroll_into_view_if_needed()
        box = slider.bounding_box()
        assert box is not None
        assert 0 <= box["x"] <= 320 - box["width"]
        slider.focus()
        opened.page.keyboard.press("ArrowRight")
        opened.says(
            painter(inspector=MeanInspector())
            .inspect("clean", replace(START, elevation=21.0))
            .text
        )
        assert opened.page.evaluate("document.documentElement.scrollWidth") <= 320


def test_names_in_files_are_shown_as_they_are_written(
    chromium: Any, tmp_path: Path
) -> None:
    """Of a splat, a study, its trigger, and a class of a detector."""
    attack = AttackConfig(name=HOSTILE, elevation=(50.0, 90.0))
    cameras = CameraConfig(train=30, size=64, distance=7.0)
    save_study(tmp_path, StudyConfig(name=HOSTILE, cameras=cameras, attack=(attack,)))
    detector = ColourDetector()
    detector.classes = (HOSTILE, "person", "stop sign")
    content = open_content(tmp_path)
    content = replace(content, splats=(replace(content.splats[0], name=HOSTILE),))
    work = Painter(content, blobs, detector_inspector(detector, min_confidence=0.0))
    with window(
        chromium, work, size=(1000, 1400), says=f"{HOSTILE}: {HOSTILE} "
    ) as opened:
        page = opened.page
        opened.says(f"Trigger {HOSTILE}: ")
        page.get_by_role("combobox", name="From").click()
        opened.says(f"inside {HOSTILE}")
        page.wait_for_timeout(300)  # an image is not found
        assert page.evaluate("globalThis.ran") is None
        for selector in ("iframe", "img[src=x]", "a", "body code"):
            assert page.locator(selector).count() == 0, selector


def test_no_script_runs_even_if_markup_came_through(
    chromium: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    markup = (
        "<img src=x onerror=globalThis.ran=1><iframe"
        " srcdoc='<script>parent.ran=1</script>'></iframe><a"
        " href='javascript:globalThis.ran=1'>a link</a>"
    )
    monkeypatch.setattr("mi_splat.viewer.panel.html.escape", lambda text: text)
    work = painter(1)
    work.content = replace(work.content, describe=lambda camera: (markup,))
    with serving(work) as page:
        opened = Window(chromium, page.address, (1000, 640))
        opened.page.get_by_text("a link").click()
        refused = {"inline event handler", "inline script", "JavaScript URL"}
        opened.until(
            lambda: all(
                f"{what} violates" in "".join(opened.errors) for what in refused
            )
        )
        assert opened.page.evaluate("globalThis.ran") is None
        opened.page.close()


def test_another_port_gets_no_cookie(chromium: Any) -> None:
    cookies: list[str | None] = []

    class Listener(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            cookies.append(self.headers["Cookie"])
            self.send_error(404)

        def log_message(self, *words: object) -> None:
            pass

    with (
        HTTPServer(("127.0.0.1", 0), Listener) as other,
        chromium.new_context() as context,
    ):
        thread = threading.Thread(target=other.serve_forever)
        thread.start()
        try:
            with serving(painter(1)) as page:
                tab = context.new_page()
                tab.goto(page.address)
                tab.get_by_text("above the ground").wait_for()
                tab.goto(f"http://127.0.0.1:{other.server_port}/")
                tab.evaluate("fetch('/page')")
        finally:
            other.shutdown()
            thread.join()
    assert len(cookies) >= 2
    assert set(cookies) == {None}


def test_the_page_opens_from_a_link_of_another_site(chromium: Any) -> None:
    with serving(painter(1)) as page, chromium.new_context() as context:
        tab = context.new_page()
        tab.route(
            "http://mail.example/",
            lambda route: route.fulfill(
                body=f'<a href="{page.address}">the page</a>', content_type="text/html"
            ),
        )
        tab.goto("http://mail.example/")
        tab.get_by_text("the page").click()
        tab.get_by_text("above the ground").wait_for()
