"""A study is one TOML file: settings, and what of them varies.

    study = "dagger"                    # what is studied; the other settings are that kind's own
    question = "Which ball suffices?"
    target = "person"
    attack = { steps = 11 }

    [matrix]                            # every combination of these
    seed = [0, 1, 2]
    "attack.eps" = [2.0, 5.0]
    pair = [{ name = "car", object = "car" }, { name = "sign", object = "stop_sign" }]  # several fields at once

    [[case]]                            # parts of the study: settings, and axes, of their own
    name = "linf"
    attack = { norm = "linf" }
    matrix = { "attack.eps" = [0.02, 0.05] }

    [[ablation]]                        # one value at a time, the rest as it stands above
    "attack.steps" = [5, 40]

    [bisect]                            # the smallest value that suffices; also in a case
    field = "attack.eps"
    values = [1.0, 2.0, 3.0]

    [judge.matrix]                      # who looks at what came out, and how
    condition = ["ray", ".spz"]

Light, without torch. What the settings mean, the kinds say (`KINDS`).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError, message, nearest
from mi_splat.io.parsing import DocumentReader

KINDS: dict[str, str] = {
    "dagger": "attacks.studies.dagger",
    "dagger-eot": "attacks.studies.dagger",
    "cloak": "attacks.studies.cloak",
}
"""Kinds of studies, and the modules that know their settings and jobs."""

PARTS = ("study", "question", "matrix", "case", "ablation", "bisect", "judge")
"""Keys of a file that are no settings."""
_OF_CASES = ("name", "matrix", "bisect")

Settings = Mapping[str, Any]
"""Tables in tables, as the file has them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """One value of an axis.

    Attributes:
        label: What it is called in tables.
        settings: What it sets.
    """

    label: Any
    settings: Settings


Axes = Mapping[str, tuple[Choice, ...]]
"""What varies, by name, the slowest first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One combination of settings.

    Attributes:
        part: Name of the case or ablation that it belongs to; empty for none.
        labels: Of every axis the label of its value.
        settings: All settings.
    """

    part: str
    labels: Mapping[str, Any]
    settings: Settings


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """Points that differ in one number, of which the smallest that suffices is looked for.

    Attributes:
        field: The axis of that number.
        points: The points, the number rising.
    """

    field: str
    points: tuple[Point, ...]

    def asked(self, suffices: Callable[[Point], bool | None]) -> list[Point]:
        """The points that a bisection has looked at and the one that it wants to look at next.

        Args:
            suffices: Whether a point has its aim; None if that is not known yet. A larger number is taken to do as
                well.
        """
        points: list[Point] = []
        low, high = -1, len(self.points)  # fails, suffices
        while high - low > 1:
            middle = (low + high) // 2
            points.append(self.points[middle])
            enough = suffices(self.points[middle])
            if enough is None:
                break
            low, high = (low, middle) if enough else (middle, high)
        return points


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A case or an ablation.

    Attributes:
        name: Of it; empty for the study itself.
        settings: What it sets otherwise than the study.
        axes: What varies in it.
        bisected: The axis of `axes` whose smallest value that suffices is looked for; empty for none.
    """

    name: str
    settings: Settings
    axes: Axes
    bisected: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """What a file says.

    Attributes:
        name: Of the study, as of its file.
        kind: Key of `KINDS`.
        question: What is asked, one sentence; empty for none.
        settings: Of the kind.
        parts: What is done.
        judge: Settings of those who look at what came out; None if nobody does.
        judge_axes: What varies of them.
        text: The file.
    """

    name: str
    kind: str
    question: str
    settings: Settings
    parts: tuple[Part, ...]
    judge: Settings | None
    judge_axes: Axes
    text: str

    def of(self, names: Sequence[str]) -> Study:
        """The study with some of its parts alone; all if none is named.

        Raises:
            InvalidValueError: There is no such part.
        """
        known = {part.name: part for part in self.parts}
        for name in names:
            do = nearest(name, known, "name one of these")
            _check(name in known, f"part of {self.name}", " or ".join(known), name, do)
        return dataclasses.replace(self, parts=tuple(known[name] for name in names)) if names else self

    def points(self) -> Iterator[Point | Search]:
        """Every combination of settings, part by part; those of a bisection together."""
        for part in self.parts:
            settings = merged(self.settings, part.settings)
            axes = {name: choices for name, choices in part.axes.items() if name != part.bisected}
            for point in combinations(settings, axes, part.name):
                if not part.bisected:
                    yield point
                    continue
                axis = {part.bisected: part.axes[part.bisected]}
                tried = (
                    Point(part=part.name, labels={**point.labels, **value.labels}, settings=value.settings)
                    for value in combinations(point.settings, axis)
                )
                yield Search(field=part.bisected, points=tuple(tried))

    def judges(self) -> list[Point]:
        """Every way to look at what came out; none if nobody looks."""
        return [] if self.judge is None else list(combinations(self.judge, self.judge_axes))


def read_study(path: Path) -> Study:
    """The study in a TOML file.

    Raises:
        InvalidValueError: There is no such file, it is no TOML, or it is none of a study.
    """
    if not path.is_file():
        raise InvalidValueError(message("study", "a TOML file", f"no file {path}", "check the path"))
    table = DocumentReader(expected="a TOML file", do="correct it").read_toml(path)
    return study_of(table, path.stem, path.read_text("utf-8-sig"))


def study_of(table: Settings, name: str, text: str = "") -> Study:
    """The study in a table.

    Args:
        table: The content of a file.
        name: Name of the study.
        text: The file.

    Raises:
        InvalidValueError: Some part is none.
    """
    kind, question = table.get("study"), table.get("question", "")
    if kind not in KINDS:
        do = nearest(str(kind), KINDS, 'write for instance study = "dagger" first')
        raise InvalidValueError(message(f"study in {name}", " or ".join(KINDS), repr(kind), do))
    _check(isinstance(question, str), f"question in {name}", "a sentence", question, "write it in quotes")
    judge = _table(table, "judge", name) if "judge" in table else None
    return Study(
        name=name,
        kind=str(kind),
        question=str(question),
        settings={key: value for key, value in table.items() if key not in PARTS},
        parts=_parts(table, name),
        judge=None if judge is None else {key: value for key, value in judge.items() if key != "matrix"},
        judge_axes=_axes({} if judge is None else _table(judge, "matrix", f"{name}, judge"), f"{name}, judge"),
        text=text,
    )


def _parts(table: Settings, name: str) -> tuple[Part, ...]:
    """The cases, or the study as a whole; and the ablations."""
    axes = _axes(_table(table, "matrix", name), name)
    shared = table.get("bisect")
    cases = _tables(table, "case", name)
    parts = [_part(case, axes, shared, name) for case in cases or [{}]]
    for number, entry in enumerate(_tables(table, "ablation", name)):
        title = str(entry.get("name", f"ablation {number + 1}" if number else "ablation"))
        values = _axes({key: value for key, value in entry.items() if key != "name"}, f"{name}, {title}")
        choices = tuple(
            Choice(label=f"{path} {choice.label}", settings=choice.settings)
            for path, several in values.items()
            for choice in several
        )
        parts.append(Part(name=title, settings={}, axes={**axes, "value": choices}))
    names = [part.name for part in parts]
    do = "give each case a name of its own"
    _check(len(set(names)) == len(names) and (not cases or "" not in names), f"case in {name}", "names", names, do)
    return tuple(parts)


def _part(case: Settings, axes: Axes, shared: Any, name: str) -> Part:
    where = f"{name}, case {case.get('name', '')}".rstrip()
    varied = {**axes, **_axes(_table(case, "matrix", where), where)}
    bisect = case.get("bisect", shared)
    bisected = ""
    if bisect is not None:
        good = isinstance(bisect, Mapping) and set(bisect) == {"field", "values"} and isinstance(bisect["field"], str)
        _check(good, f"bisect in {where}", "field and values", bisect, 'write field = "attack.eps", values = [1, 2]')
        bisected = bisect["field"]
        varied[bisected] = _choices(bisected, bisect["values"], where)
        numbers = [choice.label for choice in varied[bisected]]
        rising = all(isinstance(number, (int, float)) for number in numbers) and numbers == sorted(numbers)
        _check(rising, f"values of bisect in {where}", "rising numbers", numbers, "sort them")
    settings = {key: value for key, value in case.items() if key not in _OF_CASES}
    return Part(name=str(case.get("name", "")), settings=settings, axes=varied, bisected=bisected)


def combinations(settings: Settings, axes: Axes, part: str = "") -> Iterator[Point]:
    """Every combination of the values of some axes.

    Args:
        settings: What is changed.
        axes: What varies.
        part: Name of the part.
    """
    for choices in itertools.product(*axes.values()):
        point = settings
        for choice in choices:
            point = merged(point, choice.settings)
        labels = {name: choice.label for name, choice in zip(axes, choices, strict=True)}
        yield Point(part=part, labels=labels, settings=point)


def merged(settings: Any, changes: Any) -> Any:
    """Settings with changes: tables are put together, and of a list of tables one is changed by its name."""
    if isinstance(settings, Mapping) and isinstance(changes, Mapping):
        return {**settings, **{key: merged(settings.get(key), value) for key, value in changes.items()}}
    if isinstance(settings, list) and isinstance(changes, Mapping):
        names = [entry.get("name") if isinstance(entry, Mapping) else None for entry in settings]
        for key in changes:
            _check(key in names, "name", " or ".join(map(str, names)), key, nearest(key, map(str, names), "correct it"))
        return [
            merged(entry, changes.get(name, {})) if name in changes else entry
            for entry, name in zip(settings, names, strict=True)
        ]
    return changes


def _axes(table: Settings, where: str, above: str = "") -> dict[str, tuple[Choice, ...]]:
    """The axes of a table, by the path of what they set; "attack.eps" and eps in a table attack are the same."""
    axes: dict[str, tuple[Choice, ...]] = {}
    for key, values in table.items():
        path = f"{above}{key}"
        if isinstance(values, Mapping):
            axes |= _axes(values, where, f"{path}.")
        else:
            axes[path] = _choices(path, values, where)
    return axes


def _choices(path: str, values: Any, where: str) -> tuple[Choice, ...]:
    what = f"{path} in {where}"
    _check(isinstance(values, list) and values, what, "a list of one or more values", repr(values), "write [1, 2]")
    choices = tuple(_choice(path, value) for value in values)
    labels = [choice.label for choice in choices]
    _check(len(set(map(str, labels))) == len(labels), what, "values with different names", labels, "name each once")
    return choices


def _choice(path: str, value: Any) -> Choice:
    if isinstance(value, Mapping):
        settings = {key: entry for key, entry in value.items() if key != "name"}
        return Choice(label=str(value.get("name") or label_of(settings)), settings=settings)
    settings = value
    for key in reversed(path.split(".")):
        settings = {key: settings}
    return Choice(label=label_of(value), settings=settings)


def label_of(value: Any) -> Any:
    """What a value is called in a table: a number or a text."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {label_of(entry)}" for key, entry in value.items()) or "none"
    if isinstance(value, list):
        return " + ".join(str(label_of(entry)) for entry in value) or "none"
    return value


def _table(table: Settings, key: str, where: str) -> Settings:
    value = table.get(key, {})
    _check(isinstance(value, Mapping), f"{key} in {where}", "a table", repr(value), f"write [{key}] above its keys")
    return value if isinstance(value, Mapping) else {}


def _tables(table: Settings, key: str, where: str) -> Sequence[Settings]:
    value = table.get(key, [])
    good = isinstance(value, list) and all(isinstance(entry, Mapping) for entry in value)
    _check(good, f"{key} in {where}", "tables", repr(value), f"write [[{key}]] above each of them")
    return value if isinstance(value, list) else []


def _check(good: object, what: str, expected: str, got: object, do: str) -> None:
    if not good:
        raise InvalidValueError(message(what, expected, got, do))


def with_none(value: Any) -> Any:
    """Settings in which "none" has become None, at any depth: TOML has no word for it."""
    if isinstance(value, Mapping):
        return {key: with_none(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [with_none(entry) for entry in value]
    return None if value == "none" else value
