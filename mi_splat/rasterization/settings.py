"""The two settings of a picture that can be wrong, checked with the same words wherever they are given."""

import math
import numbers
from collections.abc import Sequence

from mi_splat.errors import InvalidValueError


def checked_near(value: float) -> float:
    """The distance, if it can be a near plane."""
    if not (isinstance(value, numbers.Real) and math.isfinite(value) and value > 0):
        raise InvalidValueError.of("near", "a positive distance", value, "pass world units, such as 0.2")
    return value


def checked_background(value: Sequence[float]) -> tuple[float, float, float]:
    """The colour, if it can be a background."""
    if len(value) != 3 or not all(math.isfinite(v) for v in value):
        raise InvalidValueError.of("background", "three finite numbers", value, "pass an sRGB colour")
    return value[0], value[1], value[2]
