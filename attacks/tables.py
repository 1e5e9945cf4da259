"""Tables of figures: columns of cells over lines, as values for a page and as
Markdown.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from attacks.rate import Rate, number

Line = TypeVar("Line")
Column = str | Callable[[Line], object]
"""What a column shows of a line: what stands there under a key, or what a function
makes of it.
"""


def cell(value: Any) -> str:
    """A value as a cell: a rate, or what `Rate.as_dict` makes of it, with its interval;
    a dash for none.
    """
    if isinstance(value, Mapping) and {"successes", "total"} <= set(value):
        value = Rate.of(value)
    if value is None:
        return "-"
    if isinstance(value, Rate):
        return value.words
    if isinstance(value, bool):
        if value:
            return "yes"
        return "no"
    if isinstance(value, float):
        return f"{value:g}"
    return str(value)


def number_at(*path: str, form: str = ".2f") -> Column[Any]:
    """A column of numbers in one format, at the end of a path of keys; a dash where
    there is none.
    """
    return lambda line: number(
        functools.reduce(lambda value, key: value and value.get(key), path, line), form
    )


def short_rate(*path: str, interval: bool = False) -> Column[Any]:
    """A column of rates at the end of a path of keys, as short as `Rate.short` writes
    them.
    """
    return lambda line: Rate.of(
        functools.reduce(lambda value, key: value[key], path, line)
    ).short(interval=interval)


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table: the first cell of each row is its heading."""

    caption: str  # what stands above it
    head: tuple[str, ...]  # titles of the columns
    rows: tuple[tuple[str, ...], ...]  # the cells

    @classmethod
    def of(
        cls, caption: str, columns: Mapping[str, Column[Line]], lines: Iterable[Line]
    ) -> Table:
        """A table with a row for each line."""
        rows = (
            tuple(_cell_of(line, column) for column in columns.values())
            for line in lines
        )
        return cls(caption=caption, head=tuple(columns), rows=tuple(rows))

    @property
    def markdown(self) -> str:
        """The table in Markdown under a heading."""
        return f"## {self.caption}\n\n{markdown(self.head, self.rows)}"


def _cell_of(line: Any, column: Any) -> str:
    return cell(column(line) if callable(column) else line.get(column))


def sections(tables: Iterable[Table]) -> str:
    """Tables in Markdown, each under a heading."""
    return "\n\n".join(table.markdown for table in tables) + "\n"


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Cells as a table in Markdown, without an end of the last line."""
    lines = (head, ("---",) * len(head), *rows)
    return "\n".join(
        f"| {' | '.join(text.replace('|', chr(92) + '|') for text in line)} |"
        for line in lines
    )


def named_settings(values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Nested settings as names with dots and values; tables of a list are numbered."""
    for key, value in values.items():
        tables = {key: value}
        if (
            isinstance(value, (list, tuple))
            and value
            and all(isinstance(entry, Mapping) for entry in value)
        ):
            tables = {f"{key}.{number}": entry for number, entry in enumerate(value)}
        for name, table in tables.items():
            if isinstance(table, Mapping):
                yield from (
                    (f"{name}.{inner}", entry) for inner, entry in named_settings(table)
                )
            else:
                yield name, table
