"""The page in a real browser: read in light, in dark and at the width of a telephone;
nobody is asked for anything.

Needs Chromium (Debian's package `chromium`) and Playwright (of the extra `dev`).
"""

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("jinja2", reason="pages need the extra report")
pytest.importorskip("matplotlib", reason="pages need the extra report")

from attacks.report.page import write_page
from attacks.report.results import read_section
from tests.browser import CHROMIUM
from tests.report.results import write_cloak, write_dagger, write_evaluation

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium"),
]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    made = [
        write_cloak(folder / "cloak"),
        write_dagger(folder / "dagger"),
        write_evaluation(folder / "judged"),
    ]
    write_page([read_section(one) for one in made], folder / "page.html")
    return folder / "page.html"


@pytest.mark.parametrize(
    ("scheme", "width"),
    [("light", 1100), ("dark", 1100), ("light", 360)],
    ids=lambda value: str(value),
)
def test_it_is_read_in_light_and_dark_and_on_a_telephone(
    chromium: Any, page: Path, scheme: str, width: int
) -> None:
    window = chromium.new_page(
        viewport={"width": width, "height": 740}, color_scheme=scheme
    )
    errors: list[str] = []
    asked: list[str] = []
    window.on("console", lambda line: errors.append(line.text))
    window.on("pageerror", lambda error: errors.append(str(error)))
    window.on("request", lambda request: asked.append(request.url))
    window.goto(page.as_uri())

    headline = window.locator("article").first.locator(".card.attack")
    assert headline.locator(".value").inner_text().replace("\u00a0", " ") == "100 %"
    assert "277 of 277; 95 % interval 87.1 to 100 %" in headline.inner_text().replace(
        "\u00a0", " "
    )
    assert "0.3 %" in window.locator("article").first.locator(
        ".card.control"
    ).inner_text().replace("\u00a0", " ")
    assert window.get_by_role("complementary", name="Warnings").first.is_visible()
    assert window.get_by_role(
        "table", name="Each result, its figure, and its control"
    ).is_visible()

    light = brightness(window, "body", "backgroundColor")
    dark = brightness(window, "body", "color")
    assert light > dark + 400 if scheme == "light" else dark > light + 400
    line = window.locator(".chart svg path[style*='--line-0']").first
    # a variable that is not there would leave it black or none
    assert sum(colour(line, "stroke")) != 0
    ink = window.locator(".chart svg text").first
    assert abs(sum(colour(ink, "fill")) - brightness(window, "body", "color")) < 60

    assert window.evaluate("document.documentElement.scrollWidth") <= width
    for picture in window.locator("img").all():
        assert picture.evaluate("one => one.complete && one.naturalWidth > 0")
    window.locator("summary", has_text="Every setting").first.click()
    assert window.get_by_text("evaluation.well_inside").first.is_visible()
    window.get_by_role("link", name="thing to person").click()
    assert window.url.endswith("#result-2")
    assert window.evaluate("document.documentElement.scrollWidth") <= width
    assert not errors
    assert {url.partition("#")[0] for url in asked if not url.startswith("data:")} == {
        page.as_uri()
    }
    window.close()


def colour(element: Any, name: str) -> list[int]:
    """Red, green and blue of a colour of an element, 0 to 255."""
    text = element.evaluate(f"one => getComputedStyle(one).{name}")
    return [
        int(float(part)) for part in text.partition("(")[2].rstrip(")").split(",")[:3]
    ]


def brightness(window: Any, selector: str, name: str) -> int:
    """Sum of the three channels."""
    return sum(colour(window.locator(selector).first, name))
