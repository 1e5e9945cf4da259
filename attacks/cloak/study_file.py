"""Frozen dataclasses from TOML files: every key and value is checked, and errors name the section and the key."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar

from mi_splat.errors import InvalidValueError, message, nearest
from mi_splat.io.parsing import DocumentReader


def in_range(where: str, value: float, lowest: float, highest: float) -> None:
    """Raise unless a number lies between two others.

    Args:
        where: Section and key, for the error.
        value: The number.
        lowest: Smallest number that is allowed.
        highest: Largest one; infinity sets no limit.

    Raises:
        InvalidValueError: It does not.
    """
    if not lowest <= value <= highest:
        expected = f"{lowest:g} or more" if highest == math.inf else f"{lowest:g} to {highest:g}"
        raise InvalidValueError(message(where, expected, value, "change it"))


def one_of(where: str, value: Any, known: Any) -> None:
    """Raise unless a value is one of those known, naming the nearest."""
    if value not in known:
        do = nearest(str(value), map(str, known), "choose one of them")
        raise InvalidValueError(message(where, " or ".join(map(str, known)), repr(value), do))


_T = TypeVar("_T")


def read_table(kind: type[_T], path: Path) -> _T:
    """A frozen dataclass from a TOML file, see `from_table`.

    Raises:
        InvalidValueError: There is no such file, it is no TOML, or a key or a value in it means nothing.
    """
    if not path.is_file():
        raise InvalidValueError(message("study", "a TOML file", f"no file {path}", "check the path"))
    content = DocumentReader(expected="a TOML file", do="correct it").read_toml(path)
    return from_table(kind, content, str(path))


def from_table(kind: type[_T], table: dict[str, Any], where: str) -> _T:
    """A frozen dataclass from a table of a file.

    Args:
        kind: The dataclass.
        table: Its keys and values; lists stand for tuples, tables for other dataclasses.
        where: Name of the table, for errors.

    Raises:
        InvalidValueError: A key is unknown or missing, or a value is of another type.
    """
    hints = typing.get_type_hints(kind)
    known = {entry.name: entry for entry in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for key in table:
        one_of(f"key in {where}", key, known)
    missing = [
        name
        for name, entry in known.items()
        if name not in table and entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise InvalidValueError(message(where, f"the key {missing[0]}", "none", "add it"))
    return kind(**{key: _value(hints[key], value, f"{where}, {key}") for key, value in table.items()})


def _value(hint: Any, value: Any, where: str) -> Any:
    """A value of a file as the type that a field has."""
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise InvalidValueError(message(where, "a table", repr(value), "write [section] above its keys"))
        return from_table(typing.cast(type, hint), value, where)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        one_of(where, value, arguments)
        return value
    if origin in (typing.Union, types.UnionType):
        lists = [part for part in arguments if typing.get_origin(part) is tuple and isinstance(value, list)]
        return _value(next(iter(lists), next(part for part in arguments if part is not type(None))), value, where)
    if origin is tuple:
        length = None if arguments[-1] is Ellipsis else len(arguments)
        if not isinstance(value, list) or (length is not None and len(value) != length):
            expected = "a list" if length is None else f"a list of {length}"
            raise InvalidValueError(message(where, expected, repr(value), "write it in brackets"))
        return tuple(_value(arguments[0], part, where) for part in value)
    fits = isinstance(value, (int, float)) if hint is float else isinstance(value, hint)
    if not fits or isinstance(value, bool) is not (hint is bool):
        raise InvalidValueError(message(where, f"a value of type {hint.__name__}", repr(value), "change it"))
    return float(value) if hint is float else value
