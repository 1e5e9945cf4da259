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
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from mi_splat.viewer import export
from mi_splat.viewer.export import write_export
from mi_splat.viewer.page import Page
from mi_splat.viewer.painter import Painter
from tests.browser import CHROMIUM
from tests.viewer.exhibits import START, Looker, painter

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium"),
    # In the threads of a browser that is told to go away.
    pytest.mark.filterwarnings("ignore::DeprecationWarning:websockets"),
]
PATIENCE = 30.0


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
        assert not self.errors
        others = [url for url in self.asked if urlsplit(url.removeprefix("blob:")).hostname not in ("127.0.0.1", None)]
        assert not others


@contextmanager
def window(chromium: Any, work: Painter, size: tuple[int, int] = (1000, 640)) -> Iterator[Window]:
    """A window on a page, whose pictures another thread makes."""
    stop = threading.Event()
    with Page(work, port=0) as page:
        thread = threading.Thread(target=page.run, args=(stop,))
        thread.start()
        try:
            opened = Window(chromium, page.address, size)
            opened.says("above the ground")
            yield opened
            opened.check()
            opened.page.close()
        finally:
            stop.set()
            thread.join()


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
