"""A page for every script of docs/examples, written when the site is built: its
docstring, its image, its code, and what it prints.

Images and prints are in docs/images/examples, and this file, run as a script, makes
them anew. tests/project/test_examples.py runs the examples, too, and compares.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

if TYPE_CHECKING:
    from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parents[1]
WIDEST = 1024
"""Pixels of an image on a page."""

_LINK = re.compile(r"\((\d\d_\w+)\.py\)")


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def scripts() -> list[Path]:
    """The examples in their order."""
    return sorted((DOCS / "examples").glob("*.py"))


def write_pages(app: Sphinx) -> None:
    """Write all pages; one that has not changed stays untouched, so that it is not read
    again.
    """
    for script in scripts():
        path = Path(app.srcdir) / "examples" / f"{script.stem}.md"
        text = page(script)
        if not path.is_file() or path.read_text() != text:
            path.write_text(text)


def page(script: Path) -> str:
    """The page of one example, in Markdown."""
    docstring, code = parts(script)
    title, description = docstring.split("\n", 1)
    number = script.stem[:2].lstrip("0")
    return "\n".join(
        [
            f"# {number}. {title.rstrip('.')}",
            _LINK.sub(r"(\1.md)", description),
            "",
            f"![{title}](../images/examples/{script.stem}.jpg)",
            "",
            "```sh",
            f"python docs/examples/{script.name}",
            "```",
            "",
            "```python",
            code.strip(),
            "```",
            "",
            *printed(script),
        ]
    )


def printed(script: Path) -> Iterator[str]:
    """What an example prints, if anything."""
    path = kept(script, "txt")
    if path.is_file():
        yield from ("It prints:", "", "```text", path.read_text().strip(), "```", "")


def kept(script: Path, ending: str) -> Path:
    """Where the image or the print of an example is kept."""
    return DOCS / "images" / "examples" / f"{script.stem}.{ending}"


def parts(script: Path) -> tuple[str, str]:
    """The docstring of an example, and the code below it."""
    text = script.read_text()
    tree = ast.parse(text)
    docstring = ast.get_docstring(tree)
    end = tree.body[0].end_lineno
    assert docstring is not None, f"{script}: an example begins with a docstring"
    code = "\n".join(text.splitlines()[end:])
    return docstring, code


def page_image(path: Path) -> Image.Image:
    """The image that an example has written, as its page has it."""
    image = Image.open(path).convert("RGB")
    image.thumbnail((WIDEST, WIDEST))
    return image


def main() -> None:
    """Run all examples in the folder of the repository, and keep what they make."""
    for script in scripts():
        done = subprocess.run(
            [sys.executable, script],
            cwd=DOCS.parent,
            check=True,
            stdout=subprocess.PIPE,
            text=True,
        )
        if done.stdout:
            kept(script, "txt").write_text(done.stdout)
        image = page_image(DOCS.parent / "out" / f"{script.stem}.png")
        image.save(kept(script, "jpg"), quality=88)


if __name__ == "__main__":
    main()
