"""What site.css has to know for a telephone: which words of code may be broken, and
which pictures have to scroll.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from docutils.nodes import document
    from sphinx.application import Sphinx

UNBROKEN = 28
"""Signs of a word of code that is never broken."""
WIDE = 2.6
"""Width of a picture by its height from which it would be too small to see on a
telephone.
"""


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("doctree-read", mark)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def mark(app: Sphinx, doctree: document) -> None:
    """Give long words of code the class `long`, and what holds a drawing or a wide
    picture the class `scrolls`.
    """
    import imagesize
    from docutils.nodes import image, literal, paragraph

    for code in doctree.findall(literal):
        if max(map(len, code.astext().split()), default=0) > UNBROKEN:
            code["classes"].append("long")
    for picture in doctree.findall(image):
        width, height = imagesize.get(Path(app.srcdir) / picture["uri"])
        wide = picture["uri"].endswith(".svg") or width > WIDE * height
        if (
            wide
            and isinstance(picture.parent, paragraph)
            and len(picture.parent.children) == 1
        ):
            picture.parent["classes"].append("scrolls")
