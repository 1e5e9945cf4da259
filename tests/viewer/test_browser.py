"""The page in a real browser: it opens, moves, shows both splats and the right numbers, and asks nobody else.

Needs Chromium (Debian's package `chromium`) and Playwright (of the extra `dev`).
"""

from __future__ import annotations

import io
import re
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

from attacks.cloak.study.attack_config import AttackConfig
from attacks.cloak.study.config import CameraConfig, StudyConfig
from attacks.viewing.detections import detector_inspector
from attacks.viewing.results import open_exhibit
from mi_splat.io import save_splat
from mi_splat.viewer import export
from mi_splat.viewer.export import write_export
from mi_splat.viewer.guard import COOKIE
from mi_splat.viewer.page import Page
from mi_splat.viewer.painter import Painter
from tests.browser import CHROMIUM
from tests.fakes import ColourDetector, blobs
from tests.viewer.exhibits import START, Looker, ball, exhibit, painter, save_study

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium"),
    # In the threads of a browser that is told to go away.
    pytest.mark.filterwarnings("ignore::DeprecationWarning:websockets"),
]
PATIENCE = 30.0
UNUSED = "'unsafe-eval' is not an allowed source of script"
"""What viser's own renderer of splats complains of, which the page does not use."""
HOSTILE = (
    "<iframe srcdoc='<img src=x onerror=parent.ran=1>'> [l](javascript:globalThis.ran=1) **b** `c` &lt; www.a.example"
)
"""A name that would run scripts, and look otherwise than it is written; it can be the name of a file."""


class Window:
    """A window of the browser, which remembers what went wrong in it and whom it asked."""

    def __init__(self, chromium: Any, address: str, size: tuple[int, int]) -> None:
        self.page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
        self.errors: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda line: self.errors.append(line.text) if line.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("websocket", lambda socket: self.asked.append(socket.url))
        self.page.goto(address)

    def shot(self, width: int | None = None) -> NDArray[np.int32]:
        """What is to be seen, without the controls on the right if a width is given."""
        with Image.open(io.BytesIO(self.page.screenshot())) as image:
            return np.asarray(image.convert("RGB"), np.int32)[:, :width]

    def until(self, true: Callable[[], bool]) -> None:
        """Wait until something is the case."""
        end = time.monotonic() + PATIENCE
        while not true():
            assert time.monotonic() < end, self.page.inner_text("body")
            self.page.wait_for_timeout(100)

    def says(self, text: str) -> None:
        """Wait until the page says something."""
        self.until(lambda: text in self.page.inner_text("body"))

    def check(self) -> None:
        """Nothing went wrong, and nobody but the server was asked."""
        assert not [error for error in self.errors if UNUSED not in error]
        others = [url for url in self.asked if urlsplit(url.removeprefix("blob:")).hostname not in ("127.0.0.1", None)]
        assert not others


@contextmanager
def serving(work: Painter) -> Iterator[str]:
    """The address of a page whose pictures another thread makes."""
    stop = threading.Event()
    with Page(work, port=0) as page:
        thread = threading.Thread(target=page.run, args=(stop,))
        thread.start()
        try:
            yield page.address
        finally:
            stop.set()
            thread.join()


@contextmanager
def window(
    chromium: Any, work: Painter, size: tuple[int, int] = (1000, 640), *, says: str = "above the ground"
) -> Iterator[Window]:
    """A window on a page that says something sooner or later."""
    with serving(work) as address:
        opened = Window(chromium, address, size)
        opened.says(says)
        yield opened
        opened.check()
        opened.page.close()


def colours(pixels: NDArray[np.int32]) -> tuple[int, int]:
    """How many pixels are clearly red, and how many clearly green."""
    red, green = pixels[..., 0], pixels[..., 1]
    return int((red > green + 60).sum()), int((green > red + 60).sum())


def test_it_shows_both_splats_and_what_the_api_says_of_them(chromium: Any) -> None:
    work = painter(looker=Looker())
    with window(chromium, work) as opened:
        expected = painter(looker=Looker())
        for name in ("clean", "attacked"):
            opened.says(expected.inspect(name, START).text)
        opened.says(f"{expected.likeness(START):.1f} dB")
        red, green = colours(opened.shot(650))
        assert red > 2000
        assert green > 2000
        commands = opened.page.locator("textarea").evaluate_all("areas => areas.map(area => area.value)")
        assert set(expected.commands(START).values()) <= set(commands)


def test_the_keyboard_alone_moves_the_camera_and_chooses_what_is_shown(chromium: Any) -> None:
    with window(chromium, painter(looker=Looker())) as opened:
        keys = opened.page.keyboard
        for _ in range(40):  # to the first slider, as with the tab key
            keys.press("Tab")
            if opened.page.evaluate("document.activeElement.getAttribute('role')") == "slider":
                break
        assert float(opened.page.evaluate("document.activeElement.getAttribute('aria-valuenow')")) == START.elevation
        for _ in range(5):
            keys.press("ArrowRight")
        there = replace(START, elevation=START.elevation + 5)
        opened.says(painter(looker=Looker()).inspect("clean", there).text)
        opened.says(f"{there.camera((8, 8)).position[2]:.1f} above the ground")

        show = opened.page.get_by_role("combobox", name="Show")
        show.focus()
        chosen = "() => document.querySelector('[role=option][data-combobox-selected]')?.textContent"
        for _ in range(8):
            keys.press("ArrowDown")
            opened.page.wait_for_timeout(100)
            if opened.page.evaluate(chosen) == "clean":
                break
        keys.press("Enter")
        opened.until(lambda: colours(opened.shot(650))[1] < 100)
        assert colours(opened.shot(650))[0] > 2000


def test_the_mouse_moves_the_camera_and_the_picture_follows(chromium: Any) -> None:
    with window(chromium, painter(1)) as opened:
        before, text = opened.shot(650), opened.page.locator("textarea").first.input_value()
        opened.page.wait_for_timeout(1200)
        mouse = opened.page.mouse
        mouse.move(300, 300)
        mouse.down()
        mouse.move(420, 240, steps=6)
        mouse.up()
        opened.until(lambda: opened.page.locator("textarea").first.input_value() != text)
        command = opened.page.locator("textarea").first.input_value()
        assert re.search(r"--azimuth [\d.]+ --elevation -?[\d.]+", command)
        opened.until(lambda: bool(np.abs(opened.shot(650) - before).mean() > 0.5))


def test_a_narrow_window_has_pictures_and_controls(chromium: Any) -> None:
    with window(chromium, painter(looker=Looker()), size=(320, 640)) as opened:
        opened.page.wait_for_timeout(500)
        red, green = colours(opened.shot()[:256])  # above the controls
        assert red > 200
        assert green > 200
        slider = opened.page.get_by_role("slider").first
        slider.scroll_into_view_if_needed()
        box = slider.bounding_box()
        assert box is not None
        assert 0 <= box["x"] <= 320 - box["width"]
        slider.focus()
        opened.page.keyboard.press("ArrowRight")
        opened.says(painter(looker=Looker()).inspect("clean", replace(START, elevation=21.0)).text)
        assert opened.page.evaluate("document.documentElement.scrollWidth") <= 320


@pytest.mark.parametrize("size", [(1000, 700), (320, 640)])
def test_the_page_in_a_file(
    chromium: Any, size: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "SHORTER_SIDE", 60)
    work = painter(looker=Looker())
    write_export(work, tmp_path / "page.html", views=(6, 2))
    opened = Window(chromium, (tmp_path / "page.html").as_uri(), size)
    page, first = opened.page, opened.shot()
    red, green = colours(first)
    assert min(red, green) > 1000
    assert page.get_by_label("Azimuth").input_value() == "0"
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "azimuth"
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Tab")
    page.keyboard.press("ArrowRight")
    there = replace(START, azimuth=START.azimuth + 60, elevation=67.5)
    for name in ("clean", "attacked"):
        opened.says(work.inspect(name, there).text)
    assert page.get_by_label("Azimuth").get_attribute("aria-valuetext") == "90°"
    assert not np.array_equal(opened.shot(), first)
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    assert not opened.errors
    assert all(url.startswith(("file:", "data:")) for url in opened.asked)
    page.close()


def of_study(folder: Path) -> Painter:
    """A study with an attack of this name."""
    attack = AttackConfig(name=HOSTILE, elevation=(50.0, 90.0))
    cameras = CameraConfig(train=30, size=64, distance=7.0)
    save_study(folder, StudyConfig(name=HOSTILE, cameras=cameras, attack=(attack,)))
    return Painter(open_exhibit(folder), blobs)


def of_weights(folder: Path) -> Painter:
    """A detector with a class of this name."""
    detector = ColourDetector()
    detector.classes = (HOSTILE, "person", "stop sign")
    return Painter(exhibit(1), blobs, detector_inspector(detector, min_confidence=0.0))


def of_file(folder: Path) -> Painter:
    """A splat in a file of this name."""
    path = folder / f"{HOSTILE}.ply"
    save_splat(ball((0.9, 0.1, 0.1)), path)
    return Painter(open_exhibit(path), blobs, Looker())


VECTORS: dict[Callable[[Path], Painter], tuple[str, int]] = {
    of_study: (f"Trigger {HOSTILE}: ", 2),
    of_weights: (f"clean: {HOSTILE} ", 1),
    of_file: (f"{HOSTILE}: mean colour", 2),
}
"""What a page says of each, and how often the name is in its text."""


def check_names(opened: Window) -> None:
    """No name has become markup or a script."""
    page = opened.page
    page.wait_for_timeout(300)  # an image is not found
    assert page.evaluate("globalThis.ran") is None
    for selector in ("iframe", "img[src=x]", "a", "body code"):
        assert page.locator(selector).count() == 0, selector


@pytest.mark.parametrize("vector", VECTORS)
def test_names_from_outside_are_shown_as_they_are_written(
    chromium: Any, vector: Callable[[Path], Painter], tmp_path: Path
) -> None:
    said, times = VECTORS[vector]
    with window(chromium, vector(tmp_path), size=(1000, 1400), says=said) as opened:
        check_names(opened)
        assert opened.page.inner_text("body").count(HOSTILE) == times
        if vector is of_study:
            opened.page.get_by_role("combobox", name="From").click()
            opened.says(f"inside {HOSTILE}")
            check_names(opened)


def test_where_markup_came_through_still_no_script_runs(chromium: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    markup = (
        "<img src=x onerror=globalThis.ran=1><iframe srcdoc='<script>parent.ran=1</script>'></iframe>"
        "<a href='javascript:globalThis.ran=1'>a link</a>"
    )
    monkeypatch.setattr("mi_splat.viewer.panel.html.escape", lambda text: text)
    work = painter(1)
    work.exhibit = replace(work.exhibit, place=lambda camera: (markup,))
    with serving(work) as address:
        opened = Window(chromium, address, (1000, 640))
        opened.page.get_by_text("a link").click()
        refused = {"inline event handler", "inline script", "JavaScript URL"}
        opened.until(lambda: all(f"{what} violates" in "".join(opened.errors) for what in refused))
        assert opened.page.evaluate("globalThis.ran") is None
        opened.page.close()


@pytest.mark.parametrize("vector", VECTORS)
def test_names_from_outside_in_a_page_in_a_file(
    chromium: Any, vector: Callable[[Path], Painter], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "SHORTER_SIDE", 60)
    path = tmp_path / "page.html"
    write_export(vector(tmp_path), path, views=(1, 1))
    opened = Window(chromium, path.as_uri(), (1000, 700))
    opened.says(HOSTILE)
    check_names(opened)
    assert opened.page.title() == opened.page.locator("h1").inner_text()
    assert not opened.errors
    opened.page.close()


def test_two_pages_in_one_browser(chromium: Any) -> None:
    context = chromium.new_context(viewport={"width": 400, "height": 300})
    with context, serving(painter(1)) as first, serving(painter(2)) as second:
        tabs = [context.new_page() for _ in range(2)]
        for tab, address in zip(tabs, (first, second), strict=True):
            tab.bring_to_front()
            tab.goto(address)
            tab.get_by_text("above the ground").wait_for()
            assert address.partition("token=")[2] not in tab.url
            assert "token" not in tab.url
        for tab in tabs:  # each by its own cookie, after the other has set one
            tab.bring_to_front()
            tab.reload()
            tab.get_by_text("above the ground").wait_for()
        tabs[0].bring_to_front()
        tabs[0].goto(second)
        tabs[0].get_by_text("PSNR").wait_for()
        assert tabs[0].evaluate("history.length") == 3  # nothing, and each page once, without its token
        cookies = {cookie["name"]: cookie for cookie in context.cookies()}
        assert set(cookies) == {f"{COOKIE}-{urlsplit(address).port}" for address in (first, second)}


def test_another_port_gets_no_cookie(chromium: Any) -> None:
    heard: list[str | None] = []

    class Listener(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            heard.append(self.headers["Cookie"])
            self.send_error(404)

        def log_message(self, *words: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Listener) as other, chromium.new_context() as context:
        thread = threading.Thread(target=other.serve_forever)
        thread.start()
        try:
            with serving(painter(1)) as address:
                tab = context.new_page()
                tab.goto(address)
                tab.get_by_text("above the ground").wait_for()
                tab.goto(f"http://127.0.0.1:{other.server_port}/")
                tab.evaluate("fetch('/page')")
        finally:
            other.shutdown()
            thread.join()
    assert len(heard) >= 2
    assert set(heard) == {None}


def test_the_page_opens_from_a_link_of_another_site(chromium: Any) -> None:
    with serving(painter(1)) as address, chromium.new_context() as context:
        tab = context.new_page()
        tab.route(
            "http://mail.example/",
            lambda route: route.fulfill(body=f'<a href="{address}">the page</a>', content_type="text/html"),
        )
        tab.goto("http://mail.example/")
        tab.get_by_text("the page").click()
        tab.get_by_text("above the ground").wait_for()
