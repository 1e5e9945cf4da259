"""The figures of the documentation have one style, and are legible at the width of a
page.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from PIL import Image

from tests.project.layers import ROOT

FIGURES = ROOT / "docs" / "figures"
STYLE = (FIGURES / "page.mplstyle").read_text()
WIDTH = 7.2
"""Inches of a page."""
LEAST = 8.0
"""Points of a text at that width."""
SCRIPTS = [path for path in FIGURES.glob("*.py") if "matplotlib" in path.read_text()]


def test_no_text_is_small() -> None:
    sizes = re.findall(r"^(?!lines)[\w.]*size: ([\d.]+)$", STYLE, re.MULTILINE)
    assert len(sizes) == 6
    assert min(map(float, sizes)) >= LEAST


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_takes_sizes_from_the_style(script: Path) -> None:
    code = script.read_text()
    assert '"page.mplstyle"' in code
    assert not re.findall(r"(?:fontsize|labelsize|dpi)=\d", code)
    widths = re.findall(r"figsize=\(([\d.]+)", code)
    assert widths
    assert max(map(float, widths)) <= WIDTH


@pytest.mark.parametrize(
    "name",
    [
        "cloak_path",
        "conventions_axes",
        "conventions_sh",
        "dagger_curve",
        "detectors_recall",
    ],
)
def test_an_image_is_no_wider_than_its_page(name: str) -> None:
    dots = float(re.findall(r"^savefig.dpi: (\d+)$", STYLE, re.MULTILINE)[0])
    with Image.open(ROOT / "docs" / "images" / f"{name}.png") as image:
        assert image.width <= WIDTH * dots
