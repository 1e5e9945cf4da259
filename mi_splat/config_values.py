"""Checks of what users pass: whole and finite numbers, one value or several; light, without torch."""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Collection, Iterable, Mapping
from numbers import Real
from typing import Any, TypeVar

from mi_splat.errors import InvalidValueError, message

_Value = TypeVar("_Value")
_NUMBERS = ("int", "int | None", "float", "float | None")


def check_numbers(config: object, least: Mapping[str, int] | None = None, *, skip: Collection[str] = ()) -> None:
    """Raise unless every number of a configuration is of the kind that its field says.

    Numbers of NumPy become Python's, so that the configuration can be written as JSON.

    Args:
        config: A frozen dataclass in a module that has `from __future__ import annotations`.
        least: Smallest value of a field, by its name; the others have no limit here.
        skip: Fields that are checked elsewhere.

    Raises:
        InvalidValueError: A value is no number, not whole where the field is an int, not finite, or too small.
    """
    for field in dataclasses.fields(config):  # type: ignore[arg-type]  # a dataclass, as said above
        value = getattr(config, field.name)
        if field.type not in _NUMBERS or field.name in skip or (value is None and "None" in field.type):
            continue
        low = (least or {}).get(field.name)
        read = whole_number if field.type.startswith("int") else finite_number
        object.__setattr__(config, field.name, read(field.name, value, least=low))


def check_decay(name: str, first: float, last: float) -> None:
    """Raise unless a number can decay exponentially: neither its first nor its last value, NAME_final, is 0.

    Raises:
        InvalidValueError: One of them is.
    """
    for which, value in ((name, first), (f"{name}_final", last)):
        if not value > 0:
            expected = "a number > 0, as it decays exponentially"
            raise InvalidValueError(message(which, expected, value, "1e-9 is next to nothing"))


def whole_number(name: str, value: Any, *, least: int | None = None) -> int:
    """A whole number as Python's int.

    Raises:
        InvalidValueError: It is something else (a bool or 2.0, too), or less than `least`.
    """
    try:
        found = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        found = None
    if found is None or (least is not None and found < least):
        if found is None:
            expected = "a whole number" + ("" if least is None else f" >= {least}")
            raise InvalidValueError(message(name, expected, repr(value), "pass an int"))
        raise InvalidValueError(message(name, f"a number >= {least}", found, "ask for more"))
    return found


def finite_number(name: str, value: Any, *, least: int | None = None) -> float:
    """A finite number; those of Python stay as they are, others become floats.

    Raises:
        InvalidValueError: It is something else, or less than `least`.
    """
    good = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if not good or (least is not None and value < least):
        expected = "a finite number" + ("" if least is None else f" >= {least}")
        raise InvalidValueError(message(name, expected, repr(value), "change it"))
    return value if type(value) in (int, float) else float(value)


def several(value: Any) -> tuple[Any, ...]:
    """One value or several as a tuple; a string is one value."""
    if hasattr(value, "tolist"):  # of NumPy or torch
        value = value.tolist()
    return tuple(value) if isinstance(value, Iterable) and not isinstance(value, str) else (value,)


def several_of(kind: type[_Value], what: str, value: object) -> tuple[_Value, ...]:
    """One value of a kind, or several, as a tuple.

    Args:
        kind: Its class.
        what: Name of the argument, for the error.
        value: One, or an iterable of them.

    Raises:
        InvalidValueError: Something else is among them.
    """
    found = several(value)
    for one in found:
        if not isinstance(one, kind):
            name = kind.__name__
            raise InvalidValueError(message(what, f"values of {name}", type(one).__name__, f"make a {name} of it"))
    return found
