"""The figures of a result as one tidy frame, in which each is known by its labels.

A label says over what a figure was counted, for instance a detector or a seed; a figure
without that label is of all of them together. One label is the measure. In the file of
a result, figures.csv, labels and numbers are columns, and each line is a figure
(`attacks.observe.rows` lists the columns).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from attacks.figures.rate import Rate, pooled
from attacks.observe.rows import (
    FIGURES_FILE,
    Cell,
    columns_of,
    frame_of,
    read_rows,
    write_rows,
)
from mi_splat.errors import InvalidValueError
from mi_splat.io.folders import file_in

MEASURE = "measure"
"""The label that says what was counted or measured."""
AXIS = "axis: "
"""Head of the labels of what a study varies; the name of the axis follows."""
LOW = "from"
HIGH = "to"
"""Labels with the ends of a part of an interval."""
NUMBERS = ("successes", "total", "value", "low", "high", "least", "most")
"""Columns that are no labels."""

Label = str | int | float
Labels = Mapping[str, Label | None]
Key = frozenset[tuple[str, Label]]
NOTHING = Rate(successes=0, total=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    """A figure that is no rate: a value, or the summary of several."""

    value: float
    low: float | None = None  # ends of the 95 % interval of a mean
    high: float | None = None
    least: float | None = None  # of the values that it summarises
    most: float | None = None
    total: int | None = None  # number of these values


Figure = Rate | Number


def key_of(labels: Labels) -> Key:
    """Labels as what a figure is found by; None and "" stand for no label."""
    return frozenset(
        (name, label) for name, label in labels.items() if label not in (None, "")
    )


class Figures:
    """Figures by their labels."""

    def __init__(self, by_key: Mapping[Key, Figure]) -> None:
        self.by_key = by_key

    @classmethod
    def of(cls, entries: Iterable[tuple[Labels, Figure | float | None]]) -> Figures:
        """Figures with their labels; those that are None are left out."""
        figures: dict[Key, Figure] = {}
        for labels, figure in entries:
            if figure is None:
                continue
            if not isinstance(figure, (Rate, Number)):
                figure = Number(value=float(figure))
            figures[key_of(labels)] = figure
        return cls(figures)

    @classmethod
    def together(cls, parts: Iterable[Figures]) -> Figures:
        """The figures of several parts."""
        return cls({key: figure for part in parts for key, figure in part})

    def __iter__(self) -> Iterator[tuple[Key, Figure]]:
        return iter(self.by_key.items())

    def __len__(self) -> int:
        return len(self.by_key)

    def labelled(self, **labels: Label | None) -> Figures:
        """The same figures with further labels."""
        more = key_of(labels)
        return Figures({key | more: figure for key, figure in self})

    def where(self, **labels: Label | None) -> Figures:
        """Those with all of these labels, which they lose; None stands for no label."""
        wanted = key_of(labels)
        absent = {name for name, label in labels.items() if label is None}
        return Figures(
            {
                key - wanted: figure
                for key, figure in self
                if wanted <= key and absent.isdisjoint(name for name, _ in key)
            }
        )

    def having(self, *names: str) -> Figures:
        """Those with a label of each of these names."""
        wanted = set(names)
        return Figures(
            {key: figure for key, figure in self if wanted <= {name for name, _ in key}}
        )

    def groups(self, *names: str) -> dict[tuple[Any, ...], Figures]:
        """The figures by some of their labels, which they lose."""
        groups: dict[tuple[Any, ...], dict[Key, Figure]] = {}
        for key, figure in self:
            labels = dict(key)
            group = tuple(labels.pop(name, None) for name in names)
            groups.setdefault(group, {})[key_of(labels)] = figure
        return {group: Figures(figures) for group, figures in groups.items()}

    def labels(self, name: str) -> list[Any]:
        """Every label of a name, each once."""
        every = (label for key in self.by_key for other, label in key if other == name)
        return list(dict.fromkeys(every))

    @property
    def axes(self) -> list[str]:
        """Names of the labels that say what a study varies."""
        names = (name for key in self.by_key for name, _ in sorted(key, key=str))
        return [name for name in dict.fromkeys(names) if name.startswith(AXIS)]

    def find(self, measure: str, **labels: Label | None) -> Figure | None:
        """The figure with exactly these labels."""
        return self.by_key.get(key_of({MEASURE: measure, **labels}))

    def rate(self, measure: str, **labels: Label | None) -> Rate:
        """The rate with exactly these labels; where there is none, one of nothing."""
        figure = self.find(measure, **labels)
        if isinstance(figure, Rate):
            return figure
        return NOTHING

    def value(self, measure: str, **labels: Label | None) -> float | None:
        """The number with exactly these labels; None where there is none."""
        figure = self.find(measure, **labels)
        if isinstance(figure, Number):
            return figure.value
        return None

    def rates(self, measure: str, **labels: Label | None) -> list[Rate]:
        """Every rate with these labels, whatever others it has."""
        found = self.where(measure=measure, **labels).by_key.values()
        return [figure for figure in found if isinstance(figure, Rate)]

    def pooled(self, measure: str, **labels: Label | None) -> Rate:
        """Those rates together."""
        return pooled(self.rates(measure, **labels))

    def table(self) -> pl.DataFrame:
        """The figures as a table, a line for each."""
        return frame_of({**dict(sorted(key)), **_cells(figure)} for key, figure in self)

    def as_dicts(self) -> list[dict[str, Cell]]:
        """The figures as JSON can hold them, without what is empty."""
        return [
            {name: cell for name, cell in line.items() if cell is not None}
            for line in self.table().iter_rows(named=True)
        ]

    @classmethod
    def of_table(cls, table: pl.DataFrame) -> Figures:
        """The figures of a table."""
        figures: dict[Key, Figure] = {}
        for row in table.iter_rows(named=True):
            numbers = {name: row.pop(name, None) for name in NUMBERS}
            figures[key_of(row)] = _figure(numbers)
        if len(figures) < len(table):
            raise ValueError("two figures with the same labels")
        return cls(figures)


def _cells(figure: Figure) -> dict[str, Cell]:
    """The numbers of a figure by their columns, to ten digits."""
    if isinstance(figure, Rate):
        low, high = figure.interval
        counts = {"successes": figure.successes, "total": figure.total}
        return {**counts, "low": _rounded(low), "high": _rounded(high)}
    cells = {name: getattr(figure, name) for name in NUMBERS[1:]}
    return {
        name: _rounded(cell) if isinstance(cell, float) else cell
        for name, cell in cells.items()
    }


def _rounded(number: float) -> float:
    return float(f"{number:.10g}")


def _figure(numbers: Mapping[str, Any]) -> Figure:
    if numbers["successes"] is not None:
        interval = (numbers["low"], numbers["high"])
        return Rate.with_interval(numbers["successes"], numbers["total"], interval)
    if numbers["value"] is None:
        raise ValueError("a figure without a number")
    return Number(**{name: numbers[name] for name in NUMBERS[1:]})


def write_figures(figures: Figures, folder: Path) -> Path:
    """Write the figures of a result into its folder."""
    return write_rows(figures.table(), folder / FIGURES_FILE)


def read_figures(folder: Path) -> Figures:
    """The figures of a result."""
    path = file_in(folder, FIGURES_FILE)
    if not path.is_file():
        do = "make the result again with this version"
        raise InvalidValueError.of(str(folder), FIGURES_FILE, "none", do)
    try:
        return Figures.of_table(read_rows(path))
    except (TypeError, ValueError) as error:
        do = "get the result again"
        raise InvalidValueError.of(str(path), "figures", error, do) from error


def text_of(key: Key) -> str:
    """The labels of a figure in a line, the measure first."""
    labels = dict(key)
    measure = labels.pop(MEASURE, "")
    names = [column.name for column in columns_of(labels)]
    parts = [f"{name.removeprefix(AXIS)} {labels[name]}" for name in names]
    return ", ".join([str(measure), *parts])
