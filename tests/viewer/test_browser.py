"""The page in a real browser: it opens, moves, shows both splats and the right numbers, and asks nobody else.

Needs Chromium (Debian's package `chromium`) and Playwright (of the extra `dev`).
"""

import re
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from numpy.typing import NDArray

from mi_splat.viewer import export
from mi_splat.viewer.export import write_export
from mi_splat.viewer.guard import COOKIE
from tests.browser import CHROMIUM
from tests.viewer.exhibits import ABOVE, START, Looker, painter
from tests.viewer.windows import Window, window
from tests.viewer.wire import serving
from tests.viewer.works import bench

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium"),
    # In the threads of a browser that is told to go away.
    pytest.mark.filterwarnings("ignore::DeprecationWarning:websockets"),
]


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
        opened.until(lambda: min(colours(opened.shot(650))) > 2000)  # the last picture comes after its words
        commands = opened.page.locator("textarea").evaluate_all("areas => areas.map(area => area.value)")
        assert set(expected.commands(START).values()) <= set(commands)


def test_the_keyboard_alone_moves_the_camera_and_chooses_what_is_shown(chromium: Any) -> None:
    with window(chromium, painter(looker=Looker())) as opened:
        keys, named = opened.page.keyboard, opened.page.get_by_role("slider", name="Elevation")
        named.wait_for()
        for _ in range(40):  # to the first slider, as with the tab key
            keys.press("Tab")
            if opened.page.evaluate("document.activeElement.getAttribute('role')") == "slider":
                break
        assert named.evaluate("slider => slider == document.activeElement")
        assert float(named.get_attribute("aria-valuenow")) == START.elevation
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


def test_an_object_is_picked_and_worked_on(chromium: Any, tmp_path: Path) -> None:
    with window(chromium, bench()) as opened:
        page = opened.page
        page.get_by_role("tab", name="Tools").press("Enter")
        page.mouse.click(340, 320)
        opened.says("Gaussians of clean")
        with page.expect_download() as download:
            page.get_by_role("button", name="Save mask.npy").press("Enter")
        download.value.save_as(tmp_path / "mask.npy")
        mask = np.load(tmp_path / "mask.npy")
        assert f"{mask.sum()} of {len(mask)} Gaussians of clean" in page.inner_text("body")
        page.get_by_text("Work", exact=True).first.click()
        page.get_by_label("eps").last.fill("7")  # numbers have names
        opened.until(
            lambda: any("--eps=7" in text for text in page.locator("textarea").evaluate_all("a => a.map(x => x.value)"))
        )
        page.get_by_role("button", name="Work", exact=True).press("Enter")
        opened.says(f"done to {mask.sum()}")
        opened.until(lambda: min(colours(opened.shot(650))) > 2000)  # both splats, in their own colours
        page.get_by_role("button", name="from above").press("Enter")
        page.get_by_role("tab", name="Look").press("Enter")
        opened.says(f"{ABOVE.camera((8, 8)).position[2]:.1f} above the ground")


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
    assert page.get_by_label("Camera").input_value() == "0"
    opened.says(work.inspect("attacked", START).text)
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "azimuth"
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Tab")
    page.keyboard.press("ArrowRight")
    there = replace(START, azimuth=START.azimuth + 60, elevation=67.5)
    for name in ("clean", "attacked"):
        opened.says(work.inspect(name, there).text)
    assert page.get_by_label("Camera").input_value() == ""
    assert page.get_by_label("Azimuth").get_attribute("aria-valuetext") == "90°"
    assert not np.array_equal(opened.shot(), first)
    page.get_by_label("Camera").select_option("0")
    assert page.get_by_label("Azimuth").input_value() == "0"  # where that camera is
    assert page.get_by_label("Azimuth").get_attribute("aria-valuetext") == f"{START.azimuth:g}°"
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    assert not opened.errors
    assert all(url.startswith(("file:", "data:")) for url in opened.asked)
    page.close()


def test_two_pages_in_one_browser(chromium: Any) -> None:
    context = chromium.new_context(viewport={"width": 400, "height": 300})
    with context, serving(painter(1)) as one, serving(painter(2)) as other:
        first, second = one.address, other.address
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
        names = {cookie["name"] for cookie in context.cookies()}
        assert names == {f"{COOKIE}-{urlsplit(address).port}" for address in (first, second)}


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
            with serving(painter(1)) as page:
                tab = context.new_page()
                tab.goto(page.address)
                tab.get_by_text("above the ground").wait_for()
                tab.goto(f"http://127.0.0.1:{other.server_port}/")
                tab.evaluate("fetch('/page')")
        finally:
            other.shutdown()
            thread.join()
    assert len(heard) >= 2
    assert set(heard) == {None}


def test_the_page_opens_from_a_link_of_another_site(chromium: Any) -> None:
    with serving(painter(1)) as page, chromium.new_context() as context:
        tab = context.new_page()
        tab.route(
            "http://mail.example/",
            lambda route: route.fulfill(body=f'<a href="{page.address}">the page</a>', content_type="text/html"),
        )
        tab.goto("http://mail.example/")
        tab.get_by_text("the page").click()
        tab.get_by_text("above the ground").wait_for()
