"""A camera's values from what users have, NumPy's numbers and lists included; all else is refused in words."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError


def pose_tensor(value: object) -> Tensor:
    """A pose as float64 on the CPU, from a tensor, an array or nested lists."""
    try:
        return torch.as_tensor(value).detach().to("cpu", torch.float64)
    except (TypeError, ValueError, RuntimeError):
        got = f"{type(value).__name__} {value!r:.80}"
        raise InvalidValueError.of("to_world", "a (4, 4) matrix of numbers", got, "pass a tensor") from None


def focal_lengths(value: object) -> float | tuple[float, float]:
    """A focal length, or those of x and y; numbers and tuples of them stay as they are."""
    if isinstance(value, int | float):
        return value
    if isinstance(value, Sequence) or getattr(value, "ndim", 0) > 0:
        return two_numbers("focal", value)
    try:
        return float(value)  # type: ignore[arg-type]  # NumPy's and torch's numbers; the rest is refused
    except (TypeError, ValueError):
        raise InvalidValueError.of("focal", "one number or two", repr(value), "pass (fx, fy) in pixels") from None


def two_numbers(name: str, value: Any) -> tuple[float, float]:
    """Two numbers from any sequence of them."""
    try:
        x, y = value
        return (x, y) if isinstance(x, float) and isinstance(y, float) else (float(x), float(y))
    except (TypeError, ValueError):
        raise InvalidValueError.of(name, "two numbers", repr(value), "pass (x, y) in pixels") from None


def pixel_count(name: str, value: object) -> int:
    """A picture's width or height, from any kind of integer."""
    try:
        size = operator.index(value)  # type: ignore[arg-type]  # what is no integer is refused
    except TypeError:
        size = 0
    if not 0 < size <= 1 << 15:
        raise InvalidValueError.of(name, "an integer in 1..32768", value, "check the image size")
    return size


def check_points(**values: Sequence[float]) -> None:
    """Raise unless each value is three finite numbers."""
    for name, numbers in values.items():
        try:
            point = [float(number) for number in numbers]
        except (TypeError, ValueError):
            point = []
        if len(point) != 3:
            raise InvalidValueError.of(name, "three numbers", repr(numbers), "pass (x, y, z) in world units")
    check_finite(**values)


def check_finite(**values: Sequence[float]) -> None:
    """Raise unless all numbers are finite."""
    for name, numbers in values.items():
        if not all(math.isfinite(number) for number in numbers):
            shown = numbers[0] if len(numbers) == 1 else tuple(numbers)
            raise InvalidValueError.of(name, "finite numbers", shown, "pass world units and degrees")
