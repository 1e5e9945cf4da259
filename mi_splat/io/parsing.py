"""JSON and TOML that somebody else may have written, read within bounds: a value or an error, whatever the file holds.

A document is UTF-8, a byte order mark may stand first, and it is neither too long nor too deep. No key stands twice in
an object, numbers are finite, whole ones fit into 64 bits, and texts are Unicode without NUL.
"""

import json
import math
import re
import sys
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError, MiSplatError, message

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MOST_BYTES = 1 << 25
"""Most that a document may be unless its reader says so."""
MOST_DEPTH = 64
"""Most objects and lists inside of each other."""

_DIGITS = 20
"""Most characters of a whole number of 64 bits."""
_SHOWN = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class DocumentReader:
    """How documents of one kind are read, and what is said of one that is broken.

    Attributes:
        expected: What a document should be, for messages.
        do: What to do about a broken one, for messages.
        error: What is raised.
        most: Bytes that a document may have.
    """

    expected: str = "a JSON object"
    do: str = "make the result again"
    error: type[MiSplatError] = InvalidValueError
    most: int = MOST_BYTES

    def json_value(self, data: bytes, where: str) -> Any:
        """What a JSON document holds, of any kind."""
        return self._parsed(partial(json.loads, object_pairs_hook=_object, parse_int=_whole), data, where)

    def json_object(self, data: bytes, where: str) -> dict[str, Any]:
        """The object in a JSON document; see `json_value`."""
        document = self.json_value(data, where)
        if not isinstance(document, dict):
            raise self.broken(where, kind_of(document))
        return document

    def read_json(self, path: Path) -> dict[str, Any]:
        """The object in a JSON file; see `json_value`."""
        return self.json_object(self.read_bytes(path), str(path))

    def read_json_value(self, path: Path) -> Any:
        """What a JSON file holds, of any kind; see `json_value`."""
        return self.json_value(self.read_bytes(path), str(path))

    def read_toml(self, path: Path) -> dict[str, Any]:
        """The table in a TOML file; see `json_value`."""
        document: dict[str, Any] = self._parsed(tomllib.loads, self.read_bytes(path), str(path))
        return document

    def read_bytes(self, path: Path) -> bytes:
        """The bytes of a file that is not too long."""
        try:
            with path.open("rb") as file:
                data = file.read(self.most + 1)
        except OSError as error:
            raise self.broken(str(path), error.strerror or str(error)) from error
        except ValueError as error:  # a path with a NUL
            raise self.broken(repr(str(path)), str(error)) from error
        if len(data) > self.most:
            raise self.broken(str(path), "a longer one", f"{self.expected} of at most {self.most:,} bytes")
        return data

    def broken(self, where: str, got: object, expected: str | None = None) -> MiSplatError:
        """The error for a document, or a part of one, that is something else than `expected`, or than is said here."""
        return self.error(message(where, self.expected if expected is None else expected, got, self.do))

    def _parsed(self, parse: Callable[[str], Any], data: bytes, where: str) -> Any:
        if len(data) > self.most:
            raise self.broken(where, f"{len(data):,}", f"{self.expected} of at most {self.most:,} bytes")
        try:
            document = parse(data.decode("utf-8-sig"))
        except RecursionError:
            raise self.broken(where, "more", f"at most {MOST_DEPTH} levels") from None
        except (ValueError, OverflowError) as error:
            raise self.broken(where, str(error)[:_SHOWN] or type(error).__name__) from error
        fault = _fault(document)
        if fault is not None:
            path_inside, expected, got = fault
            raise self.broken(f"{where}: {path_inside}" if path_inside else where, got, expected)
        return document


def read_json(path: Path) -> dict[str, Any]:
    """The object in the JSON file of a result."""
    return DocumentReader().read_json(path)


def kind_of(value: object) -> str:
    """What a value of a document is called there."""
    names = {dict: "an object", list: "a list", str: "a text", bool: "a truth value", type(None): "null"}
    return names.get(type(value), "a number" if isinstance(value, int | float) else type(value).__name__)


def _fault(document: Any) -> tuple[str, str, str] | None:
    """The first value that is beyond its bounds: where it is, what was expected and what is there."""
    waiting: deque[tuple[str, Any, int]] = deque([("", {"": document}, 0)])
    while waiting:
        path, values, depth = waiting.popleft()
        if depth > MOST_DEPTH:
            return path, f"at most {MOST_DEPTH} levels", "more"
        for key, value in values.items() if isinstance(values, dict) else enumerate(values):
            kind = type(value)
            if kind is dict or kind is list:
                waiting.append((_below(path, key), value, depth + 1))
            elif kind is float:
                if not math.isfinite(value):
                    return _below(path, key), "a finite number", repr(value)
            elif kind is int:
                if not -(1 << 63) <= value < 1 << 63:
                    return _below(path, key), "a whole number of 64 bits", "a larger one"
            elif kind is str and not _is_text(value):
                return _below(path, key), "Unicode without NUL", repr(value)[:_SHOWN]
            if type(key) is str and not _is_text(key):
                return path, "keys of Unicode without NUL", repr(key)[:_SHOWN]
    return None


def _below(path: str, key: object) -> str:
    name = str(key)[:40]
    return f"{path}/{name}" if path else name


_NO_TEXT = re.compile("[\0\ud800-\udfff]")


def _is_text(value: str) -> bool:
    return (value.isascii() and "\0" not in value) or _NO_TEXT.search(value) is None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {twice[:40]!r} twice in one object")
    return values


def _whole(text: str) -> int:
    if len(text) > _DIGITS:
        raise ValueError(f"a whole number of {len(text):,} characters, of which 64 bits have at most {_DIGITS}")
    return int(text)
