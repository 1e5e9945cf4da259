"""Frozen dataclasses from TOML files: every key and value is checked, and errors name the section and the key."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import decode
from mi_splat.io.parsing import DocumentReader

_Study = TypeVar("_Study")


def read_table(kind: type[_Study], path: Path) -> _Study:
    """A frozen dataclass from a TOML file, see `mi_splat.fields.decode`.

    Raises:
        InvalidValueError: There is no such file, it is no TOML, or a key or a value in it means nothing.
    """
    if not path.is_file():
        raise InvalidValueError(message("study", "a TOML file", f"no file {path}", "check the path"))
    return decode(kind, DocumentReader(expected="a TOML file", do="correct it").read_toml(path), str(path))
