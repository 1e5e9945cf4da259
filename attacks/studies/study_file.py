"""A study is one TOML file: settings, and what of them varies (docs/studies.md); light,
without torch.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError, nearest
from mi_splat.io.parsing import DocumentReader

KINDS: dict[str, tuple[str, str]] = {
    "dagger": ("attacks.studies.dagger", "DaggerWork"),
    "dagger-eot": ("attacks.studies.dagger", "DaggerWork"),
    "cloak": ("attacks.studies.cloak", "CloakWork"),
    "poison": ("attacks.studies.poison", "PoisonWork"),
    "compare": ("attacks.studies.compare", "CompareWork"),
}
"""Kinds of studies, and the `Work` that knows the settings and jobs of each."""

PARTS = ("study", "question", "matrix", "case", "bisect", "evaluate_with")
"""Keys of a file that are no settings."""
_OF_CASES = ("name", "matrix", "bisect")
Settings = Mapping[str, Any]
"""Tables in tables, as the file has them."""
Axes = Mapping[str, Mapping[Any, Settings]]
"""What varies, by name, the slowest first: what each value sets, by what tables call
it.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One combination of settings."""

    part: str = ""  # the case that it belongs to; empty for none
    labels: Mapping[str, Any]  # of every axis the label of its value
    settings: Settings  # all of them
    # the axis whose smallest value that suffices is looked for; empty for none
    bisected: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """What a file says."""

    name: str  # of the study, as of its file
    kind: str  # key of `KINDS`
    question: str = ""  # one sentence; empty for none
    # by case; points of a bisection with rising values
    parts: Mapping[str, Sequence[Point]]
    # how results are evaluated besides; none if only as attacked
    evaluations: Sequence[Point] = ()
    text: str = ""  # the file

    def of(self, names: Sequence[str]) -> Study:
        """The study with some of its parts alone; all if none is named."""
        for name in names:
            do = nearest(name, self.parts, "name one of these")
            _check(
                name in self.parts,
                f"part of {self.name}",
                " or ".join(self.parts),
                name,
                do,
            )
        if names:
            return dataclasses.replace(
                self, parts={name: self.parts[name] for name in names}
            )
        return self

    @property
    def named(self) -> dict[str, str]:
        """What its result says of the study."""
        return {"study": self.kind, "name": self.name, "question": self.question}

    @property
    def points(self) -> list[Point]:
        """Every combination of settings, part by part."""
        return [point for points in self.parts.values() for point in points]


def read_study(path: Path) -> Study:
    """The study in a TOML file."""
    if not path.is_file():
        raise InvalidValueError.of(
            "study", "a TOML file", f"no file {path}", "check the path"
        )
    table = DocumentReader(expected="a TOML file", do="correct it").read_toml(path)
    return study_of(table, path.stem, path.read_text("utf-8-sig"))


def study_of(table: Settings, name: str, text: str = "") -> Study:
    """The study in a table."""
    # the file of `mi-splat cloak`
    usual = "cloak" if isinstance(table.get("attack"), list) else None
    kind = table.get("study", usual)
    question = table.get("question", "")
    do = nearest(str(kind), KINDS, 'write for instance study = "dagger" first')
    _check(kind in [*KINDS], f"study in {name}", " or ".join(KINDS), repr(kind), do)
    _check(
        isinstance(question, str),
        f"question in {name}",
        "a sentence",
        question,
        "write it in quotes",
    )
    do = "rename the table"
    _check("judge" not in table, f"table in {name}", "evaluate_with", "judge", do)
    evaluation = _table(table, "evaluate_with", name)
    where = f"{name}, evaluate_with"
    evaluation_axes = _axes(_table(evaluation, "matrix", where), where)
    return Study(
        name=name,
        kind=str(kind),
        question=question,
        parts=_parts(table, name),
        evaluations=(
            _combinations(_without(evaluation, "matrix"), evaluation_axes)
            if "evaluate_with" in table
            else ()
        ),
        text=text,
    )


def _parts(table: Settings, name: str) -> dict[str, list[Point]]:
    settings = _without(table, *PARTS)
    axes = _axes(_table(table, "matrix", name), name)
    cases = _tables(table, "case", name)
    parts = [
        _case({"bisect": table.get("bisect"), **case}, settings, axes, name)
        for case in cases or [{}]
    ]
    names = [title for title, _ in parts]
    do = "give each case a name of its own"
    _check(
        len(set(names)) == len(names) and (not cases or "" not in names),
        f"case in {name}",
        "names",
        names,
        do,
    )
    return dict(parts)


def _case(
    case: Settings, settings: Settings, above: Axes, name: str
) -> tuple[str, list[Point]]:
    """The name of a case and its points, of the settings and axes above it and its
    own.
    """
    title = str(case.get("name", ""))
    bisect = case["bisect"]
    where = f"{name}, case {title}" if title else f"{name}, case"
    settings = merged(settings, _without(case, *_OF_CASES))
    axes = {**above, **_axes(_table(case, "matrix", where), where)}
    if bisect is None:
        return title, _combinations(settings, axes, title)
    good = (
        isinstance(bisect, Mapping)
        and set(bisect) == {"field", "values"}
        and isinstance(bisect["field"], str)
    )
    _check(
        good,
        f"bisect in {where}",
        "field and values",
        bisect,
        'write field = "attack.eps", values = [1, 2]',
    )
    field = bisect["field"]
    values = _axis(bisect["field"], bisect["values"], where)
    rising = all(isinstance(number, (int, float)) for number in values) and [
        *values
    ] == sorted(values)
    _check(
        rising, f"values of bisect in {where}", "rising numbers", [*values], "sort them"
    )
    return title, _combinations(
        settings, {**_without(axes, field), field: values}, title, field
    )


def _combinations(
    settings: Settings, axes: Axes, part: str = "", bisected: str = ""
) -> list[Point]:
    """Every combination of the values of some axes, the last one the fastest."""
    points = []
    for labels in itertools.product(*axes.values()):
        changed = settings
        for axis, label in zip(axes.values(), labels, strict=True):
            changed = merged(changed, axis[label])
        labelled = dict(zip(axes, labels, strict=True))
        points.append(
            Point(part=part, labels=labelled, settings=changed, bisected=bisected)
        )
    return points


def _without(table: Settings, *names: str) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key not in names}


def merged(settings: Any, changes: Any) -> Any:
    """Settings with changes: tables are put together, and of a list of tables one is
    changed by its name.
    """
    if isinstance(settings, Mapping) and isinstance(changes, Mapping):
        return {
            **settings,
            **{key: merged(settings.get(key), value) for key, value in changes.items()},
        }
    if isinstance(settings, list) and isinstance(changes, Mapping):
        names = [
            entry.get("name") if isinstance(entry, Mapping) else None
            for entry in settings
        ]
        for key in changes:
            _check(
                key in names,
                "name",
                " or ".join(map(str, names)),
                key,
                nearest(key, map(str, names), "correct it"),
            )
        return [
            merged(entry, changes.get(name, {})) if name in changes else entry
            for entry, name in zip(settings, names, strict=True)
        ]
    return changes


def _axes(
    table: Settings, where: str, above: str = ""
) -> dict[str, Mapping[Any, Settings]]:
    """The axes of a table, by the path of what they set; "attack.eps" and eps in a
    table attack are the same.
    """
    axes: dict[str, Mapping[Any, Settings]] = {}
    for key, values in table.items():
        path = f"{above}{key}"
        axes |= (
            _axes(values, where, f"{path}.")
            if isinstance(values, Mapping)
            else {path: _axis(path, values, where)}
        )
    return axes


def _axis(path: str, values: Any, where: str) -> dict[Any, Settings]:
    what = f"{path} in {where}"
    labels = list[Any]()
    axis = dict[Any, Settings]()
    _check(
        isinstance(values, list) and values,
        what,
        "a list of one or more values",
        repr(values),
        "write [1, 2]",
    )
    for value in values:
        sets: Any = value
        if isinstance(value, Mapping):
            sets = _without(value, "name")
            labels.append(str(value.get("name") or label_of(sets)))
        else:
            labels.append(label_of(value))
            for key in reversed(path.split(".")):
                sets = {key: sets}
        axis[labels[-1]] = sets
    _check(
        len({*map(str, axis)}) == len(values),
        what,
        "values with different names",
        labels,
        "name each once",
    )
    return axis


def label_of(value: Any) -> Any:
    """What a value is called in a table: a number or a text."""
    if isinstance(value, Mapping):
        return (
            ", ".join(f"{key} {label_of(entry)}" for key, entry in value.items())
            or "none"
        )
    if isinstance(value, list):
        return " + ".join(str(label_of(entry)) for entry in value) or "none"
    return value


def _table(table: Settings, key: str, where: str) -> Settings:
    value = table.get(key, {})
    _check(
        isinstance(value, Mapping),
        f"{key} in {where}",
        "a table",
        repr(value),
        f"write [{key}] above its keys",
    )
    if isinstance(value, Mapping):
        return value
    return {}


def _tables(table: Settings, key: str, where: str) -> Sequence[Settings]:
    value = table.get(key, [])
    good = isinstance(value, list) and all(
        isinstance(entry, Mapping) for entry in value
    )
    _check(
        good,
        f"{key} in {where}",
        "tables",
        repr(value),
        f"write [[{key}]] above each of them",
    )
    if isinstance(value, list):
        return value
    return []


def _check(good: object, what: str, expected: str, got: object, do: str) -> None:
    if not good:
        raise InvalidValueError.of(what, expected, got, do)


def with_none(value: Any) -> Any:
    """Settings in which "none" has become None, at any depth: TOML has no word for
    it.
    """
    if isinstance(value, Mapping):
        return {key: with_none(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [with_none(entry) for entry in value]
    if value == "none":
        return None
    return value
