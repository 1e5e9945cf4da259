"""What a page says of one result, as plain values: whatever a command has written
becomes one `Section`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from attacks.figures.frame import HIGH, LOW, Figures
from attacks.figures.rate import FEW, Rate, percent
from attacks.figures.tables import Table, cell, named_settings

MOST_VALUES = 12
"""Values of one setting that are listed where several attacks differ in it."""


def duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} minutes"
    return f"{seconds / 3600:.1f} hours"


def listed(words: Sequence[str]) -> str:
    """Several words as a sentence has them."""
    if len(words) > 1:
        return " and ".join([", ".join(words[:-1]), words[-1]])
    return "".join(words)


def sentence(text: str) -> str:
    """A text with a capital and a full stop, as a warning is shown."""
    text = text.strip()
    return capital(text) + ("" if text.endswith((".", "!", "?")) else ".")


def capital(text: str) -> str:
    """A text with a capital, unless it begins with a name of the code."""
    if "_" in text.partition(" ")[0]:
        return text
    return text[:1].upper() + text[1:]


def settings(values: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Nested settings as names with dots and values."""
    return tuple((name, plain(value)) for name, value in named_settings(values))


def plain(value: Any) -> str:
    """A value of a JSON as a page shows it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        if value:
            return "yes"
        return "no"
    if isinstance(value, float):
        if float(f"{value:g}") == value:
            return f"{value:g}"
        return repr(value)
    if isinstance(value, list):
        return ", ".join(map(plain, value)) or "none"
    return str(value)


def shared(several: Iterable[Mapping[str, Any]]) -> tuple[tuple[str, str], ...]:
    """The settings of several attacks: what all share, and the values of what
    differs.
    """
    values: dict[str, dict[str, None]] = {}
    for attack in several:
        for name, value in settings(attack):
            values.setdefault(name, {})[value] = None
    return tuple(
        (
            name,
            "; ".join(
                [
                    *list(different)[:MOST_VALUES],
                    *([f"and {more} more"] if more > 0 else []),
                ]
            ),
        )
        for name, different in values.items()
        for more in [len(different) - MOST_VALUES]
    )


def versions_of(result: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Packages, variant and commit of a result, as far as it names them."""
    packages = {
        str(name): str(version) for name, version in result.get("versions", {}).items()
    }
    more = {
        name: plain(result[name])
        for name in ("variant", "commit")
        if result.get(name) is not None
    }
    return tuple({**packages, **more}.items())


Role = Literal["attack", "control", "other"]
"""What a line of a chart stands for; it decides the colour, the marker and the
dashes.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One figure."""

    label: str  # what it is
    # how often, with its interval; None for what is not counted
    rate: Rate | None = None
    words: str = ""  # the value where there is no rate
    note: str = ""  # what else the reader has to know of it

    @classmethod
    def each(cls, words: Mapping[str, str]) -> tuple[Figure, ...]:
        """A figure for each label that is not counted."""
        return tuple(cls(label=label, words=text) for label, text in words.items())

    @property
    def value(self) -> str:
        """The figure, short: a percentage only where enough was counted to have one."""
        if self.rate is None:
            return self.words
        if self.rate.total < FEW:
            if self.rate.total:
                return self.counts
            return "nothing counted"
        return percent(self.rate.fraction)

    @property
    def counts(self) -> str:
        """Successes and total; empty where nothing is counted."""
        if self.rate is None:
            return ""
        return self.rate.counts

    @property
    def interval(self) -> str:
        """The 95 % interval; empty where nothing is counted."""
        if self.rate is None or not self.rate.total:
            return ""
        return self.rate.ends

    @property
    def cell(self) -> str:
        """The whole figure in a cell of a table."""
        if self.rate is None:
            return self.words
        return cell(self.rate)

    @property
    def row(self) -> tuple[str, str, str]:
        """The figure as a row of a table: what, how much, and the interval."""
        name = f"{self.label} ({self.note})" if self.note else self.label
        if self.rate is None or not self.rate.total:
            return name, self.words or "-", ""
        return name, f"{self.counts} = {percent(self.rate.fraction)}", self.interval


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """An image file of a result."""

    path: Path  # of the PNG
    caption: str  # what is to be seen
    alt: str = ""  # the same for who cannot see it; empty where the caption says it
    # whether it has so many columns that a small screen should scroll it
    wide: bool = False
    large: bool = False  # whether it takes the whole width of any screen


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a line, with the ends of its interval if it has one."""

    x: float
    y: float
    low: float | None = None
    high: float | None = None

    @classmethod
    def of(cls, x: float, rate: Rate) -> Point:
        """A rate with its interval."""
        return cls(x, rate.fraction, *rate.interval)


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A line of a chart; without points it is left out."""

    name: str
    role: Role
    points: tuple[Point, ...]

    @classmethod
    def of(cls, name: str, role: Role, rates: Iterable[Rate]) -> Line:
        """Rates at 0, 1, ...; but none that counts nothing."""
        points = (Point.of(x, rate) for x, rate in enumerate(rates) if rate.total)
        return cls(name=name, role=role, points=tuple(points))

    @classmethod
    def over(
        cls, name: str, role: Role, figures: Figures, measure: str, **labels: str
    ) -> Line:
        """Rates of the parts of an interval, each in the middle of its part."""
        points = []
        for (low, high), of_part in figures.groups(LOW, HIGH).items():
            rate = of_part.rate(measure, **labels)
            if rate.total:
                points.append(Point.of((low + high) / 2, rate))
        return cls(name=name, role=role, points=tuple(points))


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """Lines over an axis; a chart without any point is left out."""

    title: str
    x_label: str  # of the axis, with the unit
    y_label: str
    lines: tuple[Line, ...]
    caption: str = "Bars are 95 % intervals."
    ticks: tuple[str, ...] = ()  # names of 0, 1, ... where the axis has no numbers
    # ends and name of a part of the axis that is marked
    shade: tuple[float, float, str] | None = None
    level: tuple[float, str] | None = None  # height and name of a horizontal line
    fractions: bool = True  # whether heights are fractions, shown from 0 to 100 %
    connected: bool = True  # whether the points of a line belong together
    # whether points are azimuths and elevations in degrees, drawn as seen from above
    dome: bool = False

    @classmethod
    def bars(
        cls,
        title: str,
        labels: tuple[str, str],
        ticks: Iterable[str],
        *lines: Line,
        **more: Any,
    ) -> Chart:
        """A chart over names, with the labels of both axes."""
        (x_label, y_label), names = labels, tuple(ticks)
        return cls(
            title=title,
            x_label=x_label,
            y_label=y_label,
            lines=lines,
            ticks=names,
            connected=False,
            **more,
        )

    @classmethod
    def directions(
        cls,
        title: str,
        caption: str,
        groups: Mapping[str, tuple[Role, Iterable[Sequence[float]]]],
    ) -> Chart:
        """A dome on which each group of azimuths and elevations, degrees, has its
        marks.
        """
        return cls(
            title=title,
            caption=caption,
            x_label="azimuth, degrees",
            y_label="elevation, degrees",
            lines=tuple(
                Line(
                    name=name,
                    role=role,
                    points=tuple(Point(*angles) for angles in several),
                )
                for name, (role, several) in groups.items()
            ),
            fractions=False,
            connected=False,
            dome=True,
        )

    @property
    def drawn(self) -> tuple[Line, ...]:
        """The lines that have points."""
        return tuple(line for line in self.lines if line.points)


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """What a page says of one result."""

    kind: str  # what sort of result it is; results of one kind are compared
    title: str  # which one
    done: str  # what was done, in plain words
    conclusion: str  # what may be concluded, in plain words
    headline: Figure  # the figure that matters
    # the same where nothing was attacked, or noise was added; None without a control
    control: Figure | None = None
    attacked: bool = True  # whether the figure is one of an attack
    # what the headline counts, in the plural: for the warnings that every attack has
    counting: str = "views"
    figures: Sequence[Figure] = ()  # more figures; with the two above, a table
    # reasons to look twice, besides those that every attack has
    warnings: Sequence[str] = ()
    # what can be seen; those without a file are left out
    pictures: Sequence[Picture] = ()
    charts: Sequence[Chart] = ()  # what is drawn from the result's numbers
    tables: Sequence[Table] = ()  # more numbers; those without rows are left out
    configuration: tuple[tuple[str, str], ...] = ()  # every setting, by name
    versions: tuple[tuple[str, str], ...] = ()  # packages, variant and commit, by name
    folder: str = ""  # where it lies, as the reader of the command line named it
    command: str = ""  # command line that made it, as it was given; empty if none did
    # SHA-256 of manifest.json, which stands for every file of the result; empty where
    # there is none
    manifest: str = ""
    file: tuple[str, str] | None = None  # name and text of the file of a study
    # labels of the figures that a terminal shows below the headline and its control;
    # all of them if it names none
    brief: tuple[str, ...] = ()

    @property
    def all_figures(self) -> tuple[Figure, ...]:
        """The headline, its control, and the others, each once."""
        return tuple(
            dict.fromkeys(
                (
                    self.headline,
                    *([self.control] if self.control else []),
                    *self.figures,
                )
            )
        )

    @property
    def has_intervals(self) -> bool:
        """Whether one of its figures was counted."""
        return any(figure.interval for figure in self.all_figures)

    def doubts(self) -> list[str]:
        """Warnings of every attack: too little was counted, or there is nothing to
        compare with.
        """
        rate, control = (
            self.headline.rate,
            None if self.control is None else self.control.rate,
        )
        if rate is None or not self.attacked:
            return []
        doubts = []
        if rate.total < FEW:
            doubts.append(
                f"Few {self.counting}: {rate.total}. The interval is wide; others may"
                " give another rate."
            )
        if control is None or not control.total:
            doubts.append(
                "There is no control, so nothing says what would have happened without"
                " the attack."
            )
        elif control.fraction > 0 and control.interval[1] >= rate.interval[0]:
            doubts.append(
                "The intervals of the figure and of its control overlap: the attack may"
                " have done nothing."
            )
        return doubts
