"""What tyro and argparse say of wrong usage, as the one line that every other error of the program is, too."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator

from mi_splat.cli.ranges import UsageError

_FRAME = "╭╮╰╯│─| "
_RULE = re.compile(r"[-─=]*")
_PLAIN = (
    (re.compile(r"^Error parsing (?!-)[\w.-]+: "), ""),
    (re.compile(r"^Error parsing "), ""),
    (re.compile(r"invalid literal for int\(\) with base 10: "), "expected a whole number, got "),
    (re.compile(r"could not convert string to float: "), "expected a number, got "),
)
_SUGGESTION = "Perhaps you meant"


@contextlib.contextmanager
def in_one_line() -> Iterator[None]:
    """Run a parser that prints what is wrong and ends the process; raise that as an error instead.

    Raises:
        UsageError: The parser ended the process with another status than 0.
        SystemExit: It ended it with status 0, after `--help`.
    """
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            yield
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UsageError(one_line(told.getvalue())) from None


def one_line(told: str) -> str:
    """The message in a box of tyro, or in the lines of argparse, with the option that was perhaps meant.

    Args:
        told: What the parser has printed.
    """
    sections: list[list[str]] = [[]]
    for line in told.splitlines():
        if "╭" in line or "╰" in line:
            continue
        text = line.strip(_FRAME)
        if not _RULE.fullmatch(text):
            sections[-1].append(text)
        elif line.strip():
            sections.append([])
    sections = [section for section in sections if section] or [["wrong usage"]]
    if "╭" not in told and len(sections) > 1:  # where the terminal has no frames, the title is a section of its own
        del sections[0]
    first, *others = sections
    if first[0].startswith("usage:"):
        return first[-1].partition("error: ")[2] or first[-1]
    message = " ".join(first).removesuffix(".")
    for pattern, plain in _PLAIN:
        message = pattern.sub(plain, message)
    meant = [line.split()[0] for section in others if section[0].startswith(_SUGGESTION) for line in section[1:2]]
    return f"{message}; did you mean {meant[0]}?" if meant else message
