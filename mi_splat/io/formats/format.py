"""What a file format of splats is: its names, its marks, and how it is read and
written.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass

from mi_splat.io.loaded import Arrays, Encoded, Loaded
from mi_splat.registry import Registry


@dataclass(frozen=True, slots=True, kw_only=True)
class Saving:
    """What a writer is asked for besides the splat.

    Attributes:
        suffix: The one of the format's suffixes that the file will have.
        antialiased: Note in the file that the splat is to be drawn with antialiasing;
            true only for formats that keep it.
        version: One of the format's versions; None is its own choice.
    """

    suffix: str
    antialiased: bool = False
    version: int | None = None


def _needs_nothing(path: str) -> None:
    """A format that no further package is needed for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A file format of splats. Another package brings one as an entry point of the
    group `mi_splat.formats`.

    Attributes:
        name: Its name; of an entry point, the name of that.
        suffixes: Endings of its files in lower case, with the dot; a longer one of
            another format goes first.
        magic: Bytes with which its files begin, one or several; none where they begin
            with anything.
        read: From an open file and the path to name in errors, the arrays and what else
            it says. Sizes that the file claims are held against its bytes before memory
            is taken for them, and a damaged file raises `SplatFileError`.
        write: From (N, ...) float32 arrays of a scene in its frame, the bytes of a
            file, without times and random names; None for a format that is only read.
        keeps_antialiasing: Whether a file says that it is to be drawn with
            antialiasing.
        keeps_nothing: Whether a file can hold no Gaussians at all.
        in_archives: Whether it is read out of a ZIP archive too.
        versions: Versions that a caller may ask for.
        check: Raises for a path unless the packages are there that it needs.
    """

    name: str
    suffixes: tuple[str, ...]
    magic: tuple[bytes, ...] = ()
    read: Callable[[io.FileIO, str], Loaded]
    write: Callable[[Arrays, Saving], Encoded] | None = None
    keeps_antialiasing: bool = False
    keeps_nothing: bool = True
    in_archives: bool = False
    versions: tuple[int, ...] = ()
    check: Callable[[str], None] = _needs_nothing


FORMATS: Registry[Format] = Registry(
    "mi_splat.formats",
    "a Format",
    lambda value: isinstance(value, Format),
    what="file format",
)
"""Formats by their names. `mi_splat.io.splat_files` adds the project's own."""
