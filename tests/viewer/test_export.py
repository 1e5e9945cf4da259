"""The page in one file: whole, alone, and true to what was seen."""

import base64
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from mi_splat.errors import InvalidValueError
from mi_splat.viewer import export
from mi_splat.viewer.export import check_export, export_orbits, write_export
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.policy import script_hash
from tests.viewer.exhibits import START, Looker, exhibit, painter


def views_of(page: str, of: str = "views") -> list[dict[str, Any]]:
    match = re.search(rf'<script id="{of}" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert match is not None
    views: list[dict[str, Any]] = json.loads(match[1])
    return views


class Elements(HTMLParser):
    """Every element with its attributes."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "SHORTER_SIDE", 60)


@pytest.fixture
def page(tmp_path: Path) -> str:
    path = tmp_path / "page.html"
    write_export(painter(looker=Looker()), path, views=(3, 2))
    return path.read_text("utf-8")


def test_every_view_has_its_pictures_and_findings(page: str) -> None:
    work = painter(looker=Looker())
    views, orbits = views_of(page), [orbit for row in export_orbits(START, (3, 2)) for orbit in row]
    assert [(view["azimuth"], view["elevation"]) for view in views] == [(o.azimuth, o.elevation) for o in orbits]
    for view, orbit in zip(views, orbits, strict=True):
        assert [splat["findings"] for splat in view["splats"]] == [
            work.inspect(name, orbit).text for name in ("clean", "attacked")
        ]
        assert [splat["command"] for splat in view["splats"]] == list(work.commands(orbit).values())
        assert view["facts"] == [*work.exhibit.describe(orbit.camera((48, 32))), work.comparison(orbit)]
    content = base64.b64decode(views[0]["splats"][0]["picture"].removeprefix("data:image/jpeg;base64,"))
    with Image.open(io.BytesIO(content)) as picture:
        assert picture.size == (2 * 48, 2 * 32)
    assert len({splat["picture"] for view in views for splat in view["splats"]}) == 12


def test_the_listed_cameras_come_first(page: str) -> None:
    work, listed = painter(looker=Looker()), views_of(page, "cameras")
    assert [view["name"] for view in listed] == list(work.exhibit.cameras) == ["front", "above"]
    assert [[s["findings"] for s in v["splats"]] for v in listed] == [
        [work.inspect(name, orbit).text for name in ("clean", "attacked")] for orbit in work.exhibit.cameras.values()
    ]
    assert f'src="{listed[0]["splats"][0]["picture"]}"' in page  # before any script has run


def test_it_asks_nothing_of_any_network(page: str) -> None:
    elements = Elements(page).elements
    links = [
        value for _, attributes in elements for key, value in attributes.items() if key in ("src", "href", "action")
    ]
    assert links
    assert all(value is not None and value.startswith("data:") for value in links)
    assert not re.search(r"https?:|//[a-z]|url\(|@import|fetch\(|XMLHttp|WebSocket", re.sub(r"data:[^\"]*", "", page))
    assert "default-src 'none'" in page


def test_no_script_runs_but_its_own(page: str) -> None:
    (policy,) = (
        str(attributes["content"]) for tag, attributes in Elements(page).elements if attributes.get("http-equiv")
    )
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert f"script-src {script_hash(script)};" in policy
    assert policy.replace("style-src 'unsafe-inline'", "").count("unsafe") == 0


def test_sliders_have_names_and_a_keyboard(page: str) -> None:
    elements = Elements(page).elements
    sliders = {
        str(attributes["id"]) for tag, attributes in elements if tag == "input" and attributes["type"] == "range"
    }
    labels = {str(attributes["for"]) for tag, attributes in elements if tag == "label"}
    assert sliders | {"camera"} == labels == {"azimuth", "elevation", "camera"}
    assert any(attributes.get("aria-live") == "polite" for _, attributes in elements)


def test_names_from_outside_cannot_become_markup(page: str) -> None:
    assert "balls &lt;of&gt; colour" in page
    assert "<of>" not in page


def test_text_cannot_end_the_script(tmp_path: Path) -> None:
    from dataclasses import replace

    hostile = replace(exhibit(1), describe=lambda camera: ("</script><b>",))
    write_export(Painter(hostile, painter().render), tmp_path / "page.html", views=(1, 1))
    page = (tmp_path / "page.html").read_text()
    assert "<b>" not in page
    assert views_of(page)[0]["facts"] == ["</script><b>"]


def test_one_row_is_at_the_camera_s_own_elevation() -> None:
    (row,) = export_orbits(START, (4, 1))
    assert {orbit.elevation for orbit in row} == {START.elevation}
    assert [orbit.azimuth for orbit in row] == [30.0, 120.0, 210.0, 300.0]
    assert [row[0].elevation for row in export_orbits(START, (4, 3))] == [15.0, 45.0, 75.0]


def test_a_file_that_is_there_stays(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    path.write_text("mine")
    with pytest.raises(InvalidValueError, match=r"page\.html: expected a free name.*replace it with force"):
        write_export(painter(1), path, views=(1, 1))
    assert path.read_text() == "mine"
    write_export(painter(1), path, views=(1, 1), force=True)
    assert "<html" in path.read_text()


@pytest.mark.parametrize("views", [(0, 1), (1, 0), (-1, -1), (1000, 1000)])
def test_numbers_of_views(views: tuple[int, int], tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="views: expected azimuths x elevations"):
        check_export(tmp_path / "page.html", views, force=False)


def test_a_folder_is_no_page(tmp_path: Path) -> None:
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(InvalidValueError, match="choose another name"):
        check_export(tmp_path / "folder.html", (1, 1), force=True)
    with pytest.raises(InvalidValueError, match="make the folder first"):
        check_export(tmp_path / "none" / "page.html", (1, 1), force=False)


def test_nothing_is_left_where_a_picture_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object) -> str:
        raise RuntimeError("no encoder")

    monkeypatch.setattr(export, "_data_uri", fail)
    with pytest.raises(RuntimeError, match="no encoder"):
        write_export(painter(1), tmp_path / "page.html", views=(2, 1))
    assert not list(tmp_path.iterdir())
