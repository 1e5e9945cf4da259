"""The picture of docs/structure.md, which a forge draws by Mermaid, as an SVG that
needs no script.

Only what `tests/project/layers.py` writes is understood: boxes
`L0["<b>title</b><br/>modules"]` and arrows `L0 --> L1`.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

if TYPE_CHECKING:
    from sphinx.application import Sphinx

WIDTH = 430
HEIGHT = 44
GAP = 14
REACH = 200
"""Of a box, between two boxes, and of the widest arc, in pixels."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_directive("mermaid", Diagram)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


class Diagram(SphinxDirective):
    """A fenced block in Mermaid's language."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """The SVG."""
        text = "\n".join(self.content)
        boxes = re.findall(r'(L\d+)\["<b>(.*?)</b><br/>(.*?)"\]', text)
        arrows = re.findall(r"(L\d+) --> (L\d+)", text)
        return [nodes.raw("", "\n".join(svg(boxes, arrows)), format="html")]


def svg(
    boxes: list[tuple[str, str, str]], arrows: list[tuple[str, str]]
) -> Iterator[str]:
    """Layers from the bottom up, and an arc from each to those that import from it.

    Args:
        boxes: Name, title and modules of each layer, from the bottom up.
        arrows: Pairs of names, from what is imported to what imports it.
    """
    step = HEIGHT + GAP
    row = {name: len(boxes) - 1 - index for index, (name, _, _) in enumerate(boxes)}
    total = len(boxes) * step
    yield (
        f'<svg viewBox="0 0 {WIDTH + REACH} {total}" role="img" aria-label="Layers of'
        ' the code" style="max-width: 42rem; width: 100%; color:'
        ' var(--pst-color-text-base)">'
    )
    for name, title, modules in boxes:
        y = row[name] * step
        shown = ", ".join(modules.split("<br/>"))
        shown = shown if len(shown) < 70 else shown[:67] + "..."
        box = f'x="1" y="{y + 1}" width="{WIDTH - 2}" height="{HEIGHT}" rx="5"'
        yield f'<rect {box} fill="none" stroke="currentColor"/><g fill="currentColor">'
        yield (
            f'<text x="10" y="{y + 18}" font-size="14"'
            f' font-weight="bold">{html.escape(title)}</text>'
        )
        yield (
            f'<text x="10" y="{y + 35}"'
            f' font-size="10.5">{html.escape(shown)}</text></g>'
        )
    for low, high in arrows:
        start = row[low] * step + HEIGHT * 0.3
        end = row[high] * step + HEIGHT * 0.75
        bulge = WIDTH + min(REACH, 18 * (row[low] - row[high]) + 16)
        yield (
            f'<path d="M {WIDTH} {start:.0f} C {bulge} {start:.0f} {bulge} {end:.0f}'
            f' {WIDTH} {end:.0f}" fill="none" stroke="currentColor"'
            f' opacity="0.55"/><path d="M {WIDTH} {end:.0f} l 7 -3.5 v 7 z"'
            ' fill="currentColor"/>'
        )
    yield "</svg>"
