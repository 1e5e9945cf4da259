"""The settings of `splat_tile`: plain values from whatever a user gives, and Dr.Jit arrays for `mi.traverse`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mi_splat.errors import InvalidValueError, message
from mi_splat.rasterization.settings import checked_background, checked_near

_DISTANCE, _COLOUR, _SWITCH = "a positive distance", "three finite numbers", "true or false"


@dataclass(frozen=True, slots=True)
class Setting:
    """One parameter of the integrator.

    Attributes:
        default: Its value where none is given.
        checked: (any value) -> its plain value; raises InvalidValueError if it cannot be one.
        array: (plain value) -> Dr.Jit array of the current variant.
    """

    default: Any
    checked: Callable[[Any], Any]
    array: Callable[[Any], Any]


def _numbers(name: str, expected: str, value: Any) -> list[float]:
    """All numbers in a plain, NumPy or Dr.Jit value."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidValueError(message(name, expected, repr(value), "give numbers")) from None
    return [float(v) for v in np.ravel(array)]


def _near(value: Any) -> float:
    numbers = _numbers("near", _DISTANCE, value)
    if len(numbers) != 1:
        raise InvalidValueError(message("near", _DISTANCE, numbers, "give one number"))
    return checked_near(numbers[0])


def _background(value: Any) -> tuple[float, float, float]:
    numbers = _numbers("background", _COLOUR, value)
    return checked_background(numbers * 3 if len(numbers) == 1 else numbers)


def _switch(name: str, value: Any) -> bool:
    numbers = _numbers(name, _SWITCH, value)
    if len(numbers) != 1 or numbers[0] not in (0.0, 1.0):
        raise InvalidValueError(message(name, _SWITCH, value, "give a boolean"))
    return bool(numbers[0])


SETTINGS = {
    "background": Setting((0.0, 0.0, 0.0), _background, lambda value: mi.Color3f(value)),
    "near": Setting(0.2, _near, lambda value: mi.Float(value)),
    "alpha": Setting(False, lambda value: _switch("alpha", value), lambda value: mi.Bool(value)),
    "linear": Setting(False, lambda value: _switch("linear", value), lambda value: mi.Bool(value)),
}
"""By name; the table in `tile` says what each means."""
