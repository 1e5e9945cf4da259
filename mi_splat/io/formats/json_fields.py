"""JSON that somebody else wrote: read within bounds, each field with its kind and range."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mi_splat.errors import message
from mi_splat.io.errors import SplatFileError

_AGAIN = "export it again"


@dataclass(frozen=True, slots=True)
class Fields:
    """One JSON object.

    Attributes:
        values: Its content.
        where: What it is part of, for messages; starts with the path of the file.
    """

    values: Mapping[str, object]
    where: str

    def bad(self, name: str, expected: str, found: object, do: str = _AGAIN) -> SplatFileError:
        """The error for a field.

        Args:
            name: Name of the field.
            expected: What would have been right.
            found: What is there.
            do: What to do about it.
        """
        shown = repr(found)
        shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
        return SplatFileError(message(f"{self.where}: {name}", expected, shown, do))

    def whole(self, name: str, low: int, high: int, default: int | None = None) -> int:
        """A whole number in a range.

        Args:
            name: Name of the field.
            low: Smallest number allowed.
            high: Largest one.
            default: What a missing field means; None if it may not be missing.
        """
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

    def numbers(self, name: str, low: int, high: int, default: Sequence[float] | None = None) -> list[float]:
        """A list of finite numbers.

        Args:
            name: Name of the field.
            low: Least length.
            high: Largest length.
            default: What a missing field means; None if it may not be missing.
        """
        found = self.values.get(name, default)
        if isinstance(found, Sequence) and not isinstance(found, str) and low <= len(found) <= high:
            kept = [_number(item) for item in found]
            if all(math.isfinite(item) for item in kept):
                return kept
        raise self.bad(name, f"{low} to {high} finite numbers", found)

    def texts(self, name: str, count: int | None = None) -> list[str]:
        """A list of `count` strings; of any number, also none, if no count is given."""
        found = self.values.get(name, [])
        kept = [item for item in found if isinstance(item, str)] if isinstance(found, list) else []
        if not isinstance(found, list) or len(kept) != len(found) or count not in (None, len(found)):
            raise self.bad(name, "strings" if count is None else f"{count} strings", found)
        return kept

    def object(self, name: str, default: Mapping[str, object] | None = None) -> Fields:
        """An object."""
        found = self.values.get(name, default)
        if not isinstance(found, Mapping):
            raise self.bad(name, "an object", found)
        return Fields(found, f"{self.where}: {name}")

    def objects(self, name: str) -> list[Fields]:
        """A list of objects; empty if it is missing."""
        found = self.values.get(name, [])
        if not isinstance(found, list) or not all(isinstance(item, Mapping) for item in found):
            raise self.bad(name, "a list of objects", found)
        return [Fields(item, f"{self.where}: {name}[{number}]") for number, item in enumerate(found)]

    def wholes(self, name: str, count: int) -> list[int]:
        """A list of whole numbers from 0 to below `count`, each once; empty if it is missing."""
        found = self.values.get(name, [])
        if not isinstance(found, list):
            raise self.bad(name, "a list", found)
        kept = [item for item in found if isinstance(item, int) and not isinstance(item, bool) and 0 <= item < count]
        if len(kept) != len(found) or len(set(kept)) != len(kept):
            raise self.bad(name, f"different whole numbers below {count}", found)
        return kept


def parse(data: bytes, path: str, *, limit: int) -> Fields:
    """The object in a JSON document.

    Args:
        data: The document.
        path: For messages.
        limit: Most bytes that it may have.

    Raises:
        SplatFileError: It is longer, no JSON, or no object.
    """
    if len(data) > limit:
        raise SplatFileError(message(path, f"at most {limit} bytes of JSON", len(data), _AGAIN))
    try:
        values = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        reason = str(error)[:100] or type(error).__name__
        raise SplatFileError(message(path, "a JSON document", reason, _AGAIN)) from None
    if not isinstance(values, dict):
        raise SplatFileError(message(path, "a JSON object", type(values).__name__, _AGAIN))
    return Fields(values, path)


def _number(value: object) -> float:
    """The number as a float; NaN for what is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf
