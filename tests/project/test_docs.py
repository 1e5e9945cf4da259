"""The documentation is true: the site is built without a warning, its pages ask no
other host, its commands run.
"""

import ast
import importlib
import importlib.util
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from attacks.cli import COMMANDS, command_of, parse
from attacks.cli.doctor import REGISTRIES
from tests.browser import CHROMIUM
from tests.project.documented_commands import (
    BENCHMARKS,
    ROOT,
    Line,
    blocks,
    lines,
    pages,
)
from tests.project.test_extras import PROJECT
from tests.warm import Warm

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LINES = list(lines())
MOST_PAGES = 60
OURS = [line for line in LINES if line.program == "mi-splat"]


def run(*words: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *words], cwd=cwd, capture_output=True, text=True
    )


@pytest.mark.parametrize("line", LINES, ids=str)
def test_every_command_is_run_by_something(line: Line) -> None:
    assert line.when, f"say in documented_commands.py how `{line.kind}` is run"
    assert line.kind != "python" or line.words[1] in BENCHMARKS


@pytest.mark.parametrize(
    "line", [line for line in OURS if line.kind != "--help"], ids=str
)
def test_every_command_is_understood(line: Line) -> None:
    parse(*command_of(line.words[1:]))


@pytest.mark.parametrize(
    "line", [line for line in LINES if line.program == "make"], ids=str
)
def test_every_make_target_exists(line: Line) -> None:
    makefile = (ROOT / "Makefile").read_text()
    targets = [word for word in line.words[1:] if "=" not in word]
    assert targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target
    for name in (word.split("=")[0] for word in line.words[1:] if "=" in word):
        assert re.search(rf"^{name} \?=", makefile, flags=re.MULTILINE), name


def test_every_extra_exists() -> None:
    named = re.findall(
        r"(?:mi-splat|\.)\[([\w,]+)\]", "".join(path.read_text() for path in pages())
    )
    assert {extra for group in named for extra in group.split(",")} <= set(
        PROJECT["optional-dependencies"]
    )


def test_every_page_is_in_the_list() -> None:
    """README.md of docs/ is what a forge shows; it names every page but those that a
    program writes.
    """
    listed = (ROOT / "docs" / "README.md").read_text()
    for path in pages()[1:]:
        name = path.relative_to(ROOT / "docs").as_posix()
        assert (
            name in ("README.md", "index.md")
            or name.startswith(("reference/", "tables/"))
            or f"]({name})" in listed
        )


def modules(package: str) -> dict[str, bool]:
    """The modules of a package, and whether each holds more than a docstring; a package
    has the name of its folder.
    """
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(
            ".__init__"
        ): (len(ast.parse(path.read_text()).body) > 1)
        for path in sorted((ROOT / package).rglob("*.py"))
    }


def test_the_reference_names_the_modules_that_there_are() -> None:
    """All of `attacks` but its commands, which have pages of their own, and what of
    `mi_splat` is not an inside.
    """
    text = "".join(
        path.read_text() for path in (ROOT / "docs" / "reference").glob("*.md")
    )
    named = [
        *re.findall(r"automodule:: (\S+)", text),
        *" ".join(blocks("modules", text)).split(),
    ]
    assert len(named) == len(set(named))
    full = {**modules("mi_splat"), **modules("attacks")}
    assert not set(named) - set(full)
    insides = (
        r"attacks\.(cli\b.*|__main__)"
        r"|mi_splat\.(_lazy|assets|\w+\..*)"
    )
    unnamed = [
        name
        for name, holds in full.items()
        if holds and not re.fullmatch(insides, name)
    ]
    assert not set(unnamed) - set(named)


@pytest.mark.nightly
def test_the_short_commands_run(tmp_path: Path, warm: Warm) -> None:
    """On small inputs: `make commands` runs these alone."""
    pytest.importorskip(
        "ultralytics",
        reason="the documentation compares two detectors; one needs the extra yolo",
    )
    done = warm.run(
        "-m", "tests.project.run_documented", "fast", str(tmp_path), cwd=ROOT
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.nightly
def test_the_long_commands_run(tmp_path: Path) -> None:
    done = run("-m", "tests.project.run_documented", "nightly", str(tmp_path))
    assert done.returncode == 0, done.stderr


def test_the_detector_of_the_how_to_works(warm: Warm) -> None:
    (example,) = blocks(
        "python", (ROOT / "docs" / "how-to" / "write-your-own-detector.md").read_text()
    )
    done = warm.run("-c", example, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "stop sign" in done.stdout


def test_the_plug_ins_of_the_page_keep_their_contracts(warm: Warm) -> None:
    """Each section has the plug-in and its test, which is run here as it stands."""
    text = (ROOT / "docs" / "plug-ins.md").read_text()
    examples = list(blocks("python", text))
    assert len(
        re.findall(r"^check_\w+\(", "\n".join(examples), flags=re.MULTILINE)
    ) == text.count("\nTest it: ")
    done = warm.run("-c", "\n".join(examples), cwd=ROOT)
    assert done.returncode == 0, done.stderr
    (entry,) = blocks("toml", text)
    assert set(tomllib.loads(entry)["project"]["entry-points"]) <= set(REGISTRIES)
    assert set(re.findall(r"`(mi_splat\.\w+)` \| ", text)) == set(REGISTRIES)


@pytest.mark.parametrize("path", pages(), ids=lambda path: path.name)
def test_python_examples_import_what_there_is(path: Path) -> None:
    for example in blocks("python", path.read_text()):
        for node in ast.walk(ast.parse(example)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[
                0
            ] in ("mi_splat", "attacks"):
                module = importlib.import_module(node.module or "")
                assert not [
                    alias.name
                    for alias in node.names
                    if not hasattr(module, alias.name)
                ]


@pytest.mark.slow
def test_the_figures_can_be_drawn_again(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="figures need the extra report")
    done = run("docs/figures/conventions.py", str(tmp_path))
    assert done.returncode == 0, done.stderr
    drawn = {path.name for path in tmp_path.iterdir()}
    shown = set(
        re.findall(
            r"images/(conventions_\w+\.png)",
            (ROOT / "docs" / "conventions.md").read_text(),
        )
    )
    assert drawn == shown
    assert all((ROOT / "docs" / "images" / name).is_file() for name in drawn)


class Requests(HTMLParser):
    """What a browser asks for when it shows a page."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("script", "link", "img", "iframe", "source", "video"):
            self.addresses += [
                value
                for name, value in attrs
                if name in ("src", "href", "srcset") and value
            ]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for module in ("sphinx", "myst_nb", "sphinx_book_theme"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"no {module}: the site needs the extra docs")
    folder = tmp_path_factory.mktemp("site")
    done = run(
        "-m",
        "sphinx",
        "-b",
        "html",
        "-W",
        "--keep-going",
        "-q",
        "-d",
        str(folder / "trees"),
        "docs",
        str(folder),
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_the_site_has_few_pages() -> None:
    """Beside the reference; a result table is a download."""
    docs = ROOT / "docs"
    written = (docs / "examples").glob("*.py")
    names = [path.relative_to(docs).as_posix() for path in pages()[1:]]
    read = [name for name in names if not name.startswith(("reference/", "tables/"))]
    assert len(read) + len(list(written)) <= MOST_PAGES


@pytest.mark.nightly
def test_the_site_has_a_page_for_everything(site: Path) -> None:
    for name in COMMANDS:
        text = (
            site / "reference" / "commands" / f"{name.replace(' --', '-')}.html"
        ).read_text()
        assert f"<h1>mi-splat {name}" in text
    import attacks
    import mi_splat

    for package in (mi_splat, attacks):
        text = (site / "reference" / f"{package.__name__}.html").read_text()
        missing = [
            name
            for name in package.__all__
            if f'id="{package.__name__}.{name}"' not in text
        ]
        assert not missing
    assert "lane" in (site / "reference" / "rasterization.html").read_text()
    assert "<svg" in (site / "structure.html").read_text()


@pytest.mark.nightly
def test_the_notebooks_show_what_they_gave(site: Path) -> None:
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.md")):
        text = (site / "notebooks" / f"{path.stem}.html").read_text()
        assert text.count('src="../_images/') >= 2, path.name
        (file,) = (site / "_downloads").rglob(f"{path.stem}.ipynb")
        cells = [
            cell
            for cell in json.loads(file.read_text())["cells"]
            if cell["cell_type"] == "code"
        ]
        assert len(cells) == path.read_text().count("```{code-cell}")
        assert all(cell["execution_count"] for cell in cells)


@pytest.mark.nightly
def test_the_site_asks_no_other_host(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 50
    for path in pages:
        requests = Requests()
        requests.feed(path.read_text())
        assert requests.addresses
        foreign = [
            address for address in requests.addresses if re.match(r"(\w+:)?//", address)
        ]
        assert not foreign, path.relative_to(site)
    for path in (*site.rglob("*.css"), site / "_static" / "site.js"):
        assert not re.search(
            r"(@import|url\()\s*['\"]?(https?:)?//", path.read_text()
        ), path.relative_to(site)


@pytest.mark.nightly
@pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium")
@pytest.mark.parametrize(
    ("scheme", "width"), [("light", 1280), ("dark", 1280), ("light", 390)]
)
def test_the_first_page_works_without_a_network(
    chromium: Any, site: Path, scheme: str, width: int
) -> None:
    """All images are there, and nothing is wider than a telephone."""
    window = chromium.new_page(
        viewport={"width": width, "height": 900}, color_scheme=scheme
    )
    asked: list[str] = []
    window.on("request", lambda request: asked.append(request.url))
    window.goto((site / "index.html").as_uri())
    gallery = (ROOT / "docs" / "index.md").read_text().partition("gallery")[2]
    assert window.locator(".gallery img").count() == gallery.count("[![") >= 8
    assert window.evaluate("document.documentElement.scrollWidth") <= width
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
    window.close()


LOOK = """() => {
  const brightness = (element, name) =>
    getComputedStyle(element)[name].match(/[\\d.]+/g).slice(0, 3)
      .reduce((sum, value) => sum + Number(value), 0);
  const closed = "nav.bd-docs-nav > div > ul > li > details:not([open])";
  const failed = image => image.complete && !image.naturalWidth;
  return {
    width: document.documentElement.scrollWidth,
    broken: [...document.images].filter(failed).map(image => image.src),
    paper: brightness(document.body, "backgroundColor"),
    ink: brightness(document.querySelector("article h1"), "color"),
    folded: document.querySelectorAll(closed).length,
  };
}"""
"""What is asked of a page in a browser: its width, its images, its colours, and parts
of the site that are folded.
"""


@pytest.mark.nightly
@pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium")
@pytest.mark.parametrize(("scheme", "width"), [("light", 1280), ("dark", 390)])
def test_every_page_is_read_in_a_browser(
    chromium: Any, site: Path, scheme: str, width: int
) -> None:
    """Nothing makes a page wider than its window, dark is dark, every image is there,
    nobody else is asked.
    """
    window = chromium.new_page(
        viewport={"width": width, "height": 900}, color_scheme=scheme
    )
    asked: list[str] = []
    window.on("request", lambda request: asked.append(request.url))
    wrong = []
    for path in sorted(site.rglob("*.html")):
        name = path.relative_to(site).as_posix()
        if name.startswith("_static") or name in (
            "search.html",
            "genindex.html",
            "py-modindex.html",
        ):
            continue
        window.goto(path.as_uri())
        seen = window.evaluate(LOOK)
        if scheme == "light":
            contrast = seen["paper"] - seen["ink"]
        else:
            contrast = seen["ink"] - seen["paper"]
        if (
            seen["width"] > width
            or seen["broken"]
            or contrast < 400
            or seen["folded"] < 4
        ):
            wrong.append((name, seen))
    window.close()
    assert wrong == []
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []


@pytest.mark.nightly
@pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium")
def test_the_search_works_without_a_network(chromium: Any, site: Path) -> None:
    window = chromium.new_page()
    window.goto((site / "search.html").as_uri() + "?q=poison")
    # results come one by one
    window.locator("#search-results li a[href*='poison-splat']").first.wait_for()
    window.close()
