"""The examples of docs/examples: short, of public names, and what they make is what
their pages show.
"""

from __future__ import annotations

import ast
import re
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import attacks
import mi_splat
from tests.project.layers import ROOT

FOLDER = ROOT / "docs" / "examples"
IMAGES = ROOT / "docs" / "images" / "examples"
SCRIPTS = sorted(FOLDER.glob("*.py"))
CHAINS = (("01",), ("02",), ("03",), ("04", "05"), ("06", "07"), ("08",))
"""Examples that are run one after the other, because one reads what another writes."""
MOST_LINES = 59
FRACTION = re.compile(r"\d+\.\d+")
CLOSE = 2.5
"""Mean difference of two small images, of 255. Another processor may move a box by a
pixel; an attack that fails moves more.
"""


@pytest.fixture(scope="module")
def pages() -> dict[str, Any]:
    """What docs/sphinx_extensions/example_pages.py defines."""
    path = ROOT / "docs" / "sphinx_extensions" / "example_pages.py"
    return runpy.run_path(str(path))


@pytest.fixture(scope="module")
def listed() -> set[str]:
    """The modules of the reference."""
    lines = [
        path.read_text().splitlines()
        for path in (ROOT / "docs" / "reference").glob("modules-*.md")
    ]
    return {line for of_page in lines for line in of_page}


def small(image: Image.Image) -> NDArray[np.float64]:
    return np.asarray(image.convert("RGB").resize((96, 48)), dtype=np.float64)


def assert_printed(made: str, path: Path) -> None:
    """That a text is the one of a file, but for the last digits of its fractions."""
    shown = path.read_text() if path.is_file() else ""
    assert FRACTION.sub("#", made) == FRACTION.sub("#", shown)
    for one, other in zip(FRACTION.findall(made), FRACTION.findall(shown), strict=True):
        assert float(one) == pytest.approx(float(other), rel=0.05, abs=0.02)


def imports(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """The modules of this project that a script imports, and the names from each."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                yield str(node.module), alias.name
        elif isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, ""


def test_there_are_eight_and_the_first_page_shows_them_in_order() -> None:
    numbers = [path.stem[:2] for path in SCRIPTS]
    assert numbers == [f"{number:02}" for number in range(1, 9)]
    names = [path.stem for path in SCRIPTS]
    page = (ROOT / "docs" / "index.md").read_text()
    for pattern in (
        r"\(images/examples/(\w+)\.jpg\)",
        r"^python docs/examples/(\w+)\.py$",
        r"^examples/(\w+)$",
    ):
        assert re.findall(pattern, page, re.MULTILINE) == names


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_an_example_is_short_and_uses_public_names(
    script: Path, listed: set[str]
) -> None:
    text = script.read_text()
    assert len(text.splitlines()) <= MOST_LINES
    for module, name in imports(ast.parse(text)):
        if module in ("attacks", "mi_splat"):
            assert name in sys.modules[module].__all__
        elif module.startswith((attacks.__name__, mi_splat.__name__)):
            assert module in listed, f"{module} is not in the reference"
            assert not name.startswith("_")


def test_every_example_is_run() -> None:
    numbers = [number for chain in CHAINS for number in chain]
    assert numbers == [script.stem[:2] for script in SCRIPTS]


@pytest.mark.shipped
@pytest.mark.parametrize("chain", CHAINS, ids="-".join)
def test_an_example_makes_the_image_of_its_page(
    chain: tuple[str, ...],
    pages: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    monkeypatch.chdir(tmp_path)
    for script in SCRIPTS:
        if script.stem.startswith(chain):
            runpy.run_path(str(script), run_name="__main__")
            assert_printed(capsys.readouterr().out, IMAGES / f"{script.stem}.txt")
            made = pages["page_image"](tmp_path / "out" / f"{script.stem}.png")
            shown = Image.open(IMAGES / f"{script.stem}.jpg")
            assert made.size == shown.size
            assert np.abs(small(made) - small(shown)).mean() < CLOSE


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_page_has_docstring_image_and_code(
    script: Path, pages: dict[str, Any]
) -> None:
    page = pages["page"](script)
    assert page.startswith(f"# {int(script.stem[:2])}. ")
    assert f"images/examples/{script.stem}.jpg" in page
    assert ".py)" not in page
    code = page.partition("```python\n")[2].partition("```")[0]
    assert code.strip() in script.read_text()
    assert '"""' not in code.partition("import")[0]
