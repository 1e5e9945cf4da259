"""Tables of figures: columns of cells over lines, as values for a page and as
Markdown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from attacks.figures.rate import Rate, number

if TYPE_CHECKING:
    from attacks.figures.frame import Figures, Label

Line = TypeVar("Line")
Column = str | Callable[[Line], object]
"""What a column shows of a line: what stands there under a key, or what a function
makes of it.
"""
Group = tuple[Mapping[str, Any], "Figures"]
"""Labels, and the figures that have them: what most tables have a line for."""
NONE = "-"


def cell(value: object) -> str:
    """A value as a cell: a rate with its interval, a dash for none."""
    if value is None:
        return NONE
    if isinstance(value, Rate):
        return value.words
    if isinstance(value, bool):
        if value:
            return "yes"
        return "no"
    if isinstance(value, float):
        return f"{value:g}"
    return str(value)


def groups_of(figures: Figures, *names: str) -> list[Group]:
    """The figures by some of their labels."""
    groups = figures.groups(*names).items()
    return [(dict(zip(names, labels, strict=True)), each) for labels, each in groups]


def label_at(name: str) -> Column[Group]:
    """A column of the labels of a name."""
    return lambda group: group[0].get(name)


def number_at(measure: str, form: str = ".2f", **labels: Label | None) -> Column[Group]:
    """A column of numbers in one format."""
    return lambda group: number(group[1].value(measure, **labels), form)


def rate_at(measure: str, **labels: Label | None) -> Column[Group]:
    """A column of rates with their intervals."""
    return lambda group: group[1].find(measure, **labels)


def short_rate(
    measure: str, *, interval: bool = False, **labels: Label | None
) -> Column[Group]:
    """A column of rates as short as `Rate.short` writes them."""

    def text(group: Group) -> str | None:
        rate = group[1].find(measure, **labels)
        if isinstance(rate, Rate):
            return rate.short(interval=interval)
        return None

    return text


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
    def filled(self) -> Table:
        """The table without the columns in which nothing stands."""
        cells = list(zip(*self.rows, strict=True))
        kept = [number for number, cells in enumerate(cells) if {*cells} != {NONE}]
        rows = (tuple(row[number] for number in kept) for row in self.rows)
        head = tuple(self.head[number] for number in kept)
        return replace(self, head=head, rows=tuple(rows))

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
