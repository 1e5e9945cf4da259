"""The fields of JSON that somebody else wrote, each with its kind and range."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from mi_splat.errors import MiSplatError, message
from mi_splat.io.errors import SplatFileError
from mi_splat.io.parsing import DocumentReader

_AGAIN = "export it again"


@dataclass(frozen=True, slots=True)
class Fields:
    """One JSON object.

    Attributes:
        values: Its content.
        where: What it is part of, for messages; starts with the path of the file.
        error: What is raised for a field that is something else.
        do: What to do about one, for messages.
    """

    values: Mapping[str, object]
    where: str
    error: type[MiSplatError] = SplatFileError
    do: str = _AGAIN

    def bad(self, name: str, expected: str, got: object, do: str | None = None) -> MiSplatError:
        """The error for a field."""
        shown = repr(got)
        shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
        return self.error(message(f"{self.where}: {name}", expected, shown, self.do if do is None else do))

    def whole(self, name: str, low: int, high: int, default: int | None = None) -> int:
        """A whole number in a range."""
        value = self.values.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
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

    def numbers(self, name: str, low: int, high: int, default: Sequence[float] | None = None) -> list[float]:
        """A list of finite numbers."""
        values = self.values.get(name, default)
        if isinstance(values, Sequence) and not isinstance(values, str) and low <= len(values) <= high:
            kept = [_number(item) for item in values]
            if all(math.isfinite(item) for item in kept):
                return kept
        raise self.bad(name, f"{low} to {high} finite numbers", values)

    def texts(self, name: str, count: int | None = None) -> list[str]:
        """A list of `count` strings; of any number, also none, if no count is given."""
        values = self.values.get(name, [])
        kept = [item for item in values if isinstance(item, str)] if isinstance(values, list) else []
        if not isinstance(values, list) or len(kept) != len(values) or count not in (None, len(values)):
            raise self.bad(name, "strings" if count is None else f"{count} strings", values)
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
        if not isinstance(values, list) or not all(isinstance(item, Mapping) for item in values):
            raise self.bad(name, "a list of objects", values)
        return [
            replace(self, values=item, where=f"{self.where}: {name}[{number}]") for number, item in enumerate(values)
        ]

    def rows(self, name: str, count: int, width: int) -> list[list[float]]:
        """A list of `count` lists of `width` finite numbers each."""
        rows = self.values.get(name)
        if not isinstance(rows, list) or len(rows) != count:
            raise self.bad(name, f"{count} lists of {width} finite numbers", rows)
        parts = replace(self, values={f"{name}[{number}]": row for number, row in enumerate(rows)})
        return [parts.numbers(part, width, width) for part in parts.values]

    def wholes(self, name: str, low: int, high: int, count: int | None = None) -> list[int]:
        """A list of `count` whole numbers in a range; of any number if no count is given."""
        values = self.values.get(name)
        parts = values if isinstance(values, list) and count in (None, len(values)) else [None]
        kept = [item for item in parts if isinstance(item, int) and not isinstance(item, bool) and low <= item <= high]
        if len(kept) != len(parts):
            how_many = "" if count is None else f"{count} "
            raise self.bad(name, f"{how_many}whole numbers from {low} to {high}", values)
        return kept

    def indices(self, name: str, count: int) -> list[int]:
        """A list of whole numbers from 0 to below `count`, each once; empty if it is missing."""
        kept = self.wholes(name, 0, count - 1) if name in self.values else []
        if len(set(kept)) != len(kept):
            raise self.bad(name, f"different whole numbers below {count}", kept)
        return kept


def parse(data: bytes, path: str, *, limit: int) -> Fields:
    """The object in the JSON of a splat file."""
    return Fields(DocumentReader(do=_AGAIN, error=SplatFileError, most=limit).json_object(data, path), path)


def _number(value: object) -> float:
    """The number as a float; NaN for what is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf
