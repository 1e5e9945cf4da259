"""What a forge shows and the site has to show otherwise: links out of docs/, and files
elsewhere that are pages here.

Pages link to other files of the repository by path, as a forge wants it. Some of these
files are pages of the site, too: there a page of docs/reference is only a stub, and the
site puts the file in its place. What a command is for stands behind it on a forge,
where lines may be long, and above it on the site. A list of modules is their reference.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

SHOWN_IN = {
    "mi_splat/render/tile/README.md": "docs/reference/rasterization.md",
    "mi_splat/render/ray/README.md": "docs/reference/raytracing.md",
    "scenes/README.md": "docs/reference/scenes.md",
    "attacks/detectors/fasterrcnn_small.md": "docs/reference/fasterrcnn_small.md",
    "scenes/detectors/README.md": "docs/reference/yolov8n_small.md",
}
"""File of the repository to the page of the site that shows it."""
INSTEAD = {**SHOWN_IN, "README.md": "docs/start.md", "docs/README.md": "docs/index.md"}
"""File of the repository to the page that a link to it leads to."""

WIDE = 70
"""Signs of a line that is wrapped in a narrow window: then an empty line keeps commands
apart.
"""

_EXAMPLE = re.compile(r"^(docs/examples/\w+)\.py$")
"""A script that is a page of the site."""

_LINK = re.compile(r"(\]\()([^)#\s]+)(#[^)\s]*)?(\))")
_COMMANDS = re.compile(
    r"^```sh\n.*?^```$|^```text\n(?:(?:mi-splat|pip|python|PYTHONPATH)\b[^\n]*\n)+```$",
    re.MULTILINE | re.DOTALL,
)
_MODULES = re.compile(r"^```modules\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_COMMENT = re.compile(r"^(\S.*?)\s{2,}(# .*)$", re.MULTILINE)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", rewrite)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def rewrite(app: Sphinx, docname: str, source: list[str]) -> None:
    """Put the file that a page shows in its place, and let links lead to pages of the
    site where there are some.
    """
    page = f"docs/{docname}.md"
    shown = next((file for file, stub in SHOWN_IN.items() if stub == page), None)
    if shown is not None:
        file = Path(app.srcdir).parent / shown
        app.env.note_dependency(str(file))
        source[0] = file.read_text()
    source[0] = with_modules(
        with_comments_above(relinked(source[0], shown or page, page))
    )


def relinked(text: str, file: str, page: str) -> str:
    """Markdown of a file as the site's page has it.

    Args:
        text: Markdown.
        file: Where it stands in the repository; its links are relative to that.
        page: The page that shows it, as a path in the repository.
    """

    def replaced(match: re.Match[str]) -> str:
        opening, target, anchor, closing = match.groups()
        if "://" in target or target.startswith("mailto:"):
            return match.group()
        path = posixpath.normpath(posixpath.join(posixpath.dirname(file), target))
        path = INSTEAD.get(path, _EXAMPLE.sub(r"\1.md", path))
        relative = posixpath.relpath(path, posixpath.dirname(page))
        if path.startswith("docs/tables/"):
            relative = f"path:{relative}"  # a download: the site has no page of it
        return f"{opening}{relative}{anchor or ''}{closing}"

    return _LINK.sub(replaced, text)


def with_comments_above(text: str) -> str:
    """Markdown in which the comment of a command in a shell block stands in the line
    above it, apart from others.
    """

    def apart(block: re.Match[str]) -> str:
        opening, *commands, closing = block[0].splitlines()
        between = "\n\n" if max(map(len, commands)) > WIDE else "\n"
        return "\n".join(
            [
                opening,
                between.join(
                    _COMMENT.sub(r"\2\n\1", line) for line in commands if line
                ),
                closing,
            ]
        )

    return _COMMANDS.sub(apart, text)


def with_modules(text: str) -> str:
    """Markdown in which a list of modules has a section for each, with what its
    docstrings say.
    """
    section = "## {0}\n\n```{{eval-rst}}\n.. automodule:: {0}\n```"
    return _MODULES.sub(
        lambda block: "\n\n".join(section.format(name) for name in block[1].split()),
        text,
    )
