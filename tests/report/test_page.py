"""The page as a text: everything is in it, nothing is asked for, nothing that a result
says becomes markup.
"""

import json
import re
import shutil
import unicodedata
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attacks import cli
from attacks.figures.rate import Rate
from attacks.figures.tables import Table

pytest.importorskip("jinja2", reason="pages need the extra report")
pytest.importorskip("matplotlib", reason="pages need the extra report")

from attacks.report.page import LONGEST_SIDE, data_address, page_text, svg, values_of
from attacks.report.results import read_section
from attacks.report.section import Chart, Figure, Line, Point, Section
from mi_splat.io.documents import save_png
from mi_splat.io.picture_files import PictureFileError
from tests.report.results import write_cloak, write_dagger, write_evaluation

EVIL = (
    "\"><script>alert(1)</script><img src=http://x.invalid/a onerror='x'>$x_1^2$ {{ 7*7"
    " }} {% raw %}"
)


class Reader(HTMLParser):
    """The elements of a page, and those that are open."""

    VOID = ("meta", "link", "img", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def evil_section(evil: str = EVIL, **values: Any) -> Section:
    """A section whose every text tries to be markup."""
    points = (
        Point.of(0.0, Rate(successes=1, total=9)),
        Point.of(1.0, Rate(successes=4, total=9)),
    )
    lines = (
        Line(name=evil, role="attack", points=points),
        Line(name="none", role="control", points=()),
    )
    marks: dict[str, Any] = {"shade": (0.0, 1.0, evil), "level": (0.5, evil)}
    given: dict[str, Any] = {
        **dict.fromkeys(
            ("kind", "title", "folder", "done", "conclusion", "command"), evil
        ),
        "headline": Figure(label=evil, rate=Rate(successes=3, total=40), note=evil),
        "control": Figure(label=evil, words=evil),
        "warnings": (evil,),
        "charts": (
            Chart.bars(evil, (evil, evil), (evil, "b"), *lines, caption=evil, **marks),
        ),
        "tables": (Table(caption=evil, head=(evil, "b"), rows=((evil, evil),)),),
        **dict.fromkeys(("configuration", "versions"), ((evil, evil),)),
        "file": (evil, evil),
    }
    return Section(**{**given, **values})


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("results")
    one = write_dagger(folder / "a")
    return page_text(
        [read_section(one), read_section(write_cloak(folder / "b")), read_section(one)]
    )


def test_it_is_whole_and_in_order(text: str) -> None:
    page = Reader(text)
    assert page.open == []
    assert page.all("html")[0]["lang"] == "en"
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch("h[1-6]", tag)]
    assert levels.count(1) == 1
    assert levels[0] == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    assert all(attributes.get("alt") for attributes in page.all("img"))
    assert len(page.all("caption")) == len(page.all("table"))
    assert all(
        attributes.get("scope") in ("row", "col") for attributes in page.all("th")
    )
    names = [
        attributes["id"] for _, attributes in page.elements if attributes.get("id")
    ]
    assert len(names) == len(set(names))
    links = [str(attributes["href"])[1:] for attributes in page.all("a")]
    assert links
    assert set(links) <= set(names)


@pytest.mark.parametrize("evil", [False, True])
def test_nothing_is_asked_for_and_there_is_no_script(evil: bool, text: str) -> None:
    page = Reader(
        page_text([evil_section(), evil_section()], title=EVIL) if evil else text
    )
    # shown as it is
    assert not evil or (page.words.count(EVIL) >= 30 and "49" not in page.words)
    policy = next(
        one["content"]
        for one in page.all("meta")
        if one.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy is not None
    assert policy.startswith(
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    )
    assert not {"script", "iframe", "object", "embed", "base", "form"} & {
        tag for tag, _ in page.elements
    }
    for tag, attributes in page.elements:
        assert not [name for name in attributes if name.startswith("on")], tag
        for name in ("src", "href", "xlink:href", "srcset", "action", "poster"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), (tag, value)
    assert not re.search(
        r"url\((?!#)|@import", (text if not evil else "").partition("</style>")[0]
    )


def test_what_a_terminal_would_obey_is_written_out() -> None:
    hostile = "\x1b[31mred\x07\u202edesrever\u2028\x9b"
    text = page_text([evil_section(hostile), evil_section(hostile)], title=hostile)
    assert text.count(r"\x1b[31mred\x07\u202edesrever\u2028\x9b") >= 30
    assert not {
        sign
        for sign in text
        if unicodedata.category(sign) in ("Cc", "Cf", "Cs", "Zl", "Zp")
    } - {"\n", "\t"}


def test_a_chart_keeps_to_the_page_s_colours_and_its_own_names() -> None:
    (chart,) = evil_section().charts
    one = svg(chart, "chart-1")
    other = svg(chart, "chart-2")
    assert one == svg(chart, "chart-1")
    assert "var(--line-0)" in one
    assert "#0101" not in one
    assert "<script" not in one
    assert not set(re.findall(r' id="([^"]*)"', one)) & set(
        re.findall(r' id="([^"]*)"', other)
    )
    assert set(re.findall(r"(?:#|url\(#)(chart-[\w-]+)", one)) <= set(
        re.findall(r' id="([^"]*)"', one)
    )
    assert not re.search(r"\d{4}-\d\d-\d\d|Matplotlib", one)
    table = values_of(chart)
    assert table.head == (EVIL, EVIL)  # a line without points is left out
    assert [row[1].replace("\u00a0", " ") for row in table.rows] == [
        "11.1 % (2 % to 43.5 %)",
        "44.4 % (18.9 % to 73.3 %)",
    ]


@pytest.mark.parametrize(
    ("attack", "control", "value", "words"),
    [
        ((1, 1), (0, 5), "1 of 1", ["Few views: 1"]),
        ((14, 40), None, "35\u00a0%", ["no control"]),
        ((20, 40), (0, 0), "50\u00a0%", ["no control"]),
        ((20, 40), (18, 40), "50\u00a0%", ["overlap"]),
        ((20, 40), (0, 40), "50\u00a0%", []),
        ((0, 40), (0, 40), "0\u00a0%", []),
        ((0, 0), (0, 40), "nothing counted", ["Few views: 0"]),
    ],
)
def test_few_views_are_no_percentage_and_doubts_are_told(
    attack: tuple[int, int],
    control: tuple[int, int] | None,
    value: str,
    words: list[str],
) -> None:
    figure, other = (
        (
            None
            if counts is None
            else Figure(label="", rate=Rate(successes=counts[0], total=counts[1]))
        )
        for counts in (attack, control)
    )
    assert figure is not None
    assert figure.value == value
    doubts = evil_section(headline=figure, control=other).doubts()
    assert len(doubts) == len(words)
    assert all(part in text for part, text in zip(words, doubts, strict=True))


def test_large_pictures_are_made_smaller(tmp_path: Path) -> None:
    save_png(np.zeros((30, 3 * LONGEST_SIDE, 3), np.uint8), tmp_path / "a.png")
    picture = data_address(tmp_path / "a.png")
    assert (picture["width"], picture["height"]) == (LONGEST_SIDE, 10)
    assert picture["address"].startswith("data:image/png;base64,")
    (tmp_path / "b.png").write_text("no image")
    with pytest.raises(PictureFileError, match=r"b\.png: expected an image"):
        data_address(tmp_path / "b.png")


# `mi-splat report`: what it refuses, what it writes and says


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("commands")
    write_evaluation(folder / "judged")
    shutil.copytree(folder / "judged", folder / "more" / "judged")
    (folder / "old.html").write_text("an older page")
    (folder / "empty").mkdir()
    return folder


def test_results_of_one_kind_are_compared(text: str, results: Path) -> None:
    words = Reader(text).words
    assert "Compared: DAGGER, from chosen cameras" in words
    assert "Compared: CLOAK" not in words
    page = Reader(
        page_text(
            [
                read_section(results / "judged"),
                evil_section(),
                read_section(results / "more" / "judged"),
            ]
        )
    )
    assert "attacked.ply against clean.ply (judged)" in page.words


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "results: expected one folder or more"),
        (["judged", "--out", "page.txt"], "ends in .html"),
        (["judged", "--out", "old.html"], "--force"),
        (["judged", "--out", "none/page.html"], "make the folder first"),
        (["nothing", "--out", "page.html"], "check the path"),
        (
            ["judged", "empty", "--out", "page.html"],
            "empty: expected a folder that a command of mi-splat has written",
        ),
        (["judged/result.json", "--out", "page.html"], "pass judged"),
    ],
)
def test_errors_in_one_line(
    words: list[str],
    reason: str,
    results: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(results)
    before = sorted(results.iterdir())
    assert cli.main(["report", *words]) == 1
    error = capsys.readouterr().err
    assert reason in error
    assert len(error.splitlines()) == 1
    assert sorted(results.iterdir()) == before


def test_a_page_is_written_and_replaced_by_force_alone(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(results)
    words = ["report", "judged", "--out", "old.html", "--title", "A & B", "--force"]
    assert cli.main(words) == 0
    captured = capsys.readouterr()
    assert "fake_colour reports person on the attacked splat: " in captured.out
    assert "1 warning on the page" in captured.err
    page = (results / "old.html").read_bytes()
    assert b"<h1>A &amp; B</h1>" in page
    assert cli.main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["out"], len(document["results"])) == ("old.html", 1)
    assert (results / "old.html").read_bytes() == page
