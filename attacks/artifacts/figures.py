"""Figures of a result as a flat list: names, values, and how near a figure that is derived again has to be."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from attacks.rate import Rate
from mi_splat.errors import InvalidValueError, message

Value = int | float | bool | str | tuple[int, int] | None
"""A figure; a rate is its successes and its total."""

REAL_TOLERANCE = 1e-6
"""Of figures that are no counts: decibels, degrees, confidences."""
MOST_TOLERANCE = 0.01
"""Most that an artifact may allow itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A figure that a result gives.

    Attributes:
        name: Where it stands in the result, for instance by_detector/yolov8n_small/trigger_miss_rate.
        value: Its value.
        tolerance: How far a figure that is derived again may be from it; 0 for counts and words.
    """

    name: str
    value: Value
    tolerance: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        value = {"successes": self.value[0], "total": self.value[1]} if isinstance(self.value, tuple) else self.value
        return {"name": self.name, "value": value, "tolerance": self.tolerance}


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """One line of a report.

    Attributes:
        name: What was looked at.
        words: What was found.
        passed: Whether it is as it has to be; None if there is nothing to compare it with.
    """

    name: str
    words: str
    passed: bool | None

    @property
    def colour(self) -> str:
        """Green, red, or grey where there is nothing to compare with."""
        return "grey" if self.passed is None else "green" if self.passed else "red"

    def as_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {"name": self.name, "colour": self.colour, "words": self.words}


def flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[Figure]:
    """The figures in nested tables and lists; a rate, with its interval, is one figure.

    Args:
        values: Of a summary or a part of it.
        prefix: What stands before their names.
    """
    for key, value in values.items():
        yield from _flat(f"{prefix}{key}", value)


def _flat(name: str, value: Any) -> Iterator[Figure]:
    if isinstance(value, Mapping) and {"successes", "total"} <= set(value):
        yield Figure(name=name, value=(int(value["successes"]), int(value["total"])))
    elif isinstance(value, Mapping):
        yield from flat(value, f"{name}/")
    elif isinstance(value, (list, tuple)):
        yield from _of_list(name, value)
    elif isinstance(value, float):
        yield Figure(name=name, value=value, tolerance=REAL_TOLERANCE)
    else:
        yield Figure(name=name, value=value)


def _of_list(name: str, values: Sequence[Any]) -> Iterator[Figure]:
    """Entries by their number, or by their interval where they have one."""
    for number, entry in enumerate(values):
        if isinstance(entry, Mapping) and {"from", "to"} <= set(entry):
            part = f"{name}/{entry['from']:g} to {entry['to']:g}"
            if {"successes", "total"} <= set(entry):
                yield from _flat(part, entry)
            else:
                yield from flat({key: one for key, one in entry.items() if key not in ("from", "to")}, f"{part}/")
        else:
            yield from _flat(f"{name}/{number}", entry)


def read_figure(entry: Any, where: str) -> Figure:
    """A figure as `Figure.as_dict` writes it.

    Raises:
        InvalidValueError: It is none.
    """
    try:
        name, value, tolerance = entry["name"], entry["value"], float(entry["tolerance"])
        if isinstance(value, dict):
            value = (value["successes"], value["total"])
        whole = not isinstance(value, tuple) or all(type(part) is int for part in value)
        known = value is None or isinstance(value, (bool, int, float, str, tuple))
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidValueError(message(where, "figures", repr(error), "get the artifact again")) from error
    if not (isinstance(name, str) and whole and known and 0 <= tolerance <= MOST_TOLERANCE):
        expected = f"a name, a value, and a tolerance of at most {MOST_TOLERANCE}"
        raise InvalidValueError(message(where, expected, repr(entry)[:120], "get the artifact again"))
    return Figure(name=name, value=value, tolerance=tolerance)


def compared(expected: Sequence[Figure], derived: Sequence[Figure]) -> list[Line]:
    """A line for each figure: those expected in their order, then those that follow from the rows and are not named."""
    found = {figure.name: figure for figure in derived}
    lines = []
    for figure in expected:
        got = found.pop(figure.name, None)
        if got is None:
            lines.append(Line(name=figure.name, words=f"{in_words(figure.value)}, not derived", passed=False))
            continue
        same = _agree(figure, got.value)
        words = in_words(got.value) if same else f"expected {in_words(figure.value)}, got {in_words(got.value)}"
        lines.append(Line(name=figure.name, words=words, passed=same))
    lines += [
        Line(name=name, words=f"{in_words(figure.value)}, not among the expected figures", passed=False)
        for name, figure in found.items()
    ]
    return lines


def _agree(expected: Figure, got: Value) -> bool:
    here = expected.value
    if isinstance(here, bool) or isinstance(got, bool):
        return here is got
    if isinstance(here, (int, float)) and isinstance(got, (int, float)):
        return abs(here - got) <= expected.tolerance
    return here == got


def in_words(value: Value) -> str:
    """A figure for people."""
    if isinstance(value, tuple):
        return f"{value[0]}/{value[1]}"
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def moved(name: str, then: Rate | None, now: Rate, *, tolerance: float, other_weights: bool = False) -> Line:
    """How a rate has moved since the artifact was made.

    Args:
        name: Of the rate.
        then: In the rows; None if they do not have it, so that the line is grey.
        now: Today.
        tolerance: How far it may move.
        other_weights: Whether the detector has other weights than the artifact's.
    """
    if then is None:
        return Line(name=name, words=f"{_said(now)}; not in the artifact", passed=None)
    by = abs(now.fraction - then.fraction) if now.total and then.total else float(now.total != then.total)
    other = "; other weights than the artifact's" if other_weights else ""
    words = f"{_said(then)} in the rows, {_said(now)} now: moved by {by:.1%}, may move by {tolerance:.1%}{other}"
    return Line(name=name, words=words, passed=by <= tolerance)


def _said(rate: Rate) -> str:
    return f"{rate.successes}/{rate.total}"
