"""Names in other people's files are text in a real browser, whatever they look like.

Needs Chromium (Debian's package `chromium`) and Playwright (of the extra `dev`).
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from attacks.cloak.config import AttackConfig, CameraConfig, StudyConfig
from attacks.report.exhibits import detector_inspector, open_exhibit
from mi_splat.io import save_splat
from mi_splat.viewer import export
from mi_splat.viewer.export import write_export
from mi_splat.viewer.painter import Painter
from tests.browser import CHROMIUM
from tests.fakes import ColourDetector, blobs
from tests.viewer.exhibits import Looker, ball, exhibit, painter, save_study
from tests.viewer.windows import Window, window
from tests.viewer.wire import serving

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium"),
    # In the threads of a browser that is told to go away.
    pytest.mark.filterwarnings("ignore::DeprecationWarning:websockets"),
]
HOSTILE = (
    "<iframe srcdoc='<img src=x onerror=parent.ran=1>'> [l](javascript:globalThis.ran=1) **b** `c` &lt; www.a.example"
)
"""A name that would run scripts, and look otherwise than it is written; it can be the name of a file."""


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
    of_study: (f"Trigger {HOSTILE}: ", 3),
    of_weights: (f"clean: {HOSTILE} ", 1),
    of_file: (f"{HOSTILE}: mean colour", 3),
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
    shown, times = VECTORS[vector]
    with window(chromium, vector(tmp_path), size=(1000, 1400), says=shown) as opened:
        check_names(opened)
        opened.until(lambda: opened.page.inner_text("body").count(HOSTILE) == times)  # a panel is drawn anew
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
    work.exhibit = replace(work.exhibit, describe=lambda camera: (markup,))
    with serving(work) as page:
        opened = Window(chromium, page.address, (1000, 640))
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
