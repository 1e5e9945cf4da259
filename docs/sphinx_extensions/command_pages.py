"""A page for every command of `mi-splat`, written from the help of the command itself
when the site is built.

The pages are reference/commands/NAME.rst and are not kept in the repository, so they
cannot be out of date.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

FOLDER = Path("reference") / "commands"
_OPTION = re.compile(r"(?<![\w-])--[a-z](?:[\w.-]*\w)?(?![\w`])")


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_pages(app: Sphinx) -> None:
    """Write all pages; a page that has not changed stays untouched, so that it is not
    read again.
    """
    from attacks.cli import COMMANDS

    folder = Path(app.srcdir) / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.rst"):
        if old.stem not in map(file_name, COMMANDS):
            old.unlink()
    for name, summary in COMMANDS.items():
        path = folder / f"{file_name(name)}.rst"
        text = "\n".join(page(name, summary)) + "\n"
        if not path.is_file() or path.read_text() != text:
            path.write_text(text)


def file_name(command: str) -> str:
    """Name of a command's page."""
    return command.replace(" --", "-")


def page(name: str, summary: str) -> Iterator[str]:
    """The lines of a command's page."""
    from attacks.cli import examples_of, parser_of, see_also

    parser = parser_of(name)
    title = f"mi-splat {name}"
    yield from (title, "=" * len(title), "", f".. program:: {title}", "")
    for paragraph in re.split(r"\n\s*\n", parser.description or summary):
        # which stand below as code, and as links
        if not paragraph.startswith(("Examples:", "See also:")):
            yield from (marked_up(paragraph), "")
    yield from (".. code-block:: sh", "")
    for line in examples_of(name):
        yield from (f"    mi-splat {line}", "")
    for group in parser._action_groups:
        actions = [
            action
            for action in group._group_actions
            if "--help" not in action.option_strings
        ]
        if actions:
            heading = str(group.title).replace("positional arguments", "arguments")
            yield from (heading.capitalize(), "-" * len(heading), "")
            if group.description:
                yield from (marked_up(group.description), "")
            for action in actions:
                yield from entry(action)
    yield (
        "See also: "
        + ", ".join(
            f":doc:`mi-splat {other} <{file_name(other)}>`" for other in see_also(name)
        )
        + "."
    )


def entry(action: argparse.Action) -> Iterator[str]:
    """One option or argument."""
    flags = sorted(action.option_strings, key=len, reverse=True)
    flags = [flag for flag in flags if flag.startswith("--")] or flags
    value = "" if action.metavar is None else " " + str(action.metavar)
    if flags:
        names = ", ".join(f"{flag}{value}" for flag in flags)
    else:
        names = f"{action.dest.upper()}"
    yield from (f".. option:: {names}", "")
    help_text = (
        str(action.help or "")
        .replace(" (default: False)", "")
        .replace(" (required)", " Required.")
    )
    yield from (f"    {marked_up(help_text)}", "")


def marked_up(text: str) -> str:
    """Plain text with `code` and --options in it, as one line of reStructuredText."""
    text = " ".join(text.split())
    if "`" not in text:
        text = _OPTION.sub(r"`\g<0>`", text)
    parts = text.split("`")
    if len(parts) % 2 == 0:  # a lone backtick
        return escaped(text)
    return "".join(
        f"``{part}``" if index % 2 else escaped(part)
        for index, part in enumerate(parts)
    )


def escaped(text: str) -> str:
    """Text in which nothing is markup."""
    return re.sub(r"([\\*`|_])", r"\\\1", text)
