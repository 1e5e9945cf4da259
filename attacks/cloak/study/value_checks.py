"""Checks of the values of a study, whose errors name the section and the key."""

from __future__ import annotations

import math
from typing import Any

from mi_splat.errors import InvalidValueError, message, nearest


def in_range(where: str, value: float, lowest: float, highest: float) -> None:
    """Raise unless a number lies between two others.

    Args:
        where: Section and key, for the error.
        value: The number.
        lowest: Smallest number that is allowed.
        highest: Largest one; infinity sets no limit.

    Raises:
        InvalidValueError: It does not.
    """
    if not lowest <= value <= highest:
        expected = f"{lowest:g} or more" if highest == math.inf else f"{lowest:g} to {highest:g}"
        raise InvalidValueError(message(where, expected, value, "change it"))


def one_of(where: str, value: Any, known: Any) -> None:
    """Raise unless a value is one of those known, naming the nearest."""
    if value not in known:
        do = nearest(str(value), map(str, known), "choose one of them")
        raise InvalidValueError(message(where, " or ".join(map(str, known)), repr(value), do))
