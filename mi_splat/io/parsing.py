"""JSON and TOML that somebody else may have written, read within bounds: a value or an
error, whatever the file holds.

A document is UTF-8, a byte order mark may stand first, and it is neither too long nor
too deep. No key stands twice in an object, numbers are finite, whole ones fit into 64
bits, and texts are Unicode without NUL.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.errors import LFS_ADVICE, LFS_POINTER, SplatFileError

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
    """How documents of one kind are read: words for messages, what is raised, and how
    many bytes one may have.
    """

    expected: str = "a JSON object"
    do: str = "make the result again"
    error: type[MiSplatError] = InvalidValueError
    most: int = MOST_BYTES

    def json_value(self, data: bytes, where: str) -> Any:
        """What a JSON document holds, of any kind."""
        return self._parsed(
            partial(json.loads, object_pairs_hook=_object, parse_int=_whole),
            data,
            where,
        )

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
        document: dict[str, Any] = self._parsed(
            tomllib.loads, self.read_bytes(path), str(path)
        )
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
            raise self.broken(
                str(path),
                "a longer one",
                f"{self.expected} of at most {self.most:,} bytes",
            )
        if data.startswith(LFS_POINTER):
            raise self.error(message(str(path), self.expected, *LFS_ADVICE))
        return data

    def broken(
        self, where: str, got: object, expected: str | None = None
    ) -> MiSplatError:
        """The error for a document, or a part of one, that is something else than
        `expected`, or than is said here.
        """
        return self.error(
            message(
                where, self.expected if expected is None else expected, got, self.do
            )
        )

    def _parsed(self, parse: Callable[[str], Any], data: bytes, where: str) -> Any:
        if len(data) > self.most:
            raise self.broken(
                where,
                f"{len(data):,}",
                f"{self.expected} of at most {self.most:,} bytes",
            )
        try:
            document = parse(data.decode("utf-8-sig"))
        except RecursionError:
            raise self.broken(where, "more", f"at most {MOST_DEPTH} levels") from None
        except (ValueError, OverflowError) as error:
            raise self.broken(
                where, str(error)[:_SHOWN] or type(error).__name__
            ) from error
        fault = _fault(document)
        if fault is not None:
            path_inside, expected, got = fault
            raise self.broken(
                f"{where}: {path_inside}" if path_inside else where, got, expected
            )
        return document


def read_json(path: Path) -> dict[str, Any]:
    """The object in the JSON file of a result."""
    return DocumentReader().read_json(path)


def kind_of(value: object) -> str:
    """What a value of a document is called there."""
    names = {
        dict: "an object",
        list: "a list",
        str: "a text",
        bool: "a truth value",
        type(None): "null",
    }
    return names.get(
        type(value),
        "a number" if isinstance(value, int | float) else type(value).__name__,
    )


def _fault(document: Any) -> tuple[str, str, str] | None:
    """The first value that is beyond its bounds: where it is, what was expected and
    what is there.
    """
    waiting: deque[tuple[str, Any, int]] = deque([("", {"": document}, 0)])
    while waiting:
        path, values, depth = waiting.popleft()
        if depth > MOST_DEPTH:
            return path, f"at most {MOST_DEPTH} levels", "more"
        for key, value in (
            values.items() if isinstance(values, dict) else enumerate(values)
        ):
            kind = type(value)
            if kind is dict or kind is list:
                waiting.append((_below(path, key), value, depth + 1))
            elif kind is float:
                if not math.isfinite(value):
                    return _below(path, key), "a finite number", repr(value)
            elif kind is int:
                if not -(1 << 63) <= value < 1 << 63:
                    return (
                        _below(path, key),
                        "a whole number of 64 bits",
                        "a larger one",
                    )
            elif kind is str and not _is_text(value):
                return _below(path, key), "Unicode without NUL", repr(value)[:_SHOWN]
            if type(key) is str and not _is_text(key):
                return path, "keys of Unicode without NUL", repr(key)[:_SHOWN]
    return None


def _below(path: str, key: object) -> str:
    name = str(key)[:40]
    if path:
        return f"{path}/{name}"
    return name


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
        raise ValueError(
            f"a whole number of {len(text):,} characters, of which 64 bits have at most"
            f" {_DIGITS}"
        )
    return int(text)


@dataclass(frozen=True, slots=True)
class Fields:
    """The fields of a JSON object that somebody else wrote, each asked for with its
    kind and range.
    """

    values: Mapping[str, object]
    where: str
    error: type[MiSplatError] = SplatFileError
    do: str = "export it again"

    def bad(
        self, name: str, expected: str, got: object, do: str | None = None
    ) -> MiSplatError:
        """The error for a field."""
        shown = repr(got)
        shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
        return self.error(
            message(
                f"{self.where}: {name}", expected, shown, self.do if do is None else do
            )
        )

    def whole(self, name: str, low: int, high: int, default: int | None = None) -> int:
        """A whole number in a range."""
        value = self.values.get(name, default)
        if (
            isinstance(value, bool)
            or not isinstance(value, int)
            or not low <= value <= high
        ):
            raise self.bad(name, f"a whole number from {low} to {high}", value)
        return value

    def text(self, name: str, default: str | None = None) -> str:
        """A string."""
        value = self.values.get(name, default)
        if not isinstance(value, str):
            raise self.bad(name, "a string", value)
        return value

    def number(self, name: str) -> float:
        """A finite number."""
        value = self.values.get(name)
        if not math.isfinite(_number(value)):
            raise self.bad(name, "a finite number", value)
        return _number(value)

    def numbers(
        self, name: str, low: int, high: int, default: Sequence[float] | None = None
    ) -> list[float]:
        """A list of finite numbers."""
        values = self.values.get(name, default)
        if (
            isinstance(values, Sequence)
            and not isinstance(values, str)
            and low <= len(values) <= high
        ):
            kept = [_number(item) for item in values]
            if all(math.isfinite(item) for item in kept):
                return kept
        raise self.bad(name, f"{low} to {high} finite numbers", values)

    def texts(self, name: str, count: int | None = None) -> list[str]:
        """A list of `count` strings; of any number, also none, if no count is given."""
        values = self.values.get(name, [])
        if isinstance(values, list):
            kept = [item for item in values if isinstance(item, str)]
        else:
            kept = []
        if (
            not isinstance(values, list)
            or len(kept) != len(values)
            or count not in (None, len(values))
        ):
            raise self.bad(
                name, "strings" if count is None else f"{count} strings", values
            )
        return kept

    def object(self, name: str, default: Mapping[str, object] | None = None) -> Fields:
        """An object."""
        value = self.values.get(name, default)
        if not isinstance(value, Mapping):
            raise self.bad(name, "an object", value)
        return replace(self, values=value, where=f"{self.where}: {name}")

    def objects(self, name: str) -> list[Fields]:
        """A list of objects; empty if it is missing."""
        values = self.values.get(name, [])
        if not isinstance(values, list) or not all(
            isinstance(item, Mapping) for item in values
        ):
            raise self.bad(name, "a list of objects", values)
        return [
            replace(self, values=item, where=f"{self.where}: {name}[{number}]")
            for number, item in enumerate(values)
        ]

    def rows(self, name: str, count: int, width: int) -> list[list[float]]:
        """A list of `count` lists of `width` finite numbers each."""
        rows = self.values.get(name)
        if not isinstance(rows, list) or len(rows) != count:
            raise self.bad(name, f"{count} lists of {width} finite numbers", rows)
        parts = replace(
            self, values={f"{name}[{number}]": row for number, row in enumerate(rows)}
        )
        return [parts.numbers(part, width, width) for part in parts.values]

    def wholes(
        self, name: str, low: int, high: int, count: int | None = None
    ) -> list[int]:
        """A list of `count` whole numbers in a range; of any number if no count is
        given.
        """
        values = self.values.get(name)
        if isinstance(values, list) and count in (None, len(values)):
            parts = values
        else:
            parts = [None]
        kept = [
            item
            for item in parts
            if isinstance(item, int)
            and not isinstance(item, bool)
            and low <= item <= high
        ]
        if len(kept) != len(parts):
            how_many = "" if count is None else f"{count} "
            raise self.bad(
                name, f"{how_many}whole numbers from {low} to {high}", values
            )
        return kept

    def indices(self, name: str, count: int) -> list[int]:
        """A list of whole numbers from 0 to below `count`, each once; empty if it is
        missing.
        """
        kept = self.wholes(name, 0, count - 1) if name in self.values else []
        if len(set(kept)) != len(kept):
            raise self.bad(name, f"different whole numbers below {count}", kept)
        return kept


def parse(data: bytes, path: str, *, limit: int) -> Fields:
    """The object in the JSON of a splat file."""
    reader = DocumentReader(do="export it again", error=SplatFileError, most=limit)
    return Fields(reader.json_object(data, path), path)


def _number(value: object) -> float:
    """The number as a float; NaN for what is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf
