"""A field of a configuration says once what it takes: its range, its unit, what its
values are called, what to do.

    eps: Annotated[float, at_least(0, "units of the file", "5 is the paper's")] = 5.0

The constructor reads it (`check`), the command line (`mi_splat.cli.flags`), and files
of studies (`decode`); all of them refuse a value in the same words. Light, without
torch.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import os
import types
import typing
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from mi_splat.errors import InvalidValueError, nearest

_Value = TypeVar("_Value")


class FieldError(InvalidValueError):
    """A value that a field does not take; `what` is the field's name, or where it
    stands in a file.
    """

    def at(self, name: str) -> FieldError:
        """The error with another name for the field, a flag for instance."""
        error = FieldError(f"{name}{str(self).removeprefix(self.what)}")
        error.what = name
        return error


@dataclass(frozen=True, slots=True, kw_only=True)
class Range:
    """The numbers that a field takes, each number of it if it takes several."""

    low: float = -math.inf  # the least, -inf for none
    # the greatest, inf for none; infinite numbers are never taken
    high: float = math.inf
    open_low: bool = False  # whether `low` itself is left out
    open_high: bool = False  # whether `high` itself is left out
    unit: str = ""  # what is counted or measured, in words
    do: str = "change it"  # what to do with another number

    def holds(self, value: float) -> bool:
        """Whether a field takes a number."""
        above_low = value > self.low if self.open_low else value >= self.low
        below_high = value < self.high if self.open_high else value <= self.high
        return math.isfinite(value) and above_low and below_high

    @property
    def bounds(self) -> str:
        """The numbers in signs: ">= 1" or "in (0, 1]"; empty for all."""
        low, high = (
            f"{bound:.0f}" if float(bound).is_integer() else f"{bound:g}"
            for bound in (self.low, self.high)
        )
        if math.isinf(self.high):
            if math.isinf(self.low):
                return ""
            return f"{'>' if self.open_low else '>='} {low}"
        return (
            f"in {'(' if self.open_low else '['}{low},"
            f" {high}{')' if self.open_high else ']'}"
        )

    def __str__(self) -> str:
        text = f"a number {self.bounds}".strip()
        if self.unit:
            return f"{text} ({self.unit})"
        return text


@dataclass(frozen=True, slots=True)
class Metavar:
    """What `--help` calls the values of a field, one word for each of them."""

    # for instance "X Y Z". A field without it takes the unit of its range, or what its
    # type says
    name: str


@dataclass(frozen=True, slots=True)
class Converter:
    """How a tuple, or a table, is read from and written as one word of the command
    line.
    """

    # the value of a word; raises ValueError, which says what was expected
    read: Callable[[str], Any]
    write: Callable[[Any], str]  # the word for a value


@dataclass(frozen=True, slots=True)
class Output:
    """The mark of a path to write: a scene of the package is none."""


def at_least(low: float, unit: str = "", do: str = "change it") -> Range:
    """The numbers from `low` on."""
    return Range(low=low, unit=unit, do=do)


def above(low: float, unit: str = "", do: str = "change it") -> Range:
    """The numbers greater than `low`."""
    return Range(low=low, open_low=True, unit=unit, do=do)


def between(low: float, high: float, unit: str = "", do: str = "change it") -> Range:
    """The numbers from `low` to `high`, both included."""
    return Range(low=low, high=high, unit=unit, do=do)


Fraction = Annotated[float, between(0, 1), Metavar("FRACTION")]
PositiveFraction = Annotated[
    float, Range(low=0, high=1, open_low=True), Metavar("FRACTION")
]
Share = Annotated[float, Range(low=0, high=1, open_high=True), Metavar("SHARE")]
Seed = Annotated[int, between(0, 2**31 - 1, do="0 is usual"), Metavar("SEED")]
Length = Annotated[float, above(0, "world units"), Metavar("LENGTH")]
Steps = Annotated[int, at_least(1, "steps")]
Count = Annotated[int, at_least(0)]
Degree = Annotated[int, between(0, 3, do="3 is what 3DGS writes"), Metavar("DEGREE")]
Folder = Annotated[Path, Metavar("FOLDER")]
OutFile = Annotated[Path, Output()]
OutFolder = Annotated[Folder, Output()]
Box = Annotated[
    tuple[float, float, float, float, float, float],
    Range(unit="world units"),
    Metavar("X0 Y0 Z0 X1 Y1 Z1"),
]
"""Lower and upper corner."""


EXAMPLES = Path(__file__).with_name("examples")
"""Scenes that are part of the package."""


def named_path(name: str | os.PathLike[str]) -> Path:
    """The path that a name stands for: itself, or that of a scene of the package for
    `example:SCENE`.
    """
    kind, _, scene = os.fspath(name).partition(":")
    if kind != "example":
        return Path(name)
    check_choice("example", scene, sorted(path.stem for path in EXAMPLES.glob("*.xml")))
    return EXAMPLES / f"{scene}.xml"


def check(config: object) -> None:
    """Raise unless every field of a configuration is of the type and in the range that
    it says.

    Values of NumPy become Python's, and lists tuples; one value stands for a tuple of
    it. Other types are left alone.
    """
    hints = type_hints(type(config))
    # a dataclass, as said above
    for field in dataclasses.fields(config):  # type: ignore[arg-type]
        value = getattr(config, field.name)
        kept = taken(hints[field.name], value, field.name)
        if kept is not value:
            object.__setattr__(config, field.name, kept)


@dataclass(frozen=True, slots=True, kw_only=True)
class Checked:
    """A configuration whose fields say all that is to be checked."""

    def __post_init__(self) -> None:
        check(self)


def decode(kind: type[_Value], table: Mapping[str, Any], where: str) -> _Value:
    """A frozen dataclass from a table of TOML or an object of JSON."""
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for key in table:
        check_choice(f"key in {where}", key, fields)
    for name, field in fields.items():
        has_default = (
            field.default is not dataclasses.MISSING
            or field.default_factory is not dataclasses.MISSING
        )
        if name not in table and not has_default:
            raise FieldError.of(where, f"the key {name}", "none", "add it")
    hints = type_hints(kind)
    values = {
        key: taken(hints[key], value, f"{where}, {key}", read=True)
        for key, value in table.items()
    }
    try:
        return kind(**values)
    except FieldError as error:
        raise error.at(f"{where}, {error.what}") from None


@cache
def _type_hints(kind: Hashable) -> dict[str, Any]:
    return typing.get_type_hints(kind, include_extras=True)


def type_hints(kind: type) -> dict[str, Any]:
    """The types of a dataclass's fields, with what they say of their values."""
    return _type_hints(kind)


class FieldType(NamedTuple):
    """What a field's annotation says."""

    kind: Any  # without `Annotated` and `None`
    marks: tuple[Any, ...]
    optional: bool  # whether it may be None
    origin: Any
    args: tuple[Any, ...]


@cache
def field_type(hint: Any) -> FieldType:
    """What the annotation of a field says."""
    marks: tuple[Any, ...] = ()
    optional = False
    while True:
        if typing.get_origin(hint) is Annotated:
            marks += hint.__metadata__[::-1]
            hint = hint.__origin__
            continue
        kinds = [kind for kind in typing.get_args(hint) if kind is not types.NoneType]
        if (
            typing.get_origin(hint) not in (typing.Union, types.UnionType)
            or len(kinds) > 1
        ):
            args = typing.get_args(hint)
            return FieldType(
                hint,
                marks,
                optional or types.NoneType in args,
                typing.get_origin(hint),
                args,
            )
        hint = kinds[0]
        optional = True


def check_choice(what: str, value: object, known: Collection[Any]) -> None:
    """Raise unless a value is one of those known, naming the nearest."""
    if value not in known:
        raise _unknown(what, value, known)


def _unknown(what: str, value: object, known: Iterable[Any]) -> FieldError:
    names = [str(choice) for choice in known]
    got = value if isinstance(value, str) and value else repr(value)
    return FieldError.of(
        what,
        f"one of {', '.join(names)}",
        got,
        nearest(str(value), names, "choose one of them"),
    )


def several(value: Any) -> tuple[Any, ...]:
    """One value or several as a tuple; a string is one value."""
    if type(value) is tuple:
        return value
    if hasattr(value, "tolist"):  # of NumPy or torch
        value = value.tolist()
    if isinstance(value, Iterable) and not isinstance(value, (str, Mapping)):
        return tuple(value)
    return (value,)


def several_of(kind: type[_Value], what: str, value: object) -> tuple[_Value, ...]:
    """One value of a kind, or several, as a tuple."""
    values = several(value)
    for item in values:
        if not isinstance(item, kind):
            name = kind.__name__
            raise InvalidValueError.of(
                what, f"values of {name}", type(item).__name__, f"make a {name} of it"
            )
    return values


def checked_number(
    name: str, value: Any, allowed: Range | None = None, *, whole: bool = False
) -> Any:
    """A number in a range."""
    if hasattr(value, "item") and getattr(value, "ndim", 0) == 0:  # of NumPy or torch
        value = value.item()
    is_number = type(value) in (int, float) or (
        isinstance(value, Real) and not isinstance(value, bool)
    )
    if not is_number or (whole and not hasattr(value, "__index__")):
        expected = str(allowed or Range())
        raise FieldError.of(
            name,
            expected.replace("a number", "a whole number") if whole else expected,
            repr(value),
            "change it",
        )
    number: Any = (
        operator.index(value)
        if whole
        else value
        if isinstance(value, (int, float))
        else float(value)
    )
    allowed = allowed or Range()
    if not allowed.holds(number):
        expected = str(allowed)
        if not math.isfinite(number) and math.inf in (allowed.high, -allowed.low):
            expected = expected.replace("a number", "a finite number", 1)
        raise FieldError.of(name, expected, number, allowed.do)
    return number


def taken(
    hint: Any, value: Any, name: str, marks: tuple[Any, ...] = (), *, read: bool = False
) -> Any:
    """A value as its field has it."""
    kind, own_marks, optional, origin, parts = field_type(hint)
    marks = own_marks or marks
    if value is None and optional:
        return None
    if origin in (typing.Union, types.UnionType):
        kind = _member(parts, value)
        if kind is None:
            return value
        return taken(kind, value, name, marks, read=read)
    if origin is Literal:
        value = value.item() if hasattr(value, "item") else value
        if type(value) not in map(type, parts) or value not in parts:
            raise _unknown(name, value, parts)
        return value
    if origin is Mapping and read and isinstance(value, Mapping):
        return {
            key: taken(parts[1], item, f"{name}, {key}", read=True)
            for key, item in value.items()
        }
    if origin is tuple:
        return _tuple(parts, value, name, marks, read=read)
    if dataclasses.is_dataclass(kind) and read:
        if not isinstance(value, Mapping):
            raise FieldError.of(
                name, "a table", repr(value), "write [section] above its keys"
            )
        return decode(typing.cast(type, kind), value, name)
    return _single(kind, value, name, marks)


def _tuple(
    parts: tuple[Any, ...], value: Any, name: str, marks: tuple[Any, ...], *, read: bool
) -> tuple[Any, ...]:
    """The values of a tuple, of so many or of any number."""
    count = None if parts[-1] is Ellipsis else len(parts)
    alone = count is None and not isinstance(value, Mapping)
    if alone or not read or isinstance(value, (list, tuple)):
        values = several(value)
    else:
        values = None
    if values is None or (count is not None and len(values) != count):
        if read:
            expected = "a list" if count is None else f"a list of {count}"
            do = "write it in brackets"
        else:
            expected = f"{count} values"
            do = "pass a tuple of them"
        raise FieldError.of(name, expected, repr(value), do)
    kinds = parts[:1] * len(values) if count is None else parts
    names = [
        f"{name} {item['name']!r}" if type(item) is dict and "name" in item else name
        for item in values
    ]
    return tuple(
        taken(kind, item, item_name, marks, read=read)
        for kind, item, item_name in zip(kinds, values, names, strict=True)
    )


def _member(parts: tuple[Any, ...], value: Any) -> Any:
    """The one of several types of a field that a value is checked by; None for a value
    that is left alone.

    A table is read as the first of several dataclasses that has all of its keys.
    """
    kinds = [part for part in parts if part is not types.NoneType]
    tables = [kind for kind in kinds if dataclasses.is_dataclass(kind)]
    if isinstance(value, Mapping) and tables:
        for table in tables:
            if value.keys() <= {field.name for field in dataclasses.fields(table)}:
                return table
        return tables[0]
    is_list = isinstance(value, (list, tuple)) or getattr(value, "ndim", 0) > 0
    listed = [
        kind for kind in kinds if typing.get_origin(field_type(kind).kind) is tuple
    ]
    if is_list and listed:
        return listed[0]
    plain = [kind for kind in kinds if field_type(kind).kind in (int, float)]
    if plain and len(plain) + len(listed) == len(kinds):
        return plain[0]
    return None


def _single(kind: Any, value: Any, name: str, marks: tuple[Any, ...]) -> Any:
    """One number, text, path or truth; anything else is left alone."""
    if kind in (int, float):
        allowed = next((mark for mark in marks if isinstance(mark, Range)), None)
        number = checked_number(name, value, allowed, whole=kind is int)
        if kind is float:
            return float(number)
        return number
    if kind is Path and isinstance(value, (str, os.PathLike)):
        if any(isinstance(mark, Output) for mark in marks) and os.fspath(
            value
        ).startswith("example:"):
            raise FieldError.of(
                name,
                "a path to write",
                f"the scene {value}",
                "name a file or folder of your own",
            )
        return named_path(value)
    if kind in (str, bool, Path) and not isinstance(value, kind):
        expected = {str: "a text", bool: "true or false", Path: "a path"}[kind]
        raise FieldError.of(name, expected, repr(value), "change it")
    return value
