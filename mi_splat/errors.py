"""The two error types that mi-splat raises for bad input, and the form of their
messages.
"""

import difflib
import unicodedata
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

_Error = TypeVar("_Error", bound="MiSplatError")


class MiSplatError(Exception):
    """Base of every error that mi-splat raises on purpose; the command line prints it
    and exits with status 1.

    Attributes:
        what: What the message begins with: the name of the argument, file or option at
            fault.
        hint: What the command line adds: the flags or the command that do what the
            message says. Empty for none.
    """

    what: str = ""
    hint: str = ""

    @classmethod
    def of(
        cls: type[_Error], what: str, expected: object, got: object, do: str
    ) -> _Error:
        """The error with a `message`.

        Args:
            what: What is at fault.
            expected: What would have been right.
            got: What was found instead.
            do: What the reader should do about it.

        Returns:
            The error, to be raised.
        """
        error = cls(message(what, expected, got, do))
        error.what = shortened(what)
        return error

    def hinted(self: _Error, hint: str) -> _Error:
        """The same error with a hint for the command line.

        Args:
            hint: What to type, such as the flag that helps.

        Returns:
            This error.
        """
        self.hint = hint
        return self


class InvalidValueError(MiSplatError, ValueError):
    """A value that a function of this library cannot work with."""


_UNSEEN = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Kinds of characters that a terminal obeys instead of showing: controls, directions of
writing, ends of lines.
"""


def printable(text: str) -> str:
    """A text as a terminal may be given it: what a terminal would obey is written as
    Python writes it in a string.
    """
    return "\n".join(
        (
            line
            if line.isascii() and line.isprintable()
            else "".join(
                repr(c)[1:-1] if unicodedata.category(c) in _UNSEEN and c != "\t" else c
                for c in line
            )
        )
        for line in text.split("\n")
    )


def one_line(text: str, most: int = 400) -> str:
    """A text as one line of so many signs at most, without what a terminal would
    obey.
    """
    line = " ".join(printable(text[: 2 * most]).split())
    if len(line) <= most:
        return line
    return f"{line[: most - 3]}..."


def listed(names: Iterable[str], most: int = 6, *, width: int = 40) -> str:
    """The first of some names in one line, each of at most so many signs, and how many
    are left.
    """
    every = list(names)
    told = [one_line(name, width) for name in every[:most]]
    return (
        ", ".join([*told, f"{len(every) - most} more"] if len(every) > most else told)
        or "none"
    )


def counted(number: int, noun: str) -> str:
    """A number with its noun: "1 step", "2 steps"."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def message(what: str, expected: object, got: object, do: str) -> str:
    """The one form of an error message: what was looked at, what was expected, what
    came, what to do.

    Each part may name something of a file that somebody else has written: of long ones
    the beginning and the end are shown. What is expected may be a list of many choices.
    """
    wanted = shortened(str(expected), _MOST_CHOICES)
    remedy = shortened(do, _MOST_CHOICES)
    return (
        f"{shortened(what)}: expected {wanted}, got {shortened(str(got), 240)};"
        f" {remedy}"
    )


def shortened(text: str, most: int = 400) -> str:
    """A text of at most so many signs: of a longer one the beginning and the end."""
    if len(text) <= most:
        return text
    end = most // 4
    return f"{text[: most - end - 3]}...{text[-end:]}"


_MOST_CHOICES = 1500
"""Characters of a list of choices: 80 classes of COCO take half of them."""
_LONGEST_WORD = 200
"""No longer one is a slip of the hand; comparing it with others takes long."""


def nearest(word: str, known: Iterable[str], otherwise: str) -> str:
    """What to do about a word that is not known: "did you mean X?", for the one that is
    most like it.
    """
    by_small = {name.lower(): name for name in known if len(word) <= _LONGEST_WORD}
    near = difflib.get_close_matches(word.lower(), by_small, n=1, cutoff=0.5)
    if near:
        return f"did you mean {by_small[near[0]]}?"
    return otherwise


def install(extra: str) -> str:
    """How to install an optional part of the package, in a checkout or from a wheel."""
    if (Path(__file__).parents[1] / "pyproject.toml").is_file():
        return f"pip install -e '.[{extra}]' in your checkout of mi-splat"
    return f"pip install 'mi-splat[{extra}]'"
